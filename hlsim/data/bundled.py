"""Paths of the synthetic speech that hlsim ships.

>>> EXAMPLE_FILE.name
'flite-rms-01.flac'
"""

from pathlib import Path

SPEECH = Path(__file__).parent / "speech"
"""Folder of bundled speech at 16 kHz, with the parts ``train`` and ``valid``."""

EXAMPLE_FILE = SPEECH / "valid" / "flite-rms-01.flac"
"""Utterance of the examples."""
