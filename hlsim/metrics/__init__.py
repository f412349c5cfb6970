"""Measures of signals: scores and errors, without files."""

from importlib.util import find_spec
from typing import Any

from hlsim.metrics.haaqi_score import HaaqiReference, haaqi
from hlsim.metrics.haspi_score import HaspiReference, haspi
from hlsim.metrics.hasqi_score import HasqiReference, hasqi
from hlsim.metrics.mbstoi_score import mbstoi

_TORCHMETRICS = ["HAAQI", "HASPI", "HASQI", "MBSTOI"]

__all__ = [
    "HaaqiReference",
    "HaspiReference",
    "HasqiReference",
    "haaqi",
    "haspi",
    "hasqi",
    "mbstoi",
]
if find_spec("torchmetrics"):  # torchmetrics belongs to an extra
    __all__ += _TORCHMETRICS


def __getattr__(name: str) -> Any:
    if name in _TORCHMETRICS:
        from hlsim.metrics import torchmetric

        return getattr(torchmetric, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
