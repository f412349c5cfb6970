"""Long Fourier transforms and filters on their grids: the linear half of MSBG."""

import math
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

_BLOCK, _HOP = 4096, 3072
"""Blocks of ``filter_blocks``; taps may be 1025 at most."""

_LONG = 8192


def rfft(waveform: Tensor, points: int) -> Tensor:
    """``torch.fft.rfft``; a single long row on a CPU goes as two halves, for MKL takes half the time for two rows.

    Shape: (..., time) -> (..., points // 2 + 1).
    """
    rows = waveform.numel() // waveform.shape[-1]
    if rows > 1 or points < _LONG or points % 4 or waveform.device.type != "cpu":
        return torch.fft.rfft(waveform, points)
    padded = functional.pad(waveform[..., :points], (0, max(0, points - waveform.shape[-1])))
    even, odd = torch.fft.rfft(padded.unflatten(-1, (-1, 2)).mT).unbind(-2)
    odd = odd * _twiddle(points, odd.dtype)
    return torch.cat((even + odd, (even - odd)[..., :-1].conj().flip(-1)), -1)


def irfft(spectrum: Tensor, points: int) -> Tensor:
    """``torch.fft.irfft``, the inverse of ``rfft``. Shape: (..., points // 2 + 1) -> (..., points)."""
    rows = spectrum.numel() // spectrum.shape[-1]
    if rows > 1 or points < _LONG or points % 4 or spectrum.device.type != "cpu":
        return torch.fft.irfft(spectrum, points)
    quarter = points // 4
    low, high = spectrum[..., : quarter + 1], spectrum[..., quarter:].conj().flip(-1)
    odd = (low - high) * _twiddle(points, spectrum.dtype).conj()
    halves = torch.fft.irfft(torch.stack((low + high, odd), -2), points // 2)
    return halves.mT.flatten(-2) * 0.5


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


def _twiddle(points: int, dtype: torch.dtype) -> Tensor:
    return torch.from_numpy(_factors(points, dtype == torch.complex128))


@lru_cache(maxsize=16)
def _factors(points: int, double: bool) -> NDArray[np.complexfloating]:
    """An array, for a tensor made while a program is traced would be none that others could use."""
    factors = np.exp(np.arange(points // 4 + 1) * (-2j * np.pi / points))
    return factors if double else factors.astype(np.complex64)
