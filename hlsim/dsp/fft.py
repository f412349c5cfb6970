"""Fourier transforms with cheap gradients, suitable transform lengths, and power spectra."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

FADE_HZ = 80.0
"""Width in Hz of the fade at the end of a spectrum that is cut off."""

MAX_POWER_OF_TWO = 256
"""Largest power of two in a transform length: MKL takes up to three times as long for 2^10 * 49 as for 2^4 * 3125."""


def rfft(signals: Tensor, points: int | None = None) -> Tensor:
    """Real Fourier transform, equal to ``torch.fft.rfft``, with a cheaper gradient.

    Shape: (..., time) -> complex (..., points // 2 + 1).
    """
    points = signals.shape[-1] if points is None else points
    if signals.requires_grad and torch.is_grad_enabled():
        spectrum: Tensor = _RFFT.apply(signals[..., :points], points)
        return spectrum
    return torch.fft.rfft(signals, points)


class _RFFT(torch.autograd.Function):
    """Real transform whose gradient is a real transform; torch's is a complex one of twice the length."""

    @staticmethod
    def forward(signals: Tensor, points: int) -> Tensor:
        return torch.fft.rfft(signals, points)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: Tensor) -> None:
        ctx.time, ctx.points = inputs[0].shape[-1], inputs[1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        # The inverse counts each frequency twice, except 0 Hz and, for even lengths, the last one.
        stride = max(1, ctx.points // 2) if ctx.points % 2 == 0 else ctx.points
        # The weights are complex because torch would convert real ones for each item.
        weights = gradient.new_full(gradient.shape[-1:], 0.5)
        weights[::stride] = 1.0
        slope = torch.fft.irfft(gradient * weights, ctx.points, norm="forward")
        return slope[..., : ctx.time], None


@lru_cache(maxsize=256)
def fft_length(minimum: int, multiple: int = 1) -> int:
    """Smallest length of at least ``minimum`` samples that is a fast transform length and a multiple of ``multiple``."""
    twos_in_multiple = multiple & -multiple
    odd_factors = [3**a * 5**b * 7**c for a in range(9) for b in range(6) for c in range(2)]
    lengths = []
    for odd in odd_factors:
        for exponent in range(9):
            if exponent == 0 or twos_in_multiple << exponent <= MAX_POWER_OF_TWO:
                lengths.append(multiple * odd * 2**exponent)
    return min(length for length in lengths if length >= minimum)


def power(spectrum: Tensor) -> Tensor:
    """Squared modulus. Shape: complex (...) -> (...)."""
    if spectrum.requires_grad and torch.is_grad_enabled():
        powers: Tensor = _Power.apply(spectrum)
        return powers
    return _squared_modulus(spectrum)


def _squared_modulus(spectrum: Tensor) -> Tensor:
    squares = torch.view_as_real(spectrum).square()
    return squares[..., 0] + squares[..., 1]


class _Power(torch.autograd.Function):
    """Squared modulus with a gradient in one step; that of separate real and imaginary parts takes six."""

    @staticmethod
    def forward(spectrum: Tensor) -> Tensor:
        return _squared_modulus(spectrum)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (spectrum,) = ctx.saved_tensors
        return spectrum * (2.0 * gradient)


def soft_end(bins: int, spacing: float, end: float) -> NDArray[np.float64]:
    """Weights that fade a spectrum out towards the frequency where it is cut off: 1, then down to 0 within 80 Hz.

    A sharp end would ring for seconds, and the FFT's length would decide how much of the ringing wraps around.

    Args:
        bins: number of frequencies of the spectrum.
        spacing: distance between two frequencies in Hz.
        end: frequency in Hz at which the weights reach 0.

    Returns: (bins,).
    """
    distance_to_end = np.clip((end - spacing * np.arange(bins)) / FADE_HZ, 0.0, 1.0)
    weights: NDArray[np.float64] = np.sin(0.5 * np.pi * distance_to_end) ** 2
    return weights
