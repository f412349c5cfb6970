"""Hearing thresholds of ears: as values, as tensors, in tables and as plots."""

from hlsim.audiogram.scale import (
    FREQUENCIES,
    HIGHEST_LEVEL,
    HIGHEST_SIMULATED,
    LOWEST_LEVEL,
    SEVERITIES,
    SEVERITY_LIMITS,
    STANDARD,
)
from hlsim.audiogram.value import Audiogram, severity_index

__all__ = [
    "FREQUENCIES",
    "HIGHEST_LEVEL",
    "HIGHEST_SIMULATED",
    "LOWEST_LEVEL",
    "SEVERITIES",
    "SEVERITY_LIMITS",
    "STANDARD",
    "Audiogram",
    "severity_index",
]
