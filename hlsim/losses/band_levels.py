"""Levels in bands one ERB wide or so, and how far what is heard lies from what a normal ear hears."""

from functools import lru_cache

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

LOWEST, HIGHEST = 80.0, 7500.0
"""Edges in Hz of the lowest and the highest band. Neuro-MSBG hears nothing from 8 kHz on."""

FRAME_SECONDS = 0.032

LOWEST_POWER = 1e-18
"""Power, -86 dB SPL, that is added before the logarithm. It keeps the gradient near silence finite and is no floor on
what is heard: a band at -40 dB SPL still has its whole gradient."""

DEPTH = 40.0
"""dB under an item's loudest band as a normal ear hears it, where audibility begins."""

RISE = 20.0
"""dB over which the weight of a band rises from 0 to 1."""


def band_levels(waveform: Tensor, sample_rate: int) -> Tensor:
    """Level of each band in each frame of 32 ms, every 16 ms.

    The bands are equally wide on the ERB-number scale of Glasberg and Moore (1990), 1.25 ERB each, from 80 Hz to 7.5
    kHz, rectangular and without gaps, so that their powers add up to the signal's.

    Shape: (..., time) in pascals -> (..., frames, 24) in dB SPL; silence gives -86.
    """
    hop = round(FRAME_SECONDS / 2.0 * sample_rate)
    stft = STFT(2 * hop, 2 * hop, hop)
    spectrum = stft.analyse(waveform.reshape(-1, waveform.shape[-1]))
    # both halves of the spectrum; the squares of a Hann window of n samples sum to 3 n / 8
    powers = power(spectrum) * (2.0 / (stft.fft * 0.375 * stft.window))
    powers = powers @ constant(
        band_shares, stft.fft, sample_rate, dtype=powers.dtype, device=powers.device
    )
    levels = 10.0 * torch.log10(powers + LOWEST_POWER) + PASCAL_SPL
    return levels.reshape(*waveform.shape[:-1], *levels.shape[-2:])


def band_level_loss(heard: Tensor, normal: Tensor, sample_rate: int) -> Tensor:
    """Mean absolute difference in dB of band levels, weighted by how audible the band is.

    A gain of g dB costs ``abs(g)``. There is no floor on what is heard. With one, as at a threshold of hearing, a band
    that the impaired ear misses altogether would have no gradient, and no compensator would learn to bring it back.

    A band counts as much as a normal ear finds it audible, or, if that is more, as what is heard would be in its place:
    noise that fills a pause is an error too. There the difference is taken to 40 dB under audibility at most.

    Args:
        heard: what the impaired ear hears.
        normal: what a normal ear hears of the same speech.

    Shape: (..., time) twice, in pascals -> (...) in dB; 0 where neither is audible. The weights carry no gradient.
    """
    levels, truth = band_levels(heard, sample_rate), band_levels(normal, sample_rate)
    least = least_audible(truth)
    weights = torch.maximum(audibility(truth, least), audibility(levels, least))
    errors = (levels - torch.maximum(truth, least - DEPTH)).abs()
    return (weights * errors).sum((-2, -1)) / weights.sum((-2, -1)).clamp_min(1e-3)


def least_audible(levels: Tensor) -> Tensor:
    """Level at which audibility begins: the threshold in quiet, or 40 dB under the item's loudest band if that is more.

    Shape: (..., frames, 24) in dB SPL -> (..., 1, 24).
    """
    quiet = constant(threshold_in_quiet, dtype=levels.dtype, device=levels.device)
    return torch.maximum(quiet, levels.amax((-2, -1), keepdim=True) - DEPTH).detach()


def audibility(levels: Tensor, least: Tensor) -> Tensor:
    """Weights, 0 from ``least`` down and 1 from 20 dB above it up, without gradient.

    Shape: (..., frames, 24), (..., 1, 24) in dB SPL -> (..., frames, 24).
    """
    return ((levels.detach() - least) / RISE).clamp(0.0, 1.0)


def band_edges() -> NDArray[np.float64]:
    """Edges of the bands in Hz. Returns (25,)."""
    lowest, highest = erb_number(np.array([LOWEST, HIGHEST]))
    return erb_frequency(np.linspace(lowest, highest, BANDS + 1))


def band_centres() -> NDArray[np.float64]:
    """Geometric middles of the bands in Hz. Returns (24,)."""
    edges = band_edges()
    middles: NDArray[np.float64] = np.sqrt(edges[1:] * edges[:-1])
    return middles


def band_shares(fft: int, sample_rate: int) -> NDArray[np.float64]:
    """Share of each frequency bin in each band. Returns (fft // 2 + 1, 24)."""
    spacing = sample_rate / fft
    centre = np.arange(fft // 2 + 1)[:, None] * spacing
    edges = band_edges()
    overlap = np.minimum(edges[1:], centre + spacing / 2) - np.maximum(
        edges[:-1], centre - spacing / 2
    )
    return np.clip(overlap / spacing, 0.0, None)


@lru_cache(maxsize=1)
def threshold_in_quiet() -> NDArray[np.float64]:
    """Threshold of a normal ear at the middle of each band in dB SPL (Terhardt 1979, Equation 1). Returns (24,)."""
    khz = band_centres() / 1000.0
    quiet: NDArray[np.float64] = (
        3.64 * khz**-0.8 - 6.5 * np.exp(-0.6 * (khz - 3.3) ** 2) + 1e-3 * khz**4
    )
    return quiet
