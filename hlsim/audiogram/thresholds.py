"""Thresholds as tensors: of whatever is taken as an audiogram, checked, stored, and interpolated between frequencies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Protocol, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.conversion import EarLike, find_audiogram
from hlsim.audiogram.devices import known_on_host, on_device, on_host
from hlsim.audiogram.value import (
    FREQUENCIES,
    LOWEST_LEVEL,
    Audiogram,
    listed,
)
from hlsim.checks import broadcast_shape
from hlsim.torchtools import constant_like

HIGHEST_SIMULATED = 100.0
"""What a simulator takes, in dB HL: MSBG's expansion ratio 105 / (105 - level) is singular at 105."""


class TwoEars(Protocol):
    """A ``Listener``, to which imports from here would point upwards."""

    @property
    def left(self) -> Audiogram | None: ...

    @property
    def right(self) -> Audiogram | None: ...


AudiogramLike = EarLike | Sequence[EarLike] | TwoEars | Sequence[TwoEars]
"""One ear (see ``as_audiogram``), the two ears of a ``Listener``, a sequence with one of these per
item, or a tensor or an array of thresholds in dB HL, ``(..., 8)``."""


def as_thresholds(
    audiogram: AudiogramLike,
    *,
    highest: float = HIGHEST_SIMULATED,
    taker: str = "a simulator",
    missing: bool = False,
) -> Tensor:
    """Thresholds that a simulator takes, or another ``taker``, up to ``highest`` dB HL.

    A list of (8,) tensors holds an ear each, and one of eight (batch,) tensors a frequency each, as torch's
    ``default_collate`` makes it of thresholds; a list of eight (8,) tensors may be either and is refused.

    Args:
        missing: let a listener with one ear through, whose other ear is NaN.

    Reading a tensor on a GPU would make the host wait for the GPU. The values of such a tensor are not validated on the
    host: an ear with a level out of range becomes NaN there, and so do the outputs that are computed with it.

    Returns: (8,) for one ear, (batch, 8) for a sequence, (2, 8) for a ``Listener``, (batch, 2, 8) for a sequence of them,
    the tensor itself otherwise; dB HL.

    Raises:
        ValueError: not an audiogram, a listener without one ear, a complex or bool tensor, a last dimension other than
            8, NaN, or levels outside -10 to ``highest`` dB HL.
    """
    if isinstance(audiogram, np.ndarray):
        audiogram = torch.from_numpy(audiogram).float()
    ear = None if isinstance(audiogram, Tensor) else find_audiogram(audiogram)
    if ear is not None:
        return torch.tensor(_taken(ear.thresholds, highest, taker))
    if is_listener(audiogram):
        return torch.stack([*_both_ears(audiogram, missing, highest, taker)])
    if isinstance(audiogram, Sequence) and audiogram:
        if all(is_listener(one) for one in audiogram):
            return torch.stack(
                [
                    as_thresholds(one, highest=highest, taker=taker, missing=missing)  # type: ignore[arg-type]
                    for one in audiogram
                ]
            )
        tensors = any(isinstance(one, Tensor) for one in audiogram)
        ears = [None if tensors else find_audiogram(one) for one in audiogram]
        if all(ear is not None for ear in ears):
            return torch.tensor(
                [_taken(ear.thresholds, highest, taker) for ear in ears if ear is not None]
            )
    if isinstance(audiogram, list | tuple):
        audiogram = _stacked(audiogram)
    if not isinstance(audiogram, Tensor):
        raise ValueError(
            f"expected an audiogram, got {type(audiogram).__name__}; pass an Audiogram, a name such "
            "as 'N3', a Listener, a sequence with one of these per item, or thresholds in dB HL of "
            "shape (..., 8)"
        )
    if audiogram.is_complex() or audiogram.dtype == torch.bool:
        raise ValueError(
            f"audiogram tensor of {audiogram.dtype}; allowed: floating-point or integer dB HL"
        )
    levels = audiogram if audiogram.is_floating_point() else audiogram.float()
    if levels.ndim == 0 or levels.shape[-1] != len(FREQUENCIES) or not levels.numel():
        raise ValueError(
            f"audiogram tensor of shape {tuple(levels.shape)}; allowed: (..., 8), dB HL at {listed(FREQUENCIES)} Hz"
        )
    known = known_on_host(levels)
    if known is None:
        inside = (levels >= LOWEST_LEVEL) & (levels <= highest)
        return torch.where(inside.all(-1, keepdim=True), levels, math.nan)
    good = ((known >= LOWEST_LEVEL) & (known <= highest)).all(-1)
    if not bool(good.all()):
        _taken(known[~good][0].tolist(), highest, taker)
    return levels


def own_thresholds(audiogram: AudiogramLike | None, **limits: Any) -> Tensor | None:
    """``as_thresholds`` to keep: a copy, for the caller may write into its tensor; one that is trained stays itself."""
    if audiogram is None:
        return None
    with torch.inference_mode(False):  # it may be trained through later
        if isinstance(audiogram, Tensor):
            on_host(audiogram)  # so that its values are validated
        levels = as_thresholds(audiogram, **limits)
        return levels if levels.requires_grad else levels.clone()


def resolve_thresholds(
    stored: Tensor | None,
    audiogram: AudiogramLike | None,
    waveform: Tensor,
    *,
    two_ears: bool = False,
    **limits: Any,
) -> Tensor:
    """The call's audiogram, or else the stored one, on the waveform's device, checked to fit its leading dimensions.

    Of (batch, 1, time) and (batch, 8) each item has its ear.

    Args:
        two_ears: the stored one is of a listener, or of several.
        limits: of ``as_thresholds``.

    Raises:
        ValueError: there is neither, the shapes do not broadcast, or a listener's waveform is not (..., 2, time).
    """
    if audiogram is None and stored is None:
        raise ValueError(
            "no audiogram: give one with the call, or when building what keeps one (MSBG, NALR)"
        )
    thresholds = as_thresholds(audiogram, **limits) if audiogram is not None else stored
    assert thresholds is not None
    check_two_ears(two_ears if audiogram is None else of_listeners(audiogram), waveform)
    thresholds = one_an_item(thresholds, waveform.shape)
    try:
        broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
    except RuntimeError:
        raise ValueError(
            f"audiograms of shape {tuple(thresholds.shape)} for a waveform of shape {tuple(waveform.shape)}; allowed: "
            "one audiogram, or leading dimensions that broadcast"
        ) from None
    return on_device(thresholds, waveform.device)


def one_an_item(thresholds: Tensor, shape: torch.Size) -> Tensor:
    """As many ears as items of (batch, 1, time) belong to one each. Shape: (batch, 8) -> (batch, 1, 8), else as it is."""
    mono = len(shape) == 3 and shape[1] == 1
    return thresholds.unsqueeze(1) if mono and thresholds.shape[:-1] == shape[:1] else thresholds


def is_listener(audiogram: Any) -> TypeGuard[TwoEars]:
    """Whether it is a ``Listener``."""
    return hasattr(audiogram, "left") and hasattr(audiogram, "right")


def of_listeners(audiogram: AudiogramLike | None) -> bool:
    """Whether it is a ``Listener`` or a sequence of them."""
    several = isinstance(audiogram, list | tuple) and len(audiogram) > 0
    return is_listener(audiogram[0] if several else audiogram)  # type: ignore[index]


def _both_ears(listener: TwoEars, missing: bool, highest: float, taker: str) -> Iterator[Tensor]:
    """Left and right, (8,) each; NaN where one is missing, or ValueError unless it may."""
    if not missing and (listener.left is None or listener.right is None):
        gone, there, place = ("left", "right", 1) if listener.left is None else ("right", "left", 0)
        raise ValueError(
            f"the listener's {gone} ear is missing; give listener.{there} with waveform[..., {place}, :]"
        )
    for ear in (listener.left, listener.right):
        lacks = torch.full((len(FREQUENCIES),), math.nan)
        yield lacks if ear is None else as_thresholds(ear, highest=highest, taker=taker)


def check_two_ears(asked: bool, waveform: Tensor) -> None:
    """Raise ValueError where a listener's two ears are ``asked`` for of a waveform that is not (..., 2, time)."""
    if asked and waveform.shape[-2:-1] != (2,):
        raise ValueError(
            f"a waveform of shape {tuple(waveform.shape)} for a listener's two ears; allowed: (..., 2, time), left first"
        )


def interpolate(levels: Tensor, hz: tuple[float, ...]) -> Tensor:
    """Levels between the audiometric frequencies, linear in Hz and flat beyond. Shape: (..., 8) -> (..., frequencies)."""
    # no matrix product, which a GPU may be allowed to round to ten bits
    return (levels.unsqueeze(-1) * constant_like(levels, interpolation_weights, hz)).sum(-2)


def interpolation_weights(hz: tuple[float, ...]) -> NDArray[np.float64]:
    """``interpolate`` as a matrix. Returns (8, frequencies)."""
    return np.stack([np.interp(hz, FREQUENCIES, row) for row in np.eye(len(FREQUENCIES))])


def _stacked(tensors: Any) -> Any:
    """One tensor of a list of (8,) tensors, an ear each, or of eight (batch,) ones, a frequency each; else as given."""
    kinds = len(FREQUENCIES)
    if not all(isinstance(one, Tensor) and one.ndim == 1 for one in tensors):
        return tensors
    if len({len(one) for one in tensors}) != 1:
        return tensors
    ears, frequencies = len(tensors[0]) == kinds, len(tensors) == kinds
    if ears and frequencies:
        raise ValueError(
            "audiogram is eight tensors of 8 levels, an ear each or a frequency each; allowed: torch.stack(audiogram) of "
            "ears, torch.stack(audiogram, -1) of frequencies"
        )
    return torch.stack(tuple(tensors), 0 if ears else -1) if ears or frequencies else tensors


def _taken(levels: Sequence[float], highest: float, taker: str) -> Sequence[float]:
    """The levels, or ValueError where the taker does not take them."""
    if not all(LOWEST_LEVEL <= level <= highest for level in levels):
        reason = " (MSBG is singular at 105)" if highest == HIGHEST_SIMULATED else ""
        raise ValueError(
            f"audiogram levels {listed(levels)} dB HL; {taker} takes {LOWEST_LEVEL:g} to {highest:g}{reason}"
        )
    return levels
