"""Long Fourier transforms and filters on their grids: the linear half of MSBG."""

import math
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.compiling import lasting

_BLOCK, _HOP = 4096, 3072
"""Blocks of ``filter_blocks``; taps may be 1025 at most."""

_LONG = 12000

_EDGE_HZ = 80.0


def rfft(waveform: Tensor, points: int) -> Tensor:
    """``torch.fft.rfft``; a single long row on a CPU goes as complex numbers, for which MKL takes a third of the time.

    Not where torch has one thread: with complex numbers the last bits were not the same in every process.

    Shape: (..., time) -> (..., points // 2 + 1).
    """
    if not _long_row(waveform, points):
        return torch.fft.rfft(waveform, points)
    return torch.fft.fft(waveform.to(waveform.dtype.to_complex()), points)[..., : points // 2 + 1]


def irfft(spectrum: Tensor, points: int) -> Tensor:
    """``torch.fft.irfft``, the inverse of ``rfft``, of a spectrum that may end early: zeros follow.

    Shape: (..., points // 2 + 1 or less) -> (..., points).
    """
    if not _long_row(spectrum, points):
        return torch.fft.irfft(spectrum, points)
    sides = _sides(spectrum.shape[-1], points, spectrum.real.dtype, spectrum.device)
    return torch.fft.ifft(spectrum * sides, points).real


@lru_cache(maxsize=16)
def _sides(bins: int, points: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """How often each frequency is in a spectrum, negative ones counted too. Shape: (bins,)."""
    with lasting():
        sides = torch.full((bins,), 2.0, dtype=dtype, device=device)
        sides[:: points // 2] = 1.0
        return sides


def filter_centred(waveform: Tensor, taps: Tensor) -> Tensor:
    """FIR of as many samples before as after, which does not delay. Shape: (..., time), (..., 2 reach) -> (..., time)."""
    time, reach = waveform.shape[-1], taps.shape[-1] // 2
    points = fft_length(time + 2 * reach, 4)
    if torch.compiler.is_exporting():
        points = 1 << (points - 1).bit_length()  # at other lengths onnxruntime is off by 1e-3 to 1e-2
    return irfft(rfft(waveform, points) * rfft(taps, points), points)[..., reach : reach + time]


def filter_blocks(waveform: Tensor, response: Tensor, length: int) -> Tensor:
    """Causal FIR by overlapping blocks, whose short transforms take a quarter of a long one's time.

    Shape: (..., time), (2049,) -> (..., length).

    Args:
        response: of at most 1025 taps, on the grid of ``block_points``.
    """
    lead = _BLOCK - _HOP
    blocks = math.ceil(length / _HOP)
    padded = functional.pad(waveform, (lead, blocks * _HOP - waveform.shape[-1]))
    frames = torch.fft.rfft(padded.unfold(-1, _BLOCK, _HOP)) * response
    return torch.fft.irfft(frames, _BLOCK)[..., lead:].flatten(-2)[..., :length]


def block_points() -> int:
    """FFT length of ``filter_blocks``."""
    return _BLOCK


@lru_cache(maxsize=256)
def fft_length(least: int, multiple: int = 1) -> int:
    """The next length of small primes that is a multiple of ``multiple``.

    No more than 8 twos: MKL takes up to three times as long for a row of 2^10 * 49 as for one of 2^4 * 3125.
    """
    spare = multiple & -multiple  # twos that it has already
    odd = [3**a * 5**b * 7**c for a in range(9) for b in range(6) for c in range(4)]
    lengths = [multiple * o * 2**twos for o in odd for twos in range(9) if twos == 0 or spare << twos <= 256]
    return min(length for length in lengths if length >= least)


def edge(bins: int, hz: float, end: float) -> NDArray[np.float64]:
    """Factors on a spectrum that ends where there is more to come: 1, and down to 0 within the last 80 Hz.

    A sharp end would ring on for seconds, and how much of that comes round again hangs on the FFT's length.

    Args:
        bins: of the spectrum.
        hz: from one to the next.
        end: in Hz.

    Returns: (bins,).
    """
    left = np.clip((end - hz * np.arange(bins)) / _EDGE_HZ, 0.0, 1.0)
    factors: NDArray[np.float64] = np.sin(0.5 * np.pi * left) ** 2
    return factors


def _long_row(signal: Tensor, points: int) -> bool:
    if signal.device.type != "cpu" or torch.get_num_threads() == 1 or torch.compiler.is_compiling():
        return False  # compiled programs are for any number of threads, and ONNX pads no complex numbers
    return points >= _LONG and points % 2 == 0 and signal.numel() == signal.shape[-1]
