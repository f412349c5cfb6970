"""Hearing thresholds of an ear: as a value, as tensors, in tables, as a picture."""

from hlsim.audiogram.value import (
    FREQUENCIES,
    HIGHEST_LEVEL,
    LOWEST_LEVEL,
    SEVERITIES,
    SEVERITY_LIMITS,
    STANDARD,
    Audiogram,
    severity_index,
)

__all__ = [
    "FREQUENCIES",
    "HIGHEST_LEVEL",
    "LOWEST_LEVEL",
    "SEVERITIES",
    "SEVERITY_LIMITS",
    "STANDARD",
    "Audiogram",
    "severity_index",
]
