"""The hearing thresholds of one ear, and the severity of its loss."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hlsim.extras import MissingExtraError

FREQUENCIES = (250.0, 500.0, 1000.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)
"""Audiometric frequencies in Hz that every simulator uses."""

LOWEST_LEVEL, HIGHEST_LEVEL = -10.0, 120.0
"""Range of the thresholds of an audiogram in dB HL."""

SEVERITIES = ("none", "mild", "moderate", "severe")
"""MSBG's degrees of loss, by the mean threshold from 2 to 8 kHz."""

SEVERITY_LIMITS = (15.0, 35.0, 56.0)
"""Mean thresholds in dB HL above which a loss is mild, moderate and severe (pyclarity 0.9.0)."""

STEPS_PER_DB = 1e4
"""Resolution of thresholds for the severity, so that 19.7 dB HL in single precision counts as 19.7."""

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

COLUMN = re.compile(r"hl_(\d+\.?\d*|\.\d+)(_.+)?")
"""Column of a CSV file: a frequency, and the name of a remark on it."""

CLARITY_KEYS = ("audiogram_cfs", "audiogram_levels_l", "audiogram_levels_r")
"""Keys of an entry of Clarity's ``listeners.json``."""


@dataclass(frozen=True, repr=False)
class Audiogram:
    """Hearing thresholds of one ear in dB HL, ascending in frequency.

    Checkpoints that hold audiograms, say as hyperparameters, are loaded with ``weights_only=True``
    inside ``torch.serialization.safe_globals([Audiogram])``.

    Args:
        levels: thresholds in dB HL from -10 to 120, one per frequency.
        frequencies: frequencies in Hz, by default the eight that simulators use. Other grids are
            kept as given; ``thresholds`` interpolates them linearly over log frequency, flat beyond
            the ends.

    Raises:
        ValueError: the numbers of levels and frequencies differ, a value is not finite or out of
            range, or the frequencies do not ascend, or all lie below 250 or above 8000 Hz.
    """

    levels: tuple[float, ...]
    frequencies: tuple[float, ...] = FREQUENCIES

    def __post_init__(self) -> None:
        levels = _as_numbers(self.levels, "levels")
        frequencies = _as_numbers(self.frequencies, "frequencies")
        if len(levels) != len(frequencies) or not levels:
            raise ValueError(
                f"expected one level per frequency, got {len(levels)} levels and "
                f"{len(frequencies)} frequencies; by default there are {len(FREQUENCIES)}: "
                f"{join_numbers(FREQUENCIES)} Hz"
            )
        if min(levels) < LOWEST_LEVEL or max(levels) > HIGHEST_LEVEL:
            raise ValueError(
                f"expected levels from {LOWEST_LEVEL:g} to {HIGHEST_LEVEL:g} dB HL, "
                f"got {join_numbers(levels)}"
            )
        ascending = all(low < high for low, high in pairwise(frequencies))
        if frequencies[0] <= 0 or not ascending:
            raise ValueError(
                f"expected positive, ascending frequencies in Hz, got {join_numbers(frequencies)}"
            )
        if frequencies[-1] < FREQUENCIES[0] or frequencies[0] > FREQUENCIES[-1]:
            raise ValueError(
                f"expected a frequency from {FREQUENCIES[0]:g} to {FREQUENCIES[-1]:g} Hz, "
                f"got {join_numbers(frequencies)}; give frequencies in Hz, not kHz"
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
        levels = np.interp(np.log(FREQUENCIES), np.log(self.frequencies), self.levels)
        return tuple(float(level) for level in levels)

    @property
    def severity(self) -> str:
        """MSBG's degree of loss: none, mild, moderate or severe, by the mean threshold from 2 to 8 kHz."""
        thresholds = torch.tensor(self.thresholds, dtype=torch.float64, device="cpu")
        return SEVERITIES[int(severity_index(thresholds))]

    def plot(self, axes: Any = None, **style: Any) -> Any:
        """Draw the audiogram: dB HL downwards over octaves, with bands for MSBG's degrees of loss.

        Args:
            axes: matplotlib axes, which may hold other ears; by default those of a new figure.
            style: properties of the line, such as ``color="tab:red"`` and ``label="right"``.

        Returns: the axes.

        Raises:
            MissingExtraError: matplotlib is not installed.
        """
        from hlsim.audiogram.plot import plot_audiogram

        limits = pairwise((LOWEST_LEVEL, *SEVERITY_LIMITS, HIGHEST_LEVEL))
        degrees = dict(zip(SEVERITIES, limits, strict=True))
        return plot_audiogram(self.frequencies, self.levels, degrees, axes, **style)

    def to_dict(self) -> dict[str, list[float]]:
        """Return a dictionary that JSON can hold."""
        return {"levels": list(self.levels), "frequencies": list(self.frequencies)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Audiogram:
        """Return the audiogram of a dictionary that ``to_dict`` made.

        Raises:
            ValueError: the value is not a mapping, or has no ``levels``.
        """
        if not isinstance(data, Mapping) or "levels" not in data:
            found = list(data) if isinstance(data, Mapping) else type(data).__name__
            raise ValueError(f"expected a dictionary with 'levels', got {found}")
        return cls(data["levels"], data.get("frequencies", FREQUENCIES))

    def to_row(self) -> dict[str, str]:
        """Return the columns ``hl_250`` and so on for a CSV file."""
        points = zip(self.frequencies, self.levels, strict=True)
        return {f"hl_{_shortest(frequency)}": _shortest(level) for frequency, level in points}

    @classmethod
    def from_row(cls, row: Mapping[str, str]) -> Audiogram:
        """Return the audiogram of a row of a CSV file, from its columns ``hl_<frequency in Hz>``.

        Other columns are ignored, as are remarks on a frequency such as
        ``hl_8000_extrapolated_flat``, whose values were not measured.

        Raises:
            ValueError: there is no such column, one holds no number, two have the same frequency,
                or a column begins with ``hl`` and is neither a threshold nor a remark.
        """
        points: dict[float, float] = {}
        for column, value in row.items():
            match = COLUMN.fullmatch(str(column))
            if match is None and str(column).lower().startswith("hl"):
                raise ValueError(
                    f"expected columns of thresholds such as hl_500, got {column!r}; write hl_ and "
                    "the frequency in Hz"
                )
            if match is None or match[2]:
                continue
            frequency = float(match[1])
            if frequency in points:
                raise ValueError(f"column {column}: {frequency:g} Hz has two columns")
            try:
                points[frequency] = float(value)
            except (TypeError, ValueError):
                raise ValueError(
                    f"column {column}: expected a level in dB HL, got {value!r}"
                ) from None
        if not points:
            raise ValueError(f"expected columns hl_250, hl_500 and so on, got {list(row)}")
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
                f"pyclarity is needed here and not installed ({error}); "
                "pip install 'pyclarity==0.9.*'"
            ) from error
        return ClarityAudiogram(
            levels=np.array(self.levels), frequencies=np.array(self.frequencies)
        )

    @classmethod
    def from_clarity(cls, source: Any, ear: str | None = None) -> Audiogram:
        """Return the audiogram of an object or an entry of Clarity.

        Args:
            source: pyclarity's ``Audiogram``, its ``Listener``, or an entry of ``listeners.json``.
            ear: ``"left"`` or ``"right"`` for a listener, None for an audiogram.

        Raises:
            ValueError: the source is none of these, or ``ear`` does not fit it.
        """
        if isinstance(source, Mapping):
            missing = [key for key in CLARITY_KEYS if key not in source]
            if missing:
                raise ValueError(
                    f"expected an entry of listeners.json, but {', '.join(missing)} is missing"
                )
        two_ears = has_two_ears(source)
        if not two_ears and not is_claritys(source):
            raise ValueError(
                "expected pyclarity's Audiogram or Listener, or an entry of listeners.json, "
                f"got {type(source).__name__}"
            )
        if two_ears and ear not in ("left", "right"):
            raise ValueError(
                f"expected ear='left' or ear='right', as the source has two ears, got {ear!r}"
            )
        if not two_ears and ear is not None:
            raise ValueError(f"expected no ear, as the source has only one, got {ear!r}")
        if isinstance(source, Mapping):
            side = str(ear)[0]
            return cls(source[f"audiogram_levels_{side}"], source["audiogram_cfs"])
        audiogram = getattr(source, f"audiogram_{ear}") if two_ears else source
        return cls(audiogram.levels, audiogram.frequencies)


def is_claritys(value: Any) -> bool:
    """Return whether a value is pyclarity's ``Audiogram``, without importing pyclarity."""
    return hasattr(value, "levels") and hasattr(value, "frequencies")


def has_two_ears(value: Any) -> bool:
    """Return whether a value is pyclarity's ``Listener`` or an entry of ``listeners.json``."""
    if isinstance(value, Mapping):
        return set(CLARITY_KEYS) <= value.keys()
    return hasattr(value, "audiogram_left") and hasattr(value, "audiogram_right")


def severity_index(thresholds: Tensor) -> Tensor:
    """Return the index into ``SEVERITIES`` of each ear. Shape: (..., 8) dB HL -> (...), int64."""
    high = thresholds[..., FREQUENCIES.index(2000.0) :].double()
    # Tensors, because CUDA multiplies by the reciprocal of a number, which changes the last bit.
    steps_per_db = high.new_full((), STEPS_PER_DB)
    count = high.new_full((), high.shape[-1])
    first, *others = ((high * STEPS_PER_DB).round() / steps_per_db).unbind(-1)
    mean = sum(others, start=first) / count
    return torch.stack([mean > limit for limit in SEVERITY_LIMITS]).sum(0)


def join_numbers(values: Iterable[float]) -> str:
    """Return numbers as messages show them."""
    return ", ".join(f"{value:g}" for value in values)


def _as_numbers(values: Iterable[float], name: str) -> tuple[float, ...]:
    try:
        if isinstance(values, str | Mapping):  # their characters or keys are not levels
            raise TypeError
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        raise ValueError(f"expected {name} of an audiogram as numbers, got {values!r}") from None
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"expected finite {name} of an audiogram, got {join_numbers(numbers)}")
    return numbers


def _shortest(value: float) -> str:
    """Return the shortest text that is read as the same number."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)
