"""The way into the cochlea and out of it, with resampling on the same FFT grids; blocks of long signals.

Where two rates meet, the lower one's spectrum ends softly, and so with nothing at half that rate, a frequency that the
higher one has twice.
"""

import math

import torch
from torch import Tensor

from hlsim.dsp.fft import edge, fft_length, long_irfft, long_rfft
from hlsim.dsp.fir import filter_blocks
from hlsim.dsp.overlap import overlapping
from hlsim.msbg.cochlea import shared_multiple
from hlsim.msbg.ear import EAR_DELAY, RATE
from hlsim.msbg.envelope import HALF_RATE_STEP, STEP
from hlsim.msbg.filters import Filters
from hlsim.msbg.smearing import HOP

_FIR_TAIL = 2 * EAR_DELAY + 132  # with the low-pass on the way out

_BLOCK_SECONDS = 8.0
# what a block needs around it: filters, delay, and low-passes down to 1e-6
_LEAD_SECONDS, _LAG_SECONDS, _FADE_SECONDS = 0.75, 0.55, 0.2


def to_cochlea(signals: Tensor, rate: int, length: int, step: int, filters: Filters) -> Tensor:
    """Resample to 44.1 kHz / step and pass outer and middle ear. Shape: (items, time) -> (items, length)."""
    if rate == RATE and step == 1:
        return filter_blocks(signals, filters.get("forward blocks"), length)
    up, down = ratio(rate, step)
    least = max(signals.shape[-1], math.ceil(length * down / up)) + math.ceil(_FIR_TAIL * down / up / step)
    own, points = _grid(least, up, down)
    bins = min(own, points) // 2 + 1
    response = filters.get("forward", points * step, bins, up / down, rate)
    return long_irfft(long_rfft(signals, own)[..., :bins] * response, points)[..., :length]


def from_spectrum(
    spectrum: Tensor,
    points: int,
    step: int,
    rate: int,
    samples: int,
    filters: Filters,
    *,
    gain: float,
    delay: int,
) -> Tensor:
    """Back out of the ear, low-pass, advance by ``delay`` and return to ``rate``, from the cochlea's spectrum.

    Shape: (items, points // (2 step) + 1) -> (items, samples).

    Args:
        gain: factor on all of it.
        points: FFT length at 44.1 kHz of the spectrum.
        step: the spectrum is of a signal at 44.1 kHz / step.
        delay: samples at 44.1 kHz.
    """
    inner, out = points // step, points * rate // RATE
    if not shared_multiple(rate, step):
        heard = long_irfft(spectrum, inner)
        return from_cochlea(heard, rate, inner, samples, filters, gain=gain, step=step, delay=delay)
    bins = min(inner, out) // 2 + 1
    response = filters.get("backward", points, delay, bins, gain * out / inner, rate)
    return long_irfft(spectrum[..., :bins] * response, out)[..., :samples]


def from_cochlea(
    heard: Tensor,
    rate: int,
    length: int,
    samples: int,
    filters: Filters,
    *,
    gain: float,
    step: int = 1,
    delay: int = 0,
) -> Tensor:
    """``from_spectrum`` of a waveform. Shape: (items, length) -> (items, samples)."""
    up, down = ratio(rate, step)
    own, points = _grid(math.ceil((length + _FIR_TAIL) * down / up), up, down)
    bins = min(own, points) // 2 + 1
    response = filters.get("backward", points * step, delay, bins, gain * down / up, rate)
    return long_irfft(long_rfft(heard, points)[..., :bins] * response, own)[..., :samples]


def to_inner(signals: Tensor, rate: int) -> Tensor:
    """Resample to 44.1 kHz. Shape: (items, time) -> (items, ceil(time * 44100 / rate))."""
    if rate == RATE:
        return signals
    up, down = ratio(rate, 1)
    own, points = _grid(signals.shape[-1], up, down)
    bins = min(own, points) // 2 + 1
    response = torch.from_numpy(up / down * edge(bins, RATE / points, min(rate, RATE) / 2)).to(signals)
    return long_irfft(long_rfft(signals, own)[..., :bins] * response, points)[
        ..., : math.ceil(signals.shape[-1] * up / down)
    ]


def block_bounds(samples: int, rate: int) -> list[tuple[int, int, int, int]]:
    """``overlapping`` blocks of a signal at ``rate``.

    They begin where the smearing's frames and the envelopes' steps do, so that they are those of the whole.
    """
    common = math.lcm(HOP, STEP, round(2 * HALF_RATE_STEP))
    unit = common * rate // math.gcd(common * rate, RATE)  # samples in a whole number of hops and of steps
    hop = round(_BLOCK_SECONDS * rate) // unit * unit
    lead, lag = (math.ceil(s * rate / unit) * unit for s in (_LEAD_SECONDS, _LAG_SECONDS))
    return overlapping(samples, hop, lead, lag)


def faded(block: Tensor, rate: int, begin: bool, end: bool) -> Tensor:
    """A block's lead faded in and its lag out over 0.2 s: a sharp cut would ring wherever a band ends sharply.

    Shape: (items, time) -> (items, time).
    """
    time = round(_FADE_SECONDS * rate)
    place = torch.arange(1, time + 1, dtype=torch.float64, device=block.device) * (math.pi / (time + 1))
    ramp = (0.5 - 0.5 * place.cos()).to(block.dtype)
    ones = block.new_ones(block.shape[-1] - 2 * time)
    edge = ramp.new_ones(time)
    return block * torch.cat((ramp if begin else edge, ones, ramp.flip(-1) if end else edge))


def ratio(rate: int, step: int) -> tuple[int, int]:
    """Smallest whole numbers in proportion to 44.1 kHz / step and ``rate``."""
    common = math.gcd(RATE // step, rate)
    return RATE // step // common, rate // common


def _grid(samples: int, up: int, down: int) -> tuple[int, int]:
    """FFT lengths at ``down`` and at ``up`` that span the same time, at least ``samples`` at ``down``."""
    blocks = fft_length(math.ceil(samples / down), 4)
    return blocks * down, blocks * up
