"""Loudness recruitment: each channel is expanded by a gain that follows its envelope.

The envelope is low-passed at 75 Hz or less, so that it and the gain are computed at a 24th of the rate and the gain
is interpolated, or, where the envelope is near zero, the envelope.
"""

from functools import lru_cache
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import ellip
from torch import Tensor

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import PASCAL_SPL
from hlsim.msbg.ear import RATE
from hlsim.msbg.filterbank import FilterBank, erb
from hlsim.spectrum import power, rfft

CATCH_UP_SPL = 105.0
"""Level in dB SPL at which the impaired ear hears as loud as a normal one."""

STEP = 24
"""Samples from one value of the gain to the next."""

# pyclarity limits the envelope to 1e-9 of its full scale of 120 dB SPL
_LOWEST_ENVELOPE = 1e-9 * 10.0 ** ((120.0 - PASCAL_SPL) / 20.0)
_HIGHEST_ENVELOPE = 10.0 ** ((CATCH_UP_SPL - PASCAL_SPL) / 20.0)
_BOXES = 3  # three running means of 24 samples put zeros of third order where decimation would alias to 0 Hz
_TAPS = 6

AHEAD = _TAPS // 2
"""Steps ahead of a sample that its gain is interpolated from."""

_SLIGHT = 1.3  # expansion ratio at 24 dB HL
_TINY = 1e-30  # Pa^2, keeps the gradients of silence finite


def expansion_ratios(thresholds: Tensor, bank: FilterBank) -> Tensor:
    """Ratio 105 / (105 - threshold) by which each channel's level is expanded.

    Thresholds are interpolated linearly over Hz and extended flat below 250 and above 8000 Hz.

    Shape: (..., 8) dB HL -> (..., channels).
    """
    weights = torch.from_numpy(_interpolation(bank.centre_frequencies)).to(thresholds)
    return CATCH_UP_SPL / (CATCH_UP_SPL - thresholds @ weights)


def detect(signals: Tensor, harmonics: bool) -> Tensor:
    """What a full-wave rectifier makes of the real part of analytic signals, times pi / 2, less its harmonics.

    Shape: complex (...) -> (...).

    Args:
        harmonics: with the lower two: |cos a| is 2 / pi (1 + 2/3 cos 2a - 2/15 cos 4a ...); otherwise the modulus.
    """
    if signals.requires_grad and torch.is_grad_enabled():
        return cast(Tensor, _Detect.apply(signals, harmonics)[0])
    return _detect(signals, harmonics)[0]


def _detect(signals: Tensor, harmonics: bool) -> tuple[Tensor, ...]:
    """What is detected; with harmonics also the modulus, and the squared cosine of the angle."""
    squared = power(signals).add_(_TINY)
    if not harmonics:
        return (squared.sqrt_(),)  # torch's own modulus takes four times as long
    cosine, modulus = signals.real.square() / squared, squared.sqrt()
    return modulus * ((cosine * (-16 / 15) + 12 / 5) * cosine + 1 / 5), modulus, cosine


class _Detect(torch.autograd.Function):
    """``_detect`` with a gradient of half the steps."""

    generate_vmap_rule = True

    @staticmethod
    def forward(signals: Tensor, harmonics: bool) -> tuple[Tensor, ...]:
        return _detect(signals, harmonics)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, bool], output: tuple[Tensor, ...]) -> None:
        ctx.harmonics = inputs[1]
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(inputs[0], *output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *others: Tensor) -> tuple[Tensor, None]:
        signals, *detected = ctx.saved_tensors
        if not ctx.harmonics:
            return signals * (gradient / detected[0]), None
        # with a gradient of its own, what is constant here comes from the signals anew
        _, modulus, cosine = _detect(signals, True) if torch.is_grad_enabled() else detected
        share = gradient / modulus
        along = share * ((cosine * (16 / 5) - 20 / 3) * cosine + 5)
        across = share * ((cosine * (16 / 5) - 12 / 5) * cosine + 1 / 5)
        return torch.complex(signals.real * along, signals.imag * across), None


def decimate(rectified: Tensor, kernel: Tensor) -> Tensor:
    """Weighted sums of each step's samples, for ``smooth``. Shape: (..., time), (3, 24 // step) -> (..., 3, steps)."""
    return kernel @ rectified.unflatten(-1, (-1, kernel.shape[-1])).mT


def smooth(sums: Tensor, lowpass: Tensor) -> Tensor:
    """Envelopes at samples 0, 24, ... from the sums of ``decimate``; periodic.

    Shape: (..., channels, 3, steps), (channels, steps // 2 + 1) -> (..., channels, steps).
    """
    before, here, after = sums.unbind(-2)
    slow = (here + before.roll(1, -1)).add_(after.roll(-1, -1))
    return torch.fft.irfft(rfft(slow).mul_(lowpass), slow.shape[-1])


def envelope(channels: Tensor, lowpass: Tensor) -> Tensor:
    """Full-wave rectify at 44.1 kHz and low-pass, zero-phase, at a 24th of the rate.

    Shape: (..., channels, time), (channels, time // 48 + 1) -> (..., channels, time // 24), the values at samples 0, 24,
    ...; ``time`` is a multiple of 24 and the signal is taken as periodic.
    """
    kernel = torch.from_numpy(decimation_kernel()).to(channels)
    return smooth(decimate(channels.abs(), kernel), lowpass)


def gains(envelopes: Tensor, ratios: Tensor) -> Tensor:
    """The recruitment gain (envelope / catch-up level) ** (ratio - 1).

    Shape: (..., channels, steps), (..., channels) -> (..., channels, steps).
    """
    level = envelopes.clamp(_LOWEST_ENVELOPE, _HIGHEST_ENVELOPE).div_(_HIGHEST_ENVELOPE).log()
    return (level * (ratios.unsqueeze(-1) - 1.0)).exp_()


def interpolate(values: Tensor, kernel: Tensor) -> Tensor:
    """Values between the steps' ones; periodic. Shape: (..., steps), ``interpolation_kernel`` -> (..., time)."""
    reach, columns = kernel.shape
    together = reach - _TAPS + 1
    steps = values.shape[-1]
    windows = _around(values, -steps % together).unfold(-1, reach, together)
    # as one product, for matmul makes one a channel of it, at twice the cost
    fine = (windows.reshape(-1, reach) @ kernel).view(*windows.shape[:-2], -1)
    return fine if steps % together == 0 else fine[..., : steps * columns // together]


def weigh(
    channels: Tensor, gain: Tensor, kernel: Tensor, slight: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Interpolate the gains, apply them and sum the channels.

    Shape: (..., channels, time), (..., channels, steps), ``interpolation_kernel`` -> (..., time).

    Args:
        slight: envelopes (..., channels, steps) and ratios (..., channels), where some ratios are slight. The low-pass
            overshoots, and where the envelope goes through zero the gain has kinks. A small loss does not bury them,
            and the way out of the ear lifts their upper end by 40 dB, so that there the envelope is interpolated instead.
    """
    full = interpolate(gain, kernel)
    if slight is not None:
        envelopes, ratios = slight
        steep = _steep(envelopes) & ((ratios != 1.0) & (ratios < _SLIGHT)).unsqueeze(-1)
        every = full.shape[-1] // steep.shape[-1]
        if steep.device.type == "cpu":
            own = ratios.unsqueeze(-1).expand(steep.shape)[steep]
            about = _around(envelopes).unfold(-1, _TAPS, 1)[steep]
            full.unflatten(-1, (-1, every))[steep] = gains(about @ kernel[:_TAPS, :every], own)
        else:  # indices would have to come back from the device
            fine = gains(interpolate(envelopes, kernel), ratios)
            full = torch.where(steep.repeat_interleave(every, -1), fine, full)
    if torch.is_grad_enabled() and (channels.requires_grad or full.requires_grad):
        return cast(Tensor, _SumOfProducts.apply(channels, full))
    return _sum_of_products(channels, full)


def _sum_of_products(channels: Tensor, factors: Tensor) -> Tensor:
    """Shape: (..., channels, time) twice -> (..., time)."""
    first, *others = zip(channels.unbind(-2), factors.unbind(-2), strict=True)
    total = torch.mul(*first)
    # in place, a channel at a time: it stays in the processor's cache, and torch's sum takes eight times as long
    for channel, factor in others:
        total.addcmul_(channel, factor)
    return total


class _SumOfProducts(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(channels: Tensor, factors: Tensor) -> Tensor:
        return _sum_of_products(channels, factors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        channels, factors = ctx.saved_tensors
        every = gradient.unsqueeze(-2)
        return every * factors, every * channels


def _around(values: Tensor, more: int = 0) -> Tensor:
    """With those that the interpolation at the ends needs, and zeros. Shape: (..., steps) -> (..., steps + 5 + more)."""
    zeros = values.new_zeros(*values.shape[:-1], more)
    return torch.cat((values[..., 1 - AHEAD :], values, values[..., :AHEAD], zeros), -1)


def _steep(envelopes: Tensor) -> Tensor:
    """Where an envelope goes through zero. Shape: (..., steps) -> (..., steps)."""
    floored = envelopes.detach().clamp_min(_LOWEST_ENVELOPE)
    low = torch.minimum(floored, floored.roll(-1, -1))
    high = torch.maximum(floored, floored.roll(-1, -1))
    return low < 0.3 * torch.maximum(high.roll(1, -1), high.roll(-1, -1))


def expand(channels: Tensor, envelopes: Tensor, ratios: Tensor) -> Tensor:
    """Apply the recruitment gain at 44.1 kHz and sum the channels.

    Shape: (..., channels, time), (..., channels, time // 24), (..., channels) -> (..., time).
    """
    kernel = torch.from_numpy(interpolation_kernel()).to(channels)
    return weigh(channels, gains(envelopes, ratios), kernel, (envelopes, ratios))


def envelope_lowpass(
    bank: FilterBank, points: int, step: int = 1, channels: slice = slice(None)
) -> NDArray[np.complex128]:
    """Response that turns the rfft of ``decimate``'s means into that of the envelope at samples 0, 24, ...

    The low-pass is ``ellip(2, 0.25, 35)`` at 3/4 of 100 Hz or of the channel's ERB if less, run forwards and backwards
    as pyclarity does with ``filtfilt``; what that does at the end is in ``hlsim.msbg.ending``.

    Args:
        points: FFT length at 44.1 kHz, a multiple of 24.
        step: samples at 44.1 kHz from one of the rectified signal's to the next.
        channels: which of the bank's; all by default.

    Returns: (channels, points // 48 + 1).
    """
    omega = 2.0 * np.pi * np.arange(points // STEP // 2 + 1) / points
    powers = np.exp(-1j * omega) ** np.arange(3)[:, None]
    numerators, denominators = np.array(envelope_filters(bank)[channels]).swapaxes(0, 1)
    rows = np.abs((numerators @ powers) / (denominators @ powers)) ** 2
    with np.errstate(invalid="ignore"):
        box = np.sin(STEP * omega / 2.0) / (STEP // step * np.sin(step * omega / 2.0))
    box[0] = 1.0
    return rows / box**_BOXES * np.exp(-0.5j * (STEP - step) * omega)


@lru_cache(maxsize=4)
def envelope_filters(bank: FilterBank) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Numerator and denominator of each channel's low-pass."""
    widths = erb(np.array(bank.centre_frequencies))
    return [ellip(2, 0.25, 35, 0.75 * min(100.0, width) / (RATE / 2.0)) for width in widths]


@lru_cache(maxsize=8)
def _interpolation(centre_frequencies: tuple[float, ...]) -> NDArray[np.float64]:
    return np.array([np.interp(centre_frequencies, FREQUENCIES, row) for row in np.eye(len(FREQUENCIES))])


@lru_cache(maxsize=8)
def decimation_kernel(step: int = 1) -> NDArray[np.float64]:
    """Weights of a block's samples in the mean around the block after it, itself and the one before.

    Returns: (3, 24 // step).
    """
    samples = STEP // step
    box = np.full(samples, 1.0 / samples)
    kernel = np.pad(np.convolve(np.convolve(box, box), box), 1)
    return np.ascontiguousarray(kernel.reshape(_BOXES, samples))


@lru_cache(maxsize=16)
def interpolation_kernel(step: int = 1, parts: int = 1, together: int = 8) -> NDArray[np.float64]:
    """Weights of the values about some steps for the samples of these: six count for each, after Lagrange.

    Args:
        parts: of a sample, one after the other, that weigh alike.
        together: steps that a matrix product interpolates at once; best a divisor of their number.

    Returns: (together + 5, together * 24 // step * parts).
    """
    nodes = np.arange(_TAPS) - (_TAPS // 2 - 1.0)
    place = np.arange(0, STEP, step) / STEP
    weights = np.ones((_TAPS, len(place)))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            weights[i] *= (place - other) / (node - other)
    kernel = np.zeros((_TAPS + together - 1, together, len(place)))
    for i in range(together):
        kernel[i : i + _TAPS, i] = weights
    return kernel.reshape(len(kernel), -1).repeat(parts, -1)
