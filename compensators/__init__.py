"""Compensators: modules that turn a waveform and an audiogram into what the ear is to be given."""

from compensators.config import MappingConfig
from compensators.mapping import MappingCompensator
from compensators.nalr import NALR
from compensators.pretrained import load_compensator, save_compensator, trained_for

__all__ = [
    "NALR",
    "MappingCompensator",
    "MappingConfig",
    "load_compensator",
    "save_compensator",
    "trained_for",
]
