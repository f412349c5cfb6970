"""The teacher: the simulator whose output a network learns."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import set_level
from hlsim.checks import check_names, check_rate
from hlsim.dsp.resample import resample
from hlsim.msbg import MSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.plugins import WaveformPlugin

TEACHERS = ("msbg",)

Reference = Callable[[Tensor, Tensor, int], Tensor]
"""A simulator in place of the exact MSBG: (items, time) in pascals, (items, 8) in dB HL and the
sample rate in Hz -> (items, time)."""


class PluginTeacher:
    """A simulator ``(waveform, audiogram) -> waveform`` of your own, as a ``Reference``.

    It receives (items, time) in pascals at its attribute ``sample_rate``, 16000 Hz if it has none,
    and (items, 8) in dB HL, and returns the perceived signals, time-aligned with its input.

    Args:
        name: As for ``load_plugin``.

    Raises:
        ValueError: As ``WaveformPlugin``, the sample rate is out of range, or the output for half a
            second of noise and an ear without a loss is no such waveform.
    """

    def __init__(self, name: str) -> None:
        self.plugin = WaveformPlugin(name, "teacher")
        try:
            rate = check_rate(getattr(self.plugin.function, "sample_rate", NEURO_RATE))
        except ValueError as error:
            raise ValueError(f"teacher {name}: {error}") from error
        self.sample_rate = rate
        noise = torch.randn(1, rate // 2, generator=torch.Generator().manual_seed(0))
        self.plugin.check_aligned(set_level(noise, 65.0), rate, torch.zeros(1, len(FREQUENCIES)))

    def __str__(self) -> str:
        return str(self.plugin)

    def __call__(self, signals: Tensor, thresholds: Tensor, sample_rate: int) -> Tensor:
        """Perceived signals. Shape: (items, time) in pascals, (items, 8) in dB HL -> (items, time)."""
        perceived = self.plugin(resample(signals, sample_rate, self.sample_rate), thresholds)
        return resample(perceived, self.sample_rate, sample_rate)[..., : signals.shape[-1]]


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
        """Perceived signals. Shape: (items, time) in pascals, (items, 8) in dB HL -> (items, time)."""
        if self.reference is not None:
            return self.reference(signals, thresholds, self.sample_rate)
        perceived: Tensor = self.msbg(signals, thresholds)
        return perceived


def find_teacher(name: str) -> PluginTeacher | None:
    """The teacher with a name: None for ``msbg``, the exact one, or a plug-in.

    Raises:
        ValueError: There is no such teacher.
    """
    if ":" in name:
        return PluginTeacher(name)
    check_names([name], (*TEACHERS, "package.module:name"), "teachers")
    return None


def name_of(reference: Reference | None) -> str:
    """Name of a teacher, with the fingerprint of a plug-in."""
    return "msbg" if reference is None else str(getattr(reference, "__name__", reference))
