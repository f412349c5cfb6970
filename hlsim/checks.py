"""Checks of values: settings first, then rates, waveforms and lengths; what is refused is told with what is allowed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from numbers import Real
from typing import Any, Literal, get_args, get_origin, get_type_hints

import torch
from torch import Tensor

LOWEST_RATE, HIGHEST_RATE = 16000, 48000
"""Sample rates in Hz that simulators and compensators take."""

HIGHEST_SAMPLE = 1e9
"""Largest sample that is taken. From 1e14 on, a power of five or a product of powers leaves float32."""

Lengths = Tensor | Sequence[int]
"""Samples of each item, in the shape of the leading dimensions."""

_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


def broadcast_shape(*shapes: Sequence[int]) -> torch.Size:
    """Return the shape to which all shapes broadcast.

    ``torch.broadcast_shapes`` does the same, but its first call imports sympy, which takes a third of a second.

    Raises:
        RuntimeError: the shapes do not fit.
    """
    number = torch.empty(())
    return torch.broadcast_tensors(*(number.expand(shape) for shape in shapes))[0].shape


def refuse_unknown(
    found: Iterable[Any], allowed: Iterable[str], what: str, where: str = ""
) -> None:
    """Raise ValueError unless every name is allowed; ``what`` they are and ``where`` they stand is for the message."""
    allowed = list(allowed)
    if unknown := sorted({str(name) for name in found} - set(allowed)):
        place = f" {where}" if where else ""
        raise ValueError(
            f"unknown {what} {', '.join(unknown)}{place}; allowed: {', '.join(allowed)}"
        )


def check_choice(name: str, value: Any, choice: Any, where: str = "") -> None:
    """Raise ValueError unless a value is one of those of a ``Literal``."""
    if not isinstance(value, str) or value not in get_args(choice):
        place = f" {where}" if where else ""
        raise ValueError(f"{name} {value!r}{place}; allowed: {', '.join(get_args(choice))}")


def refuse_other_kinds(settings: Any, where: str) -> None:
    """Raise ValueError unless every field of a dataclass holds what it is annotated with: an int, a float, a bool, a str,
    one of a few, a pair of floats (ascending) or a dict of them."""
    kinds = get_type_hints(type(settings))
    for name in (entry.name for entry in fields(settings)):
        kind, value = kinds[name], getattr(settings, name)
        origin = get_origin(kind)
        if origin is Literal:
            check_choice(name, value, kind, where)
        elif origin is tuple:
            if not isinstance(value, tuple | list) or len(value) != 2:
                raise ValueError(
                    f"{name} {value!r} {where}; allowed: a lowest and a highest, as [0, 20]"
                )
            for one in value:
                _refuse(one, float, name, where)
            if value[0] > value[1]:
                raise ValueError(
                    f"{name} {list(value)} {where}; allowed: a lowest and a highest, ascending"
                )
        elif origin is dict:
            if not isinstance(value, Mapping):
                raise ValueError(f"{name} {value!r} {where}; allowed: 'name: value' lines below it")
            for key, one in value.items() if float in kind.__args__ else ():
                _refuse(one, float, f"{name}: {key}", where)
        else:
            _refuse(value, kind, name, where)


def refuse_weights(weights: Mapping[str, float], allowed: Iterable[str], where: str) -> None:
    """Raise ValueError unless all are of known criteria, none is negative and one or more is above 0."""
    refuse_unknown(weights, allowed, "criteria", where)
    if min(weights.values(), default=0.0) < 0.0 or not any(weights.values()):
        raise ValueError(
            f"weights {dict(weights)} {where}; allowed: 0 or more, one or more above 0"
        )


def refuse_seed(seed: int, where: str) -> None:
    """Raise ValueError for a seed that torch's generators do not take."""
    if not -(2**62) < seed < 2**62:
        raise ValueError(f"seed {seed} {where}; allowed: whole numbers between -2**62 and 2**62")


def _refuse(value: Any, kind: type, name: str, where: str) -> None:
    if is_finite(value) if kind is float else type(value) is kind:
        return
    wanted = f"allowed: {_KINDS[kind]}"
    if kind is float and isinstance(value, str):
        wanted += " (YAML takes 1e-3 for text; write 1.0e-3)"
    raise ValueError(f"{name} {value!r} {where}; {wanted}")


def is_finite(value: Any) -> bool:
    """Whether it is a finite number, Python's or numpy's; a bool is none."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number that no float holds
        return False


def check_rate(sample_rate: int) -> int:
    """Return the rate, or raise ValueError unless it is a whole number of Hz from 16000 to 48000."""
    inside = is_finite(sample_rate) and LOWEST_RATE <= sample_rate <= HIGHEST_RATE
    if not inside or int(sample_rate) != sample_rate:
        raise ValueError(
            f"sample rate {sample_rate!r} Hz; allowed: {LOWEST_RATE} to {HIGHEST_RATE}"
        )
    return int(sample_rate)


def check_waveform(
    waveform: Tensor, name: str = "waveform", *, highest: float = HIGHEST_SAMPLE
) -> Tensor:
    """Return the waveform, or raise ValueError unless it is a floating-point (..., time) tensor with samples up to 1e9.

    NaN and infinity pass, and make their item's results NaN. The values are not checked on a GPU,
    because the host would wait for it, nor in a compiled program.
    """
    check_floating(waveform, name)
    if waveform.ndim == 0 or waveform.numel() == 0:
        raise ValueError(
            f"{name} has shape {tuple(waveform.shape)}; allowed: (..., time) with at least one sample"
        )
    if waveform.device.type == "cpu" and not torch.compiler.is_compiling():
        low, high = torch.aminmax(waveform.detach())
        if highest < (peak := max(-float(low), float(high))) < math.inf:
            raise ValueError(f"{name} has a sample of {peak:.3g}; allowed: up to {highest:g}")
    return waveform


def check_floating(waveform: Tensor, name: str = "waveform") -> None:
    """Raise ValueError unless it is a floating-point tensor."""
    if not isinstance(waveform, Tensor) or not waveform.is_floating_point():
        kind = waveform.dtype if isinstance(waveform, Tensor) else type(waveform).__name__
        scaled = "; divide 16-bit samples by 32768" if "int16" in str(kind) else ""
        raise ValueError(f"{name} is {kind}; allowed: a floating-point tensor (..., time){scaled}")


def check_lengths(lengths: Lengths, shape: torch.Size) -> Tensor:
    """The lengths in samples as a tensor on the CPU.

    Args:
        lengths: whole numbers of samples, or shares of ``time`` above 0 to 1, as SpeechBrain has them; (batch,) serves a
            batch of shape (batch, 1, time), too.
        shape: of the batch, (..., time).

    Returns: (...), int64.

    Raises:
        ValueError: other numbers, of another shape, or outside 1 to time.
    """
    *items, time = shape
    allowed = (
        f"allowed: whole numbers from 1 to {time} (samples) of shape {tuple(items)}, one an item"
    )
    try:
        ends = torch.as_tensor(lengths, device="cpu")
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"lengths is {type(lengths).__name__}; {allowed}") from None
    if ends.is_floating_point() and bool(((ends > 0.0) & (ends <= 1.0)).all()):
        ends = (ends.double() * time).round().long().clamp_min(1)
    if len(shape) == 3 and shape[1] == 1 and ends.shape == shape[:1]:
        ends = ends.unsqueeze(-1)
    if ends.is_floating_point() or ends.is_complex() or ends.dtype == torch.bool:
        raise ValueError(f"lengths of {ends.dtype}; {allowed}")
    if ends.shape != shape[:-1]:
        raise ValueError(f"lengths of shape {tuple(ends.shape)}; {allowed}")
    if not bool(((ends >= 1) & (ends <= time)).all()):
        raise ValueError(f"lengths from {int(ends.min())} to {int(ends.max())}; {allowed}")
    return ends.long()


def silent_after(waveform: Tensor, ends: Tensor) -> Tensor:
    """Zeros in place of what follows each item's end. Shape: (..., time), (...) -> (..., time)."""
    places = torch.arange(waveform.shape[-1], device=waveform.device)
    return torch.where(
        places < ends.to(waveform.device, non_blocking=True).unsqueeze(-1), waveform, 0.0
    )
