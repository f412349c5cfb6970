"""Augmentation of training speech: noise, equalisation, amplification, compression and level.

A simulator that is to guide a compensator must be accurate on the output of compensators, which amplify and compress.
"""

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.active_level import active_level_db

HIGHEST_LEVEL = 115.0  # RMS level in dB SPL above which no training signal goes
EQUALISER_FREQUENCIES = (100.0, 250.0, 600.0, 1500.0, 3500.0, 7000.0)  # Hz, of the random equaliser
POWER_FLOOR = 1e-20


def mix(speech: Tensor, noise: Tensor, snr_db: Tensor, sample_rate: int | None = None) -> Tensor:
    """Add noise at a signal-to-noise ratio.

    The ratio is that of RMS levels or, with ``sample_rate``, that of the active speech level (ITU-T P.56) and the noise's
    RMS level.

    Shape: (items, time) twice, (items,) dB -> (items, time).
    """
    level = 10.0 * speech.square().mean(-1).clamp_min(POWER_FLOOR).log10()
    if sample_rate is not None:
        for item, waveform in enumerate(speech):
            if bool(waveform.any()):
                level[item] = active_level_db(waveform, sample_rate)
    return speech + set_level(noise, level - snr_db, full_scale_spl=0.0)


def equalise(waveform: Tensor, gains_db: Tensor, frequencies: Tensor, sample_rate: int) -> Tensor:
    """Apply a zero-phase filter whose gains are linear over log frequency, and flat beyond the ends.

    Shape: (items, time), (items, points) dB, (points,) Hz -> (items, time).
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
    """Compress the level in 10 ms around its mean. Shape: (items, time), (items,) -> (items, time)."""
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
    """Random training signals in pascals.

    Two in five items are noisy, at -5 to 20 dB. If ``treated``, one in five is compressed by 1.5 to 4, two in five are
    equalised by up to 15 dB, and two in five amplified by 0.2 to 0.8 of the ear's loss. ``levels`` is the range of levels
    in dB SPL before equalisation and amplification.

    Shape: (items, time), (items, time) or None, (items, 8) dB HL -> (items, time).
    """
    items = len(speech)
    chance = torch.rand(items, 5, generator=generator)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(items, *shape, generator=generator)

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
