"""HASPI and HASQI as losses, for training batches that may hold silence and clicks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from hlsim.metrics.ear.clean_speech import UnscorableError
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi

SCORES: dict[str, Callable[..., Tensor]] = {"haspi": haspi, "hasqi": hasqi}
"""Functions that compute scores from 0 to 1, the higher the better, under the score's name."""


def score_loss(
    name: str,
    processed: Tensor,
    clean: Tensor,
    ears: Tensor,
    ends: Sequence[int],
    sample_rate: int,
) -> Tensor:
    """Compute 1 minus the score of each item, for training.

    The ear's internal noise has no random effect (``noise="expected"``), so the loss is smooth. An
    item has no meaningful score if its clean signal is silent, below 20 dB SPL, only as long as a
    click, or for HASPI below the threshold of hearing: the loss of this item is 0 and has no
    gradient. An item with NaN or infinity in ``processed`` has the loss NaN.

    Args:
        name: Name of the score, ``"haspi"`` or ``"hasqi"``.
        processed: Output of the compensator in pascals. Shape: (items, time).
        clean: Clean speech in pascals, for which no gradient is computed. Shape: (items, time).
        ears: Thresholds of the impaired ear of each item in dB HL. Shape: (items, 8).
        ends: Number of samples of each item before padding.
        sample_rate: Sample rate in Hz.

    Returns:
        Loss of each item, 0 to 1. Shape: (items,).

    Raises:
        ValueError: An item is shorter than 0.7 s.

    >>> speech = torch.randn(1, 16000)
    >>> loss = score_loss("haspi", speech, speech, torch.zeros(1, 8), [16000], 16000)
    >>> bool(loss < 0.2)
    True
    """
    finite = processed.detach().isfinite().all(-1)
    processed = torch.where(finite.unsqueeze(-1), processed, 0.0)
    losses = _score_loss(SCORES[name], processed, clean, ears, ends, sample_rate=sample_rate)
    return torch.where(finite, losses, torch.nan)


def _score_loss(
    score: Callable[..., Tensor],
    processed: Tensor,
    clean: Tensor,
    ears: Tensor,
    ends: Sequence[int],
    **options: Any,
) -> Tensor:
    """Compute ``score_loss`` of items whose samples are finite. Shape: -> (items,)."""
    try:
        return 1.0 - score(processed, clean, ears, lengths=ends, **options)
    except UnscorableError:
        if len(clean) == 1:
            return (0.0 * processed).sum(-1)
    # One item without a score stops the batch, so the items are scored one by one.
    losses = []
    for item, end in enumerate(ends):
        signals = processed[item, None], clean[item, None], ears[item, None]
        losses.append(_score_loss(score, *signals, [end], **options))
    return torch.cat(losses)
