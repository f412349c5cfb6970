"""Numbers of signals: scores and errors, without files."""

from typing import Any

from hlsim.metrics.haspi_score import HaspiReference, haspi
from hlsim.metrics.hasqi_score import HasqiParts, HasqiReference, hasqi
from hlsim.metrics.mbstoi_score import mbstoi

__all__ = [
    "HASPI",
    "HASQI",
    "HaspiReference",
    "HasqiParts",
    "HasqiReference",
    "haspi",
    "hasqi",
    "mbstoi",
]


def __getattr__(name: str) -> Any:
    if name in ("HASPI", "HASQI"):  # torchmetrics is an extra
        from hlsim.metrics import torchmetric

        return getattr(torchmetric, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
