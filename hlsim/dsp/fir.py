"""FIR filters: designed by frequency sampling, and run through Fourier transforms."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.fft import fft_length, rfft

BLOCK_POINTS, _HOP = 4096, 3072
"""FFT length of ``filter_blocks``, and samples from block to block."""

_GRID = 512


def frequency_sampling_fir(
    taps: int,
    frequencies: NDArray[np.float64],
    gains: NDArray[np.float64],
    window: NDArray[np.float64],
) -> NDArray[np.float64]:
    """FIR filter with given gains at given frequencies, as MATLAB's ``fir2`` designs it.

    The gains are put on a grid of 513 points with the break points moved to grid points, joined by straight lines,
    inverse transformed with a delay of (taps - 1) / 2 samples, and windowed. scipy's ``firwin2`` interpolates between
    the break points themselves, which differs by up to a few tenths of a dB where they are close; MSBG and pyclarity's
    NAL-R follow ``fir2``.

    Args:
        taps: odd number of coefficients, at most 1023.
        frequencies: ascending, 0 to 1 with 1 the Nyquist frequency.
        gains: linear gain at each frequency.
        window: (taps,).
    """
    points = _GRID + 1
    response = np.zeros(points)
    response[0] = gains[0]
    start = 0
    for i in range(len(frequencies) - 1):
        end = int(frequencies[i + 1] * points) - 1
        if end >= start:
            place = np.linspace(0.0, 1.0, end - start + 1) if end > start else np.zeros(1)
            response[start : end + 1] = place * gains[i + 1] + (1.0 - place) * gains[i]
        start = end + 1
    delay = np.exp(-0.5j * (taps - 1) * np.pi * np.arange(points) / _GRID)
    impulse = np.fft.irfft(response * delay, 2 * _GRID)
    return impulse[:taps] * window


def filter_centred(waveform: Tensor, taps: Tensor) -> Tensor:
    """FIR of as many samples before as after, which does not delay. Shape: (..., time), (..., 2 half) -> (..., time)."""
    time, half = waveform.shape[-1], taps.shape[-1] // 2
    points = fft_length(time + 2 * half, 4)
    if torch.compiler.is_exporting():
        points = (
            1 << (points - 1).bit_length()
        )  # at other lengths onnxruntime is off by 1e-3 to 1e-2
    product = rfft(waveform, points) * rfft(taps, points)
    return torch.fft.irfft(product, points)[..., half : half + time]


def filter_blocks(waveform: Tensor, response: Tensor, length: int) -> Tensor:
    """Causal FIR by overlapping blocks, whose short transforms take a quarter of a long one's time.

    Shape: (..., time), (2049,) -> (..., length).

    Args:
        response: of at most 1025 taps, by an rfft of ``BLOCK_POINTS``.
    """
    lead = BLOCK_POINTS - _HOP
    blocks = math.ceil(length / _HOP)
    padded = functional.pad(waveform, (lead, blocks * _HOP - waveform.shape[-1]))
    frames = torch.fft.rfft(padded.unfold(-1, BLOCK_POINTS, _HOP)) * response
    return torch.fft.irfft(frames, BLOCK_POINTS)[..., lead:].flatten(-2)[..., :length]
