"""Published tables, whose numbers are in ``published.json``.

Those over frequency are dicts from the frequency in Hz to a value.
"""

from pathlib import Path
from typing import Any

from hlsim.files import read_json

_TABLES = read_json(Path(__file__).with_suffix(".json"))


def _over_frequency(name: str) -> dict[int, Any]:
    """Return a table of the file by frequency in Hz, with numbers instead of texts as keys."""
    return {int(hz): value for hz, value in _TABLES[name].items()}


STANDARD = {name: tuple(levels) for name, levels in _TABLES["standard_audiograms"].items()}
"""Thresholds of the standard audiograms in dB HL at the eight audiometric frequencies.

The source is Bisgaard, Vlaming, Dahlquist 2010, Trends in Amplification 14(2), doi
10.1177/1084713810379609, tables 1 and 2, except for NH. The tables end at 6 kHz; 8 kHz repeats that
threshold.
"""

SPEECH_SPECTRUM = _over_frequency("speech_spectrum")
"""Level in dB SPL of each third of an octave in speech at 70 dB SPL, the mean of men and women.

The source is Byrne et al. 1994, Journal of the Acoustical Society of America 96(4).
"""

FREE_FIELD_THRESHOLD_SPL = _over_frequency("free_field_threshold")
"""Level in dB SPL of 0 dB HL, for tones in a free field from the front: ISO 389-7:2005."""

CAMBRIDGE_INTERCEPTS = _over_frequency("cambridge_intercepts")
"""Constant of the Cambridge formula in dB; above 5 kHz it stays the same."""

PRESCRIPTION_TABLES = _TABLES["prescriptions"]
"""Constants in dB of NAL-R and NAL-RP, by name.

``nalr_bias`` belongs to the formula at 250, 500, 1000, 2000, 4000 and 6000 Hz, ``nalrp_bias`` to
that at ``NALRP_FREQUENCIES``. ``nalrp_corrections`` are those for profound losses (1991, Figure 9):
the rows are thresholds of 90, 95, ... 120 dB HL at 2 kHz, the columns ``NALRP_FREQUENCIES``.
"""

SII_TABLE = _over_frequency("sii")
"""Third octaves of the speech intelligibility index: ANSI S3.5-1997, table 3.

The columns are the importance of the band, 1 in sum, and two spectrum levels in dB SPL per Hz: of
speech of normal vocal effort, and of the internal noise of a normal ear.
"""
