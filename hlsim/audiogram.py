"""Hearing thresholds of one ear: validated, interpolated, read, written, drawn at random, and as simulators take them."""

from __future__ import annotations

import csv
import math
import re
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from itertools import pairwise
from operator import add
from pathlib import Path
from typing import Any, Protocol, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.extras import require
from hlsim.files import read_rows
from hlsim.torchtools import constant, constant_like

FREQUENCIES = (250.0, 500.0, 1000.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)
"""The audiometric frequencies in Hz that every simulator uses."""

LOWEST_LEVEL, HIGHEST_LEVEL = -10.0, 120.0
"""What an audiogram may hold, in dB HL."""

HIGHEST_SIMULATED = 100.0
"""What a simulator takes, in dB HL: MSBG's expansion ratio 105 / (105 - level) is singular at 105."""

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

_ENTRY = ("audiogram_cfs", "audiogram_levels_l", "audiogram_levels_r")  # of Clarity's listeners.json

MILDER = ("NH", "N1", "N2", "S1")
"""Standard ears that join measured ones in validation, since those are mostly moderate and severe."""


@dataclass(frozen=True)
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
                f"(by default the {len(FREQUENCIES)} of {_listed(FREQUENCIES)} Hz)"
            )
        if any(not LOWEST_LEVEL <= level <= HIGHEST_LEVEL for level in levels):
            raise ValueError(
                f"audiogram levels {_listed(levels)} dB HL; allowed: {LOWEST_LEVEL:g} to {HIGHEST_LEVEL:g}"
            )
        if frequencies[0] <= 0 or any(b <= a for a, b in pairwise(frequencies)):
            raise ValueError(
                f"audiogram frequencies {_listed(frequencies)} Hz; allowed: positive and ascending"
            )
        if frequencies[-1] < FREQUENCIES[0] or frequencies[0] > FREQUENCIES[-1]:  # in kHz, as a rule
            raise ValueError(
                f"audiogram frequencies {_listed(frequencies)} Hz; allowed: Hz, not all under {FREQUENCIES[0]:g} or all "
                f"over {FREQUENCIES[-1]:g}"
            )
        object.__setattr__(self, "levels", levels)
        object.__setattr__(self, "frequencies", frequencies)

    @classmethod
    def standard(cls, name: str) -> Audiogram:
        """A standard audiogram by name: N1 to N7, S1 to S3 (Bisgaard 2010) or NH, 0 dB HL throughout.

        Raises:
            ValueError: no such name.
        """
        if not isinstance(name, str) or name not in STANDARD:
            raise ValueError(f"no standard audiogram {name!r}; allowed: {', '.join(STANDARD)}")
        return cls(tuple(float(level) for level in STANDARD[name]))

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
        from hlsim.audiogram_plot import plot_audiogram

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
        return {f"hl_{_exact(f)}": _exact(v) for f, v in zip(self.frequencies, self.levels, strict=True)}

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
                raise ValueError(f"audiogram column {column!r}; allowed: hl_ and a frequency in Hz, hl_500")
            if found is None or found[2]:
                continue
            if float(found[1]) in points:
                raise ValueError(f"audiogram column {column}: a second one of {float(found[1]):g} Hz")
            try:
                points[float(found[1])] = float(value)
            except (TypeError, ValueError):
                raise ValueError(
                    f"audiogram column {column} holds {value!r}; allowed: a level in dB HL"
                ) from None
        if not points:
            raise ValueError(f"a row of audiograms needs columns hl_250, hl_500, ..., got {list(row)}")
        return cls(tuple(points.values()), tuple(points))

    def to_clarity(self) -> Any:
        """The same ear as pyclarity's ``Audiogram`` (needs the extra ``pyclarity``)."""
        clarity = require("clarity.utils.audiogram", "pyclarity")
        return clarity.Audiogram(levels=np.array(self.levels), frequencies=np.array(self.frequencies))

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
        two = _has_two_ears(given)
        if not two and not _is_claritys(given):
            raise ValueError(
                f"{type(given).__name__} is none of pyclarity's; allowed: its Audiogram or Listener, or an entry of "
                "listeners.json"
            )
        if ear not in (("left", "right") if two else (None,)):
            allowed = (
                "ear='left' or ear='right', for a listener has two" if two else "None, for it is one ear"
            )
            raise ValueError(f"ear is {ear!r}; allowed: {allowed}")
        if two and isinstance(given, Mapping):
            return cls(given[f"audiogram_levels_{ear[0]}"], given["audiogram_cfs"])  # type: ignore[index]
        own = getattr(given, f"audiogram_{ear}") if two else given
        return cls(own.levels, own.frequencies)


def _is_claritys(given: Any) -> bool:
    """Whether it is pyclarity's ``Audiogram``, without importing it."""
    return hasattr(given, "levels") and hasattr(given, "frequencies")


def _has_two_ears(given: Any) -> bool:
    """Whether it is pyclarity's ``Listener`` or an entry of ``listeners.json``."""
    if isinstance(given, Mapping):
        return set(_ENTRY) <= given.keys()
    return hasattr(given, "audiogram_left") and hasattr(given, "audiogram_right")


# numbers alone: checkpoints that hold ears as hyperparameters load as those of plain tensors do
torch.serialization.add_safe_globals([Audiogram])


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
    mean = sum(levels[1:], start=levels[0]) / count  # in the order of ``severity_of``, for the same last bit
    return torch.stack([mean > limit for limit in SEVERITY_LIMITS]).sum(0)


class TwoEars(Protocol):
    """A ``Listener``, to which imports from here would point upwards."""

    @property
    def left(self) -> Audiogram | None: ...

    @property
    def right(self) -> Audiogram | None: ...


AudiogramLike = Audiogram | Sequence[Audiogram] | TwoEars | Sequence[TwoEars] | Tensor
"""One ear or a ``Listener``'s two, one a batch item, or a (..., 8) tensor of dB HL. pyclarity's ``Audiogram`` is taken as
ours is."""


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

    Returns: (8,) for one ear, (batch, 8) for a sequence, (2, 8) for a ``Listener``, (batch, 2, 8) for a sequence of them,
    the tensor itself otherwise; dB HL.

    Raises:
        ValueError: not an audiogram, a listener without one ear, a complex or bool tensor, a last dimension other than
            8, NaN, or levels outside -10 to ``highest`` dB HL.
    """
    if (ear := _one_ear(audiogram)) is not None:
        return torch.tensor(_taken(ear.thresholds, highest, taker))
    if is_listener(audiogram):
        return torch.stack([*_both_ears(audiogram, missing, highest, taker)])
    if isinstance(audiogram, Sequence) and audiogram:
        if all(is_listener(one) for one in audiogram):
            return torch.stack(
                [as_thresholds(one, highest=highest, taker=taker, missing=missing) for one in audiogram]
            )
        ears = [_one_ear(one) for one in audiogram]
        if all(ear is not None for ear in ears):
            return torch.tensor([_taken(ear.thresholds, highest, taker) for ear in ears if ear is not None])
    if isinstance(audiogram, list | tuple):
        audiogram = _stacked(audiogram)
    if not isinstance(audiogram, Tensor):
        raise ValueError(
            f"audiogram is {type(audiogram).__name__}; allowed: an Audiogram, a sequence of them, or a (..., 8) tensor"
            + _instead(audiogram)
        )
    if audiogram.is_complex() or audiogram.dtype == torch.bool:
        raise ValueError(f"audiogram tensor of {audiogram.dtype}; allowed: floating-point or integer dB HL")
    levels = audiogram if audiogram.is_floating_point() else audiogram.float()
    if levels.ndim == 0 or levels.shape[-1] != len(FREQUENCIES) or not levels.numel():
        raise ValueError(
            f"audiogram tensor of shape {tuple(levels.shape)}; allowed: (..., 8), dB HL at {_listed(FREQUENCIES)} Hz"
        )
    with torch.no_grad():
        good = ((levels >= LOWEST_LEVEL) & (levels <= highest)).all(-1)
        if not bool(good.all()):
            _taken(levels[~good][0].tolist(), highest, taker)
    return levels


def own_thresholds(audiogram: AudiogramLike | None, **limits: Any) -> Tensor | None:
    """``as_thresholds`` to keep: a copy, for the caller may write into its tensor; one that is trained stays itself."""
    if audiogram is None:
        return None
    with torch.inference_mode(False):  # it may be trained through later
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

    Args:
        two_ears: the stored one is of a listener, or of several.
        limits: of ``as_thresholds``.

    Raises:
        ValueError: there is neither, the shapes do not broadcast, or a listener's waveform is not (..., 2, time).
    """
    if audiogram is None and stored is None:
        raise ValueError("no audiogram: give one when building the simulator or with the call")
    thresholds = as_thresholds(audiogram, **limits) if audiogram is not None else stored
    assert thresholds is not None
    check_two_ears(two_ears if audiogram is None else of_listeners(audiogram), waveform)
    try:
        if thresholds.ndim > 1:
            torch.broadcast_shapes(waveform.shape[:-1], thresholds.shape[:-1])
    except RuntimeError:
        raise ValueError(
            f"audiograms of shape {tuple(thresholds.shape)} for a waveform of shape {tuple(waveform.shape)}; allowed: "
            "one audiogram, or leading dimensions that broadcast"
        ) from None
    return thresholds.to(waveform.device)


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
    right = constant(_right, hz, dtype=torch.int64, device=levels.device)
    place = constant_like(levels, _place, hz)
    return levels[..., right - 1] * (1.0 - place) + levels[..., right] * place


@lru_cache(maxsize=8)
def interpolation_weights(hz: tuple[float, ...]) -> NDArray[np.float64]:
    """``interpolate`` as a matrix. Returns (8, frequencies)."""
    one, right, place = np.eye(len(FREQUENCIES)), _right(hz), _place(hz)
    weights: NDArray[np.float64] = one[:, right - 1] * (1.0 - place) + one[:, right] * place
    return weights


def _right(hz: tuple[float, ...]) -> NDArray[np.int64]:
    """Index of the audiometric frequency at or above each one, but for the first."""
    return np.searchsorted(FREQUENCIES, hz).clip(1, len(FREQUENCIES) - 1)


def _place(hz: tuple[float, ...]) -> NDArray[np.float64]:
    """Where each lies between the audiometric frequencies around it, 0 to 1."""
    points, right = np.array(FREQUENCIES), _right(hz)
    place: NDArray[np.float64] = (np.array(hz) - points[right - 1]) / (points[right] - points[right - 1])
    return place.clip(0.0, 1.0)


def _one_ear(given: Any) -> Audiogram | None:
    """An audiogram, ours or pyclarity's, as ours."""
    if isinstance(given, Audiogram):
        return given
    return Audiogram.from_clarity(given) if _is_claritys(given) else None


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
            f"audiogram levels {_listed(levels)} dB HL; {taker} takes {LOWEST_LEVEL:g} to {highest:g}{reason}"
        )
    return levels


def _instead(given: object) -> str:
    """What to write in place of something that is no audiogram but holds one."""
    several = isinstance(given, list | tuple) and len(given) > 0
    first: Any = given[0] if several else given  # type: ignore[index]
    if isinstance(first, str) and first in STANDARD:
        make = f"Audiogram.standard({first!r})"
    elif _has_two_ears(first):
        return "; of two ears write Listener.from_clarity(listener), of one Audiogram.from_clarity(listener, 'left')"
    elif isinstance(first, Mapping):
        make = "Audiogram.from_dict(...)"
    elif several and isinstance(first, Tensor):
        return "; write torch.stack(...)"
    elif isinstance(first, np.ndarray) or (several and isinstance(first, float | int | list | tuple)):
        return "; write torch.tensor(...)"
    else:
        return ""
    return f"; write {f'[{make}, ...]' if several else make}"


def read_audiograms(path: str | Path, *, simulated: bool = False) -> list[tuple[dict[str, str], Audiogram]]:
    """Rows of a CSV file with columns ``hl_250`` and so on: each row's columns and its audiogram.

    Blanks around names and values do not count. Frequencies other than the eight are interpolated, as in ``Audiogram``.

    Args:
        simulated: take only ears that a simulator takes.

    Raises:
        ValueError: the file is missing, empty, has a column twice, or a row is no audiogram, or, with ``simulated``,
            beyond 100 dB HL; the message names file and line.
    """
    return [(row, ear) for _, row, ear in numbered_audiograms(path, simulated=simulated)]


def numbered_audiograms(
    path: str | Path, *, simulated: bool = False
) -> list[tuple[int, dict[str, str], Audiogram]]:
    """``read_audiograms`` with the number of each row's line first, for messages that name it."""
    try:
        rows = list(read_rows(path))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: cannot read audiograms: {error}") from error
    if not rows:
        raise ValueError(f"{path}: no audiograms; needs a header with hl_250, hl_500, ... and a row an ear")
    ears = []
    for number, row in rows:
        try:
            ear = Audiogram.from_row(row)
            if simulated:
                as_thresholds(ear)
            ears.append((number, row, ear))
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from error
    return ears


def draw_thresholds(count: int, generator: torch.Generator | None = None) -> Tensor:
    """Random ears that look like measured ones, from no loss to severe.

    Each lies between two neighbours of one of Bisgaard's series (NH, N1 ... N6 or NH, S1 ... S3), is tilted by up to
    20 dB at 250 Hz, and moved by Gaussian noise with a deviation of 2.4 to 8 dB that is alike at neighbouring frequencies
    (correlation 0.8, as among measured ears). Three of four are rounded to 5 dB, as audiologists do. In MSBG's sense
    27 % have no loss, 18 % a mild, 19 % a moderate and 36 % a severe one.

    Returns: (count, 8) dB HL, -10 to 100.
    """
    uniform = torch.rand(count, 5, generator=generator)
    ears = torch.empty(count, 8)
    for series, members in enumerate((("NH", "N1", "N2", "N3", "N4", "N5", "N6"), ("NH", "S1", "S2", "S3"))):
        table = torch.tensor([STANDARD[name] for name in members], dtype=torch.float32)
        # the power favours the mild end, where more ears are
        place = uniform[:, 1] ** 1.8 * (len(members) - 1)
        low = place.long().clamp(max=len(members) - 2)
        between = table[low] + (table[low + 1] - table[low]) * (place - low).unsqueeze(-1)
        ears = torch.where(((uniform[:, 0] < 0.65) == (series == 0)).unsqueeze(-1), between, ears)
    tilt = torch.tensor([1.0, 0.9, 0.6, 0.2, 0.0, 0.0, 0.0, 0.0])
    ears = ears + (40.0 * uniform[:, 4:] - 20.0) * tilt
    noise = torch.randn(count, 8, generator=generator)
    for i in range(1, 8):
        noise[:, i] = 0.8 * noise[:, i - 1] + math.sqrt(1 - 0.8**2) * noise[:, i]
    ears = ears + 8.0 * noise * (0.3 + 0.7 * uniform[:, 3:4])
    ears = torch.where(uniform[:, 2:3] < 0.75, 5.0 * (ears / 5.0).round(), ears)
    return ears.clamp(LOWEST_LEVEL, HIGHEST_SIMULATED)


def _numbers(values: Iterable[float], what: str) -> tuple[float, ...]:
    try:
        if isinstance(values, str):  # whose characters are no levels
            raise TypeError
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        raise ValueError(f"audiogram {what} {values!r}; allowed: numbers") from None
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"audiogram {what} {_listed(numbers)}; allowed: finite numbers")
    return numbers


def _exact(value: float) -> str:
    """The shortest text that is read as the same number."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def _listed(values: Iterable[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)
