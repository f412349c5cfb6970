"""Validation of settings, sample rates, waveforms and lengths.

Functions named ``check_...`` raise ValueError with what is wrong, what was expected and, where
there is one, the fix. Except for the decorator ``check_settings``, those that return something
return the validated value.
"""

import difflib
import inspect
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from numbers import Real
from typing import Any, ParamSpec, get_args

import numpy as np
import torch
from torch import Tensor, nn

LOWEST_RATE, HIGHEST_RATE = 16000, 48000
"""Sample rates in Hz that simulators and compensators accept."""

HIGHEST_SAMPLE = 1e9
"""Largest accepted sample. From 4.3e9 on, products of two powers exceed the range of float32."""

LOUDEST_SPL = 120.0
"""RMS level in dB SPL above which a warning is given, once per process."""

MOST_CHANNELS = 8
"""Largest last dimension that, behind one above this, is taken as channels instead of time."""

P = ParamSpec("P")

Lengths = Tensor | Sequence[int]
"""Number of samples of each item of a padded batch, in the shape of the leading dimensions."""


def suggest(name: str, names: Iterable[str]) -> str:
    """Return a question for an error message about a name, or "" if no name is similar.

    Args:
        name: Name that does not exist.
        names: Names that exist.

    >>> suggest("nal-r", ["nalr", "wdrc"])
    ' (did you mean nalr?)'
    >>> suggest("loud", ["nalr", "wdrc"])
    ''
    """
    similar = difflib.get_close_matches(name.lower(), names, n=1)
    return f" (did you mean {similar[0]}?)" if similar and similar[0] != name else ""


def check_names(names: Iterable[Any], known: Iterable[str], description: str) -> None:
    """Raise ValueError unless all names of settings or options are known.

    Args:
        names: Names to validate.
        known: Accepted names.
        description: Noun in the plural for the message, such as ``criteria``.

    >>> check_names(["bands"], ["bands", "paper"], "criteria")
    """
    known = list(known)
    unknown = sorted({str(name) for name in names} - set(known))
    if unknown:
        texts = [name + suggest(name, known) for name in unknown]
        raise ValueError(
            f"unknown {description}: {', '.join(texts)}; expected some of "
            f"{', '.join(known) or 'none'}"
        )


def check_settings(construct: Callable[P, None]) -> Callable[P, None]:
    """Decorate a constructor so that an unknown keyword argument raises ValueError with a hint.

    >>> class Filter:
    ...     @check_settings
    ...     def __init__(self, order: int = 1) -> None:
    ...         pass
    >>> Filter(ordre=2)
    Traceback (most recent call last):
    ValueError: unknown settings of Filter: ordre (did you mean order?); expected some of order
    """
    _, *known = inspect.signature(construct).parameters

    @wraps(construct)
    def call(*args: P.args, **kwargs: P.kwargs) -> None:
        check_names(kwargs, known, f"settings of {type(args[0]).__name__}")
        construct(*args, **kwargs)

    return call


def check_attributes(thing: Any, noun: str, **expected: Any) -> None:
    """Raise ValueError if an object has an attribute with another value than expected.

    An object without the attribute is accepted.

    Args:
        thing: Object to validate.
        noun: Noun for the object, for the message.
        expected: Expected value of each attribute.

    >>> check_attributes("N3", "a module", sample_rate=16000)
    """
    for name, value in expected.items():
        attribute = getattr(thing, name, value)
        if attribute != value:
            raise ValueError(
                f"expected {noun} with {name}={value}, got {attribute}; build it with this value"
            )


def check_choice(name: str, value: Any, choice: Any) -> None:
    """Raise ValueError unless a setting has one of the values of a ``typing.Literal``.

    Args:
        name: Name of the setting, for the message.
        value: Value to validate.
        choice: The ``Literal`` with the accepted strings.

    >>> from typing import Literal
    >>> check_choice("ears", "better", Literal["mean", "better"])
    """
    choices = get_args(choice)
    if not isinstance(value, str) or value not in choices:
        raise ValueError(
            f"expected {name} to be one of {', '.join(choices)}, got {value!r}"
            f"{suggest(str(value), choices)}"
        )


def check_number(
    name: str, value: Any, lowest: float, highest: float = math.inf, *, whole: bool = False
) -> None:
    """Raise ValueError unless a setting is a finite number in a range that includes both ends.

    Args:
        name: Name of the setting, for the message.
        value: Value to validate.
        lowest: Smallest accepted number.
        highest: Largest accepted number.
        whole: Whether only integers of Python are accepted, which can be written as JSON.

    >>> check_number("bands", 20, 4, 40, whole=True)
    """
    accepted = is_finite(value) and lowest <= value <= highest
    if accepted and not (whole and type(value) is not int):
        return
    kind = "a whole number" if whole else "a number"
    limits = "" if lowest == -math.inf else f" from {lowest:.10g}"
    if highest < math.inf:
        limits += f" to {highest:.10g}"
    is_other_type = accepted and int(value) == value  # such as 3.0 and NumPy's integers
    fix = f"; convert it: {int(value)}" if is_other_type else ""
    raise ValueError(f"expected {name} to be {kind}{limits}, got {describe(value)}{fix}")


def check_seed(seed: Any) -> None:
    """Raise ValueError unless a seed is a whole number from 0 to 2^32 - 1, as NumPy requires.

    >>> check_seed(0)
    """
    check_number("seed", seed, 0, 2**32 - 1, whole=True)


def check_flag(name: str, value: Any) -> None:
    """Raise ValueError unless a setting is True or False.

    Args:
        name: Name of the setting, for the message.
        value: Value to validate.

    >>> check_flag("linked", True)
    """
    if not isinstance(value, bool):
        raise ValueError(f"expected {name} to be True or False, got {describe(value)}")


def check_weights(weights: Any, known: Iterable[str], description: str) -> dict[str, float]:
    """Validate weights by name, and return them as floats.

    Args:
        weights: Mapping of names to finite numbers of 0 or more, of which at least one is above 0.
        known: Accepted names.
        description: Noun in the plural for messages, such as ``criteria``.

    Raises:
        ValueError: The weights are not as described.

    >>> check_weights({"bands": 1}, ["bands", "paper"], "criteria")
    {'bands': 1.0}
    """
    if not isinstance(weights, Mapping):
        raise ValueError(
            f"expected weights of {description} by name, such as {{{next(iter(known))!r}: 1.0}}, "
            f"got {describe(weights)}"
        )
    check_names(weights, known, description)
    for name, weight in weights.items():
        check_number(f"the weight of {name}", weight, 0.0)
    if not any(weights.values()):
        raise ValueError(
            f"expected a weight above 0 for at least one of the {description}, got {weights}"
        )
    return {name: float(weight) for name, weight in weights.items()}


def is_finite(value: Any) -> bool:
    """Return whether a value is a finite real number of Python or NumPy. A bool is not one.

    >>> is_finite(1.5), is_finite(True), is_finite(math.nan)
    (True, False, False)
    """
    number: Any = value
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    # Unlike ``math.isfinite``, the comparison takes integers that are too large for a float.
    return is_number and bool(-math.inf < number < math.inf)


def describe(value: Any) -> str:
    """Return the text of a value for an error message, with its type unless it is a finite number.

    >>> describe(3), describe("3")
    ('3', "'3' (str)")
    """
    return repr(value) if is_finite(value) else f"{value!r} ({type(value).__name__})"


def check_rate(sample_rate: int, lowest: int = LOWEST_RATE, highest: int = HIGHEST_RATE) -> int:
    """Validate a sample rate, and return it as an int.

    Args:
        sample_rate: Sample rate in Hz.
        lowest: Lowest accepted rate.
        highest: Highest accepted rate.

    Raises:
        ValueError: The rate is not a whole number of Hz from ``lowest`` to ``highest``.

    >>> check_rate(44100.0)
    44100
    """
    accepted = is_finite(sample_rate) and lowest <= sample_rate <= highest
    if not accepted or int(sample_rate) != sample_rate:
        raise ValueError(
            f"expected a sample rate that is a whole number from {lowest} to {highest} Hz, got "
            f"{describe(sample_rate)}; resample the signals, in Python for example with "
            "hlsim.load_audio(path, sample_rate=16000)"
        )
    return int(sample_rate)


def check_waveform(
    waveform: Tensor,
    name: str = "waveform",
    *,
    full_scale_spl: float | None = None,
) -> Tensor:
    """Validate that a tensor is a waveform, and return it.

    NaN and infinity pass, so that the results of their item contain NaN. The values are not
    validated on a GPU, because that would synchronise with the GPU, nor in a compiled program.

    Args:
        waveform: Tensor of shape (..., time).
        name: Name of the argument, for messages.
        full_scale_spl: Level in dB SPL of RMS 1.0. If it is passed, the first waveform of a process
            whose level is above 120 dB SPL causes a warning.

    Raises:
        ValueError: The value is not a floating-point tensor with time last, has no samples, or has
            a sample whose magnitude is above 1e9 (unless another one is NaN or infinite).

    >>> check_waveform(torch.zeros(2, 16000)).shape
    torch.Size([2, 16000])
    """
    check_time_last(waveform, name)
    if waveform.numel() == 0:
        raise ValueError(
            f"expected {name} to have the shape (..., time) with at least one sample, "
            f"got {tuple(waveform.shape)}"
        )
    if waveform.device.type == "cpu" and not torch.compiler.is_compiling():
        low, high = torch.aminmax(waveform.detach())
        peak = max(-float(low), float(high))
        if HIGHEST_SAMPLE < peak < math.inf:
            raise ValueError(
                f"expected samples of {name} up to {HIGHEST_SAMPLE:g}, got a peak of {peak:.3g}; "
                f"scale {name} to pascals, in Python for example with hlsim.load_audio"
            )
        if full_scale_spl is not None:
            _warn_if_loud(waveform, name, peak, full_scale_spl)
    return waveform


def check_finite(signals: Tensor, name: str = "waveform") -> None:
    """Raise ValueError if a sample is NaN or infinite. This synchronises with a GPU.

    Args:
        signals: Signals, (time,) or (items, ..., time).
        name: Name of the signals, for the message.

    >>> check_finite(torch.ones(2, 9000), "clean")
    """
    items = torch.atleast_2d(signals.detach()).flatten(1)
    is_finite = items.isfinite().all(-1).tolist()
    if not all(is_finite):
        item = f" in item {is_finite.index(False)}" if len(is_finite) > 1 else ""
        raise ValueError(
            f"{name} has samples that are NaN or infinite{item}; correct it, or leave it out"
        )


def check_shape(output: Any, source: str, shape: tuple[int, ...]) -> Tensor:
    """Return what a module returned, if it is a floating-point tensor of the expected shape.

    Args:
        output: Value to validate.
        source: Name of the module or function that returned it, for the message.
        shape: Expected shape.

    Raises:
        ValueError: The value is no such tensor.

    >>> check_shape(torch.zeros(2), "criterion", (2,))
    tensor([0., 0.])
    """
    is_real = isinstance(output, Tensor) and output.is_floating_point()
    if not is_real or output.shape != shape:
        result = type(output).__name__
        if isinstance(output, Tensor):
            result = f"{output.dtype} of shape {tuple(output.shape)}"
        raise ValueError(
            f"expected the {source} to return a floating-point tensor of shape {tuple(shape)}, "
            f"got {result}"
        )
    return output


def check_device(module: nn.Module, device: torch.device | None = None) -> None:
    """Raise ValueError if a module lacks its weights, or has them on another device than its input.

    Args:
        module: Module with or without weights.
        device: Device of the input; None accepts any.

    >>> check_device(nn.Linear(2, 2), torch.device("cpu"))
    """
    weight = next(module.parameters(), None)
    if weight is None:
        return
    name = type(module).__name__
    if weight.is_meta:
        raise ValueError(
            f"{name} was built on the meta device and has no weights; build it on the CPU, or load "
            "a state dict with assign=True"
        )
    if device is not None and weight.device != device:
        raise ValueError(
            f"expected the waveform on {weight.device}, the device of {name}, got {device}; move "
            "either with .to()"
        )


@contextmanager
def loud_outputs() -> Iterator[None]:
    """Suppress, inside a ``with`` block, the warning of ``check_waveform`` that a signal is loud.

    Outputs of aids may be loud on purpose. A loud waveform after the block can still cause it.

    >>> with loud_outputs():
    ...     _ = check_waveform(torch.full((10,), 1000.0), full_scale_spl=94.0)
    """
    global _has_warned_of_level
    has_warned = _has_warned_of_level
    _has_warned_of_level = True
    try:
        yield
    finally:
        _has_warned_of_level = has_warned


_has_warned_of_level = False


def _warn_if_loud(waveform: Tensor, name: str, peak: float, full_scale_spl: float) -> None:
    """Warn, once per process, of a waveform with an item whose level is above ``LOUDEST_SPL``.

    Args:
        waveform: Signals, (..., time).
        name: Name of the argument, for the message.
        peak: Largest magnitude of a sample.
        full_scale_spl: Level in dB SPL of RMS 1.0.
    """
    global _has_warned_of_level
    highest_rms = 10.0 ** ((LOUDEST_SPL - full_scale_spl) / 20.0)
    # No RMS is above the peak, so that the level of other waveforms need not be computed.
    if _has_warned_of_level or not highest_rms < peak < math.inf:
        return
    rms = float(waveform.detach().double().square().mean(-1).max().sqrt())
    if rms > highest_rms:
        _has_warned_of_level = True
        warnings.warn(
            f"{name} has a level of {20.0 * math.log10(rms) + full_scale_spl:.0f} dB SPL; did you "
            "forget calibration? Set the level of the signals (--spl on the command line, "
            "hlsim.load_audio or hlsim.calibration.set_level in Python), or declare their scale "
            "(--full-scale-spl, full_scale_spl). There are no further warnings of this kind",
            stacklevel=3,
        )


def check_time_last(waveform: Tensor, name: str = "waveform") -> None:
    """Raise ValueError unless a value is a floating-point tensor whose last dimension can be time.

    A last dimension of up to eight values behind one of more than eight is taken as channels, and
    rejected.

    Args:
        waveform: Value to validate.
        name: Name of the argument, for messages.

    >>> try:
    ...     check_time_last(torch.zeros(16000, 2))
    ... except ValueError as error:
    ...     print(error)
    expected waveform with time last, got shape (16000, 2); transpose it: x.T
    """
    if not isinstance(waveform, Tensor) or not waveform.is_floating_point():
        kind = getattr(waveform, "dtype", None) or type(waveform).__name__
        fix = "; divide 16-bit samples by 32768" if kind == torch.int16 else ""
        if isinstance(waveform, np.ndarray):
            kind, fix = f"a NumPy array of {kind}", "; convert it: torch.from_numpy(x).float()"
        raise ValueError(
            f"expected {name} to be a floating-point tensor with time last, got {kind}{fix}"
        )
    shape = tuple(waveform.shape)
    if not shape:
        raise ValueError(f"expected {name} with time last, got a tensor without dimensions")
    if len(shape) > 1 and shape[-1] <= MOST_CHANNELS < shape[-2]:
        fix = "x.T" if len(shape) == 2 else "x.mT"
        raise ValueError(f"expected {name} with time last, got shape {shape}; transpose it: {fix}")


def check_lengths(lengths: Lengths, shape: torch.Size) -> Tensor:
    """Validate the lengths of the items of a padded batch, and return them in samples on the CPU.

    Args:
        lengths: Whole numbers of samples from 1 to ``time``. The shape is that of the batch without
            time; (batch,) also serves a batch of shape (batch, 1, time).
        shape: Shape of the batch, (..., time).

    Returns:
        Number of samples of each item, (...), int64.

    Raises:
        ValueError: The numbers, their type or their shape are not as described.

    >>> check_lengths([50, 100], torch.Size([2, 100]))
    tensor([ 50, 100])
    """
    *items, time = shape
    try:
        ends = torch.as_tensor(lengths, device="cpu")
    except (TypeError, ValueError, RuntimeError):
        ends = torch.tensor(False)  # no numbers, which is rejected below
    if len(shape) == 3 and shape[1] == 1 and ends.shape == shape[:1]:
        ends = ends.unsqueeze(-1)
    is_float = ends.is_floating_point()
    is_whole = not is_float and not ends.is_complex() and ends.dtype != torch.bool
    if is_whole and ends.shape == shape[:-1]:
        samples = ends.long()
        if bool(((samples >= 1) & (samples <= time)).all()):
            return samples
    fix = ""
    if is_float:
        fix = "; convert them by .long()"
    if is_float and bool((ends <= 1.0).all()):
        fix = f"; multiply relative lengths by the time: (lengths * {time}).round().long()"
    raise ValueError(
        f"expected lengths to be whole numbers from 1 to {time} of shape {tuple(items)}, got "
        f"{describe(lengths)}{fix}"
    )
