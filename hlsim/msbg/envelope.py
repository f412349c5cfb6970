"""Envelopes of the channels: rectified signals after a low-pass of at most 75 Hz.

Envelopes vary so slowly that they are computed only once per *step* of 24 samples at 44.1 kHz (24.5
if signals run at 22.05 kHz), in three stages:

1. Rectify each channel. For most channels at reduced rates, ``detect`` computes the rectified
   channel without the harmonics that would alias.
2. Average the rectified samples of each step with three running means, so that few frequencies
   alias. ``partial_means`` computes the contributions of each step to its own average and to those
   of its two neighbours.
3. Add up the contributions and apply the low-pass (``smooth``).
"""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.erb import erb
from hlsim.dsp.fft import power, rfft
from hlsim.dsp.iir import ELLIPTIC, coefficients, digital_filter
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.filter_bank import FilterBank
from hlsim.torchtools import DifferentiableFunction, constant

STEP = 24
"""Samples per step where signals run at 44.1 kHz: from one value of an envelope to the next."""

HALF_RATE_STEP = 24.5
"""Samples at 44.1 kHz per step where signals run at 22.05 kHz: 1800 steps per second.

With this step, the FFT lengths that 22.05 kHz shares with 16 kHz have fewer factors of 7.
"""

_RUNNING_MEANS = 3
"""Number of running means over one step, applied one after the other.

Together they have zeros of third order at the frequencies that alias to 0 Hz.
"""

POWER_FLOOR = 1e-30
"""Number that is added to squared moduli, which keeps the gradients of silence finite."""


def detect(signals: Tensor, harmonics: bool) -> Tensor:
    """Compute rectified band-pass signals where the sample rate is too low for a rectifier.

    Rectifying a signal at a low rate would fold its harmonics back to low frequencies. A rectified
    cosine is |cos a| = 2 / pi (1 + 2/3 cos 2a - 2/15 cos 4a + ...). Its slow part is
    2 / pi times the modulus of the analytic signal, exp(i a). Therefore the result is pi / 2 times
    the rectified real part, without its harmonics or with the first two of them.

    Shape: complex (...) -> real (...).

    Args:
        signals: Analytic signals, complex signals without negative frequencies.
        harmonics: Whether the terms of cos 2a and cos 4a are included. Wide bands at low
            frequencies need them, because these terms reach down to the frequencies of the
            envelope.

    >>> detect(torch.tensor([3.0 + 4.0j]), harmonics=False)
    tensor([5.])
    """
    if harmonics:
        return _ModulusWithHarmonics.call(signals)[0]
    # torch's modulus of complex numbers takes four times as long.
    return power(signals).add_(POWER_FLOOR).sqrt_()


def _modulus_with_harmonics(signals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the result of ``detect`` with harmonics, and intermediate results for its gradient.

    Shape: complex (...) -> (...), (...), (...).

    Returns:
        The result, the modulus, and the squared cosine of the phase.
    """
    squared_modulus = power(signals).add_(POWER_FLOOR)
    squared_cosine = signals.real.square() / squared_modulus
    modulus = squared_modulus.sqrt()
    # The sum of the constant and both cosines, as a polynomial in the squared cosine of the phase
    shape = (squared_cosine * (-16 / 15) + 12 / 5) * squared_cosine + 1 / 5
    return modulus * shape, modulus, squared_cosine


class _ModulusWithHarmonics(DifferentiableFunction):
    """``_modulus_with_harmonics`` with a hand-written backward pass, in half of autograd's time.

    Let r be the modulus of the signal x + i y, c = x^2 / r^2 the squared cosine of its phase, and
    r P(c) the result with P(c) = 1/5 + 12/5 c - 16/15 c^2. Then dr/dx = x / r, dr/dy = y / r,
    dc/dx = 2 x (1 - c) / r^2 and dc/dy = -2 y c / r^2, so that the derivative

    - with respect to x is x / r (P + 2 (1 - c) P'), which is x / r (5 - 20/3 c + 16/5 c^2);
    - with respect to y is y / r (P - 2 c P'), which is y / r (1/5 - 12/5 c + 16/5 c^2).
    """

    @staticmethod
    def forward(signals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return _modulus_with_harmonics(signals)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*inputs, *output[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> Tensor:
        signals, modulus, squared_cosine = ctx.saved_tensors
        if torch.is_grad_enabled():
            # This gradient is itself differentiated, so it must depend on the signals.
            modulus, squared_cosine = _modulus_with_harmonics(signals)[1:]
        scaled = gradient / modulus
        # Both polynomials in c of the formulae above, by Horner's rule
        real_factor = scaled * ((squared_cosine * (16 / 5) - 20 / 3) * squared_cosine + 5)
        imag_factor = scaled * ((squared_cosine * (16 / 5) - 12 / 5) * squared_cosine + 1 / 5)
        return torch.complex(signals.real * real_factor, signals.imag * imag_factor)


def partial_means(rectified: Tensor, weights: Tensor) -> Tensor:
    """Reduce rectified signals to three sums per step, from which ``smooth`` computes envelopes.

    A step is a group of neighbouring samples, 24 at 44.1 kHz, with one value of the envelope. This
    value is a weighted average over three steps. The three sums are the contributions of the
    samples of a step to the averages of the step after, of the same step and of the step before.

    Shape: (..., time), (3, samples) -> (..., 3, steps), where time is steps * samples.

    Args:
        rectified: Rectified signals.
        weights: Weight of each sample of a step in the three sums, from ``mean_weights``.

    >>> partial_means(torch.ones(1, 48), torch.from_numpy(mean_weights()).float()).shape
    torch.Size([1, 3, 2])
    """
    return weights @ rectified.unflatten(-1, (-1, weights.shape[-1])).mT


def smooth(sums: Tensor, lowpass: Tensor) -> Tensor:
    """Compute the envelopes of channels from the sums of ``partial_means``.

    The sums that belong to one step are added up, and a low-pass for each channel smooths the
    result. The signals are treated as periodic: their end is followed by their beginning.

    Shape: (..., channels, 3, steps), (channels, steps // 2 + 1) -> (..., channels, steps).

    Args:
        sums: Sums from ``partial_means``.
        lowpass: Frequency responses of the low-passes, from ``envelope_lowpass``.

    Returns:
        Envelopes at the first sample of each step.

    >>> smooth(torch.ones(1, 3, 4), torch.ones(1, 3))
    tensor([[3., 3., 3., 3.]])
    """
    for_step_after, for_same_step, for_step_before = sums.unbind(-2)
    means = for_same_step + for_step_after.roll(1, -1)
    means.add_(for_step_before.roll(-1, -1))
    return torch.fft.irfft(rfft(means).mul_(lowpass), means.shape[-1])


def envelope(channels: Tensor, lowpass: Tensor) -> Tensor:
    """Compute the envelopes of band-pass signals at 44.1 kHz, their magnitudes that vary slowly.

    The signals are rectified and low-passed without delay. One value is computed for the first
    sample of every 24. The signals are treated as periodic: their end is followed by their
    beginning.

    Shape: (..., channels, time), (channels, time // 48 + 1) -> (..., channels, time // 24), where
        time is a multiple of 24.

    Args:
        channels: Band-pass signals, the channels of a filter bank.
        lowpass: Frequency responses of the low-passes, from ``envelope_lowpass``.

    >>> envelope(torch.full((1, 96), -2.0), torch.ones(1, 3)).round(decimals=3)
    tensor([[2., 2., 2., 2.]])
    """
    weights = mean_weights(like=channels)
    return smooth(partial_means(channels.abs(), weights), lowpass)


@constant
def envelope_lowpass(
    bank: FilterBank,
    points: int,
    samples: int = STEP,
    channels: slice = slice(None),
    step: float = STEP,
) -> NDArray[np.complex128]:
    """Compute the frequency response of the low-pass that smooths the envelope of each channel.

    A step is a group of neighbouring samples with one value of the envelope. Each low-pass is run
    forwards and backwards, as by pyclarity with ``scipy.signal.filtfilt``. The responses also
    compensate for the averaging in ``partial_means``, which attenuates high frequencies and is
    centred on the middle of a step. ``hlsim.msbg.filtfilt_end`` computes the effect of ``filtfilt``
    on the end of a signal.

    Args:
        bank: Filter bank to which the channels belong.
        points: FFT length of the signals at 44.1 kHz, a whole number of steps.
        samples: Number of samples of a rectified channel per step.
        channels: Channels of the bank, by default all of them.
        step: Length of a step in samples at 44.1 kHz.

    Returns:
        Complex responses, (channels, steps // 2 + 1).

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> envelope_lowpass(BANKS["mild"], points=4800).shape
    (36, 101)
    """
    omega = 2.0 * np.pi * np.arange(round(points / step) // 2 + 1) / points
    z_powers = np.exp(-1j * omega) ** np.arange(3)[:, None]
    numerators, denominators = np.array(envelope_filters(bank)[channels]).swapaxes(0, 1)
    forward_and_backward = np.abs((numerators @ z_powers) / (denominators @ z_powers)) ** 2
    with np.errstate(invalid="ignore"):
        mean_response = np.sin(step * omega / 2.0) / (
            samples * np.sin(step / samples * omega / 2.0)
        )
    mean_response[0] = 1.0
    # The means are centred on the middle of a step, and the envelope is wanted at its beginning.
    shift = np.exp(-0.5j * (step - step / samples) * omega)
    return forward_and_backward / mean_response**_RUNNING_MEANS * shift


@lru_cache(maxsize=4)
def envelope_filters(bank: FilterBank) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Design the low-pass at 44.1 kHz that smooths the envelope of each channel of a filter bank.

    The low-pass is an elliptic filter of second order, with 0.25 dB of ripple up to its cut-off
    frequency. The cut-off is 75 Hz, or three quarters of the equivalent rectangular bandwidth of a
    normal filter at the channel's centre frequency if that is lower. The broadening of the bank has
    no effect.

    Args:
        bank: Filter bank of a severity.

    Returns:
        Numerator and denominator for each channel, three coefficients each.

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> len(envelope_filters(BANKS["mild"]))
    36
    """
    widths = erb(np.array(bank.centre_frequencies))
    cutoffs = 0.75 * np.minimum(100.0, widths)
    return [coefficients(digital_filter(ELLIPTIC, cutoff, MSBG_RATE)) for cutoff in cutoffs]


@constant
def mean_weights(samples: int = STEP) -> NDArray[np.float64]:
    """Compute the weights for ``partial_means``: how much each sample contributes to averages.

    A step is a group of neighbouring samples with one value of the envelope. This value is a
    weighted average over three steps. The weights are largest in the middle: they are those of
    three running means in series, each as long as a step.

    Args:
        samples: Number of samples per step.

    Returns:
        Weights of the samples of a step, (3, samples): row 0 in the average of the following step,
        row 1 in that of the same step, row 2 in that of the preceding step.

    >>> print(mean_weights(3).sum(-1).round(3))
    [0.148 0.704 0.148]
    """
    box = np.full(samples, 1.0 / samples)
    weights = np.pad(np.convolve(np.convolve(box, box), box), 1)
    return np.ascontiguousarray(weights.reshape(_RUNNING_MEANS, samples))
