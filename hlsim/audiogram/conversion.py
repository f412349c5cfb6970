"""Conversion of names, lists, arrays and dictionaries into an ``Audiogram``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.value import Audiogram

EarLike = Audiogram | str | Sequence[float] | NDArray[Any] | Tensor | Mapping[float, float]
"""An audiogram, or what ``as_audiogram`` converts into one."""


def as_audiogram(ear: EarLike) -> Audiogram:
    """Convert the description of one ear into an ``Audiogram``.

    Args:
        ear: An ``Audiogram`` of hlsim or pyclarity; the name of a standard audiogram, such as
            ``"N3"`` or ``"n3"``; eight thresholds in dB HL at ``FREQUENCIES``, as a sequence, an
            array or a tensor; or a mapping of frequencies in Hz to thresholds in dB HL.

    Raises:
        ValueError: The value is none of these, or its thresholds are not valid.

    Example:
        >>> from hlsim.audiogram.conversion import as_audiogram
        >>> as_audiogram("n3")
        Audiogram('N3')
        >>> as_audiogram({250: 20, 1000: 30, 8000: 70}).levels
        (20.0, 30.0, 70.0)
    """
    audiogram = find_audiogram(ear)
    if audiogram is None:
        raise ValueError(
            f"expected an ear, got {type(ear).__name__}; pass an Audiogram, a name such as 'N3', "
            "eight thresholds in dB HL, or a dictionary of frequencies in Hz to thresholds"
        )
    return audiogram


def find_audiogram(ear: Any) -> Audiogram | None:
    """Convert a value as ``as_audiogram`` does, or return ``None`` if it does not describe one ear.

    Raises:
        ValueError: The value describes one ear, but its thresholds are not valid.

    >>> find_audiogram("n3"), find_audiogram(3)
    (Audiogram('N3'), None)
    """
    if isinstance(ear, Audiogram):
        return ear
    if isinstance(ear, str):
        return Audiogram.standard(ear)
    if hasattr(ear, "levels") and hasattr(ear, "frequencies"):  # pyclarity's
        return Audiogram.from_clarity(ear)
    if isinstance(ear, Mapping):
        return _from_mapping(ear)
    if isinstance(ear, np.ndarray | Tensor):
        return Audiogram(tuple(ear.tolist())) if ear.ndim == 1 else None
    if isinstance(ear, Sequence) and ear and all(isinstance(level, Real | None) for level in ear):
        return Audiogram(tuple(ear))
    return None


def _from_mapping(levels: Mapping[Any, Any]) -> Audiogram:
    """Convert a mapping of frequencies, in any order, to thresholds."""
    if "levels" in levels:
        return Audiogram.from_dict(levels)
    try:
        frequencies = sorted(levels, key=float)
    except (TypeError, ValueError):
        raise ValueError(
            f"expected a dictionary of frequencies in Hz to thresholds in dB HL, got {levels!r}; "
            "for two ears, pass Listener(left, right)"
        ) from None
    return Audiogram(tuple(levels[frequency] for frequency in frequencies), tuple(frequencies))
