"""Fourier transforms with cheap gradients, fast transform lengths, and power spectra."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.torchtools import DifferentiableFunction

FADE_HZ = 80.0
"""Width in Hz of the fade-out at the end of a spectrum that is cut off."""

MAX_POWER_OF_TWO = 256
"""Largest power of two in a fast transform length.

On some processors, MKL takes longer for lengths with a larger one: for 2^10 * 49 points longer than
for 2^4 * 3125.
"""


def rfft(signals: Tensor, points: int | None = None) -> Tensor:
    """Compute the Fourier transform of real signals, with a faster backward pass than autograd's.

    Shape: (..., time) -> complex (..., points // 2 + 1).

    Args:
        signals: Real signals, which are cut or zero-padded to the length of the transform.
        points: Length of the transform, by default that of the signals.

    Raises:
        ValueError: The signals are in half precision, or are integers of less than 32 bits.

    >>> rfft(torch.tensor([1.0, 0.0, -1.0, 0.0]))
    tensor([0.+0.j, 2.+0.j, 0.+0.j])
    """
    if signals.dtype.itemsize < torch.float32.itemsize:
        raise ValueError(
            f"expected signals of float32 or float64, got {signals.dtype}; convert the model with "
            ".float() and, for speed, use torch.autocast"
        )
    points = signals.shape[-1] if points is None else points
    return _RFFT.call(signals[..., :points], points)


class _RFFT(DifferentiableFunction):
    """Real Fourier transform with a hand-written backward pass, which is also a real transform.

    Autograd's backward pass of ``torch.fft.rfft`` is a complex transform, which takes about twice
    as long as a real one.
    """

    @staticmethod
    def forward(signals: Tensor, points: int) -> Tensor:
        return torch.fft.rfft(signals, points)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: Tensor) -> None:
        signals, ctx.points = inputs
        ctx.time = signals.shape[-1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        # The inverse counts each frequency twice, except 0 Hz and, for even lengths, the last one.
        # The weights are complex because torch would convert real ones for each item.
        weights = gradient.new_full(gradient.shape[-1:], 0.5)
        # An assignment to a single number would synchronise with a GPU.
        weights[0].fill_(1.0)
        if ctx.points % 2 == 0:
            weights[-1].fill_(1.0)
        slope = torch.fft.irfft(gradient * weights, ctx.points, norm="forward")
        return slope[..., : ctx.time], None


_ODD_FACTORS = [3**a * 5**b * 7**c for a in range(9) for b in range(6) for c in range(2)]


@lru_cache(maxsize=256)
def fft_length(minimum: int, multiple: int = 1) -> int:
    """Return the smallest length from ``minimum`` on for which Fourier transforms are fast.

    Apart from the factors of ``multiple``, the length is a product of factors 2, at most eight
    factors 3, five factors 5 and one 7. Factors 2 are added only up to the power
    ``MAX_POWER_OF_TWO``.

    Args:
        minimum: Smallest length allowed.
        multiple: Number of which the length is a multiple.

    >>> fft_length(1001)
    1008
    """
    twos_in_multiple = multiple & -multiple
    lengths = []
    for odd in _ODD_FACTORS:
        quotient = max(1, -(-minimum // (multiple * odd)))  # rounded up
        exponent = (quotient - 1).bit_length()  # of the smallest power of two from quotient on
        if exponent == 0 or (exponent < 9 and twos_in_multiple << exponent <= MAX_POWER_OF_TWO):
            lengths.append(multiple * odd << exponent)
    return min(lengths)


def correlate(output: Tensor, reference: Tensor) -> tuple[int, float]:
    """Find the lag at which the cross-correlation of two signals has the largest magnitude.

    The mean of each signal is subtracted first.

    Args:
        output: The output, on the CPU and without a gradient. Shape: (time,).
        reference: Signal with which it is compared, likewise. Shape: (other time,).

    Returns:
        The number of samples by which the output is later, negative if it is earlier; and the
        magnitude of the correlation coefficient at this lag, 0 to 1, or 0 if a signal is constant.

    >>> speech = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    >>> lag, coefficient = correlate(torch.nn.functional.pad(-speech, (32, 0)), speech)
    >>> lag, round(coefficient, 3)
    (32, 1.0)
    """
    signals = [(signal.double() - signal.double().mean()).numpy() for signal in (output, reference)]
    points = fft_length(len(output) + len(reference) - 1)
    spectra = [np.fft.rfft(signal, points) for signal in signals]
    magnitudes = np.abs(np.fft.irfft(spectra[0] * spectra[1].conj(), points))
    peak = int(magnitudes.argmax())
    # The correlations at negative lags are at the end.
    lag = peak if peak < len(output) else peak - points
    scale = np.prod([np.linalg.norm(signal) for signal in signals])
    return lag, float(magnitudes[peak] / scale) if scale else 0.0


def power(spectrum: Tensor) -> Tensor:
    """Compute squared magnitudes of complex numbers, with a faster backward pass than autograd's.

    Shape: complex (...) -> real (...).

    >>> power(torch.tensor([3.0 + 4.0j]))
    tensor([25.])
    """
    return _Power.call(spectrum)


class _Power(DifferentiableFunction):
    """Squared modulus of complex numbers, with a hand-written backward pass.

    The gradient with respect to x is 2 x times that of the result. Autograd's pass takes more
    operations.

    Shape: complex (...) -> real (...).
    """

    @staticmethod
    def forward(spectrum: Tensor) -> Tensor:
        squares = torch.view_as_real(spectrum).square()
        return squares[..., 0] + squares[..., 1]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (spectrum,) = ctx.saved_tensors
        return spectrum * (2.0 * gradient)


def fade_out_weights(bins: int, spacing: float, end: float) -> NDArray[np.float64]:
    """Compute weights that fade a spectrum out over the last 80 Hz below a frequency.

    The weights are 1 up to 80 Hz below this frequency, and then fall to 0. If the spectrum were cut
    off suddenly, signals would ring for seconds, and the length of the transform would decide how
    much of the ringing wraps around.

    Args:
        bins: Number of frequencies of the spectrum.
        spacing: Distance between two frequencies in Hz.
        end: Frequency in Hz at which the weights reach 0.

    Returns:
        Weights, (bins,).

    >>> print(fade_out_weights(5, spacing=40.0, end=160.0).round(2))
    [1.  1.  1.  0.5 0. ]
    """
    distance_to_end = np.clip((end - spacing * np.arange(bins)) / FADE_HZ, 0.0, 1.0)
    return np.sin(0.5 * np.pi * distance_to_end) ** 2
