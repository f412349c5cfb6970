"""The criterion ``"coherent-bands"``, the default of ``HearingLossLoss``.

It compares the coherence and the level in each band with those for a normal ear.

Coherence says how much of a signal is a fixed filter of the other: it is 1 for any gain and phase,
and falls with noise. Both signals are divided into 24 bands (``hlsim.metrics.band_levels``) and
overlapping segments of 96 ms. Let ``H`` be the spectra in frames of 32 ms of what the impaired ear
perceives, and ``R`` those of what a normal ear perceives. Each band and segment has

- ``incoherence``, ``1 - (sum |mean H R*|)^2 / (sum mean |H|^2 * sum mean |R|^2)``, with means over
  the frames of the segment, sums over the frequencies of the band, and the conjugate ``R*``. It is
  0 if the perceived signal is the reference times any gain and any fixed phase. It rises with
  noise, late reverberation and distortion, however soft: noise in a band that is perceived too
  softly does not lower it.
- ``misalignment``, the part of the coherence that is lost to a phase shift, plus a tenth of the
  same part of its square root, which distinguishes a signal from its negative. It has a small
  weight, as nobody hears the sign or a delay of one millisecond; it leads a model with an arbitrary
  phase shift to one without.
- ``levels``, ``10 ln(1 + abs(d) / 10)`` of the difference ``d`` of the levels in dB. The slope
  falls with the difference, so that a severe ear, which perceives 100 dB too little and 2.5 dB more
  per dB of gain, counts like a mild one.
- ``louder``, by how many dB more than 3 the perceived level is above both the reference and the
  threshold of audibility: too much gain, and noise in pauses.

The first three are weighted by the audibility of the reference, ``P / (P + threshold)`` of its
power ``P``, and ``louder`` by that of the perceived signal. The threshold is that of normal hearing
in quiet, or 41 dB below the strongest band of the reference if that is higher. A weight is above 0
wherever there is power, and so small in faint bands that they do not dominate the gradient.
"""

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

Other speech than the reference, at its level, costs about 1.3, a level that is 40 dB too low 0.48,
and one that is 40 dB too high about 2.
"""

_DEPTH_DB = 41.0
"""Level in dB below the strongest band of an item at which the weight of a band is one half."""

KNEE = 10.0
"""Difference in level in dB at which one more dB costs half as much as the first dB does."""

_POWER_FLOOR = 1e-22
"""Power, -126 dB SPL, added before the logarithm.

Soft speech in an N5 ear has -110, and keeps its gradient.
"""

HIGHEST_PEAK = 10.0 ** ((120.0 - PASCAL_SPL) / 20.0)
"""Pressure in pascals, 120 dB SPL, above which the magnitude of a sample has a loss."""

MARGIN = 3.0
"""Excess of the level in dB that does not count as louder."""

FRAMES_PER_HOP = 3
"""Number of frames from one segment to the next; a segment has twice as many."""

SIGN_WEIGHT = 0.1
"""Weight of the term of the misalignment that tells a signal from its negative."""

PRODUCT_FLOOR = 1e-36
"""Value added to products of two powers in Pa^2, far below those of audible bands."""

_WEIGHT_FLOOR = 1e-9
"""Smallest sum of weights by which a part is divided: that of speech at about -100 dB SPL."""


def coherent_band_parts(perceived: Tensor, normal: Tensor, sample_rate: int) -> dict[str, Tensor]:
    """Compute four errors of perceived speech: in coherence, phase and level, and excess level.

    Weights of bands and segments carry no gradient. Audible sound has a gradient even where the
    reference is silent.

    Args:
        perceived: Speech that the impaired ear perceives, (items, time) in pascals.
        normal: Clean speech as a normal ear perceives it, (items, time) in pascals.
        sample_rate: Sample rate in Hz.

    Returns:
        Four parts, (items,) each, which are means over audible bands and segments:
        ``incoherence``, 0 for the reference with any gain and phase per band, about 0.9 for
        unrelated noise; ``misalignment``, the part of the coherence that a phase shift costs;
        ``levels``, ``10 ln(1 + d / 10)`` of the error d of the level in dB; ``louder``, by how many
        dB more than 3 a band is above both the reference and the threshold of audibility.

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

    quiet = _quiet_power(like=perceived)
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


def peak_excess(output: Tensor) -> Tensor:
    """Compute the mean over all samples of ``max(abs(x) / P - 1, 0)``.

    P is ``HIGHEST_PEAK``, the pressure at 120 dB SPL, with which each sample is compared.

    Shape: (items, time) -> (items,).

    Args:
        output: Output of an aid in pascals.

    >>> peak_excess(torch.full((1, 100), 2.0 * HIGHEST_PEAK))
    tensor([1.])
    """
    return (output.abs() / HIGHEST_PEAK - 1.0).clamp_min(0.0).mean(-1)


def _average_segments(frames: Tensor) -> Tensor:
    """Average frames, which are 16 ms apart, over segments of 96 ms, every 48 ms.

    Zeros pad the frames to a multiple of three. Up to three frames give one segment of 48 ms.

    Shape: (items, frames, n) -> (items, segments, n).
    """
    missing = -frames.shape[-2] % FRAMES_PER_HOP
    padded = functional.pad(frames, (0, 0, 0, missing))
    halves = padded.unflatten(-2, (-1, FRAMES_PER_HOP)).mean(-2)
    if halves.shape[-2] < 2:
        return halves
    return 0.5 * (halves[..., 1:, :] + halves[..., :-1, :])


def _audibility(powers: Tensor, threshold: Tensor) -> Tensor:
    """Compute how audible powers are: p / (p + threshold), which is 0.5 at the threshold.

    The weights carry no gradient.

    Args:
        powers: Powers in Pa^2, (items, segments, bands).
        threshold: Power in Pa^2 at which a band is half audible, broadcast to ``powers``.
    """
    powers = powers.detach()
    return powers / (powers + threshold)


def _decibels(powers: Tensor) -> Tensor:
    """Convert powers in Pa^2 to levels in dB relative to 1 Pa, at least -220. Any shape."""
    return 10.0 * torch.log10(powers + _POWER_FLOOR)


@constant
def _quiet_power() -> NDArray[np.float64]:
    """Return the power in Pa^2 of each band at the threshold of normal hearing, (24,)."""
    return 10.0 ** ((threshold_in_quiet() - PASCAL_SPL) / 10.0)
