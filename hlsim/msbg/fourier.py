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
    """``torch.fft.rfft``; a single long row on a CPU goes as complex numbers, for which MKL plans in a fifth of the time.

    Shape: (..., time) -> (..., points // 2 + 1).
    """
    if not _long_row(waveform, points):
        return torch.fft.rfft(waveform, points)
    padded = functional.pad(waveform, (0, points - waveform.shape[-1]))  # which cuts as well
    both = torch.fft.fft(torch.view_as_complex(padded.unflatten(-1, (-1, 2))))  # even samples + i odd ones
    both = torch.cat((both, both[..., :1]), -1)
    own, mirrored = _untangling(points, both.dtype)
    return torch.addcmul(both * own, both.flip(-1).conj(), mirrored)


def irfft(spectrum: Tensor, points: int) -> Tensor:
    """``torch.fft.irfft``, the inverse of ``rfft``. Shape: (..., points // 2 + 1) -> (..., points)."""
    if not _long_row(spectrum, points):
        return torch.fft.irfft(spectrum, points)
    own, mirrored = _untangling(points, spectrum.dtype)
    ends = spectrum.real[..., :: points // 2].to(
        spectrum.dtype
    )  # as torch does, without their imaginary parts
    spectrum = torch.cat((ends[..., :1], spectrum[..., 1:-1], ends[..., 1:]), -1)
    both = torch.addcmul(spectrum * own.conj(), spectrum.flip(-1).conj(), mirrored.conj())
    return torch.view_as_real(torch.fft.ifft(both[..., :-1])).flatten(-2)


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


def _long_row(signal: Tensor, points: int) -> bool:
    rows = signal.numel() // signal.shape[-1]
    return rows == 1 and points >= _LONG and points % 2 == 0 and signal.device.type == "cpu"


def _untangling(points: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """What to multiply the spectrum of pairs of samples and its mirror image with for that of the samples."""
    own, mirrored = _factors(points, dtype == torch.complex128)
    return torch.from_numpy(own), torch.from_numpy(mirrored)


@lru_cache(maxsize=16)
def _factors(points: int, double: bool) -> tuple[NDArray[np.complexfloating], NDArray[np.complexfloating]]:
    """Arrays, for a tensor made while a program is traced would be none that others could use."""
    turned = 0.5j * np.exp(np.arange(points // 2 + 1) * (-2j * np.pi / points))
    factors = 0.5 - turned, 0.5 + turned
    return factors if double else tuple(factor.astype(np.complex64) for factor in factors)
