"""Augmentation of training speech: noise, equalisation, amplification, compression and level.

A Neuro-MSBG later guides the training of hearing aids, which amplify and compress. It must
therefore be accurate on amplified and compressed speech, not only on recordings as they are.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.scale import interpolate_over_log
from hlsim.calibration import NEURO_RATE, POWER_FLOOR, level_spl, set_level
from hlsim.data.mixing import mix

HIGHEST_LEVEL = 115.0
"""Highest RMS level in dB SPL of a signal that was equalised and amplified."""

_EQUALISER_FREQUENCIES = (100.0, 250.0, 600.0, 1500.0, 3500.0, 7000.0)
"""Frequencies in Hz for which the random equaliser has gains."""


def draw_uniform(
    low: float, high: float, shape: tuple[int, ...], generator: torch.Generator
) -> Tensor:
    """Draw random numbers that are uniformly distributed between two limits.

    Args:
        low: Lower limit.
        high: Upper limit.
        shape: Shape of the tensor to return.
        generator: Source of the random numbers.

    >>> draw_uniform(1.0, 2.0, (3,), torch.Generator()).shape
    torch.Size([3])
    """
    return low + (high - low) * torch.rand(shape, generator=generator)


def replace_share(
    signals: Tensor, replacements: Tensor, share: float, generator: torch.Generator
) -> Tensor:
    """Replace random items by others.

    Args:
        signals: Items with shape (items, samples).
        replacements: Replacement for each item, with the same shape.
        share: Probability with which an item is replaced, from 0 to 1.
        generator: Source of the random numbers.

    Returns:
        A new tensor with shape (items, samples).

    >>> replace_share(torch.zeros(1, 3), torch.ones(1, 3), 1.0, torch.Generator())
    tensor([[1., 1., 1.]])
    """
    is_replaced = torch.rand(len(signals), 1, generator=generator) < share
    return torch.where(is_replaced, replacements, signals)


def equalise(
    waveform: Tensor, gains_db: Tensor, frequencies: Sequence[float], sample_rate: int
) -> Tensor:
    """Filter signals without delay by gains at a few frequencies.

    The gains in dB are interpolated over log frequency. Below the lowest and above the highest
    frequency they are constant.

    Args:
        waveform: Signals with shape (items, time).
        gains_db: Gains in dB with shape (items, frequencies).
        frequencies: Frequencies in Hz, in ascending order.
        sample_rate: Sample rate in Hz.

    Returns:
        Filtered signals with shape (items, time).

    >>> equalise(torch.ones(1, 3), torch.tensor([[20.0, 20.0]]), (250.0, 4000.0), 16000)
    tensor([[10., 10., 10.]])
    """
    time = waveform.shape[-1]
    points = 2 * time
    hertz = np.fft.rfftfreq(points, 1.0 / sample_rate)
    gain_db = np.stack([interpolate_over_log(hertz, frequencies, row.numpy()) for row in gains_db])
    gain = torch.from_numpy(10.0 ** (gain_db / 20.0)).to(waveform.dtype)
    return torch.fft.irfft(torch.fft.rfft(waveform, points) * gain, points)[..., :time]


def compress(waveform: Tensor, ratio: Tensor, sample_rate: int) -> Tensor:
    """Compress the dynamic range of signals, as hearing aids do.

    The level in a running window of 10 ms approaches the mean level of the signal: a difference of
    d dB becomes one of about d / ratio dB. The gain of soft parts is at most 30 (1 - 1 / ratio) dB,
    so that silence is not amplified without limit.

    Args:
        waveform: Signals with shape (items, time).
        ratio: Compression ratios with shape (items,), where 1.0 changes nothing.
        sample_rate: Sample rate in Hz.

    Returns:
        Compressed signals with shape (items, time).

    >>> compress(torch.ones(1, 1600), torch.tensor([2.0]), 16000).shape
    torch.Size([1, 1600])
    """
    width = 2 * (sample_rate // 200) + 1
    squared = waveform.square().unsqueeze(1)
    power = functional.avg_pool1d(squared, width, 1, width // 2, count_include_pad=False).squeeze(1)
    mean = power.mean(-1, keepdim=True)
    exponent = ((1.0 / ratio - 1.0) / 2.0).unsqueeze(-1)
    return waveform * ((power + 1e-3 * mean + POWER_FLOOR) / (mean + POWER_FLOOR)) ** exponent


def equalise_share(signals: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Filter random signals with random gains from -15 to 15 dB at six frequencies.

    Args:
        signals: Signals at 16 kHz with shape (items, time).
        share: Probability with which a signal is filtered, from 0 to 1.
        generator: Source of the random numbers.

    Returns:
        Signals with shape (items, time), where the others are unchanged.

    >>> equalise_share(torch.ones(2, 1600), 0.5, torch.Generator()).shape
    torch.Size([2, 1600])
    """
    shape = len(signals), len(_EQUALISER_FREQUENCIES)
    gains_db = draw_uniform(-15.0, 15.0, shape, generator)
    equalised = equalise(signals, gains_db, _EQUALISER_FREQUENCIES, NEURO_RATE)
    return replace_share(signals, equalised, share, generator)


def augment_speech(
    speech: Tensor,
    noise: Tensor | None,
    ears: Tensor,
    generator: torch.Generator,
    *,
    levels: tuple[float, float] = (40.0, 95.0),
    treated: bool = True,
) -> Tensor:
    """Make random inputs for training a simulator from clean speech.

    Each item is noisy with a probability of 40 %, at -5 to 20 dB SNR, and gets a random level. If
    ``treated``, it is compressed with ratios of 1.5 to 4 (20 %), equalised by up to 15 dB (40 %),
    and amplified by 0.2 to 0.8 times the hearing loss (40 %).

    Args:
        speech: Clean speech at 16 kHz with shape (items, time).
        noise: Noise with shape (items, time); None for speech without noise.
        ears: Hearing thresholds in dB HL at ``FREQUENCIES``, with shape (items, 8).
        generator: Source of the random numbers.
        levels: Lowest and highest level in dB SPL before equalisation and amplification.
        treated: Whether to compress, equalise and amplify.

    Returns:
        Signals in pascals with shape (items, time), whose RMS level is at most 115 dB SPL if
        ``treated``.

    Raises:
        ValueError: The noise has another shape or is silent, see ``mix``.

    >>> speech, ears = torch.randn(2, 1600), torch.full((2, 8), 40.0)
    >>> augment_speech(speech, None, ears, torch.Generator()).shape
    torch.Size([2, 1600])
    """

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return draw_uniform(low, high, (len(speech), *shape), generator)

    signal = speech
    if noise is not None:
        noisy = mix(speech, noise, uniform(-5.0, 20.0))
        signal = replace_share(speech, noisy, 0.4, generator)
    if treated:
        compressed = compress(signal, uniform(1.5, 4.0), NEURO_RATE)
        signal = replace_share(signal, compressed, 0.2, generator)
    signal = set_level(signal, uniform(*levels))
    if treated:
        signal = equalise_share(signal, 0.4, generator)
        gains_db = ears * uniform(0.2, 0.8, 1)
        amplified = equalise(signal, gains_db, FREQUENCIES, NEURO_RATE)
        signal = replace_share(signal, amplified, 0.4, generator)
        signal = set_level(signal, level_spl(signal).clamp_max(HIGHEST_LEVEL))
    return signal
