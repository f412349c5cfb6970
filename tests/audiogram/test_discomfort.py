"""Uncomfortable levels: measured, predicted, stored and read from tables."""

import copy
import json
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch

from hlsim import Audiogram, Listener, read_audiograms, read_listeners
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.discomfort import predict_uncomfortable_levels

UCL = {500: 85.0, 4000: 110.0}
EAR = Audiogram({250: 20, 1000: 40, 4000: 60}, ucl=UCL)


def test_without_measured_levels_they_are_predicted_from_the_thresholds() -> None:
    ear = Audiogram.standard("N3")
    predicted = predict_uncomfortable_levels(torch.tensor(ear.thresholds, dtype=torch.float64))
    assert ear.uncomfortable_levels() == pytest.approx(predicted.tolist())
    assert ear.uncomfortable_levels([1000.0]) == (98.7,)


def test_measured_levels_are_returned_and_shift_the_prediction_elsewhere() -> None:
    levels = EAR.uncomfortable_levels([250.0, 500.0, 4000.0, 8000.0])
    shift_500 = 85.0 - predict_uncomfortable_levels(30.0)
    shift_4000 = 110.0 - predict_uncomfortable_levels(60.0)
    lowest, highest = (predict_uncomfortable_levels(level) for level in (20.0, 60.0))
    assert levels == pytest.approx((lowest + shift_500, 85.0, 110.0, highest + shift_4000))
    between = EAR.uncomfortable_levels([500.0 * 8.0**0.5])[0]
    threshold = 40.0 + 20.0 * 0.25
    middle = 0.5 * (shift_500 + shift_4000)
    assert between == pytest.approx(predict_uncomfortable_levels(threshold) + middle)


@pytest.mark.parametrize(("measured", "expected"), [(115.0, 115.0), (114.0, 114.0)])
def test_a_level_that_was_not_reached_is_a_lower_bound(measured: float, expected: float) -> None:
    ear = Audiogram({1000: 40}, ucl={1000: measured})
    assert ear.uncomfortable_levels([1000.0]) == (expected,)
    deaf = Audiogram({1000: 110}, ucl={1000: measured})  # 116.9 dB HL are predicted
    assert deaf.uncomfortable_levels([1000.0]) == (max(measured, 116.9) if measured > 114 else 114,)


def test_no_uncomfortable_level_is_below_the_threshold() -> None:
    ear = Audiogram({500: 20, 4000: 90}, ucl={500: 60})
    assert ear.uncomfortable_levels([500, 4000]) == (60.0, 90.0)


@pytest.mark.parametrize("frequencies", [1000, 1000.0, "low", [0.0], [None], [float("nan")]])
def test_bad_frequencies_are_rejected(frequencies: Any) -> None:
    with pytest.raises(ValueError, match=r"list of frequencies in Hz, such as \[500, 1000\]"):
        EAR.uncomfortable_levels(frequencies)
    assert EAR.uncomfortable_levels([500]) == (85.0,)


def test_an_ear_keeps_its_levels_wherever_it_goes() -> None:
    assert EAR.ucl == ((500.0, 85.0), (4000.0, 110.0)) and EAR.to("cpu") is EAR
    copies = [
        Audiogram(**json.loads(json.dumps(EAR.to_dict()))),
        Audiogram.from_row(EAR.to_row()),
        copy.deepcopy(EAR),
        pickle.loads(pickle.dumps(EAR)),
        Listener(EAR, None).left,
        eval(repr(EAR), {"Audiogram": Audiogram}),
    ]
    assert set(copies) == {EAR}
    without = Audiogram(EAR.levels, EAR.frequencies)
    assert without != EAR and without.to_dict().keys() == {"levels", "frequencies"}
    assert without.thresholds == EAR.thresholds and not without.ucl


def test_tables_may_have_uncomfortable_levels(tmp_path: Path) -> None:
    table = tmp_path / "ears.csv"
    table.write_text(
        "listener,left_500,left_1000,right_500,ucl_left_500,UCL left 1k,ucl_right_500 Hz\n"
        "A,30,40,50,95,,120\nB,30,40,50,,,\n"
    )
    listeners = read_listeners(table)
    left, right = listeners["A"].left, listeners["A"].right
    assert left == Audiogram({500: 30, 1000: 40}, ucl={500: 95})
    assert right == Audiogram({500: 50}, ucl={500: 120})
    assert listeners["B"] == Listener({500: 30, 1000: 40}, {500: 50})
    table.write_text("hl_500,ldl_500\n30,95\n")
    ((_, ear),) = read_audiograms(table)
    assert ear == Audiogram({500: 30}, ucl={500: 95})
    for column in ("UCL_500 (dB HL)", "loudness discomfort level 500", "hl_500_ucl", "500 ULL"):
        table.write_text(f"hl_500,{column}\n30,95\n")
        assert read_audiograms(table)[0][1] == ear
    table.write_text("frequency,threshold,UCL (dB HL)\n500,30,95\n1000,40,\n")
    ((_, ear),) = read_audiograms(table)
    assert ear == Audiogram({500: 30, 1000: 40}, ucl={500: 95})
    table.write_text("hl_500,ucl_500\n30,9\n")
    with pytest.raises(ValueError, match=r"column ucl_500 is '9'; expected a level from 20 to 140"):
        read_audiograms(table)
    for columns, message in [("R500,ucl_500", "to name the ear"), ("x,ucl_R500", "the right ear")]:
        table.write_text(f"L500,{columns}\n30,30,95\n")
        with pytest.raises(ValueError, match=message):
            read_audiograms(table)
    table.write_text("hl_500,ucl_500\n30,NR\n")
    with pytest.raises(ValueError, match=r"'NR'.* If no level was uncomfortable write 115; for"):
        read_audiograms(table)


def test_standard_ears_may_have_uncomfortable_levels() -> None:
    ear = Audiogram.standard("n3", ucl={500: 95})
    assert ear.levels == Audiogram.standard("N3").levels and ear.ucl == ((500.0, 95.0),)


def test_a_series_may_have_uncomfortable_levels() -> None:
    pandas = pytest.importorskip("pandas")
    series = pandas.Series({"hl_500": 30.0, "ucl_500": 95.0})
    assert Audiogram(series) == Audiogram({500: 30}, ucl={500: 95})


@pytest.mark.parametrize(
    ("ucl", "message"),
    [
        ({500: 10}, "from 20 to 140 dB HL"),
        ({50: 100}, "100 to 20000 Hz"),
        ({"low": 100}, "dictionary of frequencies"),
        ([100.0] * 8, "dictionary of frequencies"),
        (100, "dictionary of frequencies"),
        ([[500, 95], [500, 100]], "one uncomfortable level per frequency"),
    ],
)
def test_bad_levels_are_rejected(ucl: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Audiogram({500: 20}, ucl=ucl)
    with pytest.raises(ValueError, match="got 60 dB HL at 500 Hz, where the threshold is 70 dB HL"):
        Audiogram({250: 50, 1000: 90}, ucl={500: 60})
    assert Audiogram({500: 20}, ucl={500: None, 1000: float("nan")}) == Audiogram({500: 20})


def test_levels_do_not_change_what_is_simulated() -> None:
    assert Audiogram([40] * 8, ucl={f: 100 for f in FREQUENCIES}).thresholds == (40.0,) * 8
