"""The bundled speech, in the folder ``speech``."""
