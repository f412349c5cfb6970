"""Whether what is heard follows, band by band, what a normal ear hears, and has its level: the default criterion.

Both are cut into 24 ERB-wide bands (``hlsim.losses.band_levels``) and overlapping stretches of 96 ms. With ``H`` and
``R`` the spectra of what the impaired and the normal ear hear, in frames of 32 ms, each band and stretch has

- ``incoherence``, ``1 - (sum |mean H R*|)^2 / (sum mean |H|^2 * sum mean |R|^2)``, the means over the stretch's frames,
  the sums over the band's frequencies. It is 0 where what is heard is the reference times any gain and any fixed phase,
  and rises with noise, late reverberation and distortion, however soft: noise that fills a band which is heard too
  softly does not lower it.
- ``misalignment``, how much of the coherence's square root the phase takes away. Little of it counts, for nobody hears
  the sign or a millisecond's delay; it leads a model whose phase is arbitrary to none.
- ``levels``, ``10 log(1 + abs(d) / 10)`` of the difference ``d`` of their levels in dB. Its slope falls with the
  difference, so that a severe ear, which hears 100 dB too little and 2.5 dB more for each dB of gain, counts like a mild
  one.
- ``louder``, the dB by which what is heard exceeds both the reference and what is audible: too much gain, and noise in
  pauses.

Incoherence and levels are weighted by how audible the reference is, ``P / (P + least)`` of its power ``P``: above 0
wherever there is any, and so little of what is faint that it does not take the gradient over.
"""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.fft import power
from hlsim.dsp.stft import STFT
from hlsim.losses.band_levels import FRAME_SECONDS, band_shares, threshold_in_quiet
from hlsim.torchtools import constant

DEFAULT_WEIGHTS = {
    "incoherence": 1.0,
    "misalignment": 0.03,
    "levels": 0.03,
    "louder": 0.03,
    "peaks": 1.0,
}
"""What follows nothing costs 1, what is heard 40 dB too softly 0.48, and 40 dB too loud some 1.6."""

DEPTH = 41.0
"""dB under an item's loudest band, as a normal ear hears it, where the weight of a band has fallen to a half."""

KNEE = 10.0
"""Difference of levels in dB at which a further dB costs half of the first."""

LOWEST_POWER = 1e-22
"""Power, -126 dB SPL, that is added before the logarithm: soft speech in an N5 ear has -110, and keeps its gradient."""

HIGHEST_PEAK = 10.0 ** ((120.0 - PASCAL_SPL) / 20.0)
"""Pressure in pascals, 120 dB SPL, over which peaks begin to hurt."""

MARGIN = 3.0
"""Excess of the level in dB that is not counted as louder."""

HIGHEST_GRADIENT = 6.0
"""Of a sample, over the 0.9 quantile of those of its item that sound; in pauses it is held to that."""

_BLOCK = 3
"""Frames from stretch to stretch; each stretch is twice as long."""

_LIMITER_SECONDS = 0.005
_SOUNDING = 1e-3  # of the power of the loudest 5 ms
_SIGN = 0.1
_TINY = 1e-36  # a product of two powers, far under those of a heard band
_LEAST_WEIGHT = 1e-9  # of all of an item: that of a reference at some -160 dB SPL


def coherent_band_parts(heard: Tensor, normal: Tensor, sample_rate: int) -> dict[str, Tensor]:
    """Incoherence (0 to 1), error of the level (dB, compressed) and excess of the level (dB) by name, of each item.

    Args:
        heard: what the impaired ear hears.
        normal: what a normal ear hears of the clean speech.

    Shape: (items, time) twice, in pascals -> (items,) each. The weights carry no gradient; where the reference is silent,
    what is audible has one all the same.
    """
    hop = round(FRAME_SECONDS / 2.0 * sample_rate)
    stft = STFT(2 * hop, 2 * hop, hop)
    shares = constant(band_shares, stft.fft, sample_rate, dtype=heard.dtype, device=heard.device)
    # both halves of the spectrum; the squares of a Hann window of n samples sum to 3 n / 8
    shares = shares * (2.0 / (stft.fft * 0.375 * stft.window))
    ear, reference = (stft.analyse(waveform) for waveform in (heard, normal))
    level, truth = (_stretches(power(spectrum) @ shares) for spectrum in (ear, reference))
    cross = _stretches(ear * reference.conj())
    common, aligned = (power(cross) + _TINY).sqrt() @ shares, cross.real.contiguous() @ shares
    product = (level + LOWEST_POWER) * truth + _TINY

    quiet = constant(_quiet_power, dtype=heard.dtype, device=heard.device)
    least = torch.maximum(
        quiet, 10.0 ** (-DEPTH / 10.0) * truth.detach().amax((-2, -1), keepdim=True)
    )
    weights, own_weights = _audibility(truth, least), _audibility(level, least)
    total = weights.sum((-2, -1)).clamp_min(_LEAST_WEIGHT)
    error = (_decibels(level) - _decibels(truth)).abs()
    excess = (_decibels(level) - _decibels(torch.maximum(truth, least)) - MARGIN).clamp_min(0.0)
    return {
        "incoherence": (weights * (1.0 - common.square() / product)).sum((-2, -1)) / total,
        "misalignment": (
            weights
            * (
                (common.square() - aligned.square()) / product
                + _SIGN * (common - aligned) / product.sqrt()
            )
        ).sum((-2, -1))
        / total,
        "levels": (weights * (KNEE * torch.log1p(error / KNEE))).sum((-2, -1)) / total,
        # noise against silence has no audible reference to be divided by
        "louder": (own_weights * excess).sum((-2, -1))
        / torch.maximum(total, own_weights.sum((-2, -1)) / 10.0),
    }


def peak_excess(compensated: Tensor) -> Tensor:
    """By how much the samples given to the ear exceed 120 dB SPL, relative to that, on average.

    Shape: (items, time) in pascals -> (items,).
    """
    return (compensated.abs() / HIGHEST_PEAK - 1.0).clamp_min(0.0).mean(-1)


def without_spikes(compensated: Tensor, sample_rate: int) -> Tensor:
    """The same waveform, whose gradient is turned down where it is large beside that of the other samples of its item.

    Where an ear hears next to nothing, a recruiting band or a network gives a few samples a thousand times that, and all
    others no part of the step. Stretches of 5 ms are turned down as a whole: samples cut one by one leave a mean, and a
    convolutional network grows a constant pressure from it that no ear hears. What sounds is what is within 30 dB of the
    loudest stretch given. NaN stays.

    Shape: (..., time) -> (..., time).
    """
    limited: Tensor = _WithoutSpikes.apply(compensated, round(_LIMITER_SECONDS * sample_rate))
    return limited


class _WithoutSpikes(torch.autograd.Function):
    @staticmethod
    def forward(waveform: Tensor, block: int) -> Tensor:
        return waveform.view_as(waveform)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: Tensor) -> None:
        waveform, ctx.block = inputs
        ctx.save_for_backward(waveform)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (waveform,), time = ctx.saved_tensors, gradient.shape[-1]
        powers = _blocks(waveform, ctx.block).square().mean(-1)
        sizes = _blocks(gradient.abs(), ctx.block)
        sounding = powers >= _SOUNDING * powers.amax(-1, keepdim=True)
        # of what follows an item's end there is none
        present = torch.where(sounding.unsqueeze(-1) & (sizes > 0.0), sizes, math.nan).flatten(-2)
        usual = present[..., :: max(1, time // 4096)].nanquantile(0.9, -1, keepdim=True)
        limit = usual.nan_to_num(nan=math.inf) * torch.where(sounding, HIGHEST_GRADIENT, 1.0)
        factor = (limit / sizes.amax(-1)).clamp_max(1.0)
        # on straight lines between the blocks' edges, none of which is over either block's
        edges = torch.minimum(
            functional.pad(factor, (1, 0), value=1.0), functional.pad(factor, (0, 1), value=1.0)
        )
        ramp = torch.arange(ctx.block, device=gradient.device) / ctx.block
        factors = torch.lerp(edges[..., :-1, None], edges[..., 1:, None], ramp.to(edges)).flatten(
            -2
        )
        return gradient * factors[..., :time], None


def _blocks(samples: Tensor, block: int) -> Tensor:
    """Zeros where the last one goes on. Shape: (..., time) -> (..., blocks, block)."""
    return functional.pad(samples, (0, -samples.shape[-1] % block)).unflatten(-1, (-1, block))


def _stretches(frames: Tensor) -> Tensor:
    """Means over stretches of 96 ms, every 48 ms. Shape: (items, frames, n) -> (items, stretches, n)."""
    missing = -frames.shape[-2] % _BLOCK
    blocks = functional.pad(frames, (0, 0, 0, missing)).unflatten(-2, (-1, _BLOCK)).mean(-2)
    return blocks if blocks.shape[-2] < 2 else 0.5 * (blocks[..., 1:, :] + blocks[..., :-1, :])


def _audibility(powers: Tensor, least: Tensor) -> Tensor:
    powers = powers.detach()
    return powers / (powers + least)


def _decibels(powers: Tensor) -> Tensor:
    return 10.0 * torch.log10(powers + LOWEST_POWER)


def _quiet_power() -> NDArray[np.float64]:
    """Power of each band at the threshold of hearing. Returns (24,)."""
    power_in_quiet: NDArray[np.float64] = 10.0 ** ((threshold_in_quiet() - PASCAL_SPL) / 10.0)
    return power_in_quiet
