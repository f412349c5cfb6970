"""Thresholds of ears as tensors: conversion, validation, storage, and interpolation."""

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
from hlsim.audiogram.listener import Listener
from hlsim.audiogram.value import FREQUENCIES, LOWEST_LEVEL, join_numbers
from hlsim.checks import broadcast_shape
from hlsim.torchtools import constant_like

HIGHEST_SIMULATED = 100.0
"""Highest level in dB HL that simulators accept: MSBG's expansion ratio 105 / (105 - level) is singular at 105."""

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
    """Convert ears to thresholds in dB HL.

    A list of tensors holds one ear per tensor, (8,), or one frequency per tensor, (batch,), as
    torch's ``default_collate`` arranges them. Eight tensors of shape (8,) could be either, and are
    rejected.

    Reading a tensor on a GPU would make the host wait for the GPU. The values of such a tensor are not validated on the
    host: an ear with a level out of range becomes NaN there, and so do the outputs that are computed with it.

    Args:
        audiogram: ear or ears.
        highest: highest accepted level in dB HL.
        consumer: what needs the thresholds, for messages.
        allow_missing: accept a listener with one ear, whose other ear becomes NaN.

    Returns: (8,) for one ear, (batch, 8) for a sequence, (2, 8) for a ``Listener``, (batch, 2, 8)
        for a sequence of listeners, and a tensor itself.

    Raises:
        ValueError: the value is not an audiogram, a listener lacks an ear, a tensor is complex or
            bool, has another last dimension than 8 or holds NaN, or a level is out of range.
    """
    limits: dict[str, Any] = {"highest": highest, "consumer": consumer}
    if isinstance(audiogram, Listener):
        return _listener_thresholds(audiogram, allow_missing, limits)
    if isinstance(audiogram, np.ndarray):
        audiogram = torch.from_numpy(audiogram).float()
    if not isinstance(audiogram, Tensor):
        ear = find_audiogram(audiogram)
        if ear is not None:
            return torch.tensor(_check_levels(ear.thresholds, **limits))
        if isinstance(audiogram, list | tuple) and audiogram:
            first = audiogram[0]
            if isinstance(first, Tensor):
                audiogram = _stack(audiogram)
            elif isinstance(first, Listener) or find_audiogram(first) is not None:
                ears = [
                    as_thresholds(ear, **limits, allow_missing=allow_missing) for ear in audiogram
                ]
                return torch.stack(ears)
    if not isinstance(audiogram, Tensor):
        raise ValueError(
            f"expected an audiogram, got {type(audiogram).__name__}; pass an Audiogram, a name such "
            "as 'N3', a Listener, a sequence with one of these per item, or thresholds in dB HL of "
            "shape (..., 8)"
        )
    return _check_tensor(audiogram, **limits)


def store_thresholds(audiogram: AudiogramLike | None, **options: Any) -> Tensor | None:
    """Return ``as_thresholds`` for a module to keep, or None for None.

    It is a copy, because the caller may write into a tensor, unless the tensor is trained.
    """
    if audiogram is None:
        return None
    with torch.inference_mode(False):  # the module may be trained through later
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
    """Return the thresholds for a waveform, on its device: those of the call, else the stored ones.

    A waveform (batch, 1, time) with thresholds (batch, 8) has one ear per item.

    Args:
        stored: thresholds that a module keeps.
        audiogram: ear or ears that were passed to the call.
        waveform: (..., time).
        two_ears: whether the stored thresholds are those of listeners.
        options: keyword arguments of ``as_thresholds``.

    Raises:
        ValueError: there are no thresholds, their shape does not broadcast with the leading
            dimensions, or a listener's waveform is not (..., 2, time).
    """
    if audiogram is not None:
        two_ears = has_listeners(audiogram)
        thresholds = as_thresholds(audiogram, **options)
    elif stored is not None:
        thresholds = stored
    else:
        raise ValueError(
            "no audiogram; pass one with the call, or to the constructor of MSBG and NALR"
        )
    if two_ears:
        check_two_channels(waveform)
    thresholds = unsqueeze_mono(thresholds, waveform.shape)
    try:
        broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
    except RuntimeError:
        raise ValueError(
            f"expected one audiogram or one per item, got audiograms of shape "
            f"{tuple(thresholds.shape)} for a waveform of shape {tuple(waveform.shape)}"
        ) from None
    return on_device(thresholds, waveform.device)


def unsqueeze_mono(thresholds: Tensor, shape: torch.Size) -> Tensor:
    """Give thresholds the channel dimension of a mono batch.

    Shape: (batch, 8) with waveforms (batch, 1, time) -> (batch, 1, 8), otherwise unchanged.
    """
    mono = len(shape) == 3 and shape[1] == 1
    return thresholds.unsqueeze(1) if mono and thresholds.shape[:-1] == shape[:1] else thresholds


def has_listeners(audiogram: AudiogramLike | None) -> bool:
    """Return whether a value is a ``Listener`` or a sequence of listeners."""
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
    """Interpolate thresholds linearly in Hz, flat beyond the ends. Shape: (..., 8) -> (..., frequencies)."""
    # A GPU may round matrix products to ten bits, so this is a sum of products.
    weights = constant_like(levels, interpolation_weights, frequencies)
    return (levels.unsqueeze(-1) * weights).sum(-2)


def interpolation_weights(frequencies: tuple[float, ...]) -> NDArray[np.float64]:
    """Return ``interpolate`` as a matrix, (8, frequencies)."""
    rows = np.eye(len(FREQUENCIES))
    return np.stack([np.interp(frequencies, FREQUENCIES, row) for row in rows])


def _listener_thresholds(listener: Listener, allow_missing: bool, limits: dict[str, Any]) -> Tensor:
    ears = [listener.left, listener.right]
    if None in ears and not allow_missing:
        place = 1 if listener.left is None else 0
        name, other = ("left", "right") if listener.left is None else ("right", "left")
        raise ValueError(
            f"the listener has no {name} ear; pass listener.{other} with waveform[..., {place}, :]"
        )
    unknown = torch.full((len(FREQUENCIES),), math.nan)
    return torch.stack([unknown if ear is None else as_thresholds(ear, **limits) for ear in ears])


def _stack(tensors: Sequence[Any]) -> Any:
    """Stack tensors of one ear each or of one frequency each, or return what is neither."""
    shapes = {tuple(tensor.shape) for tensor in tensors if isinstance(tensor, Tensor)}
    count = len(FREQUENCIES)
    if len(shapes) != 1 or not all(isinstance(tensor, Tensor) for tensor in tensors):
        return tensors
    (shape,) = shapes
    one_ear_each = shape == (count,)
    one_frequency_each = len(shape) == 1 and len(tensors) == count
    if one_ear_each and one_frequency_each:
        raise ValueError(
            "expected one tensor, got a list of eight tensors of 8 levels, which may be ears or "
            "frequencies; stack ears with torch.stack(audiogram), frequencies with "
            "torch.stack(audiogram, -1)"
        )
    if not one_ear_each and not one_frequency_each:
        return tensors
    return torch.stack(tuple(tensors), 0 if one_ear_each else -1)


def _check_tensor(audiogram: Tensor, highest: float, consumer: str) -> Tensor:
    if audiogram.is_complex() or audiogram.dtype == torch.bool:
        raise ValueError(f"expected thresholds as real numbers, got {audiogram.dtype}")
    levels = audiogram if audiogram.is_floating_point() else audiogram.float()
    if levels.ndim == 0 or levels.shape[-1] != len(FREQUENCIES) or not levels.numel():
        raise ValueError(
            f"expected thresholds of shape (..., 8), at {join_numbers(FREQUENCIES)} Hz, "
            f"got {tuple(levels.shape)}"
        )
    known = known_on_host(levels)
    if known is None:
        inside = (levels >= LOWEST_LEVEL) & (levels <= highest)
        return torch.where(inside.all(-1, keepdim=True), levels, math.nan)
    inside = ((known >= LOWEST_LEVEL) & (known <= highest)).all(-1)
    if not bool(inside.all()):
        _check_levels(known[~inside][0].tolist(), highest, consumer)
    return levels


def _check_levels(levels: Sequence[float], highest: float, consumer: str) -> Sequence[float]:
    if not all(LOWEST_LEVEL <= level <= highest for level in levels):
        reason = ", as MSBG is singular at 105" if highest == HIGHEST_SIMULATED else ""
        raise ValueError(
            f"expected levels from {LOWEST_LEVEL:g} to {highest:g} dB HL for {consumer}{reason}, "
            f"got {join_numbers(levels)}"
        )
    return levels
