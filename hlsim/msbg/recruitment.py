"""Loudness recruitment: each channel is multiplied by a gain that rises with its envelope.

An impaired ear does not perceive soft sounds, and perceives sounds of 105 dB SPL as loud as a
normal ear does. Between these levels, its loudness grows faster than normal. The gain simulates
this growth: it is 1 at 105 dB SPL and falls towards soft sounds. (With a threshold below 0 dB HL,
it rises towards soft sounds.)

The envelope varies so slowly that it and the gain are computed once per *step* of 24 samples at
44.1 kHz (24.5 if signals run at 22.05 kHz). The gain is interpolated between steps. Where a small
envelope makes the gain of a slight loss change fast, the envelope can be interpolated instead.

Source: Moore and Glasberg (1993), Journal of the Acoustical Society of America 94, 2050-2062.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.calibration import PASCAL_SPL
from hlsim.msbg.envelope import STEP
from hlsim.torchtools import constant

CATCH_UP_SPL = 105.0
"""Level in dB SPL at which an impaired ear perceives sounds as loud as a normal one."""

# pyclarity limits the envelope to 1e-9 of its full scale, which is 120 dB SPL.
_MIN_ENVELOPE = 1e-9 * 10.0 ** ((120.0 - PASCAL_SPL) / 20.0)
"""Smallest value of an envelope in Pa that changes the gain."""

_MAX_ENVELOPE = 10.0 ** ((CATCH_UP_SPL - PASCAL_SPL) / 20.0)
"""Largest value of an envelope in Pa that changes the gain, where the gain reaches 1."""

_TAPS = 6
"""Number of steps from whose values the value of a sample is interpolated."""

AHEAD = _TAPS // 2
"""Number of the ``_TAPS`` steps that come after the sample."""

_SLIGHT_RATIO = 1.3
"""Expansion ratio at about 24 dB HL, below which sudden changes of the gain are audible."""

_DIP_RATIO = 0.3
"""Value of an envelope relative to its neighbours below which it counts as a dip."""


def expansion_ratios(thresholds: Tensor, weights: Tensor) -> Tensor:
    """Compute how many dB the perceived level in each channel changes per dB of input.

    The channels are the bands of a filter bank. The number of dB per dB, the *expansion ratio*, is
    105 / (105 - threshold), where 105 dB SPL is the level at which a sound is as loud for an
    impaired ear as for a normal ear. Thresholds must be below 105 dB HL; simulators accept at most
    100 dB HL.

    Shape: (..., frequencies), (frequencies, channels) -> (..., channels).

    Args:
        thresholds: Audiograms in dB HL.
        weights: Weights from ``hlsim.dsp.interpolation.interpolation_weights``, which interpolate
            thresholds to the centre frequencies of the channels.

    >>> expansion_ratios(torch.full((8,), 35.0), torch.full((8, 1), 0.125))
    tensor([1.5000])
    """
    # This is no matrix product, because a GPU may round factors of a product to ten bits. Next to
    # 105 dB HL, the ratio depends on every bit of the thresholds.
    channel_thresholds = (thresholds.unsqueeze(-1) * weights).sum(-2)
    return CATCH_UP_SPL / (CATCH_UP_SPL - channel_thresholds)


def recruitment_gains(envelopes: Tensor, ratios: Tensor) -> Tensor:
    """Compute the gains that make soft sounds softer, as an impaired ear perceives them.

    The gain of a channel of the filter bank is (envelope / pressure at 105 dB SPL) ** (ratio - 1).
    It is computed once per step, a group of neighbouring samples with one value of the envelope.
    Envelopes are limited to the range from 2e-8 Pa to 105 dB SPL, so that their logarithm is
    finite. Gains are at most 1, except for ratios below 1, those of thresholds below 0 dB HL. In
    float32, the gains of the softest envelopes are 0 for thresholds above about 88 dB HL.

    Shape: (..., channels, steps), (..., channels) -> (..., channels, steps).

    Args:
        envelopes: Envelopes in Pa.
        ratios: Expansion ratio of each channel, from ``expansion_ratios``.

    >>> envelopes = torch.tensor([[100.0, 3.5481, 0.35481]])
    >>> recruitment_gains(envelopes, torch.tensor([2.0])).round(decimals=3)
    tensor([[1.0000, 1.0000, 0.1000]])
    """
    limited = envelopes.clamp(_MIN_ENVELOPE, _MAX_ENVELOPE)
    log_level = limited.div_(_MAX_ENVELOPE).log()
    return (log_level * (ratios.unsqueeze(-1) - 1.0)).exp_()


def interpolate(values: Tensor, kernel: Tensor) -> Tensor:
    """Interpolate gains or envelopes, of which there is one value per step, to all samples.

    A step is a group of neighbouring samples, 24 at 44.1 kHz, and its value is that at its first
    sample. The values are treated as periodic: the last one is followed by the first.

    Shape: (..., steps), (rows, columns) -> (..., time).

    Args:
        values: Gains or envelopes.
        kernel: Weights from ``interpolation_kernel``, which also decide the number of samples per
            step.

    >>> kernel = torch.from_numpy(interpolation_kernel(samples=2)).float()
    >>> interpolate(torch.ones(8), kernel)[:3].round(decimals=3)
    tensor([1., 1., 1.])
    """
    width, columns = kernel.shape
    steps_per_window = width - _TAPS + 1
    steps = values.shape[-1]
    padded = functional.pad(_pad_periodically(values), (0, -steps % steps_per_window))
    windows = padded.unfold(-1, width, steps_per_window)
    # All windows are rows of one matrix product. Otherwise torch computes one product per channel,
    # which takes twice as long.
    interpolated = (windows.reshape(-1, width) @ kernel).view(*windows.shape[:-2], -1)
    return interpolated[..., : steps * columns // steps_per_window]


def apply_gains(
    channels: Tensor, gains: Tensor, kernel: Tensor, slight: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Multiply the channels of a filter bank by gains that vary in time, and add up the channels.

    There is one gain per step, a group of neighbouring samples; the gains between are interpolated.
    Where the envelope goes through zero, because its low-pass overshoots, the gain changes
    suddenly. After a slight loss this is audible, because the inverse of the middle ear amplifies
    high frequencies by more than 40 dB. There, with the argument ``slight``, the envelope is
    interpolated instead of the gain.

    Shape: (..., channels, time), (..., channels, steps), (rows, columns) -> (..., time), where time
    is the number of steps times ``columns / (rows - 5)``.

    Args:
        channels: Band-pass signals, real, or analytic with alternating real and imaginary parts.
        gains: Gain of each channel and step, from ``recruitment_gains``.
        kernel: Weights from ``interpolation_kernel``.
        slight: Envelopes in pascals, (..., channels, steps), and expansion ratios, (...,
            channels), with which the gains of slight losses are corrected.

    >>> kernel = torch.from_numpy(interpolation_kernel()).float()
    >>> gains = torch.full((2, 8), 0.5)
    >>> apply_gains(torch.ones(2, 8 * STEP), gains, kernel)[:3].round(decimals=3)
    tensor([1., 1., 1.])
    """
    sample_gains = interpolate(gains, kernel)
    if slight is not None:
        envelopes, ratios = slight
        sample_gains = _correct_kinks(sample_gains, envelopes, ratios, kernel)
    return _sum_of_products(channels, sample_gains)


def _correct_kinks(
    sample_gains: Tensor, envelopes: Tensor, ratios: Tensor, kernel: Tensor
) -> Tensor:
    """Replace interpolated gains by gains for the interpolated envelope, where the envelope dips.

    At these dips, interpolated gains would have audible kinks after a slight loss, one below about
    24 dB HL. Gains of other losses stay as they are.

    Shape: (..., channels, time), (..., channels, steps), (..., channels), (rows, columns) ->
        (..., channels, time).

    Args:
        sample_gains: Interpolated linear gains, which may be changed in place.
        envelopes: Envelopes in Pa.
        ratios: Expansion ratios.
        kernel: Weights from ``interpolation_kernel``.
    """
    is_slight = (ratios != 1.0) & (ratios < _SLIGHT_RATIO)
    has_kink = _find_dips(envelopes) & is_slight.unsqueeze(-1)
    samples = sample_gains.shape[-1] // has_kink.shape[-1]
    if has_kink.device.type == "cpu":
        kink_ratios = ratios.unsqueeze(-1).expand(has_kink.shape)[has_kink]
        kink_windows = _pad_periodically(envelopes).unfold(-1, _TAPS, 1)[has_kink]
        kink_envelopes = kink_windows @ kernel[:_TAPS, :samples]
        kink_gains = recruitment_gains(kink_envelopes, kink_ratios)
        sample_gains.unflatten(-1, (-1, samples))[has_kink] = kink_gains
        return sample_gains
    # Indexing by a mask would synchronise with the GPU.
    sample_envelopes = interpolate(envelopes, kernel)
    corrected = recruitment_gains(sample_envelopes, ratios)
    return torch.where(has_kink.repeat_interleave(samples, -1), corrected, sample_gains)


def _sum_of_products(channels: Tensor, factors: Tensor) -> Tensor:
    """Multiply channels by factors, and add up the channels.

    Shape: (..., channels, time), (..., channels, time) -> (..., time).
    """
    if channels.device.type != "cpu":
        return (channels * factors).sum(-2)
    # One channel at a time and in place, the sum stays in the processor's cache. torch's sum takes
    # eight times as long.
    first, *remaining = zip(channels.unbind(-2), factors.unbind(-2), strict=True)
    total = torch.mul(*first)
    for channel, factor in remaining:
        total.addcmul_(channel, factor)
    return total


def _pad_periodically(values: Tensor) -> Tensor:
    """Pad with two values before the first step and three after the last, for interpolation.

    The values are taken from the other end, because the signal is treated as periodic.

    Shape: (..., steps) -> (..., steps + 5).
    """
    return torch.cat((values[..., 1 - AHEAD :], values, values[..., :AHEAD]), -1)


def _find_dips(envelopes: Tensor) -> Tensor:
    """Find the steps where an envelope in Pa is far smaller than close by, such as near zero.

    At such a step or the next, it is below 0.3 times a value up to one step before or after both.

    Shape: (..., steps) -> bool (..., steps).
    """
    limited = envelopes.detach().clamp_min(_MIN_ENVELOPE)
    following = limited.roll(-1, -1)
    low = torch.minimum(limited, following)
    high = torch.maximum(limited, following)
    neighbouring_high = torch.maximum(high.roll(1, -1), high.roll(-1, -1))
    return low < _DIP_RATIO * neighbouring_high


def expand(channels: Tensor, envelopes: Tensor, ratios: Tensor) -> Tensor:
    """Make soft sounds in the channels of a filter bank softer, as an impaired ear perceives them.

    Each channel is multiplied by a gain that follows its envelope, and the channels are added up.

    Shape: (..., channels, time), (..., channels, time // 24), (..., channels) -> (..., time).

    Args:
        channels: Band-pass signals.
        envelopes: Envelopes in Pa at the first sample of each step of 24 samples.
        ratios: Expansion ratio of each channel, from ``expansion_ratios``.

    >>> tone = torch.ones(1, 8 * STEP)
    >>> expand(tone, torch.full((1, 8), 0.35481), torch.tensor([2.0]))[:3].round(decimals=3)
    tensor([0.1000, 0.1000, 0.1000])
    """
    kernel = interpolation_kernel(like=channels)
    gains = recruitment_gains(envelopes, ratios)
    return apply_gains(channels, gains, kernel, (envelopes, ratios))


@constant
def interpolation_kernel(
    samples: int = STEP, repeats: int = 1, steps_per_window: int = 8
) -> NDArray[np.float64]:
    """Compute the weights with which ``interpolate`` turns one value per step into one per sample.

    A step is a group of neighbouring samples. The value of each sample is interpolated from those
    of six steps by Lagrange's polynomial of fifth order. One matrix product interpolates a window
    of several steps.

    Args:
        samples: Number of samples per step.
        repeats: Number of times that each interpolated value is repeated. Analytic signals need 2,
            for their real and imaginary parts.
        steps_per_window: Number of steps in a window. A divisor of the number of all steps is best.

    Returns:
        Weights, (steps_per_window + 5, steps_per_window * samples * repeats).

    >>> interpolation_kernel().shape
    (13, 192)
    """
    nodes = np.arange(_TAPS) - (AHEAD - 1.0)
    positions = np.arange(samples) / samples
    weights = np.ones((_TAPS, samples))
    for i, node in enumerate(nodes):
        for other_node in np.delete(nodes, i):
            weights[i] *= (positions - other_node) / (node - other_node)
    kernel = np.zeros((steps_per_window + _TAPS - 1, steps_per_window, samples))
    for step in range(steps_per_window):
        kernel[step : step + _TAPS, step] = weights
    return kernel.reshape(len(kernel), -1).repeat(repeats, -1)
