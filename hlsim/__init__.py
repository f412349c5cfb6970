"""Hear through an impaired ear, and backpropagate through it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hlsim.version import __version__ as __version__

if TYPE_CHECKING:
    from hlsim.audiogram import Audiogram
    from hlsim.audiogram.listener import Listener
    from hlsim.losses.haspi_loss import HASPILoss
    from hlsim.losses.hearing_loss import HearingLossLoss
    from hlsim.msbg import MSBG, estimate_delay
    from hlsim.neuro import NeuroMSBG
    from hlsim.pretrained import list_pretrained, load_pretrained


__all__ = [
    "MSBG",
    "Audiogram",
    "HASPILoss",
    "HearingLossLoss",
    "Listener",
    "NeuroMSBG",
    "estimate_delay",
    "list_pretrained",
    "load_pretrained",
]

# imported when asked for, so that the program's help and its refusals do not wait for torch
_MODULES = {
    "MSBG": "hlsim.msbg",
    "Audiogram": "hlsim.audiogram",
    "HASPILoss": "hlsim.losses.haspi_loss",
    "HearingLossLoss": "hlsim.losses.hearing_loss",
    "Listener": "hlsim.audiogram.listener",
    "NeuroMSBG": "hlsim.neuro",
    "estimate_delay": "hlsim.msbg",
    "list_pretrained": "hlsim.pretrained",
    "load_pretrained": "hlsim.pretrained",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
