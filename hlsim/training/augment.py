"""What training speech goes through: noise, equalisation, amplification, compression, level.

A simulator that is to guide a compensator must be right on what compensators emit, and they amplify and compress.
"""

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import set_level

HIGHEST_LEVEL = 115.0  # RMS level in dB SPL above which no training signal goes
KNOTS = (100.0, 250.0, 600.0, 1500.0, 3500.0, 7000.0)  # Hz, of the random equaliser


def mix(speech: Tensor, noise: Tensor, snr_db: Tensor) -> Tensor:
    """Add noise at a signal-to-noise ratio of RMS levels. Shape: (items, time) twice, (items,) dB -> (items, time)."""
    level = speech.square().mean(-1).clamp_min(1e-20).log10() * 10.0
    return speech + set_level(noise, level - snr_db, full_scale_spl=0.0)


def equalise(waveform: Tensor, gains_db: Tensor, frequencies: Tensor, sample_rate: int) -> Tensor:
    """Zero-phase filter with gains that go linearly over log frequency, flat beyond the ends.

    Shape: (items, time), (items, points) dB, (points,) Hz -> (items, time).
    """
    time = waveform.shape[-1]
    points = 2 * time
    hz = torch.fft.rfftfreq(points, 1.0 / sample_rate).clamp_min(1.0).log()
    knots = frequencies.log()
    right = torch.bucketize(hz, knots).clamp(1, len(knots) - 1)
    place = ((hz - knots[right - 1]) / (knots[right] - knots[right - 1])).clamp(0.0, 1.0)
    gain_db = gains_db[:, right - 1] * (1.0 - place) + gains_db[:, right] * place
    spectrum = torch.fft.rfft(waveform, points) * 10.0 ** (gain_db / 20.0)
    return torch.fft.irfft(spectrum, points)[..., :time]


def compress(waveform: Tensor, ratio: Tensor, sample_rate: int) -> Tensor:
    """Compress the level over 10 ms about its mean. Shape: (items, time), (items,) -> (items, time)."""
    width = 2 * (sample_rate // 200) + 1
    squared = waveform.square().unsqueeze(1)
    power = functional.avg_pool1d(squared, width, 1, width // 2, count_include_pad=False).squeeze(1)
    mean = power.mean(-1, keepdim=True)
    exponent = ((1.0 / ratio - 1.0) / 2.0).unsqueeze(-1)
    return waveform * ((power + 1e-3 * mean + 1e-20) / (mean + 1e-20)) ** exponent


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

    Two in five items are noisy (-5 to 20 dB); where ``treated``, two in five equalised by up to 15 dB, two in five
    amplified by 0.2 to 0.8 of the ear's loss, one in five compressed by 1.5 to 4. ``levels`` in dB SPL are before that.

    Shape: (items, time), (items, time) or None, (items, 8) dB HL -> (items, time).
    """
    items = len(speech)
    chance = torch.rand(items, 5, generator=generator)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(items, *shape, generator=generator)

    def some(column: int, share: float, changed: Tensor, unchanged: Tensor) -> Tensor:
        return torch.where((chance[:, column] < share).unsqueeze(-1), changed, unchanged)

    signal = speech
    snr_db, ratio = uniform(-5.0, 20.0), uniform(1.5, 4.0)
    if noise is not None:
        signal = some(0, 0.4, mix(signal, noise, snr_db), signal)
    loud = uniform(*levels)
    if not treated:
        return set_level(signal, loud)
    signal = set_level(some(1, 0.2, compress(signal, ratio, sample_rate), signal), loud)
    gains = uniform(-15.0, 15.0, len(KNOTS))
    signal = some(2, 0.4, equalise(signal, gains, torch.tensor(KNOTS), sample_rate), signal)
    amplified = equalise(
        signal, ears * uniform(0.2, 0.8, 1), torch.tensor(FREQUENCIES), sample_rate
    )
    signal = some(3, 0.4, amplified, signal)
    excess = (
        10.0 * signal.square().mean(-1).clamp_min(1e-20).log10() + 94.0 - HIGHEST_LEVEL
    ).clamp_min(0.0)
    return signal * 10.0 ** (-excess / 20.0).unsqueeze(-1)
