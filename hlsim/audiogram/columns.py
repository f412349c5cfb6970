"""Columns of thresholds in a table, recognised by names that spreadsheets and clinics use."""

import re
import warnings
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

from hlsim.audiogram.scale import EAR_NAMES, HIGHEST_HZ, LOWEST_HZ, EarName

_USUAL_HZ = {
    *(125, 250, 500, 750, 1000, 1500, 2000, 3000, 4000, 6000, 8000),
    *(9000, 10000, 11200, 12000, 12500, 14000, 15000, 16000, 18000, 20000),
}
"""Frequencies of audiometry in Hz. The name of a column may be such a number alone."""

_KNOWN_WORDS = {
    *EAR_NAMES,
    *("ac", "air", "conduction", "ear", "freq", "frequency", "hl", "htl", "hz"),
    *("pt", "t", "thr", "thresh", "threshold", "thresholds"),
}
"""Words that the name of a column of thresholds may contain besides the frequency."""

UCL_WORDS = {"ucl", "ldl", "ull", "uncomfortable", "discomfort"}
"""Words for uncomfortable levels, of which one is in the name of a column of them."""

_OTHER_LEVELS = {"bc", "bone", "extrapolated"}
"""Words in the names of columns with other levels than measured thresholds of air conduction."""

# Thousands may be separated, by a blank if no letter is joined to the number ("R1 500" is none),
# and a decimal comma is as good as a point.
_NAME = re.compile(
    r"""(?P<before>\D*?)
    (?P<number>(?:(?<![a-z])\d{1,3}(?:[ ]\d{3})+|\d{1,3}(?:[,.']\d{3})+)(?!\d)
    | \d+(?:[.,]\d+)? | [.,]\d+)
    [ _]?(?P<kilo>k?)(?P<after>.*)""",
    re.VERBOSE,
)

_FREQUENCY = re.compile(r"(?P<number>\d+(?:[.,]\d+)?) ?(?P<kilo>k?)(?:hz)?[lr]?(?![a-z0-9])")
"""A number that may be a frequency, in the name of a column of something else."""


class ThresholdColumn(NamedTuple):
    """Meaning of a column of thresholds, or of a column of remarks on thresholds.

    Attributes:
        ear: Ear that the column's name mentions, or None.
        hz: Frequency in Hz.
        is_remark: Whether the column contains remarks on another column of this frequency.
        is_ucl: Whether the column contains uncomfortable levels instead of thresholds.

    >>> ThresholdColumn("left", 500.0).is_remark
    False
    """

    ear: EarName | None
    hz: float
    is_remark: bool = False
    is_ucl: bool = False


def threshold_columns(columns: Iterable[str]) -> dict[str, ThresholdColumn]:
    """Find the columns of thresholds among the columns of a table, and the remarks on them.

    Columns of uncomfortable levels, such as ``ucl_500`` and ``ucl_left_500``, are found as well.

    A column of thresholds is called ``hl_250``, ``250``, ``250 Hz``, ``1,000 Hz`` or ``1k``, in any
    case, perhaps with an ear, as in ``L250``, ``right_250`` or ``250 Hz (R)``. Columns such as
    ``hl_250_masked`` are remarks on ``hl_250``. Columns with another word before a frequency of
    audiometry, such as ``aided 250``, ``bone 250`` and ``masked left 250``, and those of
    extrapolated levels at such a frequency, are left out with a warning that names them. With
    ``Hz`` or a leading ``hl``, as in ``masked 250 Hz``, they are remarks, and numbers in them are
    an error (except for levels of bone conduction and extrapolated levels, which are left out). The
    same warning names columns of uncomfortable levels without a frequency. Columns that do not look
    like thresholds are left out without a warning.

    Args:
        columns: Names of all columns.

    Returns:
        The meaning of each column of thresholds, uncomfortable levels or remarks, by its name.

    Raises:
        ValueError: A name looks like that of thresholds, but is not understood or has a frequency
            below 100 or above 20000 Hz; a remark has no column of thresholds of its frequency; or
            two columns of thresholds, or of uncomfortable levels, have the same frequency and ear.

    >>> threshold_columns(["name", "R 1k"])
    {'R 1k': ThresholdColumn(ear='right', hz=1000.0, is_remark=False, is_ucl=False)}
    """
    meanings = {}
    other_columns = []
    names: dict[ThresholdColumn, str] = {}
    for column in columns:
        name = " ".join(column.lower().split())
        meaning = _read_name(column, name)
        if meaning is None:
            has_hz = any(_read_hz(*match) in _USUAL_HZ for match in _FREQUENCY.findall(name))
            is_ucl = not UCL_WORDS.isdisjoint(re.findall("[a-z]+", name))
            if has_hz or is_ucl:
                other_columns.append(column)
            continue
        meanings[column] = meaning
        if meaning.is_remark:
            continue
        if meaning in names:
            raise ValueError(
                f"columns {names[meaning]!r} and {column!r} have the same frequency; remove one of "
                "them"
            )
        names[meaning] = column
    measured_hz = {meaning.hz for meaning in names if not meaning.is_ucl}
    for column, meaning in meanings.items():
        if meaning.is_remark and meaning.hz not in measured_hz:
            raise ValueError(
                f"column {column!r}: expected a name such as hl_500, 500 Hz, 500 or R 500 for "
                "thresholds, or ucl_500 for uncomfortable levels; rename the column"
            )
    if other_columns:
        warnings.warn(
            "not read as thresholds, because of other words in the names of the columns, or no "
            f"frequency: {', '.join(map(repr, other_columns))}; if they hold thresholds of air "
            "conduction, rename them, for example to hl_500, L500 or R500; if they hold "
            "uncomfortable levels, to ucl_500",
            stacklevel=2,
        )
    return meanings


@lru_cache(maxsize=1024)  # every row of a table has the same names
def _read_name(column: str, name: str) -> ThresholdColumn | None:
    """Return the meaning of a column of thresholds or of remarks, or None for any other column.

    Args:
        column: Name of the column, for messages.
        name: The name in lower case, with single blanks.

    Raises:
        ValueError: The name looks like that of thresholds, but its number is no frequency from 100
            to 20000 Hz.
    """
    match = _NAME.match(name)
    if match is None:
        return None
    before, after = (re.findall(r"[a-z]+|\d+", match[part]) for part in ("before", "after"))
    words = {*before, *after}
    is_ucl = not words.isdisjoint(UCL_WORDS)
    has_hz = bool(words & {"hz", "khz"})
    is_explicit = has_hz or is_ucl or before[:1] == ["hl"]
    # "500 dB" is no frequency, but "dB HL 500" is one
    may_have_unit = has_hz or is_ucl or not after
    known = _KNOWN_WORDS | {"db", "dbhl"} if may_have_unit else _KNOWN_WORDS
    if is_ucl:
        known = known | UCL_WORDS | {"loudness", "level", "levels"}
    is_known = words <= known
    hz = _read_hz(match["number"], match["kilo"])
    if words & _OTHER_LEVELS:
        return None
    has_other_unit = name[match.end("number") :][:1].isalpha() and not match["kilo"]  # "500ms"
    begins_with_frequency = hz in _USUAL_HZ and known.issuperset(before) and not has_other_unit
    if not (is_known or is_explicit or begins_with_frequency):
        return None
    ears = {EAR_NAMES[word] for word in words if word in EAR_NAMES}
    ear = next(iter(ears), None)
    if not is_known or len(ears) > 1:
        return ThresholdColumn(ear, hz, is_remark=True)
    is_frequency = is_explicit or bool(match["kilo"]) or hz in _USUAL_HZ
    if not (is_frequency and LOWEST_HZ <= hz <= HIGHEST_HZ):
        raise ValueError(
            f"column {column!r}: expected a frequency from {LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz, "
            "such as 500, 1k or 1414 Hz; multiply kHz by 1000, or rename a column of other values"
        )
    return ThresholdColumn(ear, hz, is_ucl=is_ucl)


def _read_hz(number: str, kilo: str) -> float:
    """Convert the text of a frequency to Hz.

    Args:
        number: Digits, perhaps with a decimal point or comma, or with separated thousands. Three
            digits after a point or comma are thousands, unless the number is in kHz.
        kilo: ``"k"`` if the number is in kHz, otherwise an empty text.
    """
    if kilo:
        return 1000.0 * float(re.sub("[ ']", "", number).replace(",", "."))
    if re.fullmatch(r"\d{1,3}([ ,.']\d{3})+", number):
        return float(re.sub(r"\D", "", number))
    return float(number.replace(",", "."))
