"""Hearing thresholds of ears: as values, as tensors, in tables and as plots.

A threshold is the lowest level in dB HL (relative to normal hearing) at which an ear hears a tone
of a frequency; a higher threshold is a greater loss. An *ear* is one audiogram, a *listener* has
two.

Wherever an ear is expected, an ``Audiogram``, a name such as ``"N3"``, eight thresholds or a dict
of frequencies to thresholds will do.
"""

from hlsim.audiogram.published import STANDARD
from hlsim.audiogram.scale import (
    FREQUENCIES,
    HIGHEST_LEVEL,
    HIGHEST_SIMULATED,
    LOWEST_LEVEL,
    SEVERITIES,
)
from hlsim.audiogram.value import Audiogram, as_audiogram, severity_index

__all__ = [
    "FREQUENCIES",
    "HIGHEST_LEVEL",
    "HIGHEST_SIMULATED",
    "LOWEST_LEVEL",
    "SEVERITIES",
    "STANDARD",
    "Audiogram",
    "as_audiogram",
    "severity_index",
]
