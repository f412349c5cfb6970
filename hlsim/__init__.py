"""Hear through an impaired ear, and backpropagate through it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hlsim.version import __version__ as __version__

if TYPE_CHECKING:
    from compensators import (
        CAMFIT as CAMFIT,
        NALR as NALR,
        NALRP as NALRP,
        WDRC as WDRC,
        HearingAid as HearingAid,
        MappingCompensator as MappingCompensator,
        load_compensator as load_compensator,
        save_compensator as save_compensator,
    )
    from hlsim.audiogram import Audiogram as Audiogram
    from hlsim.audiogram.listener import Listener as Listener
    from hlsim.audiogram.table import (
        read_audiograms as read_audiograms,
        read_listeners as read_listeners,
    )
    from hlsim.checkpoint import list_pretrained as list_pretrained
    from hlsim.data.mixing import mix as mix
    from hlsim.evaluation.digits import reception_threshold as reception_threshold
    from hlsim.losses.hearing_loss import HASPILoss as HASPILoss, HearingLossLoss as HearingLossLoss
    from hlsim.msbg import MSBG as MSBG, estimate_delay as estimate_delay
    from hlsim.neuro import NeuroMSBG as NeuroMSBG, load_pretrained as load_pretrained
    from hlsim.shortcuts import (
        compensate as compensate,
        example_speech as example_speech,
        info as info,
        listen as listen,
        load_audio as load_audio,
        simulate as simulate,
    )

# A name is imported when it is first used, so that the command line's help does not wait for torch.
_NAMES = {
    "compensators": (
        "CAMFIT NALR NALRP WDRC HearingAid MappingCompensator load_compensator save_compensator"
    ),
    "hlsim.audiogram": "Audiogram",
    "hlsim.audiogram.listener": "Listener",
    "hlsim.audiogram.table": "read_audiograms read_listeners",
    "hlsim.checkpoint": "list_pretrained",
    "hlsim.data.mixing": "mix",
    "hlsim.evaluation.digits": "reception_threshold",
    "hlsim.losses.hearing_loss": "HASPILoss HearingLossLoss",
    "hlsim.msbg": "MSBG estimate_delay",
    "hlsim.neuro": "NeuroMSBG load_pretrained",
    "hlsim.shortcuts": "compensate example_speech info listen load_audio simulate",
}
"""Public names by the module from which they are imported."""

_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names.split()}

_MODULES = (
    "audio audiogram calibration checkpoint data dsp evaluation export losses metrics msbg neuro "
    "report simulators training"
).split()
"""Modules that need not be imported by a statement of their own."""

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"hlsim.{name}")
    if name in _MODULE_OF:
        value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES, "__version__"])
