"""The audiogram of one ear: converted, validated, and classified by severity of the loss."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.plot import EAR_STYLES, frequency_axis
from hlsim.audiogram.scale import (
    FREQUENCIES,
    HIGHEST_LEVEL,
    LOWEST_LEVEL,
    SEVERITIES,
    SEVERITY_LIMITS,
    STANDARD,
    EarName,
)
from hlsim.extras import require

Result = TypeVar("Result")

# a frequency, "k" for kHz, and the name of a remark on the frequency
_COLUMN = re.compile(r"(?:hl[_ ]?)?(\d+\.?\d*|\.\d+) ?(k?)(?:hz)?(_.+)?", re.IGNORECASE)
_UNMEASURED = ("", "na", "n/a", "null", "none", "nan")


@dataclass(frozen=True, repr=False)
class Audiogram:
    """Hearing thresholds of one ear in dB HL, at any frequencies.

    The exact MSBG interpolates the thresholds linearly in Hz between the frequencies at which they
    were measured, as pyclarity does. Everything else uses ``thresholds``, the levels at eight
    frequencies. Simulators accept thresholds up to 100 dB HL.

    Checkpoints that hold audiograms, say as hyperparameters, are loaded with ``weights_only=True``
    inside ``torch.serialization.safe_globals([Audiogram])``.

    Args:
        levels: Thresholds in dB HL, -10 to 120, one per frequency. A frequency with ``None`` or
            NaN was not measured, and is left out.
        frequencies: Ascending frequencies in Hz; by default 250, 500, 1000, 2000, 3000, 4000, 6000
            and 8000, the ``FREQUENCIES``.

    Raises:
        ValueError: The numbers of levels and frequencies differ, no level was measured, one is out
            of range, or the frequencies do not ascend, or all lie below 250 or above 8000 Hz.

    Example:
        >>> from hlsim import Audiogram
        >>> ear = Audiogram([15, 20, 25, 30, 40, 35], [250, 500, 1000, 2000, 4000, 8000])
        >>> ear.severity, ear.pta
        ('mild', 28.75)
    """

    levels: tuple[float, ...]
    frequencies: tuple[float, ...] = FREQUENCIES

    def __post_init__(self) -> None:
        levels, frequencies = _as_array(self.levels), _as_array(self.frequencies)
        if len(levels) != len(frequencies):
            raise ValueError(
                f"expected one level per frequency, got {len(levels)} levels for "
                f"{len(frequencies)} frequencies, {frequencies.tolist()} Hz; for other "
                "frequencies pass a dictionary of each frequency in Hz to its threshold, such as "
                "{500: 20, 4000: 50}"
            )
        is_measured = ~np.isnan(levels)
        levels, frequencies = levels[is_measured], frequencies[is_measured]
        check_range(levels, HIGHEST_LEVEL, frequencies)
        ascending = len(levels) > 0 and frequencies[0] > 0 and (np.diff(frequencies) > 0).all()
        overlaps = (
            ascending
            and FREQUENCIES[0] <= frequencies[-1] < math.inf
            and frequencies[0] <= FREQUENCIES[-1]
        )
        if not overlaps:
            raise ValueError(
                "expected levels at ascending frequencies in Hz that overlap the range from "
                f"{FREQUENCIES[0]:g} to {FREQUENCIES[-1]:g}, got levels at "
                f"{frequencies.tolist()} Hz; sort the frequencies, or multiply kHz by 1000"
            )
        object.__setattr__(self, "levels", tuple(levels.tolist()))
        object.__setattr__(self, "frequencies", tuple(frequencies.tolist()))

    @classmethod
    def standard(cls, name: str) -> Audiogram:
        """Return a standard audiogram.

        N1 to N7 are flat or moderately sloping losses from very mild to profound, S1 to S3 are
        steep. Simulators do not accept N7, which has thresholds above 100 dB HL.

        Source: Bisgaard, Vlaming and Dahlquist (2010).

        Args:
            name: ``"N1"`` to ``"N7"``, ``"S1"`` to ``"S3"``, or ``"NH"`` for 0 dB HL at all
                frequencies, in upper or lower case.

        Raises:
            ValueError: There is no standard audiogram of this name.

        Example:
            >>> from hlsim import Audiogram
            >>> Audiogram.standard("n3")
            Audiogram('N3')
        """
        key = str(name).upper()
        if key not in STANDARD:
            names = ", ".join(STANDARD)
            raise ValueError(
                f"unknown standard audiogram {name!r}; expected one of {names} (simulators accept "
                "all but N7)"
            )
        return cls(STANDARD[key])

    def __repr__(self) -> str:
        for name, levels in STANDARD.items():
            if self.frequencies == FREQUENCIES and self.levels == levels:
                return f"Audiogram({name!r})"
        points = zip(self.frequencies, self.levels, strict=True)
        text = ", ".join(f"{frequency:g}: {level:g}" for frequency, level in points)
        return f"Audiogram({{{text}}})"

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Thresholds in dB HL at the eight ``FREQUENCIES``.

        Between other frequencies they are interpolated linearly over log frequency; beyond the
        lowest and the highest frequency they stay constant.
        """
        if self.frequencies == FREQUENCIES:
            return self.levels
        values = np.interp(np.log(FREQUENCIES), np.log(self.frequencies), self.levels)
        return tuple(values.tolist())

    @property
    def severity(self) -> str:
        """Degree of hearing loss: ``"none"``, ``"mild"``, ``"moderate"`` or ``"severe"``.

        It follows from the mean of the levels that were measured from 2 to 8 kHz, and is none if
        there is no such level, as in pyclarity.
        """
        levels = torch.tensor(self.levels, dtype=torch.float64, device="cpu")
        return SEVERITIES[int(severity_index(levels, self.frequencies))]

    @property
    def pta(self) -> float:
        """Pure-tone average in dB HL: mean threshold at 500, 1000, 2000 and 4000 Hz."""
        levels = dict(zip(FREQUENCIES, self.thresholds, strict=True))
        return sum(levels[hz] for hz in (500.0, 1000.0, 2000.0, 4000.0)) / 4.0

    def plot(self, axes: Any = None, *, ear: EarName | None = None) -> Any:
        """Draw the audiogram as audiologists do, with the hearing loss downwards.

        Args:
            axes: Matplotlib axes to draw on, which may show other ears; by default new axes.
            ear: ``"left"`` draws blue crosses and ``"right"`` red circles, as audiologists do, with
                the ear and its pure-tone average in the legend.

        Returns:
            The axes.

        Raises:
            MissingExtraError: matplotlib is not installed.
        """
        if axes is None:
            _, axes = require("matplotlib.pyplot", "eval").subplots(layout="constrained")
        label = None if ear is None else f"{ear}, PTA {self.pta:.0f} dB HL"
        axes.plot(self.frequencies, self.levels, label=label, **EAR_STYLES[ear])
        frequency_axis(axes, FREQUENCIES)
        axes.set(ylim=(HIGHEST_LEVEL, LOWEST_LEVEL), ylabel="threshold (dB HL)")
        if ear is not None:
            axes.legend()
        return axes

    def to_dict(self) -> dict[str, list[float]]:
        """Return a dictionary of ``levels`` and ``frequencies``, which can be written as JSON."""
        return {"levels": list(self.levels), "frequencies": list(self.frequencies)}

    def to_row(self) -> dict[str, str]:
        """Return the thresholds as texts for a CSV file by column: ``hl_250``, ``hl_500``, ..."""
        points = zip(self.frequencies, self.levels, strict=True)
        return {f"hl_{_shortest(hz)}": _shortest(level) for hz, level in points}

    @classmethod
    def from_row(cls, row: Mapping[str, str], highest: float = HIGHEST_LEVEL) -> Audiogram:
        """Convert a row of a table into an audiogram.

        A column of thresholds is called ``hl_250``, ``250``, ``250 Hz`` or ``1k``, in any order
        and case. Other columns are ignored, and so are remarks on a frequency, such as
        ``hl_8000_extrapolated_flat``. A frequency was not measured if its value is empty, ``NA``,
        ``null``, ``None`` or ``nan``.

        Args:
            row: Texts by column.
            highest: Highest level allowed, in dB HL.

        Raises:
            ValueError: The row has no measured threshold, two of one frequency, one that is not a
                number from -10 to ``highest``, or a column that begins with ``hl`` by mistake.
        """
        points: dict[float, float] = {}
        columns: dict[float, str] = {}
        for column, text in row.items():
            frequency = column_frequency(column)
            if frequency is None:
                continue
            if frequency in columns:
                raise ValueError(
                    f"columns {columns[frequency]!r} and {column!r} have the same frequency; "
                    "remove one of them"
                )
            columns[frequency] = column
            if str(text).strip().lower() not in _UNMEASURED:
                points[frequency] = _parse_level(text, column, highest)
        if not points:
            raise ValueError(
                "expected measured thresholds in columns such as hl_250, hl_500 and hl_1000, got "
                f"the columns {', '.join(row)}; add columns or thresholds"
            )
        frequencies = tuple(sorted(points))
        return cls(tuple(points[frequency] for frequency in frequencies), frequencies)

    def to_clarity(self) -> Any:
        """Return pyclarity's ``Audiogram`` with the same levels and frequencies.

        Raises:
            MissingExtraError: pyclarity is not installed.
        """
        module = require("clarity.utils.audiogram", "dev")
        return module.Audiogram(np.array(self.levels), np.array(self.frequencies))


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
        >>> from hlsim.audiogram import as_audiogram
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
        return Audiogram(ear.levels, ear.frequencies)
    if isinstance(ear, Mapping):
        return _from_mapping(ear)
    if isinstance(ear, np.ndarray | Tensor):
        return Audiogram(tuple(ear.tolist())) if ear.ndim == 1 else None
    if isinstance(ear, Sequence) and ear and all(isinstance(level, Real | None) for level in ear):
        return Audiogram(tuple(ear))
    return None


def _from_mapping(levels: Mapping[Any, Any]) -> Audiogram:
    """Convert a mapping of frequencies, in any order, to thresholds."""
    try:
        frequencies = sorted(levels, key=float)
    except (TypeError, ValueError):
        raise ValueError(
            f"expected a dictionary of frequencies in Hz to thresholds in dB HL, got {levels!r}; "
            "for two ears, pass Listener(left, right)"
        ) from None
    return Audiogram(tuple(levels[frequency] for frequency in frequencies), tuple(frequencies))


def severity_index(levels: Tensor, frequencies: Sequence[float] = FREQUENCIES) -> Tensor:
    """Compute the degree of hearing loss of each ear: 0 none, 1 mild, 2 moderate, 3 severe.

    The mean threshold from 2 to 8 kHz decides, as in pyclarity: a loss is mild above 15 dB HL,
    moderate above 35 dB HL and severe above 56 dB HL.

    Shape: (..., frequencies) -> int64 (...), indices into ``SEVERITIES``.

    Args:
        levels: Thresholds in dB HL.
        frequencies: Frequencies of the last dimension in Hz.

    >>> SEVERITIES[severity_index(torch.full((8,), 40.0))]
    'moderate'
    """
    # rounded, so that 19.7 dB HL in single precision counts as 19.7
    rounded = levels.double().round(decimals=4).unbind(-1)
    pairs = zip(rounded, frequencies, strict=True)
    high = [level for level, hz in pairs if 2000.0 <= hz <= 8000.0]
    total = sum(high, start=torch.zeros_like(rounded[0]))
    # The sum is compared, because CUDA may round a mean in another way.
    return torch.stack([total > limit * len(high) for limit in SEVERITY_LIMITS]).sum(0)


def convert_at(place: str, convert: Callable[..., Result], *arguments: Any) -> Result:
    """Call a function, and put a place in a file before the message of a ValueError that it raises.

    Args:
        place: Place for the message, such as ``ears.csv, line 2``.
        convert: Function to call.
        arguments: Arguments of the function.

    Returns:
        The result of the function.

    >>> convert_at("ears.csv, line 2", Audiogram.from_row, {"hl_500": "20"})
    Audiogram({500: 20})
    """
    try:
        return convert(*arguments)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def check_range(
    levels: Iterable[float],
    highest: float,
    frequencies: Iterable[float] = FREQUENCIES,
) -> None:
    """Validate that thresholds lie between -10 dB HL and a highest level.

    Args:
        levels: Thresholds in dB HL.
        highest: Highest level that is valid, in dB HL.
        frequencies: Frequency of each threshold in Hz, for the message.

    Raises:
        ValueError: A level is below -10 or above ``highest``, or NaN.

    >>> check_range([20.0] * 8, 100.0)
    """
    for level, frequency in zip(levels, frequencies, strict=True):
        if LOWEST_LEVEL <= level <= highest:
            continue
        raise ValueError(
            f"expected levels from {LOWEST_LEVEL:g} to {highest:g} dB HL, got {level:g} at "
            f"{frequency:g} Hz; pass a level in this range"
        )


def column_frequency(column: str) -> float | None:
    """Return the frequency in Hz of a column of thresholds, or ``None`` for another column.

    >>> column_frequency("1k"), column_frequency("hl_500"), column_frequency("listener")
    (1000.0, 500.0, None)
    """
    match = _COLUMN.fullmatch(column)
    if match is None and re.match(r"hl[_ ]?\d", column, re.IGNORECASE):
        raise ValueError(f"column {column!r}: expected hl_ and a frequency in Hz, such as hl_500")
    if match is None or match[3]:
        return None
    return float(match[1]) * (1000.0 if match[2] else 1.0)


def _parse_level(text: str, column: str, highest: float) -> float:
    """Convert the text of a threshold, which may have a decimal comma, into a number."""
    try:
        level = float(text.replace(",", "."))
    except ValueError:
        level = math.nan
    if not LOWEST_LEVEL <= level <= highest:
        raise ValueError(
            f"column {column} is {text!r}; expected a level from {LOWEST_LEVEL:g} to {highest:g} "
            "dB HL. For no response write the highest level that was presented; for a frequency "
            "that was not measured leave the value empty, and it will be interpolated"
        )
    return level


def _as_array(values: Any) -> NDArray[np.float64]:
    """Convert a sequence of numbers into an array with NaN in place of ``None``."""
    try:
        numbers = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.array(math.nan)
    if numbers.ndim != 1:
        raise ValueError(f"expected a list of numbers for an audiogram, got {values!r}")
    return numbers


def _shortest(value: float) -> str:
    """Return the shortest text that reads as the same number, without a decimal point if whole."""
    return str(value).removesuffix(".0")
