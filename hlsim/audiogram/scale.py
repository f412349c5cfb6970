"""Frequencies and ranges of thresholds, severities of hearing loss, and standard audiograms."""

from typing import Literal

EarName = Literal["left", "right"]

EARS: tuple[EarName, EarName] = ("left", "right")

EAR_NAMES: dict[str, EarName] = {
    "l": "left",
    "le": "left",
    "lt": "left",
    "left": "left",
    "r": "right",
    "re": "right",
    "rt": "right",
    "right": "right",
}
"""Texts for an ear in a table, in lower case."""

FREQUENCIES = (250.0, 500.0, 1000.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)
"""The eight audiometric frequencies in Hz at which networks, losses and aids take thresholds."""

LOWEST_HZ, HIGHEST_HZ = 100.0, 20000.0
"""Range of the frequencies in Hz at which an audiogram may have thresholds."""

LOWEST_LEVEL, HIGHEST_LEVEL = -10.0, 120.0
"""Range of the thresholds of an audiogram in dB HL."""

HIGHEST_SIMULATED = 100.0
"""Highest threshold in dB HL that a simulator accepts. MSBG divides by 0 at 105 dB HL."""

SEVERITIES = ("none", "mild", "moderate", "severe")
"""MSBG's severities of loss, by the mean threshold from 2 to 8 kHz."""

SEVERITY_LIMITS = (15.0, 35.0, 56.0)
"""Mean thresholds in dB HL above which a loss is mild, moderate and severe (pyclarity 0.9.0)."""

WHO_GRADES = {
    "normal": 20.0,
    "mild": 35.0,
    "moderate": 50.0,
    "moderately severe": 65.0,
    "severe": 80.0,
    "profound": 95.0,
    "complete": float("inf"),
}
"""Pure-tone average in dB HL below which each of WHO's grades of hearing loss ends (2021)."""

# Bisgaard, Vlaming, Dahlquist 2010, Trends in Amplification 14(2), doi 10.1177/1084713810379609,
# Tables 1 and 2, at the frequencies above. The tables end at 6 kHz; 8 kHz repeats that threshold.
STANDARD = {
    "NH": (0, 0, 0, 0, 0, 0, 0, 0),
    "N1": (10, 10, 10, 15, 20, 30, 40, 40),
    "N2": (20, 20, 25, 35, 40, 45, 50, 50),
    "N3": (35, 35, 40, 50, 55, 60, 65, 65),
    "N4": (55, 55, 55, 65, 70, 75, 80, 80),
    "N5": (65, 70, 75, 80, 80, 80, 80, 80),
    "N6": (75, 80, 85, 90, 95, 100, 100, 100),
    "N7": (90, 95, 105, 105, 105, 105, 105, 105),
    "S1": (10, 10, 10, 15, 30, 55, 70, 70),
    "S2": (20, 20, 25, 55, 75, 95, 95, 95),
    "S3": (30, 35, 60, 75, 80, 80, 85, 85),
}
