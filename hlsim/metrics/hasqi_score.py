"""HASQI version 2 in PyTorch: the quality of speech in an impaired ear.

The score is that of pyclarity 0.9.0, with a gradient. The notes in ``hlsim.metrics.haspi_score`` on
rates, lengths, levels and alignment apply to it, too.

Source: Kates and Arehart 2014, "The hearing-aid speech quality index (HASQI) version 2", J. Audio
Eng. Soc. 62(3), 99-117.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import Lengths
from hlsim.metrics.ear import fine_structure
from hlsim.metrics.ear.model import Extent
from hlsim.metrics.pair import Noise, match_pair
from hlsim.metrics.quality import Comparison, QualityParts, QualityReference
from hlsim.torchtools import not_compiled

HasqiParts = QualityParts


@not_compiled  # tracing takes minutes
def hasqi(
    processed: Tensor,
    clean: Tensor,
    audiogram: AudiogramLike,
    *,
    sample_rate: int = 16000,
    full_scale_spl: float = PASCAL_SPL,
    lengths: Lengths | None = None,
    noise: Noise = "expected",
    seed: int | Sequence[int] = 0,
    whole_khz: bool = False,
) -> Tensor:
    """Compute HASQI version 2 of each item: how good the processed speech sounds to an ear, 0 to 1.

    The score compares the processed speech with clean speech that NAL-R has amplified for the same
    ear. It is differentiable in ``processed``.

    Args:
        processed, clean, audiogram, sample_rate, full_scale_spl, lengths, seed, whole_khz: The
            arguments of ``haspi``.
        noise: Noise at the threshold of hearing, which matters where nothing of the processed
            speech is audible. ``"expected"`` uses the same noise every time; ``"seeded"`` draws the
            noise that pyclarity draws with ``seed``; ``"none"`` leaves it out.

    Shape: (..., time) twice, and (..., 8) dB HL -> (...,).

    Raises:
        ValueError: As for ``haspi``.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> round(float(hasqi(speech, speech, "NH")), 2)
    0.99
    """
    processed, clean, lengths = match_pair(processed, clean, sample_rate, lengths)
    reference = HasqiReference(
        clean,
        audiogram,
        sample_rate=sample_rate,
        full_scale_spl=full_scale_spl,
        lengths=lengths,
        whole_khz=whole_khz,
        keep=False,
    )
    return reference.score(processed, noise=noise, seed=seed)


class HasqiReference(QualityReference):
    """Clean speech in an impaired ear, prepared for the HASQI of many processed signals.

    In float32 it takes about 18 MB per second of speech.

    Args:
        clean, audiogram, sample_rate, full_scale_spl, lengths, whole_khz: The arguments of
            ``hasqi``. The scores have the dtype and the device of ``clean``, whose gradient is not
            computed.
        keep: Store the clean signal's features; otherwise they are computed for each score, which
            takes less memory.

    Raises:
        ValueError: As for ``haspi``.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> reference = HasqiReference(speech, "N3")
    >>> bool(reference.score(0.1 * speech) < reference.score(speech))
    True
    """

    score_name = "HASQI"
    envelope_segment = fine_structure.SEGMENT

    @staticmethod
    def compute_parts(comparison: Comparison, extent: Extent) -> Tensor:
        counts = fine_structure.segments_of(extent)
        envelopes = fine_structure.envelope_correlation(
            comparison.clean_levels, comparison.processed_levels, counts
        )
        fine = fine_structure.synchrony(comparison.coherence, comparison.energy, counts)
        x = fine_structure.relative_loudness(comparison.clean_spectrum)
        y = fine_structure.relative_loudness(comparison.processed_spectrum)
        shape = fine_structure.spectral_similarity(x - y, 2.5)
        slope = fine_structure.spectral_similarity((x - y).diff(dim=-1), 1.0)
        return torch.stack((envelopes.square() * fine, 0.579 * shape + 0.421 * slope), -1)

    @staticmethod
    def _combine(nonlinear: Tensor, linear: Tensor) -> Tensor:
        return nonlinear * linear
