"""HASPI as a training loss, with what it lacks: a heard level, a limit of peaks and, where wanted, quality."""

from pathlib import Path

from torch import nn

from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.losses.frozen_simulator import Hearing
from hlsim.losses.hearing_loss import EarsName, HearingLossLoss, Reduction
from hlsim.neuro.config import NEURO_RATE

_LEVEL = {"levels": 0.03, "louder": 0.06, "peaks": 1.0}
"""What is too loud costs twice what it costs by default, for HASPI rewards gain."""


class HASPILoss(HearingLossLoss):
    """1 less HASPI, a share of 1 less HASQI, and how far the heard level is from a normal ear's.

    HASPI alone rewards any gain. What is heard through ``simulator`` is therefore compared, in level only, with what a
    normal ear hears of the clean speech, and samples over 120 dB SPL cost: the parts levels, louder and peaks of
    ``hlsim.losses.coherent_bands``. HASPI and HASQI are of what the ear is given (``hlsim.metrics``), with the hair
    cells' noise as expected; an item whose clean speech nobody hears counts 0 there (``hlsim.metrics.objective``).

    It is a ``HearingLossLoss`` and is called as one, ``loss(compensated, clean, audiogram=None, lengths=None)``, with its
    shapes, conventions and errors; items last 0.7 s or more, and no gradient of HASPI reaches ``clean``. A step costs
    some 10 times the default loss's, with HASQI some 23 times.

    Args:
        quality: weight of 1 less HASQI, beside 1 of 1 less HASPI.
        level: weight of level and peaks. Without them, 0, a model learns to be as loud as it can.
        audiogram, simulator, sample_rate, full_scale_spl, reduction, normal, ears: as ``HearingLossLoss``.

    Raises:
        ValueError: as ``HearingLossLoss``; a weight that is negative or not finite.
    """

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        quality: float = 0.0,
        level: float = 1.0,
        simulator: str | Path | nn.Module = "neuro-msbg",
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
        reduction: Reduction = "mean",
        normal: Hearing | None = None,
        ears: EarsName = "mean",
    ) -> None:
        criterion = {"haspi": 1.0, "hasqi": quality, "coherent-bands": level}
        parts = {"haspi": 1.0} | ({"hasqi": 1.0} if quality else {}) | (_LEVEL if level else {})
        super().__init__(
            audiogram,
            simulator=simulator,
            sample_rate=sample_rate,
            full_scale_spl=full_scale_spl,
            criterion=criterion,
            weights=parts,
            reduction=reduction,
            normal=normal,
            ears=ears,
        )
