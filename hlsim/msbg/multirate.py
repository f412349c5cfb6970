"""The multirate filter bank: a gammatone channel is a band, and only the widest need 44.1 kHz.

A channel is kept up to five bandwidths above its frequency, where it is 57 dB down, or to the highest frequency of
interest. Narrow ones run as analytic signals at about 5.5 or 11 kHz, or 9 where that is enough, whose modulus is the
envelope: what a rectifier adds, harmonics of the band, lies above its low-pass. It does not where bands are so wide for
their frequency that they come down to 0 Hz: with severe losses two harmonics complete the modulus. The lowest channels,
and the widest at 44.1 kHz, are rectified as they are, as the reference does: at that rate its harmonics fold, too.

Channels centred far above the highest frequency of interest all hear what there is next to it, by their skirts, and
expand it alike, by the threshold at 8 kHz: they run as one, the sum of them.
"""

import itertools
import math
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.erb import erb
from hlsim.dsp.fft import fade_out_weights
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import HALF_RATE_STEP, STEP, decimation_kernel, envelope_lowpass
from hlsim.msbg.filterbank import FilterBank, gammatone_response
from hlsim.msbg.recruitment import interpolation_kernel
from hlsim.msbg.smearing import SKIRT_HZ
from hlsim.torchtools import as_tensor

_KEPT = 5.0  # bandwidths above its frequency to which a channel is kept
_WIDE = 2.5  # broadening above which bands come so near to 0 Hz that a rectifier's harmonics count
_TRUE_HZ = 400.0  # below, channels are rectified as they are
_FAR = 1.75  # times the highest frequency of interest, above which channels run as one
_FAR_RATIO = 1.3  # expansion, of a loss of 24 dB, at which their gain is right; with more they are heard less
_CACHED = (
    2_000_000  # samples of a rate band on a CPU, for each step to find the last one's in its cache
)


Detector = Literal["itself", "modulus", "harmonics"]
"""What a channel's envelope is taken from: the rectified signal, or the analytic one, alone or with harmonics."""


@dataclass(frozen=True)
class RateBand:
    """Channels that run together, at one rate.

    Attributes:
        channels: which of the bank's.
        points: its FFT length.
        detector: how they are rectified.
        response: of the channels, (channels, points // 2 + 1), or of their analytic signals, (channels, points).
        decimation: weights of a step's samples, (3, samples).
        interpolation: ``interpolation_kernel``, each weight twice for analytic signals' two parts.
    """

    channels: slice
    points: int
    detector: Detector
    response: Tensor
    decimation: Tensor
    interpolation: Tensor


@dataclass(frozen=True)
class MultirateBank:
    """A bank on the FFT grid of a length.

    Attributes:
        bands: from the lowest channels up.
        lowpass: of the envelopes, (channels, steps // 2 + 1), as many channels as the bands have.
    """

    bands: tuple[RateBand, ...]
    lowpass: Tensor

    @property
    def nbytes(self) -> int:
        return self.lowpass.nbytes + sum(band.response.nbytes for band in self.bands)


def assign_rates(
    bank: FilterBank, step: int, highest: float = MSBG_RATE / 2
) -> list[tuple[slice, int, Detector]]:
    """Channels, samples in each of an envelope's steps and how they are rectified, from the lowest channels up.

    Where the bank has more, the last one stands for those, too.

    Args:
        step: of the signal: 1, or 2 where nothing above 11 kHz is of interest.
        highest: frequency of interest in Hz.
    """
    a_second = MSBG_RATE / envelope_step(step)
    slow, fast = 3, 6
    widest = int((highest + SKIRT_HZ) / a_second) + 1
    kinds: list[tuple[int, Detector]] = []
    for hz, width in zip(
        bank.centre_frequencies, erb(np.array(bank.centre_frequencies)), strict=True
    ):
        top = hz + _KEPT * bank.broadening * float(width)
        if hz < _TRUE_HZ:
            kinds.append((fast, "itself"))
        elif top <= slow * a_second:
            kinds.append((fast, "harmonics") if bank.broadening > _WIDE else (slow, "modulus"))
        elif step == 2:
            kinds.append((widest, "modulus"))
        elif top <= fast * a_second and bank.broadening <= _WIDE:
            kinds.append((fast, "modulus"))
        else:
            kinds.append((STEP, "itself"))
    kinds = kinds[: _count_kept(bank, highest)]
    bounds = [0, *(i for i in range(1, len(kinds)) if kinds[i] != kinds[i - 1]), len(kinds)]
    return [(slice(a, b), *kinds[a]) for a, b in itertools.pairwise(bounds)]


def multirate_bank(
    bank: FilterBank,
    points: int,
    step: int,
    highest: float,
    dtype: torch.dtype,
    device: torch.device,
) -> MultirateBank:
    """A bank's channels, each at the rate that it needs.

    Args:
        points: FFT length at 44.1 kHz, a whole number of the envelopes' steps.
        step, highest: as in ``assign_rates``.
    """

    tensor = partial(as_tensor, dtype=dtype, device=device)
    last = _count_kept(bank, highest)
    steps = round(points / envelope_step(step))
    together = next((count for count in (8, 9, 7, 10, 6, 5) if steps % count == 0), 8)
    bands, lowpass = [], []
    for channels, samples, detector in _cut_for_cache(
        assign_rates(bank, step, highest), steps, device
    ):
        count, analytic = steps * samples, detector != "itself"
        bins = min(count if analytic else count // 2 + 1, points // step // 2 + 1)
        # signals are too loud by the ratio of the rates, as their sum's spectrum is to be; those that are to be
        # transformed as analytic ones half of it, the other half being in negative frequencies
        response = gammatone_response(bank, points, channels, bins)
        smoothing = envelope_lowpass(bank, points, samples, channels, envelope_step(step))
        if channels.stop == last < bank.channels:
            far = gammatone_response(bank, points, slice(last - 1, None), bins)
            response[-1] = far.sum(0)
            smoothing[-1] *= _far_level(far[:, round(highest * points / MSBG_RATE)])
        # by how much slower than the signal's the channels' rate is
        decimation = decimation_kernel(samples) * (step * samples / envelope_step(step))
        interpolation = interpolation_kernel(samples, 2 if detector == "modulus" else 1, together)
        if detector == "modulus":
            response[:, 0] *= 0.5
            decimation = decimation * (4.0 / math.pi)
        elif detector == "harmonics":
            response[:, 1:] *= 2.0
            decimation = decimation * (2.0 / math.pi)
        if samples < STEP:
            response *= fade_out_weights(
                bins, MSBG_RATE / points, count / (1 if analytic else 2) * MSBG_RATE / points
            )
        kernels = tensor(decimation), tensor(interpolation)
        bands.append(RateBand(channels, count, detector, tensor(response), *kernels))
        lowpass.append(smoothing)
    return MultirateBank(tuple(bands), tensor(np.concatenate(lowpass)))


def envelope_step(step: int) -> float:
    """Samples at 44.1 kHz from one value of an envelope to the next, of signals at 44.1 kHz / ``step``."""
    return STEP if step == 1 else HALF_RATE_STEP


def _count_kept(bank: FilterBank, highest: float) -> int:
    """Channels, those far above the highest frequency of interest as one."""
    return min(bank.channels, 1 + sum(hz <= _FAR * highest for hz in bank.centre_frequencies))


def _far_level(responses: NDArray[np.complex128]) -> float:
    """Factor on the envelope of a sum of channels, for it to be expanded as they are.

    Args:
        responses: of the channels at one frequency.
    """
    more = _FAR_RATIO - 1.0
    total = abs(responses.sum())
    expanded = abs((responses * np.abs(responses) ** more).sum()) / total
    return float(expanded ** (1.0 / more) / total)


def total_response(bank: FilterBank, points: int, step: int) -> NDArray[np.complex128]:
    """The sum of all channels, for ears with no loss at all. Returns (points // step // 2 + 1,)."""
    total = gammatone_response(bank, points, bins=points // step // 2 + 1).sum(0)
    if step > 1 and (points // step) % 2 == 0:
        total[-1] = 0.0
    return total


def _cut_for_cache(
    bands: list[tuple[slice, int, Detector]], steps: int, device: torch.device
) -> list[tuple[slice, int, Detector]]:
    """The rate bands, on a CPU cut to what its cache holds."""
    if device.type != "cpu":
        return bands
    parts = []
    for channels, samples, detector in bands:
        count = channels.stop - channels.start
        size = count * (1 if detector == "itself" else 2) * steps * samples
        pieces = min(count, math.ceil(size / _CACHED))
        cuts = [channels.start + count * piece // pieces for piece in range(pieces + 1)]
        parts += [(slice(a, b), samples, detector) for a, b in itertools.pairwise(cuts)]
    return parts
