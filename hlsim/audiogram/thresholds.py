"""Thresholds as tensors: converted, validated, stored, and interpolated between frequencies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.conversion import EarLike, find_audiogram
from hlsim.audiogram.devices import known_on_host, on_device, on_host
from hlsim.audiogram.listener import EARS, Listener
from hlsim.audiogram.value import (
    FREQUENCIES,
    HIGHEST_SIMULATED,
    LOWEST_LEVEL,
    Audiogram,
    check_range,
    join_numbers,
)
from hlsim.checks import broadcast_shape
from hlsim.torchtools import constant_like

AudiogramLike = EarLike | Listener | Sequence[EarLike] | Sequence[Listener]
"""One ear (see ``as_audiogram``), the two ears of a ``Listener``, a sequence with one of these per
item, or a tensor or an array of thresholds in dB HL, ``(..., 8)``."""


def as_thresholds(
    audiogram: AudiogramLike,
    *,
    highest: float = HIGHEST_SIMULATED,
    consumer: str = "a simulator",
    allow_missing: bool = False,
) -> Tensor:
    """Return the thresholds of one or more ears at the eight ``FREQUENCIES``.

    An ``Audiogram`` with other frequencies is interpolated over log frequency
    (``Audiogram.thresholds``). In a list of tensors, (8,) tensors are one ear each, and eight
    (batch,) tensors are one frequency each, as torch's ``default_collate`` stacks them.

    Reading a tensor on a GPU would make the host wait for the GPU. The values of such a tensor are
    not validated on the host: an ear with a level out of range becomes NaN, and so do the outputs
    that are computed with it.

    Args:
        audiogram: One or more ears.
        highest: Highest level allowed, in dB HL.
        consumer: What takes the thresholds, for messages.
        allow_missing: Accept listeners with one ear. The thresholds of the other ear are NaN.

    Returns:
        Thresholds in dB HL: (8,) for one ear, (2, 8) for a ``Listener``, (batch, 8) and
        (batch, 2, 8) for sequences of them, and a tensor itself.

    Raises:
        ValueError: The value does not describe ears, an ear is missing, a tensor does not hold
            eight real numbers per ear, or a level is NaN or outside -10 to ``highest`` dB HL.
    """
    if isinstance(audiogram, np.ndarray):
        audiogram = torch.from_numpy(audiogram).float()
    found = list_ears(audiogram)
    if found is not None:
        ears, shape = found
        if not allow_missing and None in ears:
            _raise_missing_ear(ears.index(None))
        unknown = (math.nan,) * len(FREQUENCIES)
        rows = [unknown if ear is None else ear.thresholds for ear in ears]
        for row in rows:
            if row is not unknown:
                check_range(row, highest, consumer)
        return torch.tensor(rows).reshape(*shape, len(FREQUENCIES))
    levels = _stacked(audiogram)
    if not isinstance(levels, Tensor):
        raise ValueError(
            f"expected an audiogram, got {type(levels).__name__}; pass an Audiogram, a name such "
            "as 'N3', a Listener, a sequence with one of these per item, or thresholds in dB HL of "
            "shape (..., 8)"
        )
    if levels.is_complex() or levels.dtype == torch.bool:
        raise ValueError(
            f"expected an audiogram tensor of real numbers in dB HL, got {levels.dtype}"
        )
    if levels.ndim == 0 or levels.shape[-1] != len(FREQUENCIES) or not levels.numel():
        raise ValueError(
            f"expected an audiogram tensor of shape (..., 8), dB HL at {join_numbers(FREQUENCIES)} Hz, got shape "
            f"{tuple(levels.shape)}; pass an Audiogram for other frequencies"
        )
    if not levels.is_floating_point():
        levels = levels.float()
    known = known_on_host(levels)
    if known is None:
        in_range = ((levels >= LOWEST_LEVEL) & (levels <= highest)).all(-1, keepdim=True)
        return torch.where(in_range, levels, math.nan)
    in_range = ((known >= LOWEST_LEVEL) & (known <= highest)).all(-1)
    if not bool(in_range.all()):
        check_range(known[~in_range][0].tolist(), highest, consumer)
    return levels


def list_ears(audiogram: Any) -> tuple[list[Audiogram | None], tuple[int, ...]] | None:
    """Return the audiograms of a value, and the shape of their thresholds without the last dimension.

    The missing ear of a listener is ``None``. The result is ``None`` for a tensor, for a sequence of
    tensors, and for what does not describe ears.
    """
    if isinstance(audiogram, Tensor):
        return None
    ear = find_audiogram(audiogram)
    if ear is not None:
        return [ear], ()
    if isinstance(audiogram, Listener):
        return [audiogram.left, audiogram.right], (len(EARS),)
    if not isinstance(audiogram, Sequence):
        return None
    ears: list[Audiogram | None] = []
    shapes = set()
    for part in audiogram:
        found = list_ears(part)
        if found is None:
            return None
        ears += found[0]
        shapes.add(found[1])
    return (ears, (len(audiogram), *shapes.pop())) if len(shapes) == 1 else None


def other_grids(audiogram: AudiogramLike | None) -> list[Audiogram | None]:
    """Return the ears that were measured at other than the eight frequencies, for the exact MSBG.

    Returns:
        One audiogram per ear, in the order of ``as_thresholds``, or ``None`` for an ear at the
        eight frequencies; an empty list if all ears are at the eight frequencies.

    Raises:
        ValueError: A level is above 100 dB HL, at whatever frequency.
    """
    ears, _ = list_ears(audiogram) or ([], ())
    others = [None if ear is None or ear.frequencies == FREQUENCIES else ear for ear in ears]
    for ear in others:
        if ear is not None:
            check_range(ear.levels, HIGHEST_SIMULATED, "a simulator")
    return others if any(others) else []


def store_thresholds(audiogram: AudiogramLike | None, **options: Any) -> Tensor | None:
    """Return ``as_thresholds`` for a module to store.

    The result is a copy, because the caller may write into a tensor later. A tensor that requires a
    gradient stays itself.
    """
    if audiogram is None:
        return None
    with torch.inference_mode(False):  # the module may be trained later
        if isinstance(audiogram, Tensor):
            on_host(audiogram)  # so that its values are validated
        levels = as_thresholds(audiogram, **options)
        return levels if levels.requires_grad else levels.clone()


def resolve_thresholds(
    stored: Tensor | None,
    audiogram: AudiogramLike | None,
    waveform: Tensor,
    *,
    two_ears: bool = False,
    **options: Any,
) -> Tensor:
    """Return the thresholds of a call, or else the stored ones, on the waveform's device.

    Args:
        stored: Thresholds of the module, ``(..., 8)``.
        audiogram: Ears of the call.
        waveform: Signals, ``(..., time)``.
        two_ears: Whether the stored thresholds are those of listeners.
        options: Keyword arguments of ``as_thresholds``.

    Returns:
        Thresholds that broadcast with the leading dimensions of the waveform, ``(..., 8)``; one ear
        per item for (batch, 1, time) and (batch, 8).

    Raises:
        ValueError: There are no ears, the shapes do not broadcast, or the waveform of a listener is
            not (..., 2, time).
    """
    if audiogram is None and stored is None:
        raise ValueError(
            "no audiogram; pass one with the call, or to MSBG or NALR when building it"
        )
    thresholds = stored if audiogram is None else as_thresholds(audiogram, **options)
    assert thresholds is not None
    if two_ears if audiogram is None else has_listeners(audiogram):
        check_two_channels(waveform)
    thresholds = unsqueeze_mono(thresholds, waveform.shape)
    try:
        broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
    except RuntimeError:
        raise ValueError(
            f"audiograms of shape {tuple(thresholds.shape)} do not fit a waveform of shape "
            f"{tuple(waveform.shape)}; pass one audiogram, or leading dimensions that broadcast"
        ) from None
    return on_device(thresholds, waveform.device)


def unsqueeze_mono(thresholds: Tensor, shape: torch.Size) -> Tensor:
    """Give each mono item of (batch, 1, time) its ear. Shape: (batch, 8) -> (batch, 1, 8)."""
    mono = len(shape) == 3 and shape[1] == 1
    return thresholds.unsqueeze(1) if mono and thresholds.shape[:-1] == shape[:1] else thresholds


def has_listeners(audiogram: AudiogramLike | None) -> bool:
    """Whether ears are those of a ``Listener`` or of a sequence of listeners."""
    if isinstance(audiogram, list | tuple) and audiogram:
        return isinstance(audiogram[0], Listener)
    return isinstance(audiogram, Listener)


def check_two_channels(waveform: Tensor) -> None:
    """Raise ValueError unless a waveform has the shape (..., 2, time)."""
    if waveform.shape[-2:-1] != (2,):
        raise ValueError(
            "expected a waveform of shape (..., 2, time) for two ears, left first, "
            f"got {tuple(waveform.shape)}"
        )


def interpolate(levels: Tensor, frequencies: tuple[float, ...]) -> Tensor:
    """Interpolate levels at the eight frequencies, linearly in Hz and flat beyond them.

    Shape: (..., 8) -> (..., frequencies).
    """
    # A GPU may round matrix products to ten bits, so this is a sum of products.
    weights = constant_like(levels, interpolation_weights, frequencies)
    return (levels.unsqueeze(-1) * weights).sum(-2)


def interpolation_weights(
    frequencies: tuple[float, ...], grid: tuple[float, ...] = FREQUENCIES
) -> NDArray[np.float64]:
    """Return the weights of the levels of a grid in those at other frequencies, (grid, frequencies)."""
    return np.stack([np.interp(frequencies, grid, row) for row in np.eye(len(grid))])


def _raise_missing_ear(index: int) -> None:
    """Raise ValueError for the ear with an index among the ears of listeners."""
    missing, other = EARS[index % 2], 1 - index % 2
    raise ValueError(
        f"the listener's {missing} ear is missing; pass listener.{EARS[other]} with "
        f"waveform[..., {other}, :]"
    )


def _stacked(tensors: Any) -> Any:
    """Stack a sequence of (8,) tensors, one per ear, or of eight (batch,) tensors, one per frequency.

    Anything else is returned as it is.
    """
    if not isinstance(tensors, list | tuple):
        return tensors
    lengths = {len(one) if isinstance(one, Tensor) and one.ndim == 1 else -1 for one in tensors}
    per_ear, per_frequency = lengths == {len(FREQUENCIES)}, len(tensors) == len(FREQUENCIES)
    if per_ear and per_frequency:
        raise ValueError(
            "eight tensors of 8 levels may be one ear or one frequency each; pass "
            "torch.stack(audiogram) if they are ears, torch.stack(audiogram, -1) if frequencies"
        )
    if per_ear:
        return torch.stack(tuple(tensors))
    if per_frequency and len(lengths) == 1 and -1 not in lengths:
        return torch.stack(tuple(tensors), -1)
    return tensors
