"""Levels in bands about as wide as auditory filters, for losses and for measures of studies.

There are 24 bands from 80 Hz to 7.5 kHz. They are equally wide, 1.25 ERB (equivalent rectangular
bandwidths), on the scale of Glasberg and Moore (1990), rectangular and without gaps, so that their
powers add up to that of the signal between 80 Hz and 7.5 kHz.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.erb import erb_frequency, erb_number
from hlsim.dsp.fft import power
from hlsim.dsp.stft import STFT
from hlsim.torchtools import constant

BANDS = 24
"""Number of bands."""

LOWEST, HIGHEST = 80.0, 7500.0
"""Lowest edge of the lowest band and highest edge of the highest one in Hz.

Neuro-MSBG returns nothing above 8 kHz.
"""

FRAME_SECONDS = 0.032
"""Duration of a frame in seconds. Frames overlap by half."""

_POWER_FLOOR = 1e-18
"""Power in Pa^2, -86 dB SPL, that is added before the logarithm.

It keeps the gradient near silence finite.

It does not limit the perceived level: a band at -40 dB SPL still has its whole gradient.
"""

_DEPTH_DB = 40.0
"""Level in dB below the strongest band of an item, for a normal ear, at which audibility begins."""

RISE = 20.0
"""Range in dB over which the weight of a band rises from 0 to 1."""

_WEIGHT_FLOOR = 1e-3
"""Smallest sum of weights by which a loss is divided."""


def band_levels(waveform: Tensor, sample_rate: int) -> Tensor:
    """Compute the level in 24 bands from 80 Hz to 7.5 kHz in frames of 32 ms, every 16 ms.

    The bands are about as wide as auditory filters, 1.25 ERB each. Frame k is centred on k hops of
    16 ms, rounded to whole samples; zeros surround the signal.

    Shape: (..., time) -> (..., frames, 24).

    Args:
        waveform: Signals in pascals.
        sample_rate: Sample rate in Hz.

    Returns:
        Levels in dB SPL, -86 for silence.

    >>> from hlsim.calibration import set_level
    >>> levels = band_levels(set_level(torch.randn(16000), 65.0), sample_rate=16000)
    >>> levels.shape
    torch.Size([63, 24])
    """
    stft, shares, scale = band_analysis(waveform, sample_rate)
    spectrum = stft.analyse(waveform.reshape(-1, waveform.shape[-1]))
    powers = (power(spectrum) * scale) @ shares
    levels = 10.0 * torch.log10(powers + _POWER_FLOOR) + PASCAL_SPL
    return levels.reshape(*waveform.shape[:-1], *levels.shape[-2:])


def band_level_loss(perceived: Tensor, normal: Tensor, sample_rate: int) -> Tensor:
    """Compute by how many dB the band levels of perceived speech differ from those of a normal ear.

    The result is a weighted mean of absolute differences over frames and bands. A gain of g dB
    costs ``abs(g)``, if it is 40 dB or less. Perceived levels are not raised to the threshold of
    hearing: otherwise, a band that the impaired ear misses altogether would have no gradient, and
    no compensator would learn to restore it.

    The weight of a band in a frame is the audibility, 0 to 1, of clean speech or of perceived
    speech for a normal ear, whichever is higher: noise that fills a pause is an error, too.
    Perceived levels are compared with 40 dB below the threshold of audibility where clean speech is
    softer than that. The weights have no gradient.

    Shape: (..., time), (..., time) -> (...).

    Args:
        perceived: Speech that the impaired ear perceives, in pascals.
        normal: Clean speech as a normal ear perceives it, in pascals.
        sample_rate: Sample rate in Hz.

    Returns:
        Difference in dB for each item; 0 if neither signal is audible.

    >>> speech = torch.randn(1, 16000)
    >>> band_level_loss(0.1 * speech, speech, sample_rate=16000).round(decimals=2)  # 20 dB too low
    tensor([20.])
    """
    levels = band_levels(perceived, sample_rate)
    reference_levels = band_levels(normal, sample_rate)
    threshold = audibility_threshold(reference_levels)
    weights = torch.maximum(
        audibility_weights(reference_levels, threshold), audibility_weights(levels, threshold)
    )
    errors = (levels - torch.maximum(reference_levels, threshold - _DEPTH_DB)).abs()
    total = weights.sum((-2, -1)).clamp_min(_WEIGHT_FLOOR)
    return (weights * errors).sum((-2, -1)) / total


def audibility_threshold(levels: Tensor) -> Tensor:
    """Compute the level in each band above which a normal ear hears something.

    The level is the threshold in quiet, or 40 dB below the strongest band in any frame of the item
    if that is higher, because loud bands mask soft ones. It has no gradient.

    Shape: (..., frames, 24) -> (..., 1, 24).

    Args:
        levels: Levels from ``band_levels`` in dB SPL.

    Returns:
        Levels in dB SPL.

    >>> audibility_threshold(torch.full((1, 10, 24), 60.0))[0, 0, :3]
    tensor([23.0014, 20.0000, 20.0000])
    """
    quiet = threshold_in_quiet(like=levels)
    return torch.maximum(quiet, levels.amax((-2, -1), keepdim=True) - _DEPTH_DB).detach()


def audibility_weights(levels: Tensor, threshold: Tensor) -> Tensor:
    """Compute the weight of each band: 0 up to the threshold of audibility, 1 from 20 dB above it.

    The weights have no gradient.

    Shape: (..., frames, 24), (..., 1, 24) -> (..., frames, 24).

    Args:
        levels: Levels from ``band_levels`` in dB SPL.
        threshold: Levels from ``audibility_threshold`` in dB SPL.

    >>> audibility_weights(torch.tensor([10.0, 30.0, 50.0]), threshold=torch.tensor(20.0))
    tensor([0.0000, 0.5000, 1.0000])
    """
    return ((levels.detach() - threshold) / RISE).clamp(0.0, 1.0)


def band_analysis(like: Tensor, sample_rate: int) -> tuple[STFT, Tensor, float]:
    """Design the computation of band powers: short-time Fourier transform, weights and a factor.

    Args:
        like: Tensor with the dtype and the device of the weights.
        sample_rate: Sample rate in Hz.

    Returns:
        The short-time Fourier transform; the share of each of its frequencies that lies in each
        band, 0 to 1, (frequencies, 24); and the factor by which ``power(spectrum) @ shares`` must
        be multiplied to be the mean power of a frame in each band.

    >>> stft, shares, scale = band_analysis(torch.zeros(1), sample_rate=16000)
    >>> stft.hop, shares.shape, round(scale * 512**2, 3)
    (256, torch.Size([257, 24]), 5.333)
    """
    hop = round(FRAME_SECONDS / 2.0 * sample_rate)
    stft = STFT(2 * hop, 2 * hop, hop)
    shares = _band_shares(stft.fft, sample_rate, like=like)
    # Positive and negative frequencies count. The squares of a Hann window of n samples sum to
    # 3 n / 8.
    return stft, shares, 2.0 / (stft.fft * 0.375 * stft.window)


def band_edges() -> NDArray[np.float64]:
    """Compute the edges of the 24 bands in Hz, ascending. Shape: (25,).

    >>> print(band_edges()[[0, 24]].round())
    [  80. 7500.]
    """
    lowest, highest = erb_number(np.array([LOWEST, HIGHEST]))
    return erb_frequency(np.linspace(lowest, highest, BANDS + 1))


def band_centres() -> NDArray[np.float64]:
    """Compute the geometric centres of the 24 bands in Hz. Shape: (24,).

    >>> print(band_centres()[12].round())
    1423.0
    """
    edges = band_edges()
    return np.sqrt(edges[1:] * edges[:-1])


@constant
def _band_shares(fft: int, sample_rate: int) -> NDArray[np.float64]:
    """Return the share of the width of each frequency bin that lies in each band, 0 to 1.

    Shape: (fft // 2 + 1, 24).
    """
    spacing = sample_rate / fft
    frequencies = np.arange(fft // 2 + 1)[:, None] * spacing
    edges = band_edges()
    upper = np.minimum(edges[1:], frequencies + spacing / 2)
    lower = np.maximum(edges[:-1], frequencies - spacing / 2)
    return np.clip((upper - lower) / spacing, 0.0, None)


@constant
def threshold_in_quiet() -> NDArray[np.float64]:
    """Return the softest level that a normal ear hears at the centre of each of the 24 bands.

    The centre is the geometric mean of a band's edges. Source: Terhardt (1979), Equation 1.

    Returns:
        Levels in dB SPL in a free field. Shape: (24,).

    >>> print(threshold_in_quiet()[12].round(1))  # at 1423 Hz
    2.0
    """
    # Levels in dB HL refer to the table FREE_FIELD_THRESHOLD_SPL of ISO 389-7. Losses keep this
    # formula, because networks were trained with it. It differs by up to 2.7 dB, and by 5.7 dB in
    # the highest band.
    khz = band_centres() / 1000.0
    return 3.64 * khz**-0.8 - 6.5 * np.exp(-0.6 * (khz - 3.3) ** 2) + 1e-3 * khz**4
