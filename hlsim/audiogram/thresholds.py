"""Conversion of ears into tensors of thresholds at eight frequencies, and their validation."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from hlsim.audiogram.discomfort import predict_limits
from hlsim.audiogram.listener import Listener
from hlsim.audiogram.scale import EARS, FREQUENCIES, HIGHEST_SIMULATED, LOWEST_LEVEL
from hlsim.audiogram.value import Audiogram, EarLike, check_range, find_audiogram
from hlsim.torchtools import broadcast_shape, known_on_host, on_device, on_host

# Checkpoints of PyTorch and Lightning may hold ears, for example among the hyperparameters.
torch.serialization.add_safe_globals([Audiogram, Listener])

AudiogramLike = EarLike | Listener | Sequence[EarLike] | Sequence[Listener]
"""One or more ears, in any form.

One ear (see ``as_audiogram``), the two ears of a ``Listener``, a sequence with one of these per
item, or a tensor or an array of thresholds in dB HL at the eight ``FREQUENCIES``, (..., 8).
"""


def as_thresholds(
    audiogram: AudiogramLike | None,
    *,
    highest: float = HIGHEST_SIMULATED,
) -> Tensor:
    """Convert any description of one or more ears into a tensor of thresholds in dB HL.

    The last dimension contains the thresholds at the ``FREQUENCIES`` 250, 500, 1000, 2000, 3000,
    4000, 6000 and 8000 Hz. An ``Audiogram`` with other frequencies is interpolated over log
    frequency (``Audiogram.thresholds``).

    Tensors on a GPU are not validated, because that would synchronise with the GPU, and neither are
    tensors in a compiled or exported program. Instead, an ear with a level out of range becomes
    NaN, and so do the outputs that are computed with it.

    Args:
        audiogram: One or more ears: an ``Audiogram``, a name such as ``"N3"``, a dict such as
            ``{500: 20}``, eight numbers, a ``Listener``, a sequence of these, a tensor or an array.
        highest: Highest level allowed, in dB HL.

    Returns:
        Thresholds in dB HL: (8,) for one ear, (2, 8) for a ``Listener``, (batch, 8) and
        (batch, 2, 8) for sequences of them, in float32. A floating-point tensor is returned as it
        is, (..., 8).

    Raises:
        ValueError: The value does not describe ears, an ear is missing, a tensor does not have
            eight real numbers per ear or has NaN, or a level is outside -10 to ``highest`` dB HL.

    >>> as_thresholds(["N1", "N3"]).shape
    torch.Size([2, 8])
    """
    if isinstance(audiogram, np.ndarray) and audiogram.ndim > 1:
        audiogram = torch.from_numpy(audiogram.astype(np.float32))
    listed = _list_ears(audiogram)
    if listed is None:
        return _check_tensor(audiogram, highest)
    ears, shape = listed
    for ear in ears:
        check_range(ear.thresholds, highest)
    # Whatever torch's default type and device, for example ``meta``
    rows = [ear.thresholds for ear in ears]
    thresholds = torch.tensor(rows, dtype=torch.float32, device="cpu")
    return thresholds.reshape(*shape, len(FREQUENCIES))


def _list_ears(audiogram: Any) -> tuple[list[Audiogram], tuple[int, ...]] | None:
    """Return the audiograms of a value, and the shape in which they are arranged.

    The shape is () for one ear, (2,) for a listener, and (n,) or (n, 2) for sequences of these. The
    result is ``None`` for a tensor, a sequence of tensors, and a value that does not describe ears.

    Raises:
        ValueError: An ear is not valid, or a listener lacks one.
    """
    if isinstance(audiogram, Tensor):
        return None
    ear = find_audiogram(audiogram)
    if ear is not None:
        return [ear], ()
    if isinstance(audiogram, Listener):
        known = audiogram.ears()
        if len(known) < len(EARS):
            (name,) = known
            raise ValueError(
                f"expected a listener with two ears, got the {name} ear only; pass listener.{name} "
                f"with the {name} channel of the waveform"
            )
        return [*known.values()], (len(EARS),)
    if not isinstance(audiogram, Sequence):
        return None
    ears: list[Audiogram] = []
    shapes = set()
    for part in audiogram:
        listed = _list_ears(part)
        if listed is None:
            return None
        ears += listed[0]
        shapes.add(listed[1])
    return (ears, (len(audiogram), *shapes.pop())) if len(shapes) == 1 else None


def find_limits(audiogram: AudiogramLike | None) -> Tensor | None:
    """Return the levels in dB HL to which an aid may limit its output for ears, (..., 8).

    They are the uncomfortable levels of the ear if some were measured, and otherwise those that
    ``predict_limits`` returns.

    Args:
        audiogram: One or more ears. The result is None for None, for a tensor of thresholds, and
            for an array of several ears, which have no measured levels.

    Raises:
        ValueError: An ear is not valid, or a listener lacks one.

    >>> find_limits(["N3", "N4"]).shape
    torch.Size([2, 8])
    """
    listed = _list_ears(audiogram)
    if listed is None:
        return None
    ears, shape = listed
    rows = [
        ear.uncomfortable_levels() if ear.ucl else predict_limits(np.array(ear.thresholds)).tolist()
        for ear in ears
    ]
    levels = torch.tensor(rows, dtype=torch.float32, device="cpu")
    return levels.reshape(*shape, len(FREQUENCIES))


def ears_on_other_grids(audiogram: AudiogramLike | None) -> list[Audiogram | None]:
    """Find the ears that were not measured at the eight ``FREQUENCIES``, for the exact MSBG.

    The exact MSBG interpolates thresholds between the frequencies at which they were measured.

    Args:
        audiogram: One or more ears, or None.

    Returns:
        For each ear its audiogram, or ``None`` if it was measured at the eight frequencies. The
        list is empty if all ears were, for a tensor of thresholds, and for None. The two ears of a
        listener follow one another.

    Raises:
        ValueError: An ear is not valid, a listener lacks one, or an ear that was measured at other
            frequencies has a level above 100 dB HL.

    >>> ears_on_other_grids(["N3", {500: 20}])
    [None, Audiogram({500: 20})]
    """
    ears, _ = _list_ears(audiogram) or ([], ())
    grids = [None if ear.frequencies == FREQUENCIES else ear for ear in ears]
    for ear in grids:
        if ear is not None:
            check_range(ear.levels, HIGHEST_SIMULATED, ear.frequencies)
    return grids if any(grids) else []


def resolve_thresholds(
    stored: Tensor | None,
    audiogram: AudiogramLike | None,
    waveform: Tensor,
    *,
    two_ears: bool = False,
    highest: float = HIGHEST_SIMULATED,
) -> Tensor:
    """Return the thresholds with which a module processes a waveform, on the waveform's device.

    The ears that were passed with the call have precedence over those that the module has stored.

    Args:
        stored: Thresholds that the module has stored, (..., 8), or None.
        audiogram: Ears that were passed with the call, or None.
        waveform: Signals, (..., time).
        two_ears: Whether the stored thresholds are those of listeners, (..., 2, 8).
        highest: Highest level allowed, in dB HL.

    Returns:
        Thresholds in dB HL that broadcast with the leading dimensions of the waveform, (..., 8).
        For mono items, (batch, 1, time), and one ear per item they are (batch, 1, 8).

    Raises:
        ValueError: There are no ears, they are not valid (see ``as_thresholds``), the shapes do not
            broadcast, or the waveform for a listener does not have the shape (..., 2, time).

    >>> resolve_thresholds(None, "N3", torch.zeros(2, 16000)).shape
    torch.Size([8])
    """
    ears = stored if audiogram is None else audiogram
    thresholds = as_thresholds(ears, highest=highest)
    if two_ears if audiogram is None else has_listeners(audiogram):
        check_two_channels(waveform)
    is_mono = waveform.ndim == 3 and waveform.shape[1] == 1
    if is_mono and thresholds.shape[:-1] == waveform.shape[:1]:
        thresholds = thresholds.unsqueeze(1)
    try:
        broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
    except RuntimeError:
        raise ValueError(
            f"audiograms of shape {tuple(thresholds.shape)} do not fit a waveform of shape "
            f"{tuple(waveform.shape)}; pass one audiogram, (8,), or one per item, "
            f"{(*waveform.shape[:-1], len(FREQUENCIES))}"
        ) from None
    return on_device(thresholds, waveform.device)


class StoredEars:
    """Base class of modules that store the ears for calls without an audiogram.

    Attributes:
        highest_level: Highest hearing threshold that the module accepts, in dB HL.
        thresholds: Thresholds in dB HL of the stored ears, (..., 8); None if there are none.

    >>> ears = StoredEars()
    >>> ears.store_ears("N3")
    >>> ears.resolve_thresholds(torch.zeros(16000), None).shape
    torch.Size([8])
    """

    highest_level: ClassVar[float] = HIGHEST_SIMULATED

    thresholds: Tensor | None

    def store_ears(self, audiogram: AudiogramLike | None) -> None:
        """Store the ears that calls without an audiogram use.

        The stored thresholds are a copy without a gradient, because the caller may write into a
        tensor later.

        Args:
            audiogram: One or more ears, or None.

        Raises:
            ValueError: An ear is not valid.
        """
        self.thresholds = None
        self._two_ears = has_listeners(audiogram)
        if audiogram is None:
            return
        with torch.inference_mode(False):  # the module may be trained later
            if isinstance(audiogram, Tensor):
                on_host(audiogram)  # so that its values are validated
            thresholds = as_thresholds(audiogram, highest=self.highest_level)
            self.thresholds = thresholds.detach().clone()

    def resolve_thresholds(self, waveform: Tensor, audiogram: AudiogramLike | None) -> Tensor:
        """Return the thresholds of the passed or else of the stored ears, checked for a waveform.

        See the function ``resolve_thresholds`` for shapes and errors.

        Returns: Thresholds in dB HL on the waveform's device, (..., 8).
        """
        return resolve_thresholds(
            self.thresholds,
            audiogram,
            waveform,
            two_ears=self._two_ears,
            highest=self.highest_level,
        )


def has_listeners(audiogram: AudiogramLike | None) -> bool:
    """Return whether a description of ears is a ``Listener`` or a sequence of listeners.

    >>> has_listeners(Listener("N1", "N3")), has_listeners("N1")
    (True, False)
    """
    if isinstance(audiogram, list | tuple) and audiogram:
        return isinstance(audiogram[0], Listener)
    return isinstance(audiogram, Listener)


def check_two_channels(waveform: Tensor) -> None:
    """Raise ValueError unless a waveform has the shape (..., 2, time).

    >>> check_two_channels(torch.zeros(2, 16000))
    """
    if waveform.shape[-2:-1] != (2,):
        raise ValueError(
            "expected two channels for two ears, left first (a stereo file, or a waveform of "
            f"shape (..., 2, time)), got shape {tuple(waveform.shape)}; put the signal of each ear "
            "into its channel, the same signal into both if it is mono"
        )


def _check_tensor(levels: Any, highest: float) -> Tensor:
    """Validate a tensor of thresholds in dB HL, (..., 8), and return it as floating-point numbers.

    An ear with a level out of range becomes NaN if the values are on a GPU, without a copy on the
    CPU that ``known_on_host`` returns, and in a compiled program.

    Raises:
        ValueError: The value is not such a tensor, or is empty, or a level is NaN or out of range.
    """
    if not isinstance(levels, Tensor):
        raise ValueError(
            f"expected an audiogram, got {type(levels).__name__}; pass an Audiogram, a name such "
            "as 'N3', a Listener, a sequence with one of these per item, or a tensor of thresholds "
            "in dB HL of shape (..., 8); stack tensors of one ear each with "
            "torch.stack(audiogram), of one frequency each with torch.stack(audiogram, -1)"
        )
    if levels.ndim == 0 or levels.shape[-1] != len(FREQUENCIES) or not levels.numel():
        raise ValueError(
            f"expected an audiogram tensor of shape (..., 8), at {FREQUENCIES} Hz, "
            f"got {tuple(levels.shape)}; for other frequencies pass a dictionary of each frequency "
            "in Hz to its threshold, such as {500: 20, 4000: 50}"
        )
    if not levels.is_floating_point():
        levels = levels.float()
    known = known_on_host(levels)
    if known is None or torch.compiler.is_compiling():
        in_range = (levels >= LOWEST_LEVEL) & (levels <= highest)
        return torch.where(in_range.all(-1, keepdim=True), levels, math.nan)
    in_range = ((known >= LOWEST_LEVEL) & (known <= highest)).all(-1)
    if not bool(in_range.all()):
        check_range(known[~in_range][0].tolist(), highest)
    return levels
