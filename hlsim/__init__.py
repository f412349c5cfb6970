"""Hear through an impaired ear, and backpropagate through it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hlsim.version import __version__ as __version__

if TYPE_CHECKING:
    from compensators import (
        NALR,
        WDRC,
        HearingAid,
        MappingCompensator,
        load_compensator,
        save_compensator,
    )
    from hlsim.audiogram import Audiogram
    from hlsim.audiogram.listener import Listener
    from hlsim.audiogram.table import read_audiograms
    from hlsim.checkpoint import list_pretrained
    from hlsim.losses.haspi_loss import HASPILoss
    from hlsim.losses.hearing_loss import HearingLossLoss
    from hlsim.msbg import MSBG, estimate_delay
    from hlsim.neuro import NeuroMSBG, load_pretrained
    from hlsim.shortcuts import compensate, example_speech, info, listen, load_audio, simulate


__all__ = [
    "MSBG",
    "NALR",
    "WDRC",
    "Audiogram",
    "HASPILoss",
    "HearingAid",
    "HearingLossLoss",
    "Listener",
    "MappingCompensator",
    "NeuroMSBG",
    "compensate",
    "estimate_delay",
    "example_speech",
    "info",
    "list_pretrained",
    "listen",
    "load_audio",
    "load_compensator",
    "load_pretrained",
    "read_audiograms",
    "save_compensator",
    "simulate",
]

# A name is imported when it is first used, so that the command line's help does not wait for torch.
_MODULES = {
    "MSBG": "hlsim.msbg",
    "NALR": "compensators",
    "WDRC": "compensators",
    "Audiogram": "hlsim.audiogram",
    "HASPILoss": "hlsim.losses.haspi_loss",
    "HearingAid": "compensators",
    "HearingLossLoss": "hlsim.losses.hearing_loss",
    "Listener": "hlsim.audiogram.listener",
    "MappingCompensator": "compensators",
    "NeuroMSBG": "hlsim.neuro",
    "compensate": "hlsim.shortcuts",
    "estimate_delay": "hlsim.msbg",
    "example_speech": "hlsim.shortcuts",
    "info": "hlsim.shortcuts",
    "list_pretrained": "hlsim.checkpoint",
    "listen": "hlsim.shortcuts",
    "load_audio": "hlsim.shortcuts",
    "load_compensator": "compensators",
    "load_pretrained": "hlsim.neuro",
    "read_audiograms": "hlsim.audiogram.table",
    "save_compensator": "compensators",
    "simulate": "hlsim.shortcuts",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
