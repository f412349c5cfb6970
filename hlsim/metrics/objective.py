"""HASPI and HASQI as parts of a loss, of batches that hold silence and sounds, too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from hlsim.metrics.ear.clean_speech import UnscorableError
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi

SCORES: dict[str, Callable[..., Tensor]] = {"haspi": haspi, "hasqi": hasqi}
"""Scores by name that are the less a loss, the higher they are."""


def missing_score(
    name: str,
    processed: Tensor,
    clean: Tensor,
    ears: Tensor,
    ends: Sequence[int],
    sample_rate: int,
) -> Tensor:
    """What a score lacks of 1, of each item, with the hair cells' noise as expected.

    An item whose clean signal nobody hears enough of (silent, under 20 dB SPL, a click, for HASPI under the threshold of
    hearing) counts 0 and has no gradient, for no score of it means anything. One processed to NaN or infinity gives NaN.

    Args:
        name: of ``SCORES``.
        processed, clean: (items, time) in pascals.
        ears: (items, 8) dB HL.
        ends: samples of each item.

    Returns: (items,). The gradient of ``clean`` is not followed.

    Raises:
        ValueError: an item is shorter than 0.7 s.
    """
    sound = processed.detach().isfinite().all(-1)
    given = torch.where(sound.unsqueeze(-1), processed, 0.0)
    missing = _missing(SCORES[name], given, clean, ears, ends, sample_rate=sample_rate)
    return torch.where(sound, missing, torch.nan)


def _missing(
    score: Callable[..., Tensor],
    processed: Tensor,
    clean: Tensor,
    ears: Tensor,
    ends: Sequence[int],
    **options: Any,
) -> Tensor:
    try:
        return 1.0 - score(processed, clean, ears, lengths=ends, **options)
    except UnscorableError:
        if len(clean) == 1:
            return (0.0 * processed).sum(-1)
    each = [
        _missing(score, processed[i, None], clean[i, None], ears[i, None], [end], **options)
        for i, end in enumerate(ends)
    ]
    return torch.cat(each)
