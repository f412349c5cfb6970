"""Kates' ear, which HASPI and HASQI hear with: from clean and processed speech to what they compare."""
