"""HASQI version 2 of one ear, as pyclarity computes it, but the same every time.

HASQI (Kates and Arehart 2014, J. Audio Eng. Soc. 62(3)) is the quality of the processed speech in the impaired ear
against the clean speech, amplified by NAL-R, in the same ear. pyclarity draws noise for it from numpy's global
generator, as for HASPI; what ``haspi`` says of rates, short signals and levels holds here too.
"""

from __future__ import annotations

from hlsim.audiogram import Audiogram
from hlsim.evaluation.haspi import Signal, pyclarity_score


def hasqi(
    reference: Signal,
    processed: Signal,
    audiogram: Audiogram,
    sample_rate: int,
    *,
    full_scale_spl: float = 94.0,
    seed: int = 0,
) -> float:
    """HASQI v2 of one ear, 0 to 1: pyclarity's ``hasqi_v2``, whose combined score it is, with numpy's seed set.

    Args:
        reference: clean speech, not amplified; HASQI itself adds NAL-R to it.
        processed: what the impaired ear is given.
        audiogram: of that ear.
        sample_rate: Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0 (pyclarity's ``level1``).
        seed: of the noise that HASQI adds.

    Shape: (time,) and (time,), equally long, at least 0.7 s.

    Raises:
        ValueError: as ``haspi``.
        MissingExtraError: pyclarity is not installed.
    """
    signals = (reference, processed)
    return pyclarity_score("hasqi", signals, audiogram, sample_rate, full_scale_spl, seed)
