"""The criterion ``"coherent-bands"``, the default of ``HearingLossLoss``.

It compares the coherence and the level in each band with those for a normal ear.

Coherence says how much of a signal is a fixed filter of the other: it is 1 for any gain and phase,
and falls with noise. Both signals are divided into 24 bands (``hlsim.metrics.band_levels``) and
overlapping segments of 96 ms. Let ``H`` be the spectra in frames of 32 ms of what the impaired ear
perceives, and ``R`` those of what a normal ear perceives. Each band and segment has

- ``incoherence``, ``1 - (sum |mean H R*|)^2 / (sum mean |H|^2 * sum mean |R|^2)``, with means over
  the frames of the segment and sums over the frequencies of the band. It is 0 if the perceived
  signal is the reference times any gain and any fixed phase. It rises with noise, late
  reverberation and distortion, however soft: noise in a band that is perceived too softly does not
  lower it.
- ``misalignment``, the part of the square root of the coherence that is lost to a phase shift. It
  has a small weight, as nobody hears the sign or a delay of one millisecond; it leads a model with
  an arbitrary phase shift to one without.
- ``levels``, ``10 log(1 + abs(d) / 10)`` of the difference ``d`` of the levels in dB. The slope
  falls with the difference, so that a severe ear, which perceives 100 dB too little and 2.5 dB more
  per dB of gain, counts like a mild one.
- ``louder``, the excess in dB of the perceived level over both the reference and the threshold of
  audibility: too much gain, and noise in pauses.

Incoherence and levels are weighted by the audibility of the reference, ``P / (P + threshold)`` of
its power ``P``. It is above 0 wherever there is power, and so small in faint bands that they do not
dominate the gradient.
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
from hlsim.metrics.band_levels import band_analysis, threshold_in_quiet
from hlsim.torchtools import constant

DEFAULT_WEIGHTS = {
    "incoherence": 1.0,
    "misalignment": 0.03,
    "levels": 0.03,
    "louder": 0.03,
    "peaks": 1.0,
}
"""Weights of the parts.

Speech that is unrelated to the reference costs 1, a level that is 40 dB too low 0.48, and one
that is 40 dB too high about 1.6.
"""

_DEPTH_DB = 41.0
"""Level in dB below the strongest band of an item at which the weight of a band is one half."""

KNEE = 10.0
"""Difference in level in dB at which one more dB costs half as much as the first."""

_POWER_FLOOR = 1e-22
"""Power, -126 dB SPL, added before the logarithm.

Soft speech in an N5 ear has -110, and keeps its gradient.
"""

HIGHEST_PEAK = 10.0 ** ((120.0 - PASCAL_SPL) / 20.0)
"""Pressure in pascals, 120 dB SPL, above which peaks cost."""

MARGIN = 3.0
"""Excess of the level in dB that does not count as louder."""

MAX_GRADIENT_RATIO = 6.0
"""Gradients above this multiple of the item's 90th percentile are scaled down to it.

The percentile is that of the sounding samples.
"""

FRAMES_PER_HOP = 3
"""Frames from one segment to the next; a segment is twice as long."""

LIMITER_SECONDS = 0.005
"""Length of the blocks whose gradients are scaled together."""

SOUNDING = 1e-3
"""Power of a block over that of the loudest one from which it counts as sounding."""

LIMITER_SAMPLES = 4096
"""Approximate number of samples from which the percentile of an item's gradients is taken."""

SIGN_WEIGHT = 0.1
"""Weight of the term of the misalignment that tells a signal from its negative."""

PRODUCT_FLOOR = 1e-36
"""Added to products of two powers; far below the products of audible bands."""

_WEIGHT_FLOOR = 1e-9
"""Smallest sum of weights by which a part is divided: that of a reference at about -160 dB SPL."""


def coherent_band_parts(perceived: Tensor, normal: Tensor, sample_rate: int) -> dict[str, Tensor]:
    """Compute four errors of perceived speech: in coherence, phase and level, and excess level.

    Weights of bands and segments carry no gradient. Audible sound where the reference is silent has
    a gradient all the same.

    Args:
        perceived: Speech that the impaired ear perceives, (items, time) in pascals.
        normal: Clean speech as a normal ear perceives it, (items, time) in pascals.
        sample_rate: Sample rate in Hz.

    Returns:
        Four parts, (items,) each: ``incoherence``, from 0 for filtered speech to 1 for
        noise; ``misalignment``, the effect of a phase shift; ``levels``, the level error in dB,
        compressed; ``louder``, the excess level in dB.

    >>> speech = torch.randn(1, 16000)
    >>> parts = coherent_band_parts(0.1 * speech, speech, sample_rate=16000)  # 20 dB too low
    >>> {name: round(part.item(), 2) + 0.0 for name, part in parts.items()}
    {'incoherence': 0.0, 'misalignment': 0.0, 'levels': 10.99, 'louder': 0.0}
    """
    stft, shares, scale = band_analysis(perceived, sample_rate)
    shares = shares * scale
    spectrum, reference = stft.analyse(perceived), stft.analyse(normal)
    level = _average_segments(power(spectrum) @ shares)
    reference_level = _average_segments(power(reference) @ shares)
    cross = _average_segments(spectrum * reference.conj())
    common = (power(cross) + PRODUCT_FLOOR).sqrt() @ shares
    aligned = cross.real.contiguous() @ shares
    product = (level + _POWER_FLOOR) * reference_level + PRODUCT_FLOOR

    quiet = constant(_quiet_power, dtype=perceived.dtype, device=perceived.device)
    strongest = reference_level.detach().amax((-2, -1), keepdim=True)
    threshold = torch.maximum(quiet, 10.0 ** (-_DEPTH_DB / 10.0) * strongest)
    weights = _audibility(reference_level, threshold)
    perceived_weights = _audibility(level, threshold)
    total = weights.sum((-2, -1)).clamp_min(_WEIGHT_FLOOR)
    # Noise in a silent reference has no audible reference whose weight it could be divided by.
    louder_total = torch.maximum(total, perceived_weights.sum((-2, -1)) / 10.0)

    error = (_decibels(level) - _decibels(reference_level)).abs()
    audible_level = torch.maximum(reference_level, threshold)
    excess = (_decibels(level) - _decibels(audible_level) - MARGIN).clamp_min(0.0)
    incoherence = 1.0 - common.square() / product
    phase_loss = (common.square() - aligned.square()) / product
    sign_loss = SIGN_WEIGHT * (common - aligned) / product.sqrt()
    parts = {
        "incoherence": weights * incoherence,
        "misalignment": weights * (phase_loss + sign_loss),
        "levels": weights * (KNEE * torch.log1p(error / KNEE)),
    }
    sums = {name: part.sum((-2, -1)) / total for name, part in parts.items()}
    sums["louder"] = (perceived_weights * excess).sum((-2, -1)) / louder_total
    return sums


def peak_excess(compensated: Tensor) -> Tensor:
    """Compute by how much samples exceed 120 dB SPL on average, as a multiple of that pressure.

    Shape: (items, time) -> (items,).

    Args:
        compensated: Output of an aid in pascals.

    >>> peak_excess(torch.full((1, 100), 2.0 * HIGHEST_PEAK))
    tensor([1.])
    """
    return (compensated.abs() / HIGHEST_PEAK - 1.0).clamp_min(0.0).mean(-1)


def limit_gradient_spikes(compensated: Tensor, sample_rate: int) -> Tensor:
    """Return a waveform unchanged, and limit its gradient in the backward pass.

    In ears that perceive next to nothing, a simulator gives a few samples a gradient a thousand
    times as large as that of all other samples, which then hardly affect the training step. The
    gradient is therefore divided into blocks of 5 ms. The largest magnitude in a block may be six
    times the usual magnitude of the item: the 90th percentile over its samples outside pauses. In
    pauses, which are blocks of the waveform whose RMS is 30 dB or more below that of the loudest
    block, it may be once the usual magnitude. Where it is larger, the whole block is scaled down to
    the limit. Limiting single samples would give the gradient a non-zero mean, from which a
    convolutional network learns an inaudible constant pressure. NaN in a gradient is passed on.

    Shape: (..., time) -> (..., time).

    Args:
        compensated: Output of an aid.
        sample_rate: Sample rate in Hz.

    >>> samples = torch.randn(1, 1600, requires_grad=True)
    >>> gradient = torch.ones(1, 1600)
    >>> gradient[0, 800] = 1e6
    >>> limit_gradient_spikes(samples, sample_rate=16000).backward(gradient)
    >>> print(samples.grad.max().item() <= MAX_GRADIENT_RATIO)
    True
    """
    limited: Tensor = _GradientLimiter.apply(compensated, round(LIMITER_SECONDS * sample_rate))
    return limited


class _GradientLimiter(torch.autograd.Function):
    """Identity whose gradient is limited, as ``limit_gradient_spikes`` describes."""

    @staticmethod
    def forward(waveform: Tensor, block: int) -> Tensor:
        return waveform.view_as(waveform)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: Tensor) -> None:
        waveform, ctx.block = inputs
        ctx.save_for_backward(waveform)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (waveform,) = ctx.saved_tensors
        time = gradient.shape[-1]
        powers = _split(waveform, ctx.block).square().mean(-1)
        sizes = _split(gradient.abs(), ctx.block)
        sounding = powers >= SOUNDING * powers.amax(-1, keepdim=True)
        # Samples behind the end of an item have no gradient, and are left out.
        counted = sounding.unsqueeze(-1) & (sizes > 0.0)
        candidates = torch.where(counted, sizes, math.nan).flatten(-2)
        sample = candidates[..., :: max(1, time // LIMITER_SAMPLES)]
        usual = sample.nanquantile(0.9, -1, keepdim=True).nan_to_num(nan=math.inf)
        limit = usual * torch.where(sounding, MAX_GRADIENT_RATIO, 1.0)
        factor = (limit / sizes.amax(-1)).clamp_max(1.0)

        # Factors are linear between the edges of blocks, where the smaller one of both holds.
        before = functional.pad(factor, (1, 0), value=1.0)
        after = functional.pad(factor, (0, 1), value=1.0)
        edges = torch.minimum(before, after)
        ramp = (torch.arange(ctx.block, device=gradient.device) / ctx.block).to(edges)
        factors = torch.lerp(edges[..., :-1, None], edges[..., 1:, None], ramp).flatten(-2)
        limited: Tensor = _FirstDerivative.apply(gradient * factors[..., :time])
        return limited, None


class _FirstDerivative(torch.autograd.Function):
    """Identity that raises RuntimeError if it is differentiated."""

    @staticmethod
    def forward(gradient: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        raise RuntimeError(
            "the criteria 'coherent-bands', 'haspi' and 'hasqi' limit the gradient and have no "
            "second derivative; use 'bands', 'paper' or a function"
        )


def _split(samples: Tensor, block: int) -> Tensor:
    """Split into blocks, the last one filled with zeros.

    Shape: (..., time) -> (..., blocks, block).
    """
    return functional.pad(samples, (0, -samples.shape[-1] % block)).unflatten(-1, (-1, block))


def _average_segments(frames: Tensor) -> Tensor:
    """Average over segments of 96 ms, every 48 ms.

    Shape: (items, frames, n) -> (items, segments, n).
    """
    missing = -frames.shape[-2] % FRAMES_PER_HOP
    padded = functional.pad(frames, (0, 0, 0, missing))
    halves = padded.unflatten(-2, (-1, FRAMES_PER_HOP)).mean(-2)
    if halves.shape[-2] < 2:
        return halves
    return 0.5 * (halves[..., 1:, :] + halves[..., :-1, :])


def _audibility(powers: Tensor, threshold: Tensor) -> Tensor:
    powers = powers.detach()
    return powers / (powers + threshold)


def _decibels(powers: Tensor) -> Tensor:
    return 10.0 * torch.log10(powers + _POWER_FLOOR)


def _quiet_power() -> NDArray[np.float64]:
    """Return the power of each band at the threshold of hearing, (24,)."""
    return 10.0 ** ((threshold_in_quiet() - PASCAL_SPL) / 10.0)
