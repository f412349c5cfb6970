"""The audiogram of one ear: converted, validated, and classified by severity of the loss."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.columns import threshold_columns
from hlsim.audiogram.discomfort import (
    Points,
    UclLike,
    predict_uncomfortable_levels,
    read_points,
)
from hlsim.audiogram.plot import EAR_STYLES, frequency_axis
from hlsim.audiogram.published import STANDARD
from hlsim.audiogram.scale import (
    EARS,
    FREQUENCIES,
    HIGHEST_HZ,
    HIGHEST_LEVEL,
    HIGHEST_UCL,
    LOWEST_HZ,
    LOWEST_LEVEL,
    LOWEST_UCL,
    PTA_FREQUENCIES,
    SEVERITIES,
    SEVERITY_LIMITS,
    UCL_NOT_REACHED,
    WHO_GRADES,
    EarName,
    Numbers,
    interpolate_over_log,
)
from hlsim.extras import require

_UNMEASURED = ("", "na", "n/a", "null", "none", "nan")

_THRESHOLD_ADVICE = (
    "For no response write the highest level that was presented; for a frequency that was not "
    "measured leave the value empty, and it will be interpolated"
)

_UCL_ADVICE = (
    f"If no level was uncomfortable write {UCL_NOT_REACHED:g}; for a frequency that was not "
    "measured leave the value empty, and it will be predicted"
)


@dataclass(frozen=True, repr=False)
class Audiogram:
    """Hearing thresholds of one ear in dB HL, at any frequencies.

    The exact MSBG interpolates the thresholds linearly in Hz between the frequencies at which they
    were measured, as pyclarity does. Networks, losses, aids and metrics use ``thresholds``, the
    levels at eight frequencies. Simulators accept thresholds up to 100 dB HL.

    PyTorch loads checkpoints that contain audiograms or listeners, for example as hyperparameters,
    with ``weights_only=True`` once a loss, a simulator or an aid was imported, and otherwise inside
    ``torch.serialization.safe_globals([Audiogram, Listener])``.

    Args:
        levels: Thresholds in dB HL, -10 to 120, one per frequency. A frequency with ``None`` or
            NaN was not measured, and is left out. A mapping or a ``Series`` of pandas that names
            the frequencies is also accepted, see ``as_audiogram``.
        frequencies: Ascending frequencies from 100 to 20000 Hz; by default 250, 500, 1000, 2000,
            3000, 4000, 6000 and 8000, the ``FREQUENCIES``.
        ucl: Measured uncomfortable levels of pure tones in dB HL, 20 to 140, by frequency in Hz. A
            level of 115 or more means that none was reached. The attribute contains pairs of a
            frequency and a level. See ``uncomfortable_levels``.

    Raises:
        ValueError: Levels, frequencies or ``ucl`` are no numbers, the numbers of levels and
            frequencies differ, no level was measured, one is out of range, an uncomfortable level
            below 115 dB HL is below the threshold, ``ucl`` has a frequency twice, or the
            frequencies do not ascend, or all lie below 250 or above 8000 Hz.

    Example:
        >>> from hlsim import Audiogram
        >>> ear = Audiogram([15, 20, 25, 30, 40, 35], [250, 500, 1000, 2000, 4000, 8000])
        >>> ear.severity, ear.pta, ear.who_grade
        ('mild', 28.75, 'mild')
    """

    levels: tuple[float, ...]
    frequencies: tuple[float, ...] = FREQUENCIES
    ucl: Points = field(default=(), kw_only=True)

    if TYPE_CHECKING:

        def __init__(
            self, levels: Any, frequencies: Any = FREQUENCIES, *, ucl: UclLike | None = ()
        ) -> None: ...

    def __post_init__(self) -> None:
        attributes = vars(self)  # which can be written, unlike the fields of a frozen dataclass
        attributes["ucl"] = read_points(self.ucl)
        names_frequencies = isinstance(self.levels, Mapping) or hasattr(self.levels, "to_dict")
        if names_frequencies and self.frequencies is FREQUENCIES:
            ear = find_audiogram(self.levels)
            if ear is not None:
                attributes |= vars(ear) | {"ucl": self.ucl or ear.ucl}
        levels, frequencies = _as_array(self.levels), _as_array(self.frequencies)
        if len(levels) != len(frequencies):
            raise ValueError(
                f"expected one level per frequency, got {len(levels)} levels for "
                f"{len(frequencies)} frequencies, {frequencies.tolist()} Hz; for other "
                "frequencies name each with its threshold, such as 500:20,4000:50 on the command "
                "line, and {500: 20, 4000: 50} in Python"
            )
        is_measured = ~np.isnan(levels)
        levels, frequencies = levels[is_measured], frequencies[is_measured]
        check_range(levels, HIGHEST_LEVEL, frequencies)
        ascending = len(levels) > 0 and (np.diff(frequencies) > 0).all()
        overlaps = (
            ascending
            and LOWEST_HZ <= frequencies[0] <= FREQUENCIES[-1]
            and FREQUENCIES[0] <= frequencies[-1] <= HIGHEST_HZ
        )
        if not overlaps:
            raise ValueError(
                f"expected levels at ascending frequencies from {LOWEST_HZ:g} to {HIGHEST_HZ:g} "
                f"Hz that overlap the range from {FREQUENCIES[0]:g} to {FREQUENCIES[-1]:g}, got "
                f"levels at {frequencies.tolist()} Hz; sort them, or multiply kHz by 1000"
            )
        attributes["levels"] = tuple(levels.tolist())
        attributes["frequencies"] = tuple(frequencies.tolist())
        thresholds = self._interpolate([hz for hz, _ in self.ucl]).tolist()
        for (hz, level), threshold in zip(self.ucl, thresholds, strict=True):
            if level < min(threshold, UCL_NOT_REACHED):
                raise ValueError(
                    f"expected no uncomfortable level below the threshold, got {level:g} dB HL at "
                    f"{hz:g} Hz, where the threshold is {threshold:g} dB HL; correct one of them"
                )

    @classmethod
    def standard(cls, name: str, *, ucl: UclLike | None = ()) -> Audiogram:
        """Return a standard audiogram.

        N1 to N7 are flat or moderately sloping losses from very mild to profound, S1 to S3 are
        steep. Simulators do not accept N7, which has thresholds above 100 dB HL.

        Source: Bisgaard, Vlaming and Dahlquist (2010).

        Args:
            name: ``"N1"`` to ``"N7"``, ``"S1"`` to ``"S3"``, or ``"NH"`` for 0 dB HL at all
                frequencies, in upper or lower case.
            ucl: Measured uncomfortable levels, as in the constructor.

        Raises:
            ValueError: There is no standard audiogram of this name, or the levels are not valid.

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
        return cls(STANDARD[key], ucl=ucl)

    def __repr__(self) -> str:
        text = _describe_points(zip(self.frequencies, self.levels, strict=True))
        if self.ucl:
            return f"Audiogram({text}, ucl={_describe_points(self.ucl)})"
        for name, levels in STANDARD.items():
            if self.frequencies == FREQUENCIES and self.levels == levels:
                return f"Audiogram({name!r})"
        return f"Audiogram({text})"

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Thresholds in dB HL at the eight ``FREQUENCIES``.

        Between other frequencies they are interpolated linearly over log frequency; beyond the
        lowest and the highest frequency they stay constant.
        """
        if self.frequencies == FREQUENCIES:
            return self.levels
        return tuple(self._interpolate(FREQUENCIES).tolist())

    def uncomfortable_levels(self, frequencies: Sequence[float] = FREQUENCIES) -> tuple[float, ...]:
        """Return the levels from which on pure tones are uncomfortably loud, in dB HL.

        They are those that were measured, ``ucl``, or else predicted from the thresholds (see
        ``hlsim.audiogram.discomfort``, which states the error of the prediction, 8.7 dB RMS).
        Between measured frequencies, the difference of the levels from the prediction is
        interpolated over log frequency; beyond them it is constant. The result is not below the
        threshold. A measured level of 115 dB HL or more means that it was not reached, so it can
        raise the prediction, but not lower it.

        Args:
            frequencies: Frequencies of the result in Hz.

        Raises:
            ValueError: The frequencies are no sequence of numbers above 0.

        Example:
            >>> from hlsim import Audiogram
            >>> Audiogram({500: 20, 4000: 60}).uncomfortable_levels([500, 4000])
            (93.5, 103.9)
            >>> Audiogram({500: 20, 4000: 60}, ucl={4000: 91.8}).uncomfortable_levels([4000, 8000])
            (91.8, 91.8)
        """
        try:
            hertz = [float(hz) for hz in frequencies]
        except (TypeError, ValueError):
            hertz = [math.nan]
        if not all(hz > 0.0 for hz in hertz):
            raise ValueError(
                f"expected a list of frequencies in Hz, such as [500, 1000], got {frequencies!r}"
            )
        levels = predict_uncomfortable_levels(self._interpolate(hertz))
        if self.ucl:
            measured_hz, measured = np.array(self.ucl).T
            difference = measured - predict_uncomfortable_levels(self._interpolate(measured_hz))
            is_reached = measured < UCL_NOT_REACHED
            difference = np.where(is_reached, difference, np.maximum(difference, 0.0))
            levels = levels + interpolate_over_log(hertz, measured_hz, difference)
            levels = np.maximum(levels, self._interpolate(hertz))
        return tuple(round(level, 6) for level in levels.tolist())

    def _interpolate(self, frequencies: Numbers) -> NDArray[np.float64]:
        """Return thresholds in dB HL, interpolated over log frequency, at frequencies in Hz."""
        return interpolate_over_log(frequencies, self.frequencies, self.levels)

    @property
    def severity(self) -> str:
        """Degree of hearing loss in MSBG: ``"none"``, ``"mild"``, ``"moderate"`` or ``"severe"``.

        The mean of the levels that were measured from 2 to 8 kHz decides. Without such a level, the
        degree is ``"none"``, as in pyclarity.
        """
        levels = torch.tensor(self.levels, dtype=torch.float64, device="cpu")
        return SEVERITIES[int(severity_index(levels, self.frequencies))]

    @property
    def pta(self) -> float:
        """Pure-tone average in dB HL: mean threshold at 500, 1000, 2000 and 4000 Hz."""
        levels = dict(zip(FREQUENCIES, self.thresholds, strict=True))
        return sum(levels[hz] for hz in PTA_FREQUENCIES) / len(PTA_FREQUENCIES)

    def plot(self, axes: Any = None, *, ear: EarName | None = None) -> Any:
        """Draw the audiogram as audiologists do, with the hearing loss downwards.

        Args:
            axes: Matplotlib axes to draw on, which may show other ears; by default new axes.
            ear: ``"left"`` draws blue crosses and ``"right"`` red circles, as audiologists do, with
                the ear and its pure-tone average in the legend.

        Returns:
            The axes.

        Raises:
            ValueError: ``ear`` is another value.
            MissingExtraError: matplotlib is not installed.
        """
        if ear not in EAR_STYLES:
            raise ValueError(f"expected ear to be left, right or None, got {ear!r}; correct it")
        if axes is None:
            _, axes = require("matplotlib.pyplot", "eval").subplots(layout="constrained")
        label = None if ear is None else f"{ear}, PTA {self.pta:.0f} dB HL"
        axes.plot(self.frequencies, self.levels, label=label, **EAR_STYLES[ear])
        frequency_axis(axes, FREQUENCIES)
        axes.set(ylim=(HIGHEST_LEVEL, LOWEST_LEVEL), ylabel="threshold (dB HL)")
        if ear is not None:
            axes.legend()
        return axes

    @property
    def who_grade(self) -> str:
        """Grade of hearing loss: ``"normal"``, ``"mild"`` to ``"profound"``, or ``"complete"``.

        The pure-tone average (``pta``) decides: the grades end below 20, 35, 50, 65, 80 and 95 dB
        HL (``hlsim.audiogram.scale.WHO_GRADES``). They differ from ``severity``, which is MSBG's.

        Source: World Health Organization 2021, World report on hearing, Table 1.3.
        """
        average = round(self.pta, 4)
        return next(grade for grade, limit in WHO_GRADES.items() if average < limit)

    def to(self, *args: Any, **kwargs: Any) -> Audiogram:
        """Return the audiogram itself, because it is on no device.

        Lightning calls this method when it moves a batch to a device.
        """
        return self

    def to_dict(self) -> dict[str, Any]:
        """Return a dict of ``levels`` and ``frequencies``, which can be written as JSON.

        It also has the pairs of ``ucl`` if uncomfortable levels were measured.
        """
        ear: dict[str, Any] = {"levels": list(self.levels), "frequencies": list(self.frequencies)}
        return ear | {"ucl": [list(point) for point in self.ucl]} if self.ucl else ear

    def to_row(self) -> dict[str, str]:
        """Return the thresholds as texts by column of a CSV file: ``hl_250``, ``hl_500``, ...

        Measured uncomfortable levels have the columns ``ucl_500``, ...
        """
        points = zip(self.frequencies, self.levels, strict=True)
        columns = {f"hl_{_shortest(hz)}": _shortest(level) for hz, level in points}
        return columns | {f"ucl_{_shortest(hz)}": _shortest(level) for hz, level in self.ucl}

    @classmethod
    def from_row(cls, row: Mapping[str, str]) -> Audiogram:
        """Convert a row of a table with the thresholds of one ear into an audiogram.

        Args:
            row: Texts by column. ``hlsim.audiogram.columns.threshold_columns`` describes the names
                of columns of thresholds and of uncomfortable levels; other columns are ignored. A
                text that is empty, ``NA``, ``n/a``, ``null``, ``None`` or ``nan`` means that the
                frequency was not measured.

        Raises:
            ValueError: The row has the thresholds of both ears, none that was measured, two of one
                frequency, one that is not a number from -10 to 120 dB HL, an uncomfortable level
                that is not valid, a column whose name looks like thresholds but is not understood,
                or another error of ``ears_in_row``.

        >>> Audiogram.from_row({"hl_500": "20", "1k": "30"})
        Audiogram({500: 20, 1000: 30})
        """
        ears = ears_in_row(row)
        if len(ears) > 1:
            raise ValueError(
                "expected the thresholds of one ear, got those of both; read the table with "
                "read_audiograms or read_listeners"
            )
        (ear,) = ears.values()
        return ear

    def to_clarity(self) -> Any:
        """Return pyclarity's ``Audiogram`` with the same levels and frequencies.

        Raises:
            MissingExtraError: pyclarity is not installed.
        """
        module = require("clarity.utils.audiogram", "clarity")
        return module.Audiogram(np.array(self.levels), np.array(self.frequencies))


EarLike = Audiogram | str | Sequence[float] | NDArray[Any] | Tensor | Mapping[float, float]
"""An audiogram, or a value that ``as_audiogram`` converts into one."""


def as_audiogram(ear: EarLike) -> Audiogram:
    """Convert the description of one ear into an ``Audiogram``.

    Args:
        ear: An ``Audiogram`` of hlsim or pyclarity; the name of a standard audiogram, such as
            ``"N3"`` or ``"n3"``; eight thresholds in dB HL at ``FREQUENCIES``, as a sequence, an
            array or a tensor; a mapping of frequencies in Hz to thresholds in dB HL; or a pandas
            ``Series`` of thresholds by position, by frequency, or by column of a table.

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
        ValueError: The value describes one ear, but its thresholds or its name are not valid.

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
    if hasattr(ear, "to_dict") and hasattr(ear, "index"):  # a Series of pandas
        return _from_series(ear)
    if isinstance(ear, np.ndarray | Tensor):
        return Audiogram(tuple(ear.tolist())) if ear.ndim == 1 else None
    if isinstance(ear, Sequence) and ear and all(isinstance(level, Real | None) for level in ear):
        return Audiogram(tuple(ear))
    return None


def _from_mapping(levels: Mapping[Any, Any]) -> Audiogram:
    """Convert a mapping from frequencies in Hz to thresholds in dB HL into an audiogram.

    Raises:
        ValueError: A frequency is not a number, or the thresholds are not valid.
    """
    try:
        frequencies = sorted(levels, key=float)
    except (TypeError, ValueError):
        raise ValueError(
            f"expected a dictionary of frequencies in Hz to thresholds in dB HL, got {levels!r}; "
            "for two ears, pass Listener(left, right)"
        ) from None
    return Audiogram(tuple(levels[frequency] for frequency in frequencies), tuple(frequencies))


def _from_series(series: Any) -> Audiogram | None:
    """Convert a pandas ``Series`` of thresholds into an audiogram, or return None for a DataFrame.

    The labels of the series are positions (0 to 7), frequencies in Hz, or columns of a table.

    Raises:
        ValueError: The labels or the thresholds are not valid.
    """
    if series.ndim != 1:
        return None
    labels = list(series.index)
    if labels == list(range(len(labels))):
        return Audiogram(tuple(series))
    if any(isinstance(label, str) for label in labels):
        texts = series.astype(object).where(series.notna(), "").astype(str)
        return Audiogram.from_row({str(label): text for label, text in texts.items()})
    return _from_mapping(series.to_dict())


def severity_index(levels: Tensor, frequencies: Sequence[float] = FREQUENCIES) -> Tensor:
    """Compute the degree of hearing loss of each ear: 0 none, 1 mild, 2 moderate, 3 severe.

    The mean threshold from 2 to 8 kHz decides, as in pyclarity: a loss is mild above 15 dB HL,
    moderate above 35 dB HL and severe above 56 dB HL. Without a frequency from 2 to 8 kHz, the
    degree is 0.

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


def ears_in_row(
    row: Mapping[str, str], highest: float = HIGHEST_LEVEL
) -> dict[EarName | None, Audiogram]:
    """Convert the thresholds in a row of a table into audiograms, one per ear that columns name.

    Uncomfortable levels in the row become the ``ucl`` of the audiograms. A frequency was not
    measured if its value is empty, ``NA``, ``n/a``, ``null``, ``None`` or ``nan``. An ear without a
    measured threshold is left out.

    Args:
        row: Texts by column.
        highest: Highest level allowed, in dB HL.

    Returns:
        The left and the right ear, or one ear under None if columns do not name the ear.

    Raises:
        ValueError: There is no measured threshold, a column is not understood, a threshold is not a
            number from -10 to ``highest``, an uncomfortable level is not one from 20 to 140 or is
            below the threshold, some columns name an ear and others do not, two have the same
            frequency and ear, an ear has uncomfortable levels but no thresholds, its frequencies
            all lie below 250 or above 8000 Hz, or a remark is a number.

    >>> ears_in_row({"L500": "20", "R500": "30"})
    {'left': Audiogram({500: 20}), 'right': Audiogram({500: 30})}
    """
    points: dict[EarName | None, dict[float, float]] = {}
    ucl: dict[EarName | None, dict[float, float]] = {}
    for column, meaning in threshold_columns(row).items():
        text = str(row[column]).strip()
        if text.lower() in _UNMEASURED:
            continue
        if meaning.is_remark:
            _check_remark(text, column)
        elif meaning.is_ucl:
            level = _parse_level(text, column, LOWEST_UCL, HIGHEST_UCL, _UCL_ADVICE)
            ucl.setdefault(meaning.ear, {})[meaning.hz] = level
        else:
            level = _parse_level(text, column, LOWEST_LEVEL, highest, _THRESHOLD_ADVICE)
            points.setdefault(meaning.ear, {})[meaning.hz] = level
    if not points:
        raise ValueError(
            "expected measured thresholds in columns such as hl_250, hl_500 and hl_1000, got the "
            f"columns {', '.join(row)}; add columns or thresholds"
        )
    if None in points | ucl and len(points | ucl) > 1:
        raise ValueError(
            "expected all columns of thresholds and uncomfortable levels to name the ear, such as "
            f"L500 and ucl_L500, or none of them, got {', '.join(threshold_columns(row))}; rename "
            "the columns"
        )
    for ear in ucl.keys() - points.keys():
        raise ValueError(
            f"expected thresholds of the {ear} ear, of which there are uncomfortable levels, got "
            "none; add thresholds, or remove its uncomfortable levels"
        )
    return {
        ear: replace(_from_mapping(points[ear]), ucl=read_points(ucl.get(ear)))
        for ear in (None, *EARS)
        if ear in points
    }


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


def _check_remark(text: str, column: str) -> None:
    """Raise ValueError if a remark on a frequency is a number, which may be a threshold."""
    try:
        float(text.replace(",", "."))
    except ValueError:
        return
    raise ValueError(
        f"column {column!r} is {text!r}; expected a remark in words, because another column has "
        "this frequency; rename the column if it holds no thresholds (ucl_500 is an uncomfortable "
        "level), or remove one of the two"
    )


def _parse_level(text: str, column: str, lowest: float, highest: float, advice: str) -> float:
    """Convert the text of a threshold or an uncomfortable level in dB HL into a number.

    Args:
        text: Text to convert, which may have a decimal comma. A comma before three digits is
            rejected, because it may separate thousands.
        column: Name of the column, for the message.
        lowest: Lowest level allowed, in dB HL.
        highest: Highest level allowed, in dB HL.
        advice: End of the message about a text that is not valid.

    Raises:
        ValueError: The text is not a number from ``lowest`` to ``highest``, or is ambiguous.
    """
    if re.fullmatch(r"\D?[1-9]\d*,\d{3}", text):
        raise ValueError(
            f"column {column} is {text!r}, where the comma may separate thousands or decimals; "
            f"write decimals with a point, {text.replace(',', '.')}"
        )
    try:
        level = float(text.replace(",", "."))
    except ValueError:
        level = math.nan
    if not lowest <= level <= highest:
        raise ValueError(
            f"column {column} is {text!r}; expected a level from {lowest:g} to {highest:g} dB HL. "
            f"{advice}"
        )
    return level


def _as_array(values: Any) -> NDArray[np.float64]:
    """Convert numbers, or texts of numbers, into a float64 array with NaN in place of ``None``.

    Raises:
        ValueError: The value is not a sequence of numbers, or its gradient is recorded.
    """
    try:
        numbers = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        numbers = np.array(math.nan)
    if numbers.ndim != 1:
        raise ValueError(
            f"expected a list of numbers for an audiogram, got {values!r}; for a standard "
            "audiogram, write Audiogram.standard('N3')"
        )
    return numbers


def _describe_points(points: Iterable[tuple[float, float]]) -> str:
    """Return the text of a dict of frequencies to levels, such as ``{500: 20}``."""
    return f"{{{', '.join(f'{hz:g}: {level:g}' for hz, level in points)}}}"


def _shortest(value: float) -> str:
    """Return the shortest text that reads as the same number, without a decimal point if whole."""
    return str(value).removesuffix(".0")
