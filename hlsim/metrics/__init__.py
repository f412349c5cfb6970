"""Measures of signals: scores and errors, without files."""

from typing import Any

from hlsim.metrics.haaqi_score import HaaqiReference, haaqi
from hlsim.metrics.haspi_score import HaspiReference, haspi
from hlsim.metrics.hasqi_score import HasqiParts, HasqiReference, hasqi
from hlsim.metrics.mbstoi_score import mbstoi

__all__ = [
    "HAAQI",
    "HASPI",
    "HASQI",
    "HaaqiReference",
    "HaspiReference",
    "HasqiParts",
    "HasqiReference",
    "haaqi",
    "haspi",
    "hasqi",
    "mbstoi",
]


def __getattr__(name: str) -> Any:
    if name in ("HAAQI", "HASPI", "HASQI"):  # torchmetrics belongs to an extra
        from hlsim.metrics import torchmetric

        return getattr(torchmetric, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
