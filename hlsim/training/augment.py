"""Augmentation of training speech: noise, equalisation, amplification, compression and level.

A simulator guides the training of aids, which amplify and compress. It must therefore be accurate
on amplified and compressed speech.
"""

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.active_level import active_level_db

HIGHEST_LEVEL = 115.0
"""Highest RMS level of a training signal in dB SPL."""

EQUALISER_FREQUENCIES = (100.0, 250.0, 600.0, 1500.0, 3500.0, 7000.0)
"""Frequencies in Hz for which the random equaliser has gains."""

POWER_FLOOR = 1e-20
"""Power in Pa^2 that keeps logarithms and divisors away from 0."""


def draw_uniform(
    low: float, high: float, shape: tuple[int, ...], generator: torch.Generator
) -> Tensor:
    """Draw numbers of a uniform distribution from ``low`` to ``high``."""
    return low + (high - low) * torch.rand(shape, generator=generator)


def mix(speech: Tensor, noise: Tensor, snr_db: Tensor, sample_rate: int | None = None) -> Tensor:
    """Add noise at a signal-to-noise ratio.

    Args:
        speech: Speech with shape (items, time).
        noise: Noise with shape (items, time).
        snr_db: Level of the speech minus RMS level of the noise in dB, with shape (items,).
        sample_rate: Sample rate in Hz. It makes the level of the speech the active level of ITU-T
            P.56; without it, the RMS level is used.

    Returns:
        Noisy speech with shape (items, time).
    """
    level = 10.0 * speech.square().mean(-1).clamp_min(POWER_FLOOR).log10()
    if sample_rate is not None:
        for item, waveform in enumerate(speech):
            if bool(waveform.any()):
                level[item] = active_level_db(waveform, sample_rate)
    return speech + set_level(noise, level - snr_db, full_scale_spl=0.0)


def equalise(waveform: Tensor, gains_db: Tensor, frequencies: Tensor, sample_rate: int) -> Tensor:
    """Apply a zero-phase filter with gains at some frequencies.

    The gains in dB are interpolated over log frequency, and constant beyond both ends.

    Args:
        waveform: Signals with shape (items, time).
        gains_db: Gains in dB with shape (items, frequencies).
        frequencies: Frequencies in Hz with shape (frequencies,).
        sample_rate: Sample rate in Hz.

    Returns:
        Filtered signals with shape (items, time).
    """
    time = waveform.shape[-1]
    points = 2 * time
    log_hz = torch.fft.rfftfreq(points, 1.0 / sample_rate).clamp_min(1.0).log()
    knots = frequencies.log()
    right = torch.bucketize(log_hz, knots).clamp(1, len(knots) - 1)
    left = right - 1
    weight = ((log_hz - knots[left]) / (knots[right] - knots[left])).clamp(0.0, 1.0)
    gain_db = gains_db[:, left] * (1.0 - weight) + gains_db[:, right] * weight
    spectrum = torch.fft.rfft(waveform, points) * 10.0 ** (gain_db / 20.0)
    return torch.fft.irfft(spectrum, points)[..., :time]


def compress(waveform: Tensor, ratio: Tensor, sample_rate: int) -> Tensor:
    """Compress the level of segments of 10 ms around its mean.

    Args:
        waveform: Signals with shape (items, time).
        ratio: Compression ratios with shape (items,).
        sample_rate: Sample rate in Hz.

    Returns:
        Compressed signals with shape (items, time).
    """
    width = 2 * (sample_rate // 200) + 1
    squared = waveform.square().unsqueeze(1)
    power = functional.avg_pool1d(squared, width, 1, width // 2, count_include_pad=False).squeeze(1)
    mean = power.mean(-1, keepdim=True)
    exponent = ((1.0 / ratio - 1.0) / 2.0).unsqueeze(-1)
    return waveform * ((power + 1e-3 * mean + POWER_FLOOR) / (mean + POWER_FLOOR)) ** exponent


def augment_speech(
    speech: Tensor,
    noise: Tensor | None,
    ears: Tensor,
    sample_rate: int,
    generator: torch.Generator,
    *,
    levels: tuple[float, float] = (40.0, 95.0),
    treated: bool = True,
) -> Tensor:
    """Make random training signals of speech.

    40 % of the items are noisy, with -5 to 20 dB SNR. If ``treated``, 20 % are compressed with
    ratios of 1.5 to 4, 40 % are equalised by up to 15 dB, and 40 % are amplified by 0.2 to 0.8
    times the hearing loss.

    Args:
        speech: Clean speech with shape (items, time).
        noise: Noise with shape (items, time), if there is any.
        ears: Thresholds in dB HL with shape (items, 8).
        sample_rate: Sample rate in Hz.
        generator: Source of the random numbers.
        levels: Lowest and highest level in dB SPL before equalisation and amplification.
        treated: Whether to compress, equalise and amplify.

    Returns:
        Signals in pascals with shape (items, time).
    """
    items = len(speech)
    chance = torch.rand(items, 5, generator=generator)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return draw_uniform(low, high, (items, *shape), generator)

    def choose(column: int, share: float, changed: Tensor, unchanged: Tensor) -> Tensor:
        return torch.where((chance[:, column] < share).unsqueeze(-1), changed, unchanged)

    signal = speech
    snr_db = uniform(-5.0, 20.0)
    ratio = uniform(1.5, 4.0)
    if noise is not None:
        signal = choose(0, 0.4, mix(signal, noise, snr_db, sample_rate), signal)
    level = uniform(*levels)
    if not treated:
        return set_level(signal, level)
    compressed = choose(1, 0.2, compress(signal, ratio, sample_rate), signal)
    signal = set_level(compressed, level)
    gains = uniform(-15.0, 15.0, len(EQUALISER_FREQUENCIES))
    equalised = equalise(signal, gains, torch.tensor(EQUALISER_FREQUENCIES), sample_rate)
    signal = choose(2, 0.4, equalised, signal)
    gains = ears * uniform(0.2, 0.8, 1)
    amplified = equalise(signal, gains, torch.tensor(FREQUENCIES), sample_rate)
    signal = choose(3, 0.4, amplified, signal)
    return set_level(signal, level_spl(signal).clamp_max(HIGHEST_LEVEL))
