"""The teacher: the simulator whose output a network learns."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.checks import refuse_unknown
from hlsim.data.foreign import ForeignTeacher, load_teacher
from hlsim.metrics.reference import pyclarity_msbg
from hlsim.msbg import MSBG

TEACHERS = ("msbg", "pyclarity")

Reference = Callable[[Tensor, Audiogram, int], Tensor] | ForeignTeacher
"""Another simulator than the exact MSBG: of one signal and one ear, as ``pyclarity_msbg``, or a loaded one."""


class Teacher(nn.Module):
    """The exact MSBG, or another simulator, time-aligned with its input.

    Args:
        sample_rate: sample rate of the signals in Hz.
        reference: simulator to use instead of the exact MSBG.
    """

    def __init__(self, sample_rate: int, reference: Reference | None = None) -> None:
        super().__init__()
        self.sample_rate = sample_rate
        self.reference = reference
        self.msbg = MSBG(sample_rate=sample_rate)

    @torch.no_grad()
    def forward(self, signals: Tensor, thresholds: Tensor) -> Tensor:
        """Perceived signals. Shape: (items, time) in pascals, (items, 8) dB HL -> (items, time)."""
        reference = self.reference
        if reference is None:
            perceived: Tensor = self.msbg(signals, thresholds)
            return perceived
        if isinstance(reference, ForeignTeacher):
            return reference(signals, thresholds, self.sample_rate)
        outputs = []
        for signal, levels in zip(signals, thresholds, strict=True):
            ear = Audiogram(tuple(levels.tolist()))
            outputs.append(reference(signal.cpu(), ear, self.sample_rate))
        return torch.stack(outputs).to(signals)


def find_teacher(name: str) -> Reference | None:
    """The simulator with a name: None for ``msbg``, the exact one; pyclarity's; or ``package.module:name``.

    Raises:
        ValueError: there is no such teacher.
    """
    if ":" in name:
        return load_teacher(name)
    refuse_unknown([name], (*TEACHERS, "package.module:name"), "teachers")
    return None if name == "msbg" else pyclarity_msbg


def name_of(reference: Reference | None) -> str:
    """Name of a teacher, different for different simulators."""
    return "msbg" if reference is None else str(getattr(reference, "__name__", reference))
