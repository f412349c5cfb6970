"""Hearing thresholds of one ear: validated, read, written, interpolated, and as a degree of loss."""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from operator import add
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hlsim.extras import MissingExtraError

FREQUENCIES = (250.0, 500.0, 1000.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)
"""The audiometric frequencies in Hz that every simulator uses."""

LOWEST_LEVEL, HIGHEST_LEVEL = -10.0, 120.0
"""What an audiogram may hold, in dB HL."""

SEVERITIES = ("none", "mild", "moderate", "severe")
"""MSBG's degrees of loss, by the mean threshold from 2 to 8 kHz."""

SEVERITY_LIMITS = (15.0, 35.0, 56.0)
"""Mean thresholds in dB HL above which the loss is mild, moderate, severe (pyclarity 0.9.0, ``Audiogram.severity``)."""

_FINE = 1e4  # parts of a dB that levels count in for the severity: single precision's 19.7 is to be 19.7 on a limit, too

# Bisgaard, Vlaming, Dahlquist 2010, Trends in Amplification 14(2), doi 10.1177/1084713810379609, Tables 1 and 2, at the
# frequencies above; they end at 6 kHz, so that 8 kHz is our flat extension.
STANDARD = {
    "NH": (0, 0, 0, 0, 0, 0, 0, 0),
    "N1": (10, 10, 10, 15, 20, 30, 40, 40),
    "N2": (20, 20, 25, 35, 40, 45, 50, 50),
    "N3": (35, 35, 40, 50, 55, 60, 65, 65),
    "N4": (55, 55, 55, 65, 70, 75, 80, 80),
    "N5": (65, 70, 75, 80, 80, 80, 80, 80),
    "N6": (75, 80, 85, 90, 95, 100, 100, 100),
    "N7": (90, 95, 105, 105, 105, 105, 105, 105),
    "S1": (10, 10, 10, 15, 30, 55, 70, 70),
    "S2": (20, 20, 25, 55, 75, 95, 95, 95),
    "S3": (30, 35, 60, 75, 80, 80, 85, 85),
}

_COLUMN = re.compile(r"hl_(\d+\.?\d*|\.\d+)(_.+)?")  # the frequency, and the name of a remark on it

_ENTRY = (
    "audiogram_cfs",
    "audiogram_levels_l",
    "audiogram_levels_r",
)  # of Clarity's listeners.json


@dataclass(frozen=True, repr=False)
class Audiogram:
    """Hearing thresholds of one ear in dB HL, ascending in frequency.

    Args:
        levels: thresholds in dB HL, -10 to 120, one a frequency.
        frequencies: Hz; by default the eight that simulators use. Other grids are kept as given and interpolated by
            ``thresholds`` (linearly over log frequency, flat beyond the ends).

    Raises:
        ValueError: the counts differ, a value is not finite or out of range, or the frequencies do not ascend or lie all
            under 250 or over 8000 Hz.
    """

    levels: tuple[float, ...]
    frequencies: tuple[float, ...] = FREQUENCIES

    def __post_init__(self) -> None:
        levels = _numbers(self.levels, "levels")
        frequencies = _numbers(self.frequencies, "frequencies")
        if len(levels) != len(frequencies) or not levels:
            raise ValueError(
                f"an audiogram needs one level a frequency, got {len(levels)} levels and {len(frequencies)} frequencies "
                f"(by default the {len(FREQUENCIES)} of {listed(FREQUENCIES)} Hz)"
            )
        if any(not LOWEST_LEVEL <= level <= HIGHEST_LEVEL for level in levels):
            raise ValueError(
                f"audiogram levels {listed(levels)} dB HL; allowed: {LOWEST_LEVEL:g} to {HIGHEST_LEVEL:g}"
            )
        if frequencies[0] <= 0 or any(b <= a for a, b in pairwise(frequencies)):
            raise ValueError(
                f"audiogram frequencies {listed(frequencies)} Hz; allowed: positive and ascending"
            )
        if (
            frequencies[-1] < FREQUENCIES[0] or frequencies[0] > FREQUENCIES[-1]
        ):  # in kHz, as a rule
            raise ValueError(
                f"audiogram frequencies {listed(frequencies)} Hz; allowed: Hz, not all under {FREQUENCIES[0]:g} or all "
                f"over {FREQUENCIES[-1]:g}"
            )
        object.__setattr__(self, "levels", levels)
        object.__setattr__(self, "frequencies", frequencies)

    @classmethod
    def standard(cls, name: str) -> Audiogram:
        """Return a standard audiogram.

        Args:
            name: ``"N1"`` to ``"N7"`` or ``"S1"`` to ``"S3"`` (Bisgaard et al. 2010), or ``"NH"``
                for 0 dB HL at all frequencies, in upper or lower case.

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
            raise ValueError(f"unknown standard audiogram {name!r}; expected one of {names}")
        return cls(tuple(float(level) for level in STANDARD[key]))

    def __repr__(self) -> str:
        for name, levels in STANDARD.items():
            if self.frequencies == FREQUENCIES and self.levels == tuple(map(float, levels)):
                return f"Audiogram({name!r})"
        points = zip(self.frequencies, self.levels, strict=True)
        levels_by_hz = ", ".join(f"{frequency:g}: {level:g}" for frequency, level in points)
        return f"Audiogram({{{levels_by_hz}}})"

    def _repr_png_(self) -> bytes | None:
        """Return the drawn audiogram for a notebook, or ``None`` without matplotlib."""
        from hlsim.audiogram.plot import draw_png

        return draw_png(self.plot)

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Levels in dB HL at the eight frequencies that simulators use."""
        if self.frequencies == FREQUENCIES:
            return self.levels
        values = np.interp(np.log(FREQUENCIES), np.log(self.frequencies), self.levels)
        return tuple(float(value) for value in values)

    @property
    def severity(self) -> str:
        """MSBG's degree of loss: none, mild, moderate or severe, by the mean threshold from 2 to 8 kHz."""
        return severity_of(self.thresholds)

    def plot(self, axes: Any = None, **style: Any) -> Any:
        """Draw it: dB HL downwards over octaves, with MSBG's degrees of loss (``SEVERITY_LIMITS``) as bands.

        Args:
            axes: matplotlib's, which may hold other ears; by default those of a new figure of pyplot.
            style: of the line, such as ``color="tab:red"`` and ``label="right"``.

        Returns: the axes.

        Raises:
            MissingExtraError: matplotlib is not installed.
        """
        from hlsim.audiogram.plot import plot_audiogram

        limits = pairwise((LOWEST_LEVEL, *SEVERITY_LIMITS, HIGHEST_LEVEL))
        degrees = dict(zip(SEVERITIES, limits, strict=True))
        return plot_audiogram(self.frequencies, self.levels, degrees, axes, **style)

    def to_dict(self) -> dict[str, list[float]]:
        """A plain dictionary that JSON can hold."""
        return {"levels": list(self.levels), "frequencies": list(self.frequencies)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Audiogram:
        """Read what ``to_dict`` wrote. Raises ValueError where it is no mapping or ``levels`` is missing."""
        if not isinstance(data, Mapping) or "levels" not in data:
            got = list(data) if isinstance(data, Mapping) else type(data).__name__
            raise ValueError(f"an audiogram dictionary needs 'levels', got {got}")
        return cls(data["levels"], data.get("frequencies", FREQUENCIES))

    def to_row(self) -> dict[str, str]:
        """Columns ``hl_250`` and so on for a CSV file."""
        return {
            f"hl_{_exact(f)}": _exact(v) for f, v in zip(self.frequencies, self.levels, strict=True)
        }

    @classmethod
    def from_row(cls, row: Mapping[str, str]) -> Audiogram:
        """Read the columns ``hl_<frequency in Hz>`` of a CSV row.

        Others are ignored, and so are remarks on a frequency, ``hl_8000_extrapolated_flat``: what they hold was not
        measured.

        Raises:
            ValueError: the row has no such column, one that holds no number, two of a frequency, or one that begins with
                ``hl`` and is neither a threshold nor a remark.
        """
        points: dict[float, float] = {}
        for column, value in row.items():
            found = _COLUMN.fullmatch(str(column))
            if found is None and str(column).lower().startswith("hl"):
                raise ValueError(
                    f"audiogram column {column!r}; allowed: hl_ and a frequency in Hz, hl_500"
                )
            if found is None or found[2]:
                continue
            if float(found[1]) in points:
                raise ValueError(
                    f"audiogram column {column}: a second one of {float(found[1]):g} Hz"
                )
            try:
                points[float(found[1])] = float(value)
            except (TypeError, ValueError):
                raise ValueError(
                    f"audiogram column {column} holds {value!r}; allowed: a level in dB HL"
                ) from None
        if not points:
            raise ValueError(
                f"a row of audiograms needs columns hl_250, hl_500, ..., got {list(row)}"
            )
        return cls(tuple(points.values()), tuple(points))

    def to_clarity(self) -> Any:
        """Convert to pyclarity's ``Audiogram``.

        Raises:
            MissingExtraError: pyclarity is not installed.
        """
        try:
            from clarity.utils.audiogram import Audiogram as ClarityAudiogram
        except ImportError as error:
            raise MissingExtraError(
                f"pyclarity is needed here and not installed ({error}); pip install 'pyclarity==0.9.*'"
            ) from error
        return ClarityAudiogram(
            levels=np.array(self.levels), frequencies=np.array(self.frequencies)
        )

    @classmethod
    def from_clarity(cls, given: Any, ear: str | None = None) -> Audiogram:
        """From pyclarity's ``Audiogram``, or one ear of its ``Listener`` or of an entry of Clarity's ``listeners.json``.

        Args:
            ear: ``"left"`` or ``"right"``, of a listener.

        Raises:
            ValueError: none of these, a listener without ``ear``, or an audiogram with it.
        """
        if isinstance(given, Mapping) and (lack := [key for key in _ENTRY if key not in given]):
            raise ValueError(
                f"an entry of listeners.json without {', '.join(lack)}; needs {', '.join(_ENTRY)}"
            )
        two = has_two_ears(given)
        if not two and not is_claritys(given):
            raise ValueError(
                f"{type(given).__name__} is none of pyclarity's; allowed: its Audiogram or Listener, or an entry of "
                "listeners.json"
            )
        if ear not in (("left", "right") if two else (None,)):
            allowed = (
                "ear='left' or ear='right', for a listener has two"
                if two
                else "None, for it is one ear"
            )
            raise ValueError(f"ear is {ear!r}; allowed: {allowed}")
        if two and isinstance(given, Mapping):
            return cls(given[f"audiogram_levels_{ear[0]}"], given["audiogram_cfs"])  # type: ignore[index]
        own = getattr(given, f"audiogram_{ear}") if two else given
        return cls(own.levels, own.frequencies)


def is_claritys(given: Any) -> bool:
    """Whether it is pyclarity's ``Audiogram``, without importing it."""
    return hasattr(given, "levels") and hasattr(given, "frequencies")


def has_two_ears(given: Any) -> bool:
    """Whether it is pyclarity's ``Listener`` or an entry of ``listeners.json``."""
    if isinstance(given, Mapping):
        return set(_ENTRY) <= given.keys()
    return hasattr(given, "audiogram_left") and hasattr(given, "audiogram_right")


def severity_of(levels: Sequence[float]) -> str:
    """``Audiogram.severity`` of eight levels in dB HL."""
    high = [round(level * _FINE) / _FINE for level in levels[FREQUENCIES.index(2000.0) :]]
    total = reduce(add, high)  # Python's own sum rounds in other ways from 3.12 on
    return SEVERITIES[bisect_left(SEVERITY_LIMITS, total / len(high))]


def severity_index(thresholds: Tensor) -> Tensor:
    """Index into ``SEVERITIES`` of each ear. Shape: (..., 8) dB HL -> (...), int64."""
    high = thresholds[..., FREQUENCIES.index(2000.0) :].double()
    # by tensors: CUDA multiplies by a number's reciprocal instead of dividing by it, which is off by the last bit
    fine, count = (high.new_full((), value) for value in (_FINE, high.shape[-1]))
    levels = ((high * _FINE).round() / fine).unbind(-1)
    mean = (
        sum(levels[1:], start=levels[0]) / count
    )  # in the order of ``severity_of``, for the same last bit
    return torch.stack([mean > limit for limit in SEVERITY_LIMITS]).sum(0)


def _numbers(values: Iterable[float], what: str) -> tuple[float, ...]:
    try:
        if isinstance(values, str | Mapping):  # whose characters or keys are no levels
            raise TypeError
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        raise ValueError(f"audiogram {what} {values!r}; allowed: numbers") from None
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"audiogram {what} {listed(numbers)}; allowed: finite numbers")
    return numbers


def _exact(value: float) -> str:
    """The shortest text that is read as the same number."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def listed(values: Iterable[float]) -> str:
    """Numbers as messages have them."""
    return ", ".join(f"{value:g}" for value in values)
