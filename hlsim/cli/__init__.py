"""The program ``hlsim``: a module a command, which joins what computes to what presents."""
