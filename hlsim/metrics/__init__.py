"""Numbers of signals: scores and errors, without files."""

from typing import Any

from hlsim.metrics.haspi import HaspiReference, haspi
from hlsim.metrics.hasqi import HasqiParts, HasqiReference, hasqi

__all__ = ["HASPI", "HaspiReference", "HasqiParts", "HasqiReference", "haspi", "hasqi"]


def __getattr__(name: str) -> Any:
    if name == "HASPI":  # torchmetrics is an extra
        from hlsim.metrics.torchmetric import HASPI

        return HASPI
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
