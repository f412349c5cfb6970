"""HAAQI version 1 in PyTorch: the quality of music in an impaired ear.

The score is that of ``haaqi_v1`` of pyclarity 0.9.0, which the Cadenza challenges use, with a
gradient. It differs from ``compute_haaqi`` in these points:

- ``full_scale_spl`` is 94 dB SPL by default, where ``level1`` is 65.
- The noise, 10 dB below the threshold of hearing, is fixed instead of drawn, and a rate of
  44.1 kHz is not rounded to 44. ``noise="seeded", seed=..., whole_khz=True`` gives the digits of
  pyclarity.
- Both signals have one sample rate. Thresholds at other frequencies than the audiometric ones are
  interpolated on a logarithmic scale of frequency.
- Empty signals, soft clean music and signals shorter than 0.7 s raise ``ValueError``.
  ``compute_haaqi`` scores empty signals 1 or 0.

Identical signals do not score 1, here as in pyclarity. The ear expects the amplification of NAL-R:
1.2 s of chords at 70 dB SPL score 0.91 against themselves for the ear NH, 0.73 for N2 and 0.28 for
N4. Amplified by NAL-R, they score 0.91, 0.90 and 0.94. Compare scores with those of NAL-R instead
of 1. ``tests/metrics/test_scores.py`` computes these scores.

Source: Kates and Arehart 2016, "The hearing-aid audio quality index (HAAQI)", IEEE/ACM Transactions
on Audio, Speech, and Language Processing 24(2), 354-365, doi 10.1109/TASLP.2015.2507858.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import Lengths
from hlsim.dsp.fft import fft_length
from hlsim.dsp.fir import bandpass_fir
from hlsim.metrics.ear import fine_structure
from hlsim.metrics.ear.envelope_modulation import zero_phase_responses
from hlsim.metrics.ear.recursions import RATE
from hlsim.metrics.pair import Equalisation, Noise, match_pair
from hlsim.metrics.quality_reference import QualityParts, QualityReference
from hlsim.torchtools import Audio, Samples, as_type_of, constant, not_compiled

ENVELOPE_SEGMENT = 192
"""Number of samples of a segment over which envelopes are smoothed, 8 ms at 24 kHz."""

ENVELOPE_RATE = 2 * RATE // ENVELOPE_SEGMENT
"""Number of segments per second, 250, because segments overlap by half."""

MODULATION_BANDS = (20.0, 32.0), (32.0, 50.0), (50.0, 80.0), (80.0, 125.0)
"""Edges in Hz of four bands of modulation: rates at which envelopes fluctuate.

The last band ends at half of ``ENVELOPE_RATE``.
"""

MODULATION_ORDER = 128
"""Order of the filters that divide fluctuations into these bands."""


@not_compiled  # tracing takes minutes
def haaqi(
    output: Audio,
    clean: Samples,
    audiogram: AudiogramLike,
    *,
    sample_rate: int = 16000,
    full_scale_spl: float = PASCAL_SPL,
    lengths: Lengths | None = None,
    noise: Noise = "expected",
    seed: int = 0,
    whole_khz: bool = False,
    equalisation: Equalisation = 1,
) -> Audio:
    """Compute HAAQI version 1 of each item: how good the output of an aid sounds, from 0 to 1.

    The score compares the output with clean music that NAL-R has amplified for the same impaired
    ear, and is differentiable in ``output``. The delay of an output is removed, to whole samples at
    24 kHz. Stereo signals have one score per channel: take the better one by ``.amax(-1)`` or the
    mean by ``.mean(-1)``.

    Args:
        output: Output of an aid, at the impaired ear, at least 0.7 s long. Shape: (..., time).
        clean: Clean music, not amplified unless ``equalisation`` is 2. Shape: (..., time). Lengths
            of both that differ by 0.1 s at most are cut to the shorter one, with a warning.
        audiogram: The impaired ear, -10 to 120 dB HL: one for all items or one for each, or a
            ``Listener`` for (..., 2, time).
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0, 0 to 200.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        noise: Noise 10 dB below the threshold of hearing. ``"expected"`` uses the same noise every
            time; ``"seeded"`` draws the noise that pyclarity draws with ``seed``; ``"none"`` leaves
            it out.
        seed: Seed of the drawn noise of each item, 0 to 2**32 - 1.
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        equalisation: Mode of pyclarity: 1 amplifies clean music by NAL-R here, 2 takes music that
            NAL-R or another prescription has amplified.

    Returns:
        Scores, of NumPy if ``output`` is an array. Shape: (...).

    Raises:
        ValueError: Signals of different shapes or on different devices, too short, not
            floating-point, not finite or above 1e9; clean music that is silent or below 20 dB SPL;
            a rate, level, audiogram, length, seed or equalisation out of range; an unknown noise.

    >>> seconds = torch.arange(24000) / 24000
    >>> chord = sum(torch.sin(2 * torch.pi * hz * seconds) for hz in (220.0, 277.2, 329.6))
    >>> music = 0.02 * chord * torch.exp(-3 * seconds)
    >>> noisy = music + 0.01 * torch.randn(24000)
    >>> both = torch.stack([music, noisy])
    >>> scores = haaqi(both, music.expand(2, -1), "NH", sample_rate=24000)
    >>> bool(scores[0] > scores[1])
    True
    """
    matched, clean, lengths = match_pair(output, clean, sample_rate, lengths)
    reference = HaaqiReference(
        clean,
        audiogram,
        sample_rate=sample_rate,
        full_scale_spl=full_scale_spl,
        lengths=lengths,
        whole_khz=whole_khz,
        equalisation=equalisation,
        keep=False,
    )
    return as_type_of(output, reference.score(matched, noise=noise, seed=seed))


def _split_by_rate(waves: Tensor) -> Tensor:
    """Divide the fluctuations of cepstral coefficients into four bands of modulation, 20 to 125 Hz.

    The coefficients are those of segments, 250 per second.

    Shape: (items, 5, time) -> (items, 4 bands, 5, time or more).
    """
    time = waves.shape[-1]
    points = fft_length(max(time + MODULATION_ORDER // 2, MODULATION_ORDER + 1), 2)
    responses = _modulation_responses(points, like=waves)
    spectrum = torch.fft.rfft(waves, points)[:, None] * responses[:, None]
    return torch.fft.irfft(spectrum, points)


@constant
def _modulation_responses(points: int) -> NDArray[np.float64]:
    """Return the frequency responses of the bands of modulation. Shape: (4, points // 2 + 1)."""
    nyquist = ENVELOPE_RATE / 2
    filters = [
        bandpass_fir(MODULATION_ORDER + 1, low / nyquist, high / nyquist)
        for low, high in MODULATION_BANDS
    ]
    return zero_phase_responses(filters, points)


class HaaqiReference(QualityReference):
    """Clean music that is prepared once for the HAAQI of many outputs in one impaired ear.

    Args:
        clean: Clean music, not amplified unless ``equalisation`` is 2. The scores are on its
            device, and float64 if it is, otherwise float32. Its gradient is not computed. Shape:
            (..., time).
        audiogram: The impaired ear, -10 to 120 dB HL: one for all items or one for each, or a
            ``Listener`` for (..., 2, time).
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0, 0 to 200.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        equalisation: Mode of pyclarity, 1 or 2, see ``haaqi``.
        keep: Store the clean music's features, about 19 MB per second in float32; otherwise they
            are computed, and the level is validated, for each score.

    Raises:
        ValueError: Clean music that lasts less than 0.7 s, has less than 16 ms of sound, is not
            floating-point, not finite, above 1e9, silent or below 20 dB SPL; a rate, level,
            audiogram, length or equalisation out of range.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> reference = HaaqiReference(speech, "N3")
    >>> bool(reference.score(0.1 * speech) < reference.score(speech))
    True
    """

    envelope_segment = ENVELOPE_SEGMENT
    split_by_rate = staticmethod(_split_by_rate)

    @staticmethod
    def _combine(envelopes: Tensor, fine: Tensor, x: Tensor, y: Tensor) -> QualityParts:
        shape = fine_structure.spectral_similarity(x - y, 2.5)
        relative_shape = fine_structure.spectral_similarity((x - y) / (x + y), 25.0)
        nonlinear = 0.754 * envelopes**3 + 0.246 * fine
        linear = 0.329 * shape + 0.671 * relative_shape
        first_order = 0.336 * nonlinear + 0.001 * linear
        combined = first_order + 0.501 * nonlinear.square() + 0.161 * linear.square()
        return QualityParts(combined, nonlinear, linear)
