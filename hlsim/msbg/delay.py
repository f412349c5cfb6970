"""Measurement of the delay of a simulator from its response to an impulse."""

from __future__ import annotations

import torch
from torch import nn

from hlsim.audiogram import Audiogram
from hlsim.audiogram.thresholds import AudiogramLike


def estimate_delay(
    simulator: nn.Module, audiogram: AudiogramLike | None = None, *, level: float = 94.0
) -> int:
    """Measure by how many samples a simulator delays its output.

    The input is an impulse: one second of zeros, except for one sample in the middle. The delay is
    the time from the impulse to the largest magnitude of the output. The delay depends on the ear
    and on the level, because MSBG delays low frequencies more than high ones: at 44.1 kHz it is
    1078 samples without a hearing loss and 1237 to 1271 samples with one. To align signals, use
    ``MSBG.delay``, which depends on the severity of the loss only.

    Source: the Neuro-MSBG paper, Section III-A.

    Args:
        simulator: Simulator with the attributes ``sample_rate`` and ``full_scale_spl``. Build MSBG
            with ``aligned=False``, because aligned simulators have no delay.
        audiogram: Hearing loss of one ear. By default, it is the simulator's stored one, or 0 dB HL
            if there is none.
        level: Pressure of the impulse, as the level in dB SPL of a sound with this RMS pressure:
            94 is 1 Pa.

    Returns:
        The delay in samples at the simulator's sample rate.

    Raises:
        ValueError: The simulator lacks an attribute, or the audiogram has more than one ear.

    >>> from hlsim import MSBG
    >>> estimate_delay(MSBG("NH", sample_rate=44100, aligned=False))
    1078
    """
    rate = getattr(simulator, "sample_rate", None)
    full_scale_spl = getattr(simulator, "full_scale_spl", None)
    if not isinstance(rate, int) or full_scale_spl is None:
        raise ValueError(
            f"expected one of hlsim's simulators, got {type(simulator).__name__} without the "
            "attributes sample_rate and full_scale_spl"
        )
    if audiogram is None and getattr(simulator, "thresholds", None) is None:
        audiogram = Audiogram.standard("NH")
    position = rate // 2
    device = next((parameter.device for parameter in simulator.parameters()), None)
    impulse = torch.zeros(rate, device=device)
    impulse[position] = 10.0 ** ((level - float(full_scale_spl)) / 20.0)
    with torch.no_grad():
        output = simulator(impulse, audiogram)
    ears = output.shape[:-1].numel()
    if ears != 1:
        raise ValueError(f"expected the audiogram of one ear, got audiograms of {ears} ears")
    return int(output.abs().argmax()) - position
