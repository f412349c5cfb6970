"""HASPI and HASQI as losses, for training batches that may contain silence and clicks."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from hlsim.metrics.ear.clean_speech import UnscorableError
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi
from hlsim.metrics.pair import scores_or_errors

SCORES: dict[str, Callable[..., Tensor]] = {"haspi": haspi, "hasqi": hasqi}
"""Functions that compute scores from 0 to 1, the higher the better, under the score's name."""


def score_loss(
    name: str,
    output: Tensor,
    clean: Tensor,
    ears: Tensor,
    lengths: Sequence[int],
    sample_rate: int,
) -> Tensor:
    """Compute 1 minus the score of each item, for training.

    The ear's internal noise has no random effect (``noise="expected"``), so the loss is smooth. An
    item has no meaningful score if its clean signal is silent, below 20 dB SPL, shorter than 16 ms
    without the silence at its ends, or for HASPI below the threshold of hearing: the loss of this
    item is 0 and has no gradient. An item with NaN or infinity in ``output`` has the loss NaN.

    Args:
        name: Name of the score, ``"haspi"`` or ``"hasqi"``.
        output: Output of an aid in pascals. Shape: (items, time).
        clean: Clean speech in pascals, for which no gradient is computed. Shape: (items, time).
        ears: Thresholds of the impaired ear of each item in dB HL. Shape: (items, 8).
        lengths: Number of samples of each item before padding.
        sample_rate: Sample rate in Hz.

    Returns:
        Loss of each item, 0 to 1. Shape: (items,).

    Raises:
        ValueError: An item is shorter than 0.7 s, its ear is not valid, ``clean`` is not finite, or
            a sample is above 1e9 in magnitude; or the number of ``lengths`` or the rate is wrong.
        KeyError: There is no such score.

    >>> speech = torch.randn(1, 16000)
    >>> loss = score_loss("haspi", speech, speech, torch.zeros(1, 8), [16000], 16000)
    >>> bool(loss < 0.2)
    True
    """
    finite = output.detach().isfinite().all(-1)
    output = torch.where(finite.unsqueeze(-1), output, 0.0)
    scores = scores_or_errors(SCORES[name], output, clean, ears, lengths, sample_rate=sample_rate)
    losses = []
    for index, (score, signal) in enumerate(zip(scores, output, strict=True)):
        if isinstance(score, Tensor):
            losses.append(1.0 - score)
        elif isinstance(score, UnscorableError):
            losses.append((0.0 * signal).sum())
        else:
            raise ValueError(f"item {index}: {score}") from score
    return torch.where(finite, torch.stack(losses), torch.nan)
