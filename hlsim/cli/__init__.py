"""The program ``hlsim``: modules that declare the options of its commands and call the library."""
