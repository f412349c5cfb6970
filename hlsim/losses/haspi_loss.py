"""HASPI as a training loss, with terms for the perceived level, peaks and quality."""

from typing import Any

from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.losses.hearing_loss import HearingLossLoss

LEVEL_WEIGHTS = {"levels": 0.03, "louder": 0.06, "peaks": 1.0}
"""Weights of the terms of the level.

Excess level costs twice its default, as HASPI rewards gain.
"""


class HASPILoss(HearingLossLoss):
    """Training loss that rises as HASPI, a score of intelligibility, falls.

    It is 1 minus HASPI, optionally plus 1 minus HASQI (a score of quality), plus the error of the
    perceived level.

    HASPI alone rewards any gain. Therefore the loss also compares the level that is perceived
    through ``simulator`` with the level that a normal ear perceives of the clean speech, and
    penalises samples above 120 dB SPL. These terms are called ``levels``, ``louder`` and ``peaks``
    in ``loss.parts`` (see ``hlsim.losses.coherent_bands``). HASPI and HASQI are computed with
    ``noise="expected"``, which makes them deterministic. An item whose clean speech is inaudible
    has a HASPI term of 0.

    It is called as ``loss(compensated, clean, audiogram=None, lengths=None)``, with waveforms of
    shape (..., time) in pascals, and returns a scalar; ``HearingLossLoss`` describes the details.
    Items last 0.7 s or more, and no gradient of HASPI reaches ``clean``. A step costs about 10
    times that of the default loss, with HASQI 23 times.

    Args:
        audiogram: Ear or ears, as in ``HearingLossLoss``.
        quality: Weight of 1 minus HASQI, beside 1 for 1 minus HASPI.
        level: Weight of level and peaks. With 0 a model learns to be as loud as it can.
        options: ``simulator``, ``sample_rate``, ``full_scale_spl``, ``reduction``, ``normal``,
            ``ears`` and ``checkpoint`` of ``HearingLossLoss``.

    Raises:
        ValueError: A weight is negative or not finite, or an option of ``HearingLossLoss`` is not
            valid.

    >>> import hlsim
    >>> speech = hlsim.example_speech()[:16000]
    >>> loss = HASPILoss("N3", simulator="msbg")
    >>> print(loss(speech, speech).item() > loss(5.0 * speech, speech).item())  # amplified
    True
    """

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        quality: float = 0.0,
        level: float = 1.0,
        **options: Any,
    ) -> None:
        weights = {"haspi": 1.0}
        if quality:
            weights["hasqi"] = 1.0
        if level:
            weights |= LEVEL_WEIGHTS
        criterion = {"haspi": 1.0, "hasqi": quality, "coherent-bands": level}
        super().__init__(audiogram, criterion=criterion, weights=weights, **options)
