"""Numbers of signals: scores and errors, without files."""
