"""Envelopes of the channels: rectified, and low-passed at 75 Hz or less, so that every 24th sample or so tells all."""

from functools import lru_cache
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.erb import erb
from hlsim.dsp.fft import power, rfft
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.filterbank import FilterBank
from hlsim.torchtools import constant_like

STEP = 24
"""Samples at 44.1 kHz from one value of an envelope, and of the gain that follows it, to the next."""

HALF_RATE_STEP = 24.5
"""The same where signals run at 22.05 kHz: 1800 values a second, so that FFTs which 16 kHz shares have fewer sevens."""

# scipy.signal.ellipap(2, 0.25, 35): the analogue filter with its cut-off at 1 rad/s
_PROTOTYPE_ZEROS = np.array([10.769854436276223j, -10.769854436276223j])
_PROTOTYPE_POLES = np.array(
    [-0.8899906387998329 - 1.1535893623216336j, -0.8899906387998329 + 1.1535893623216336j]
)
_PROTOTYPE_GAIN = 0.017782794100389257

_BOXES = 3  # running means of a step's samples put zeros of third order where decimation would alias to 0 Hz
_TINY = 1e-30  # Pa^2, keeps the gradients of silence finite


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
        return (squared.sqrt_(),)  # torch's modulus takes four times as long
    cosine, modulus = signals.real.square() / squared, squared.sqrt()
    return modulus * ((cosine * (-16 / 15) + 12 / 5) * cosine + 1 / 5), modulus, cosine


class _Detect(torch.autograd.Function):
    """``_detect`` with a gradient of half the steps."""

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
        # where the gradient is differentiated, what is constant here comes from the signals anew
        _, modulus, cosine = _detect(signals, True) if torch.is_grad_enabled() else detected
        share = gradient / modulus
        along = share * ((cosine * (16 / 5) - 20 / 3) * cosine + 5)
        across = share * ((cosine * (16 / 5) - 12 / 5) * cosine + 1 / 5)
        return torch.complex(signals.real * along, signals.imag * across), None


def decimate(rectified: Tensor, kernel: Tensor) -> Tensor:
    """Weighted sums of each step's samples, for ``smooth``. Shape: (..., time), (3, samples) -> (..., 3, steps)."""
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
    kernel = constant_like(channels, decimation_kernel)
    return smooth(decimate(channels.abs(), kernel), lowpass)


def envelope_lowpass(
    bank: FilterBank,
    points: int,
    samples: int = STEP,
    channels: slice = slice(None),
    step: float = STEP,
) -> NDArray[np.complex128]:
    """Response that turns the rfft of ``decimate``'s means into that of the envelope at the steps.

    The low-pass is ``ellip(2, 0.25, 35)`` at 3/4 of 100 Hz or of the channel's ERB if less, run forwards and backwards
    as pyclarity does with ``filtfilt``; what that does at the end is in ``hlsim.msbg.filtfilt_end``.

    Args:
        points: FFT length at 44.1 kHz, a whole number of steps.
        samples: of the rectified signal in each step.
        channels: which of the bank's; all by default.
        step: samples at 44.1 kHz.

    Returns: (channels, steps // 2 + 1).
    """
    omega = 2.0 * np.pi * np.arange(round(points / step) // 2 + 1) / points
    powers = np.exp(-1j * omega) ** np.arange(3)[:, None]
    numerators, denominators = np.array(envelope_filters(bank)[channels]).swapaxes(0, 1)
    rows = np.abs((numerators @ powers) / (denominators @ powers)) ** 2
    with np.errstate(invalid="ignore"):
        box = np.sin(step * omega / 2.0) / (samples * np.sin(step / samples * omega / 2.0))
    box[0] = 1.0
    return rows / box**_BOXES * np.exp(-0.5j * (step - step / samples) * omega)


@lru_cache(maxsize=4)
def envelope_filters(bank: FilterBank) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Numerator and denominator of each channel's low-pass."""
    widths = erb(np.array(bank.centre_frequencies))
    return [elliptic_lowpass(0.75 * min(100.0, width) / (MSBG_RATE / 2.0)) for width in widths]


def elliptic_lowpass(cutoff: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The elliptic low-pass of second order with 0.25 dB ripple and 35 dB attenuation.

    The result is that of ``scipy.signal.ellip(2, 0.25, 35, cutoff)``, whose import takes half a second.

    Args:
        cutoff: over the Nyquist frequency.

    Returns: numerator and denominator, three coefficients each.
    """
    scale = 4.0 * np.tan(np.pi * cutoff / 2.0)
    zeros, poles = scale * _PROTOTYPE_ZEROS, scale * _PROTOTYPE_POLES
    # the bilinear transform with a sample rate of 2
    gain = _PROTOTYPE_GAIN * np.real(np.prod(4.0 - zeros) / np.prod(4.0 - poles))
    numerator, denominator = (
        np.convolve([1.0, -first], [1.0, -second]).real
        for first, second in ((4.0 + zeros) / (4.0 - zeros), (4.0 + poles) / (4.0 - poles))
    )
    return gain * numerator, denominator


@lru_cache(maxsize=8)
def decimation_kernel(samples: int = STEP) -> NDArray[np.float64]:
    """Weights of a step's samples in the mean around the step after it, itself and the one before.

    Returns: (3, samples).
    """
    box = np.full(samples, 1.0 / samples)
    kernel = np.pad(np.convolve(np.convolve(box, box), box), 1)
    return np.ascontiguousarray(kernel.reshape(_BOXES, samples))
