"""Paths of the synthetic speech and of the spoken digits that hlsim ships.

>>> EXAMPLE_FILE.name
'flite-rms-01.flac'
"""

from pathlib import Path

SPEECH = Path(__file__).parent / "speech"
"""Folder of bundled speech at 16 kHz, with the parts ``train`` and ``valid``."""

EXAMPLE_FILE = SPEECH / "valid" / "flite-rms-01.flac"
"""Utterance of the examples."""

DIGITS = Path(__file__).parent / "digits"
"""Folder of spoken digits at 16 kHz: one file per voice, with the digits 0 to 9 in equal slots."""

SLOT_SAMPLES = 12000
"""Length of the slot of a digit in samples at 16 kHz, 0.75 s. Speech begins 50 ms into it."""

DIGIT_DBFS = -26.0
"""RMS level of each digit, without the silence around it, in dB relative to full scale."""
