"""The teacher: the simulator whose output a network learns."""

from __future__ import annotations

import torch
from torch import Tensor

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.neuro.config import NEURO_RATE
from hlsim.plugins import WaveformPlugin


class PluginTeacher:
    """Teacher that calls a user's simulator of hearing loss.

    The simulator is a function ``(waveform, audiogram) -> waveform``, or a class whose objects can
    be called in this way and which is constructed without arguments. The simulator receives signals
    in pascals with shape (items, time) and thresholds in dB HL with shape (items, 8), and returns
    the perceived signals, time-aligned with its input. The sample rate is its attribute
    ``sample_rate`` or else 16000 Hz.

    Args:
        name: ``package.module:name`` or ``path/to/file.py:name``, see ``load_plugin``.

    Raises:
        ValueError: There is no such simulator, or its output for half a second of noise has another
            shape, is delayed or is not finite.

    >>> teacher = PluginTeacher("hlsim:MSBG")
    >>> teacher(0.02 * torch.randn(1, 16000), torch.zeros(1, 8)).shape
    torch.Size([1, 16000])
    """

    def __init__(self, name: str) -> None:
        self.plugin = WaveformPlugin(name, "teacher")
        self.sample_rate = rate = getattr(self.plugin.function, "sample_rate", NEURO_RATE)
        noise = torch.randn(1, rate // 2, generator=torch.Generator().manual_seed(0))
        self.plugin.check_aligned(set_level(noise, 65.0), rate, torch.zeros(1, len(FREQUENCIES)))

    def __str__(self) -> str:
        return str(self.plugin)

    def __call__(self, signals: Tensor, thresholds: Tensor) -> Tensor:
        """Simulate hearing losses. Signals are resampled to the simulator's rate and back.

        Args:
            signals: Signals at 16 kHz in pascals with shape (items, time).
            thresholds: Ears in dB HL with shape (items, 8).

        Returns:
            Perceived signals at 16 kHz in pascals with shape (items, time).
        """
        perceived = self.plugin(resample(signals, NEURO_RATE, self.sample_rate), thresholds)
        return resample(perceived, self.sample_rate, NEURO_RATE)[..., : signals.shape[-1]]


def find_teacher(name: str) -> PluginTeacher | None:
    """Load a teacher by name.

    Args:
        name: ``"msbg"``, or the name of a plug-in.

    Returns:
        The plug-in, or None for the exact MSBG.

    Raises:
        ValueError: There is no such teacher.

    >>> find_teacher("msbg") is None
    True
    """
    return None if name == "msbg" else PluginTeacher(name)
