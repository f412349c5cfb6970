"""HASQI version 2 in PyTorch: the quality of speech in an impaired ear.

The score is that of pyclarity 0.9.0, with a gradient. The notes in ``hlsim.metrics.haspi_score`` on
rates, lengths, levels and alignment apply here, too, but clean speech of 20 dB SPL or more that a
normal ear does not hear scores 0 instead of being rejected.

Source: Kates and Arehart 2014, "The hearing-aid speech quality index (HASQI) version 2", J. Audio
Eng. Soc. 62(3), 99-117.
"""

from torch import Tensor

from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import Lengths
from hlsim.metrics.ear import fine_structure
from hlsim.metrics.pair import Equalisation, Noise, match_pair
from hlsim.metrics.quality_reference import QualityParts, QualityReference
from hlsim.torchtools import Audio, Samples, as_type_of, not_compiled


@not_compiled  # tracing takes minutes
def hasqi(
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
    """Compute HASQI version 2 of each item: how good the output of an aid sounds, from 0 to 1.

    The score compares the output with clean speech that NAL-R has amplified for the same impaired
    ear, and is differentiable in ``output``. The delay of an output is removed, to whole samples at
    24 kHz.

    Args:
        output: Output of an aid, at the impaired ear, at least 0.7 s long. Shape: (..., time).
        clean: Clean speech, not amplified unless ``equalisation`` is 2. Shape: (..., time). Lengths
            of both that differ by 0.1 s at most are cut to the shorter one, with a warning.
        audiogram: The impaired ear, -10 to 120 dB HL: one for all items or one for each, or a
            ``Listener`` for (..., 2, time).
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0, 0 to 200.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        noise: Noise 10 dB below the threshold of hearing, which matters where nothing of the output
            is audible. ``"expected"`` uses the same noise every time; ``"seeded"`` draws the noise
            that pyclarity draws with ``seed``; ``"none"`` leaves it out.
        seed: Seed of the drawn noise of each item, 0 to 2**32 - 1.
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        equalisation: Mode of pyclarity: 1 amplifies clean speech by NAL-R here, 2 takes speech that
            NAL-R or another prescription has amplified.

    Returns:
        Scores, of NumPy if ``output`` is an array. Shape: (...).

    Raises:
        ValueError: Signals of different shapes or on different devices, too short, not
            floating-point, not finite or above 1e9; clean speech that is silent, below 20 dB SPL,
            or has less than 16 ms of sound; a rate, level, audiogram, length, seed or equalisation
            out of range; an unknown noise.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> round(float(hasqi(speech, speech, "NH")), 2)
    0.99
    """
    matched, clean, lengths = match_pair(output, clean, sample_rate, lengths)
    reference = HasqiReference(
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


class HasqiReference(QualityReference):
    """Clean speech that is prepared once for the HASQI of many outputs in one impaired ear.

    Args:
        clean: Clean speech, not amplified unless ``equalisation`` is 2. The scores are on its
            device, and float64 if it is, otherwise float32. Its gradient is not computed. Shape:
            (..., time).
        audiogram: The impaired ear, -10 to 120 dB HL: one for all items or one for each, or a
            ``Listener`` for (..., 2, time).
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0, 0 to 200.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        equalisation: Mode of pyclarity, 1 or 2, see ``hasqi``.
        keep: Store the clean speech's features, about 19 MB per second in float32; otherwise they
            are computed, and the level is validated, for each score.

    Raises:
        ValueError: Clean speech that lasts less than 0.7 s, has less than 16 ms of sound, is not
            floating-point, not finite, above 1e9, silent or below 20 dB SPL; a rate, level,
            audiogram, length or equalisation out of range.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> reference = HasqiReference(speech, "N3")
    >>> bool(reference.score(0.1 * speech) < reference.score(speech))
    True
    """

    envelope_segment = fine_structure.SEGMENT

    @staticmethod
    def _combine(envelopes: Tensor, fine: Tensor, x: Tensor, y: Tensor) -> QualityParts:
        shape = fine_structure.spectral_similarity(x - y, 2.5)
        slope = fine_structure.spectral_similarity((x - y).diff(dim=-1), 1.0)
        nonlinear = envelopes.square() * fine
        linear = 0.579 * shape + 0.421 * slope
        return QualityParts(nonlinear * linear, nonlinear, linear)
