"""Compensators: modules that turn a waveform and an audiogram into the output of a hearing aid."""

from compensators.config import HearingAidConfig, MappingConfig
from compensators.hearing_aid import HearingAid
from compensators.loading import load_compensator, save_compensator, trained_for
from compensators.mapping import MappingCompensator
from compensators.nalr import NALR, NALRP
from compensators.wdrc import CAMFIT, WDRC

__all__ = [
    "CAMFIT",
    "NALR",
    "NALRP",
    "WDRC",
    "HearingAid",
    "HearingAidConfig",
    "MappingCompensator",
    "MappingConfig",
    "load_compensator",
    "save_compensator",
    "trained_for",
]
