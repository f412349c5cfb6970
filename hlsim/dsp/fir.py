"""FIR filters: design by frequency sampling, and filtering with Fourier transforms."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.fft import fft_length, rfft
from hlsim.dsp.interpolation import interpolate
from hlsim.torchtools import constant

BLOCK_POINTS = 4096
"""Length of the Fourier transforms of ``filter_in_blocks``."""

_BLOCK_HOP = 3072
"""Number of samples from the start of one block of ``filter_in_blocks`` to that of the next."""

_GRID_POINTS = 513
"""Number of frequencies of the grid on which a filter is designed, 0 Hz to Nyquist frequency."""


def frequency_sampling_fir(
    taps: int,
    frequencies: NDArray[np.float64],
    gains: NDArray[np.float64],
    kaiser_beta: float | None = None,
) -> NDArray[np.float64]:
    """Design a linear-phase FIR filter from gains at some frequencies, as MATLAB's ``fir2`` does.

    The frequencies are moved to points of a grid of 513 frequencies, the gains between them follow
    straight lines, and the windowed inverse Fourier transform is the filter. scipy's ``firwin2``
    does not move the frequencies, and its gain differs where they are close: by 2 dB at 100 Hz in
    MSBG's filter of the ear. MSBG and pyclarity's NAL-R follow ``fir2``.

    Args:
        taps: Number of coefficients, odd and at most 1023. The filter delays by (taps - 1) / 2
            samples.
        frequencies: Ascending frequencies from 0 to 1, where 1 is the Nyquist frequency.
        gains: Linear gain at each frequency.
        kaiser_beta: Parameter of the Kaiser window by which the coefficients are multiplied; by
            default it is a Hamming window.

    Returns:
        Coefficients of the filter, (taps,).

    >>> flat = frequency_sampling_fir(3, np.array([0.0, 1.0]), np.array([2.0, 2.0]), 0.0)
    >>> print(abs(flat).round(6))
    [0. 2. 0.]
    """
    grid_gains = np.zeros(_GRID_POINTS)
    grid_gains[0] = gains[0]
    start = 0
    for i in range(len(frequencies) - 1):
        end = int(frequencies[i + 1] * _GRID_POINTS) - 1
        if end >= start:
            position = np.linspace(0.0, 1.0, end - start + 1) if end > start else np.zeros(1)
            grid_gains[start : end + 1] = position * gains[i + 1] + (1.0 - position) * gains[i]
        start = end + 1
    intervals = _GRID_POINTS - 1
    delay = np.exp(-0.5j * (taps - 1) * np.pi * np.arange(_GRID_POINTS) / intervals)
    impulse_response = np.fft.irfft(grid_gains * delay, 2 * intervals)
    window = np.hamming(taps) if kaiser_beta is None else np.kaiser(taps, kaiser_beta)
    return np.asarray(impulse_response[:taps] * window)


def lowpass_fir(taps: int, cutoff: float, kaiser_beta: float) -> NDArray[np.float64]:
    """Design a linear-phase low-pass, a sine cardinal in a Kaiser window, as ``firwin`` of scipy.

    Args:
        taps: Number of coefficients. The filter delays by (taps - 1) / 2 samples.
        cutoff: Frequency at which the gain of a long filter is about one half, where 1 is the
            Nyquist frequency.
        kaiser_beta: Parameter of the window.

    Returns:
        Coefficients of the filter, (taps,). The gain at 0 Hz is 1.

    >>> lowpass_fir(3, cutoff=0.5, kaiser_beta=0.0).round(2)
    array([0.28, 0.44, 0.28])
    """
    times = np.arange(taps) - 0.5 * (taps - 1)
    coefficients = np.sinc(cutoff * times) * np.kaiser(taps, kaiser_beta)
    return np.asarray(coefficients / coefficients.sum())


def bandpass_fir(taps: int, low: float, high: float) -> NDArray[np.float64]:
    """Design a linear-phase band-pass in a Hann window, as ``firwin`` of scipy.

    Args:
        taps: Number of coefficients, an odd number. The filter delays by (taps - 1) / 2 samples.
        low: Lower edge of the band, above 0, where 1 is the Nyquist frequency.
        high: Upper edge of the band. With 1, the filter is a high-pass.

    Returns:
        Coefficients of the filter, (taps,). The gain is 1 at the centre of the band, or at the
        Nyquist frequency for a high-pass.

    >>> bandpass_fir(5, low=0.5, high=1.0).round(2)
    array([-0.  , -0.19,  0.61, -0.19, -0.  ])
    """
    times = np.arange(taps) - 0.5 * (taps - 1)
    band = high * np.sinc(high * times) - low * np.sinc(low * times)
    coefficients = band * np.hanning(taps)
    centre = 1.0 if high == 1.0 else 0.5 * (low + high)
    gain = (coefficients * np.cos(np.pi * centre * times)).sum()
    return np.asarray(coefficients / gain)


def filters_with_gains(
    gains_db: Tensor, frequencies: tuple[float, ...], sample_rate: int, order: int
) -> Tensor:
    """Design linear-phase filters whose gains in dB are straight lines between some frequencies.

    The filters are those of ``frequency_sampling_fir``, and differentiable in the gains.

    Shape: (..., gains) -> (..., order + 1).

    Args:
        gains_db: Gains in dB.
        frequencies: Ascending frequencies of the gains in Hz. Beyond their ends, gains are
            constant.
        sample_rate: Sample rate in Hz.
        order: Order of the filters, an even number. They delay by half of it.

    >>> filters_with_gains(torch.zeros(2), (250.0, 4000.0), sample_rate=16000, order=4).round()
    tensor([0., 0., 1., 0., 0.])
    """
    points = np.linspace(0.0, sample_rate / 2.0, order + 1)
    gains = interpolate(gains_db, frequencies, tuple(points.tolist()))
    return (10.0 ** (gains / 20.0)) @ _unit_filters(order, like=gains)


@constant
def _unit_filters(order: int) -> NDArray[np.float64]:
    """Design a filter for each of ``order + 1`` frequencies, evenly spaced from 0 Hz to Nyquist.

    Each filter is that of ``frequency_sampling_fir`` for a gain of 1 at its frequency and of 0 at
    the others. The window makes its response lower and wider. Filters are linear in these gains:
    the sum of these filters times some gains is the filter that is designed for these gains.

    Returns:
        Coefficients, (order + 1, order + 1), one row per frequency.
    """
    grid = np.arange(order + 1) / order
    return np.stack([frequency_sampling_fir(len(grid), grid, gain) for gain in np.eye(len(grid))])


def filter_without_delay(waveform: Tensor, taps: Tensor) -> Tensor:
    """Filter signals with impulse responses that begin before time 0, so that nothing is delayed.

    Shape: (..., time), (..., 2 half) -> (..., time).

    Args:
        waveform: Signals.
        taps: Impulse responses, from ``half`` samples before time 0 to ``half - 1`` after it.

    >>> filter_without_delay(torch.ones(3), torch.tensor([0.0, 0.0, 1.0, 0.0])).round(decimals=3)
    tensor([1., 1., 1.])
    """
    time = waveform.shape[-1]
    half = taps.shape[-1] // 2
    points = fft_length(time + 2 * half, 4)
    if torch.compiler.is_exporting():
        # At other lengths than powers of two, onnxruntime's results are off by 1e-3 to 1e-2.
        points = 1 << (points - 1).bit_length()
    product = rfft(waveform, points) * rfft(taps, points)
    return torch.fft.irfft(product, points)[..., half : half + time]


def filter_in_blocks(waveform: Tensor, response: Tensor, length: int) -> Tensor:
    """Filter signals block by block, which is faster than one transform of the whole signal.

    Shape: (..., time), (2049,) -> (..., length).

    Args:
        waveform: Signals.
        response: Frequency response of the filter, ``rfft(coefficients, 4096)`` of at most 1025
            coefficients. The 4096 points are ``BLOCK_POINTS``.
        length: Number of samples to return.

    >>> delay_by_one = torch.fft.rfft(torch.tensor([0.0, 1.0]), BLOCK_POINTS)
    >>> filter_in_blocks(torch.tensor([1.0, 2.0]), delay_by_one, 3).round(decimals=3).abs()
    tensor([0., 1., 2.])
    """
    lead = BLOCK_POINTS - _BLOCK_HOP
    blocks = math.ceil(length / _BLOCK_HOP)
    padded = functional.pad(waveform, (lead, blocks * _BLOCK_HOP - waveform.shape[-1]))
    spectra = torch.fft.rfft(padded.unfold(-1, BLOCK_POINTS, _BLOCK_HOP)) * response
    filtered = torch.fft.irfft(spectra, BLOCK_POINTS)[..., lead:]
    return filtered.flatten(-2)[..., :length]
