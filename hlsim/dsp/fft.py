"""Fourier transforms: with cheaper gradients, of long rows, on lengths that suit; the power of a spectrum and its end."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.torchtools import constant_like

_LONG = 12000
_EDGE_HZ = 80.0


def rfft(signals: Tensor, points: int | None = None) -> Tensor:
    """``torch.fft.rfft``. Shape: (..., time) -> complex (..., points // 2 + 1)."""
    points = signals.shape[-1] if points is None else points
    if signals.requires_grad and torch.is_grad_enabled():
        result: Tensor = _RFFT.apply(signals[..., :points], points)
        return result
    return torch.fft.rfft(signals, points)


class _RFFT(torch.autograd.Function):
    """With a real transform as gradient, where torch's is a complex one of twice the length."""

    generate_vmap_rule = True

    @staticmethod
    def forward(signals: Tensor, points: int) -> Tensor:
        return torch.fft.rfft(signals, points)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: Tensor) -> None:
        ctx.time, ctx.points = inputs[0].shape[-1], inputs[1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        # the inverse adds each frequency twice but 0 Hz and, of even lengths, the last; complex, for a product of both
        # kinds first makes the real factors so, item by item
        once = gradient.new_full(gradient.shape[-1:], 0.5)
        once[:: max(1, ctx.points // 2) if ctx.points % 2 == 0 else ctx.points] = 1.0
        return torch.fft.irfft(gradient * once, ctx.points, norm="forward")[..., : ctx.time], None


def long_rfft(waveform: Tensor, points: int) -> Tensor:
    """``torch.fft.rfft``; a single long row on a CPU goes as complex numbers, for which MKL takes a third of the time.

    Not where torch has one thread: with complex numbers the last bits were not the same in every process.

    Shape: (..., time) -> (..., points // 2 + 1).
    """
    if not _is_long_row(waveform, points):
        return rfft(waveform, points)
    return torch.fft.fft(waveform.to(waveform.dtype.to_complex()), points)[..., : points // 2 + 1]


def long_irfft(spectrum: Tensor, points: int) -> Tensor:
    """``torch.fft.irfft``, the inverse of ``long_rfft``, of a spectrum that may end early: zeros follow.

    Shape: (..., points // 2 + 1 or less) -> (..., points).
    """
    if not _is_long_row(spectrum, points):
        return torch.fft.irfft(spectrum, points)
    return torch.fft.ifft(
        spectrum * constant_like(spectrum, _sides, spectrum.shape[-1], points), points
    ).real


def _is_long_row(signal: Tensor, points: int) -> bool:
    if signal.device.type != "cpu" or torch.get_num_threads() == 1 or torch.compiler.is_compiling():
        return False  # compiled programs are for any number of threads, and ONNX pads no complex numbers
    return points >= _LONG and points % 2 == 0 and signal.numel() == signal.shape[-1]


def _sides(bins: int, points: int) -> NDArray[np.float64]:
    """How often each frequency is in a spectrum, negative ones counted too. Returns (bins,)."""
    sides = np.full(bins, 2.0)
    sides[:: points // 2] = 1.0
    return sides


@lru_cache(maxsize=256)
def fft_length(least: int, multiple: int = 1) -> int:
    """The next length of small primes that is a multiple of ``multiple``.

    No more than 8 twos: MKL takes up to three times as long for a row of 2^10 * 49 as for one of 2^4 * 3125.
    """
    spare = multiple & -multiple  # twos that it has already
    odd = [3**a * 5**b * 7**c for a in range(9) for b in range(6) for c in range(2)]
    lengths = [
        multiple * o * 2**twos
        for o in odd
        for twos in range(9)
        if twos == 0 or spare << twos <= 256
    ]
    return min(length for length in lengths if length >= least)


def power(spectrum: Tensor) -> Tensor:
    """Squared modulus. Shape: complex (...) -> (...)."""
    if spectrum.requires_grad and torch.is_grad_enabled():
        result: Tensor = _Power.apply(spectrum)
        return result
    return _power(spectrum)


def _power(spectrum: Tensor) -> Tensor:
    squares = torch.view_as_real(spectrum).square()
    return squares[..., 0] + squares[..., 1]


class _Power(torch.autograd.Function):
    """With a gradient of one step, where that of real and imaginary part apart takes six."""

    generate_vmap_rule = True

    @staticmethod
    def forward(spectrum: Tensor) -> Tensor:
        return _power(spectrum)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (spectrum,) = ctx.saved_tensors
        return spectrum * (2.0 * gradient)


def soft_end(bins: int, hz: float, end: float) -> NDArray[np.float64]:
    """Factors on a spectrum that ends where there is more to come: 1, and down to 0 within the last 80 Hz.

    A sharp end would ring on for seconds, and how much of that comes round again depends on the FFT's length.

    Args:
        bins: of the spectrum.
        hz: from one to the next.
        end: in Hz.

    Returns: (bins,).
    """
    left = np.clip((end - hz * np.arange(bins)) / _EDGE_HZ, 0.0, 1.0)
    factors: NDArray[np.float64] = np.sin(0.5 * np.pi * left) ** 2
    return factors
