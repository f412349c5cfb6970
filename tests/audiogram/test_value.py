"""Audiograms against Bisgaard's tables and pyclarity's class; interpolation, severity and rows."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from hlsim.audiogram import FREQUENCIES, SEVERITIES, Audiogram, as_audiogram, severity_index
from hlsim.audiogram.thresholds import as_thresholds

# Bisgaard, Vlaming and Dahlquist 2010, Tables 1 and 2, all ten frequencies
BISGAARD_HZ = (250, 375, 500, 750, 1000, 1500, 2000, 3000, 4000, 6000)
BISGAARD = {
    "N1": (10, 10, 10, 10, 10, 10, 15, 20, 30, 40),
    "N2": (20, 20, 20, 22.5, 25, 30, 35, 40, 45, 50),
    "N3": (35, 35, 35, 35, 40, 45, 50, 55, 60, 65),
    "N4": (55, 55, 55, 55, 55, 60, 65, 70, 75, 80),
    "N5": (65, 67.5, 70, 72.5, 75, 80, 80, 80, 80, 80),
    "N6": (75, 77.5, 80, 82.5, 85, 90, 90, 95, 100, 100),
    "N7": (90, 92.5, 95, 100, 105, 105, 105, 105, 105, 105),
    "S1": (10, 10, 10, 10, 10, 10, 15, 30, 55, 70),
    "S2": (20, 20, 20, 22.5, 25, 35, 55, 75, 95, 95),
    "S3": (30, 30, 35, 47.5, 60, 70, 75, 80, 80, 85),
}

CLARITY_SEVERITIES = {"NOTHING": "none", "MILD": "mild", "MODERATE": "moderate", "SEVERE": "severe"}


@pytest.mark.parametrize("name", BISGAARD)
def test_standard_ears_are_bisgaards_and_flat_above_6_khz(name: str) -> None:
    ear = Audiogram.standard(name)
    published = dict(zip(BISGAARD_HZ, BISGAARD[name], strict=True))
    assert ear.frequencies == FREQUENCIES == (250, 500, 1000, 2000, 3000, 4000, 6000, 8000)
    assert ear.levels[:7] == tuple(published[int(hz)] for hz in FREQUENCIES[:7])
    assert ear.levels[7] == ear.levels[6]
    assert Audiogram.standard("NH").levels == (0.0,) * 8


def test_equal_values_of_any_type_are_equal_keys() -> None:
    levels: list[Any] = [np.arange(8), tuple(range(8)), torch.arange(8)]
    assert len({as_audiogram(values) for values in levels}) == 1


BAD_POINTS: list[tuple[Any, Any]] = [
    ((0.0,) * 7, FREQUENCIES),
    ((), ()),
    ((0.0,) * 7 + (120.5,), FREQUENCIES),
    ((-10.5,) + (0.0,) * 7, FREQUENCIES),
    ((float("inf"),) + (0.0,) * 7, FREQUENCIES),
    *(((0.0, 0.0), (250.0, hz)) for hz in (float("nan"), 250.0, 100.0)),
    *(((0.0, 0.0), hertz) for hertz in ((0.0, 500.0), (0.25, 8.0), (9000.0, 12000.0))),
    (("loud",) + (0.0,) * 7, FREQUENCIES),
    ((None,) * 8, FREQUENCIES),
    ((0.0,) * 8, (None, *FREQUENCIES[1:])),
    (30.0, FREQUENCIES),
    ("12345678", FREQUENCIES),
]
BAD_CALLS: list[tuple[Callable[..., Audiogram], tuple[Any, ...]]] = [
    *((Audiogram, points) for points in BAD_POINTS),
    *((Audiogram.standard, (name,)) for name in ("N9", ["N3"], None)),
]


@pytest.mark.parametrize(("build", "arguments"), BAD_CALLS)
def test_values_that_are_no_ear_raise_value_error(
    build: Callable[..., Audiogram], arguments: tuple[Any, ...]
) -> None:
    with pytest.raises(ValueError):
        build(*arguments)


def test_other_grids_are_interpolated_linearly_over_log_frequency_and_flat_beyond() -> None:
    ear = Audiogram((10.0, 50.0, 30.0), (500.0, 2000.0, 4000.0))
    half = float(np.log2(3000 / 2000))  # of the octave from 2 to 4 kHz
    assert ear.thresholds == pytest.approx((10, 10, 30, 50, 50 - 20 * half, 30, 30, 30))
    assert ear.levels == (10.0, 50.0, 30.0)  # kept as given
    for hz, level in ((250.0, -10.0), (8000.0, 120.0)):
        assert Audiogram((level,), (hz,)).thresholds == (level,) * 8
    unmeasured: list[Any] = [None, float("nan")]
    for level in unmeasured:
        with_gap = as_audiogram({500: 10, 2000: level, 4000: 30})
        assert with_gap == as_audiogram({500: 10, 4000: 30})


def test_pure_tone_average_is_the_mean_of_four_frequencies() -> None:
    assert Audiogram((90, 10, 20, 30, 90, 60, 90, 90)).pta == 30.0
    assert Audiogram((10, 50), (500, 8000)).pta == pytest.approx(25.0)  # 10, 20, 30 and 40


def test_severity_is_pyclaritys_in_single_and_double_precision() -> None:
    clarity = pytest.importorskip("clarity.utils.audiogram")
    rng = np.random.default_rng(1)
    ears = [rng.uniform(-10, 100) + rng.uniform(-20, 20, 8) for _ in range(1500)]
    ears += [5.0 * rng.integers(-2, 20, 8) for _ in range(1500)]  # means often lie on a limit
    # The mean of this one is 15, and in single precision a bit more.
    ears += [np.array([10.0, 10.0, 10.0, 19.7, 14.8, 18.7, 12.6, 9.2])]
    for limit in (15.0, 35.0, 56.0):
        tenths = rng.integers(round(10.0 * limit) - 80, round(10.0 * limit) + 81, (500, 8))
        tenths[:, 7] = round(50.0 * limit) - tenths[:, 3:7].sum(-1) + rng.integers(-1, 2, 500)
        ears += list(tenths / 10.0)
    levels = np.clip(ears, -10, 100)
    expected = [CLARITY_SEVERITIES[clarity.Audiogram(levels=ear).severity] for ear in levels]
    assert set(expected) == set(SEVERITIES)
    audiograms = [Audiogram(tuple(ear)) for ear in levels]
    assert [ear.severity for ear in audiograms] == expected
    single = as_thresholds(audiograms)
    assert single.dtype == torch.float32
    for tensor in (single, torch.tensor(levels)):
        assert [SEVERITIES[i] for i in severity_index(tensor).tolist()] == expected


def test_severity_on_other_grids_is_pyclaritys() -> None:
    clarity = pytest.importorskip("clarity.utils.audiogram")
    rng = np.random.default_rng(4)
    for count in rng.integers(1, 13, 1000):
        hz = np.sort(rng.choice(np.arange(250, 12001, 250), count, replace=False))
        levels = 2.5 * rng.integers(-2, 35, count)
        expected = CLARITY_SEVERITIES[clarity.Audiogram(levels, hz).severity]
        if hz[0] <= 8000:
            assert Audiogram(tuple(levels), tuple(hz)).severity == expected


def test_json_and_rows_keep_all_digits_and_add_none() -> None:
    hertz = (250.0, 707.1067811865476, 1000.0, 11313.7085)
    ear = Audiogram((35.1234567, -0.1 - 0.2, 61.25, 100.0), hertz)
    assert Audiogram(**json.loads(json.dumps(ear.to_dict()))) == ear
    row = ear.to_row()
    assert Audiogram.from_row(row) == ear
    assert list(row) == ["hl_250", "hl_707.1067811865476", "hl_1000", "hl_11313.7085"]
    assert list(row.values()) == ["35.1234567", "-0.30000000000000004", "61.25", "100"]


def test_pyclaritys_audiograms_are_ears() -> None:
    clarity = pytest.importorskip("clarity.utils.audiogram")
    ear = Audiogram.standard("S2")
    theirs = ear.to_clarity()
    assert isinstance(theirs, clarity.Audiogram) and as_audiogram(theirs) == ear
    levels = as_thresholds([theirs, clarity.AUDIOGRAM_MILD])
    assert levels.tolist() == [list(ear.levels), [10, 15, 19, 25, 28, 31, 35, 38]]


def test_levels_that_are_no_list_of_numbers_are_refused_with_the_fix() -> None:
    for levels in ([10**400] * 8, torch.zeros(8, requires_grad=True)):
        with pytest.raises(ValueError, match="expected a list of numbers"):
            Audiogram(levels)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"got 'N3'; .* write Audiogram\.standard\('N3'\)"):
        Audiogram("N3")


def test_frequencies_in_khz_are_refused() -> None:
    for ear in ({250: 20, 1: 40}, {1: 20, 2: 30, 500: 40}, {500: 20, 48000: 30}, {0.25: 10, 8: 20}):
        with pytest.raises(ValueError, match=r"100 to 20000 Hz.*multiply kHz by 1000"):
            as_audiogram(ear)


def test_a_series_is_an_ear_by_position_frequency_or_column() -> None:
    pandas = pytest.importorskip("pandas")
    n3 = Audiogram.standard("N3")
    assert as_audiogram(pandas.Series(n3.levels)) == n3
    by_hz = pandas.Series({4000: 60.0, 500: None, 1000: 40.0})
    assert as_audiogram(by_hz) == as_audiogram({1000: 40, 4000: 60})
    row = pandas.Series({"listener": "A", "500 Hz": 35, "4 kHz": 60.0})
    assert as_audiogram(row) == as_audiogram({500: 35, 4000: 60})
    for series in (by_hz, row, pandas.Series(n3.levels), pandas.Series(n3.levels[::-1], range(8))):
        assert Audiogram(series) == as_audiogram(series)
    octaves = pandas.Series(
        [10, 20, 30, 40, 50, 60, 70, 80], [125, 250, 500, 1e3, 2e3, 4e3, 6e3, 8e3]
    )
    assert Audiogram(octaves).frequencies[0] == 125.0, "frequencies count, not positions"
    assert Audiogram({500: 20, 4000: 50}) == as_audiogram({500: 20, 4000: 50})
    with pytest.raises(ValueError, match="DataFrame"):
        as_audiogram(pandas.DataFrame({"500 Hz": [20]}))


def test_who_grade_changes_at_its_limits() -> None:
    limits = {-10: "normal", 19.9: "normal", 20: "mild", 34.9: "mild", 35: "moderate"}
    limits |= {
        50: "moderately severe",
        65: "severe",
        80: "profound",
        95: "complete",
        120: "complete",
    }
    assert {level: Audiogram((level,) * 8).who_grade for level in limits} == limits
    # 35.1 + 34.9 + 35.3 + 34.7 is 139.99999999999997 in some orders
    assert Audiogram((0, 35.1, 34.9, 35.3, 0, 34.7, 0, 0)).who_grade == "moderate"
    assert (as_audiogram("N3").who_grade, as_audiogram("N3").severity) == ("moderate", "severe")
