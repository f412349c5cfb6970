"""At which rate each channel runs: a gammatone channel is a band, and only the wider ones need 44.1 kHz.

A channel runs at 11 kHz if that rate holds its band up to five bandwidths above its frequency, where it is 57 dB down.
Rectified there as it is, its harmonics would fold onto the envelope; instead the rectified signal is taken from the
analytic one, |cos| being a short series of even harmonics. The lowest channels, whose bands reach 0 Hz, and the widest
are rectified as they are, as the reference does: at 44.1 kHz its own harmonics fold too.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.msbg.ear import RATE
from hlsim.msbg.filterbank import BANKS, FilterBank, erb, gammatone_response
from hlsim.msbg.recruitment import decimation_kernel, envelope_lowpass, interpolation_kernel

REACH = 5.0
"""Bandwidths above its frequency to which a channel is kept."""

_LOW_STEP = 4
_TRUE_HZ = 350.0  # below, channels are rectified as they are
_CACHED = 400_000  # samples of a tier on a CPU, for the steps from one to the next to find them in its cache


@dataclass(frozen=True)
class Tier:
    """Channels that run together, at one rate.

    Attributes:
        channels: which of the bank's.
        step: samples at 44.1 kHz from one of its samples to the next; a divisor of 16.
        points: its FFT length.
        response: of the channels, (channels, points // 2 + 1), or (2, channels, points // 2 + 1) with those of their
            quadrature signals.
        series: coefficients of 1, cos^2 and cos^4 in |cos|; none where a signal is rectified as it is.
        decimation: weights of a block's samples, (3, 16 // step).
        interpolation: weights of six gains, (6, 16 // step).
    """

    channels: slice
    step: int
    points: int
    response: Tensor
    series: tuple[float, float, float] | None
    decimation: Tensor
    interpolation: Tensor


@dataclass(frozen=True)
class Plan:
    """A bank on the FFT grid of a length: ``tiers`` from the lowest channels up, and the envelopes' ``lowpass``.

    Attributes:
        lowpass: (channels, points // 32 + 1).
        step: that of the widest channels, 1 or 2.
        points: FFT length at 44.1 kHz, a multiple of 16.
    """

    points: int
    step: int
    tiers: tuple[Tier, ...]
    lowpass: Tensor


def assign(bank: FilterBank, step: int) -> list[tuple[slice, int, bool]]:
    """Channels, step and whether rectified as they are, from the lowest channels up.

    Args:
        step: of the widest channels: 1, or 2 where nothing above 11 kHz is of interest.
    """
    kinds: list[tuple[int, bool]] = []
    for hz, width in zip(bank.centre_frequencies, erb(np.array(bank.centre_frequencies)), strict=True):
        top = hz + REACH * bank.broadening * float(width)
        own = _LOW_STEP if top <= RATE / _LOW_STEP / 2.0 else step
        kinds.append((own, hz < _TRUE_HZ or own == 1))
    bounds = [0, *(i for i in range(1, len(kinds)) if kinds[i] != kinds[i - 1]), len(kinds)]
    return [(slice(a, b), *kinds[a]) for a, b in itertools.pairwise(bounds)]


def make_plan(severity: str, points: int, step: int, dtype: torch.dtype, device: torch.device) -> Plan:
    """The tiers of a severity's bank.

    Args:
        points: FFT length at 44.1 kHz, a multiple of 16.
        step: 1 or 2, as in ``assign``.
    """

    def tensor(values: NDArray[np.generic]) -> Tensor:
        complex_dtype = torch.complex128 if dtype == torch.float64 else torch.complex64
        kind = complex_dtype if np.iscomplexobj(values) else dtype
        return torch.from_numpy(np.ascontiguousarray(values)).to(device=device, dtype=kind)

    bank = BANKS[severity]
    tiers, lowpass = [], []
    with torch.inference_mode(False):
        for channels, own, as_is in _parts(assign(bank, step), points, device):
            count = points // own
            response = gammatone_response(bank, points, channels, count // 2 + 1) * (step / own)
            if own > 1 and count % 2 == 0:
                response[:, -1] = 0.0
            if not as_is:
                response = np.stack((response, -1j * response))
            kernels = tensor(decimation_kernel(own)), tensor(interpolation_kernel(own))
            series = None if as_is else _series(own)
            tiers.append(Tier(channels, own, count, tensor(response), series, *kernels))
            lowpass.append(envelope_lowpass(bank, points, own, channels))
        return Plan(points, step, tuple(tiers), tensor(np.concatenate(lowpass)))


def total_response(severity: str, points: int, step: int) -> NDArray[np.complex128]:
    """The sum of all channels, for ears with no loss at all. Returns (points // step // 2 + 1,)."""
    total = gammatone_response(BANKS[severity], points, bins=points // step // 2 + 1).sum(0)
    if step > 1 and (points // step) % 2 == 0:
        total[-1] = 0.0
    return total


def _parts(
    tiers: list[tuple[slice, int, bool]], points: int, device: torch.device
) -> list[tuple[slice, int, bool]]:
    """The tiers, on a CPU cut to what its cache holds."""
    if device.type != "cpu":
        return tiers
    parts = []
    for channels, step, as_is in tiers:
        size = max(1, _CACHED * step // points)
        cuts = [*range(channels.start, channels.stop, size), channels.stop]
        parts += [(slice(a, b), step, as_is) for a, b in itertools.pairwise(cuts)]
    return parts


def _series(step: int) -> tuple[float, float, float]:
    """2 / pi (1 + 2/3 cos 2a - 2/15 cos 4a) in powers of cos^2 a, without the last term where 4a would fold."""
    powers = (1 / 5, 12 / 5, -16 / 15) if step == _LOW_STEP else (1 / 3, 4 / 3, 0.0)
    return tuple(2.0 / math.pi * power for power in powers)  # type: ignore[return-value]
