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
    from hlsim.losses.hearing_loss import HASPILoss, HearingLossLoss
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
_NAMES = {
    "compensators": (
        "NALR WDRC HearingAid MappingCompensator load_compensator save_compensator".split()
    ),
    "hlsim.audiogram": ["Audiogram"],
    "hlsim.audiogram.listener": ["Listener"],
    "hlsim.audiogram.table": ["read_audiograms"],
    "hlsim.checkpoint": ["list_pretrained"],
    "hlsim.losses.hearing_loss": ["HASPILoss", "HearingLossLoss"],
    "hlsim.msbg": ["MSBG", "estimate_delay"],
    "hlsim.neuro": ["NeuroMSBG", "load_pretrained"],
    "hlsim.shortcuts": "compensate example_speech info listen load_audio simulate".split(),
}
"""Public names by the module that defines them."""


def __getattr__(name: str) -> Any:
    for module, names in _NAMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(module), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
