"""Tables of audiograms as spreadsheets, clinics and apps write them."""

import re
import warnings
from pathlib import Path
from typing import Any

import pytest

import hlsim
from hlsim import Audiogram, Listener
from hlsim.audiogram import STANDARD
from hlsim.audiogram.scale import EAR_NAMES
from hlsim.audiogram.table import read_audiograms, read_listeners

ROOT = Path(__file__).parents[2]
EARS_FILE = ROOT / "examples" / "ears.csv"


def read_text(folder: Path, text: str) -> list[Audiogram]:
    """Read the ears of a table with some text."""
    path = folder / "ears.csv"
    path.write_text(text, encoding="utf-8")
    return [ear for _, ear in read_audiograms(path)]


@pytest.mark.parametrize(
    "text",
    [
        "hl_250,hl_500,hl_1000\n10,22.5,30\n",
        "name, hl_250 , hl_500,hl_1000,\na b , 10, 22.5 ,30,\n",
        "HL_1000,HL_250,HL_500\n30,10,22.5\n",
        "250,500,1000\n10,22.5,30\n",
        "250 Hz,500Hz,1 kHz\n10,22.5,30\n",
        ".25k,hl500,1K\n10,22.5,30\n",
        "hl_250;hl_500;hl_1000\n10;22,5;30\n",
        "hl_250\thl_500\thl_1000\n10\t22,5\t30\n",
        "hl_250,hl_500,hl_1000,hl_1000_masked\n10,22.5,30,yes\n",
        "hl_250,hl_500,hl_1000,hl_1000_masked\n10,22.5,30,NaN\n",
        '250 Hz,500 Hz,"1,000 Hz"\n10,22.5,30\n',
        "250 Hz;500 Hz;1.000 Hz\n10;22,5;30\n",
        "250 Hz,500 Hz,1 000 Hz\n10,22.5,30\n",
        "250 Hz,500 Hz,1\u202f000 Hz\n10,22.5,30\n",
        "250 Hz*,500 Hz (dB HL),AC 1000\n10,22.5,30\n",
        '"250\nHz","500\nHz","1000\nHz"\n10,22.5,30\n',
        "250 Hz R,500_R,right 1k\n10,22.5,30\n",
        "AUXU1K1R,2nd visit,2019-05-01,PTA 4,250,500,1000\n7,7,7,7,10,22.5,30\n",
        "threshold_500ms_db_spl,250,500,1000\n7,10,22.5,30\n",
        "hl_250,hl_500,hl_1000\n,,\n10,22.5,30\n,,\n",
        "Frequency (Hz),Threshold (dB HL)\n1000,30\n250,10\n500,22.5\n",
        "threshold_250,thresh_500,Threshold 1k\n10,22.5,30\n",
    ],
)
def test_columns_are_found_whatever_their_order_case_and_delimiter(
    tmp_path: Path, text: str
) -> None:
    assert read_text(tmp_path, text) == [Audiogram((10, 22.5, 30), (250, 500, 1000))]


OTHER_COLUMNS = ["aided 2000", "unaided_500", "bone 1000", "masked left 500", "L aided 1k"]
OTHER_COLUMNS += ["visit2_500", "R2_1000", "L1 500", "MCL 500", "AUXU500R", "pta_500_1000_2000"]
OTHER_COLUMNS += ["bc_500", "hl_8000_extrapolated_flat", "ulc_500", "UCL", "ldl left"]


@pytest.mark.parametrize("column", OTHER_COLUMNS)
def test_columns_with_a_word_before_the_frequency_are_named(tmp_path: Path, column: str) -> None:
    with pytest.warns(UserWarning, match=f"not read as thresholds.*'{column}'.*ucl_500"):
        ears = read_text(tmp_path, f"250,500,1000,{column}\n10,22.5,30,7\n")
    assert ears == [Audiogram((10, 22.5, 30), (250, 500, 1000))]


def test_columns_that_differ_within_an_ear_of_a_long_table_are_named(tmp_path: Path) -> None:
    header, rows = "listener,ear,frequency,threshold", ("A,L,250,10", "A,L,500,20", "A,R,500,30")
    path = tmp_path / "ears.csv"
    path.write_text(f"{header},kind,clinic\n{rows[0]},air,x\n{rows[1]},bone,x\n{rows[2]},bone,y\n")
    with pytest.warns(UserWarning, match=r"one ear: the columns kind; remove rows"):
        assert len(read_audiograms(path)) == 2


def test_an_ear_of_a_long_table_may_be_spelt_in_several_ways(tmp_path: Path) -> None:
    rows = "A,R,250,10\nA,right,1000,20\nA,RE,4000,30\n"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ears = read_text(tmp_path, f"listener,ear,frequency,threshold\n{rows}")
    assert ears == [Audiogram((10, 20, 30), (250, 1000, 4000))]


@pytest.mark.parametrize(("row", "column"), [(",,500,20", "listener"), ("A,,500,20", "ear")])
def test_merged_cells_of_a_long_table_are_rejected(tmp_path: Path, row: str, column: str) -> None:
    with pytest.raises(ValueError, match=rf"line 3: expected a value in the column {column}, as"):
        read_text(tmp_path, f"listener,ear,frequency,threshold\nA,L,250,10\n{row}\n")


@pytest.mark.parametrize("text", ["", "NA", "n/a", "null", "None", "nan"])
def test_an_unmeasured_threshold_is_interpolated_as_a_missing_column_is(
    tmp_path: Path, text: str
) -> None:
    complete = read_text(tmp_path, "hl_250,hl_1000,hl_8000\n10,30,60\n")
    with_gap = read_text(tmp_path, f"hl_250,hl_1000,hl_4000,hl_8000\n10,30,{text},60\n")
    assert with_gap == complete


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["no rows"]),
        ("hl_250,hl_500\n", ["no rows"]),
        ("hl_250,hl_500\n10,20\n10,x\n", ["line 3", "hl_500", "'x'"]),
        ("hl_250,hl_500\n\n\n10,NR\n", ["line 4", "hl_500", "'NR'", "no response"]),
        ("hl_250,8 kHz\n10,110+\n", ["line 2", "8 kHz", "110+", "highest level"]),
        ("hl_250,hl_500\n10,999\n", ["line 2", "hl_500", "999", "-10 to 120"]),
        ("left,right\n10,20\n", ["line 2", "left, right"]),
        ("hl_250,hl_500\n,NA\n", ["line 2", "measured"]),
        ("hl_250,hl_8000dB\n10,20\n", ["line 2", "hl_8000dB"]),
        ("hl_500,0.5 kHz\n10,20\n", ["line 2", "hl_500", "0.5 kHz"]),
        ("hl_500,1'000 kHz\n10,20\n", ["line 2", "1'000 kHz"]),
        ("0.5,1,2\n10,20,30\n", ["line 2", "0.5", "multiply kHz by 1000"]),
        ("250,500,1,2,4,8\n10,20,30,40,50,60\n", ["line 2", "'1'", "multiply kHz by 1000"]),
        ("hl_250,hl_1\n10,20\n", ["line 2", "hl_1"]),
        ("250 Hz,2019\n10,95\n", ["line 2", "2019", "rename"]),
        ("250 Hz,1000,30000 Hz\n10,20,30\n", ["line 2", "30000 Hz"]),
        ("250 Hz,1,000 Hz\n10,20,30\n", ["line 2", "'1'"]),
        ("250 Hz;500 Hz\n10,5;1,000\n", ["line 2", "500 Hz is '1,000'", "point, 1.000"]),
        ("250 Hz,4000_masked\n10,20\n", ["line 2", "4000_masked", "rename"]),
        ("250 Hz,4000 Hz,4000_masked\n10,20,30\n", ["line 2", "4000_masked", "30"]),
        ("250 Hz,500 Hz left/right\n10,20\n", ["line 2", "500 Hz left/right"]),
        ("250 Hz,mean of 500 and 1000 Hz\n10,20\n", ["line 2", "mean of 500 and 1000 Hz"]),
        ("250 Hz,R 500 Hz\n10,20\n", ["line 2", "R 500 Hz", "name the ear"]),
        ("ear,R 500 Hz\nL,20\n", ["line 2", "'L'", "column ear"]),
        ("frequency,threshold,subject\n500,20,A\n", ["line 2", "listener and ear", "subject"]),
        ("frequency,threshold\n500,20\n500,30\n", ["line 3", "500 Hz", "second"]),
        ("frequency,threshold\n500,20\n.5k,30\n", ["line 2", "same frequency"]),
        ("frequency,threshold\n1,20\n2,30\n", ["line 2", "1 Hz"]),
        ("frequency,threshold,500 Hz\n1000,20,30\n", ["column threshold", "500 Hz", "remove"]),
        ("listener,ear,500 Hz\n\u00e9,L,20\ne\u0301,R,30\n", ["line 3", "u0301", "codes of equal"]),
        ("listener,ear,500 Hz\nL1,left,20\nl1,right,30\n", ["line 3", "L1", "l1", "only in case"]),
        ("listener,ear,500 Hz\nA,both,20\n", ["line 2", "left or right", "'both'"]),
        ("frequency,threshold,threshold 2\n500,20,30\n", ["line 2", "'threshold 2'"]),
        ("250 Hz,500 Hz\n10,20\n10\n", ["line 3", "none for 500 Hz", "complete the line"]),
    ],
)
def test_errors_name_the_file_and_the_cell(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(ValueError) as caught:
        read_text(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "ears.csv"))
    assert [word for word in words if word not in str(caught.value)] == []


def test_levels_that_no_simulator_takes_name_the_cell_too(tmp_path: Path) -> None:
    path = tmp_path / "ears.csv"
    path.write_text("hl_250,hl_8000\n10,20\n90,105\n", encoding="utf-8")
    assert len(read_audiograms(path)) == 2
    with pytest.raises(ValueError, match=r"line 3: column hl_8000 is '105'.*-10 to 100"):
        read_audiograms(path, simulated=True)


def test_standard_audiograms_have_a_name_in_place_of_a_file() -> None:
    ears = {row["listener"]: ear for row, ear in hlsim.read_audiograms("standard")}
    assert ears == {name: Audiogram.standard(name) for name in STANDARD if name != "NH"}
    assert len(ears) == 10
    simulated = read_audiograms(Path("standard"), simulated=True)
    assert {row["listener"] for row, _ in simulated} == ears.keys() - {"N7"}


def test_the_example_table_has_the_standard_ears_that_simulators_take() -> None:
    tables = [read_audiograms(path, simulated=True) for path in (EARS_FILE, "standard")]
    assert [ear for _, ear in tables[0]] == [ear for _, ear in tables[1]]


def test_both_ears_in_one_row_and_one_row_per_threshold(tmp_path: Path) -> None:
    tables = {
        "wide.csv": "Listener,L250,L1k,right_250,R 1000 Hz\nA,10,20,30,40\nB,,15,,\n",
        "both.csv": "Listener,Ear,L250,L1k,R250,R1k\nA,both,10,20,30,40\nB,both,,15,,\n",
        "long.csv": "listener,ear,frequency,threshold\nA,L,250,10\nA,L,1k,20\nA,re,250,30\n"
        "A,re,1000 Hz,40\nB,left,1000,15\n",
    }
    left, right = Audiogram((10, 20), (250, 1000)), Audiogram((30, 40), (250, 1000))
    expected = [("A", left), ("A", right), ("B", Audiogram((15,), (1000,)))]
    for name, text in tables.items():
        path = tmp_path / name
        path.write_text(text)
        ears = read_audiograms(path)
        assert [(row["listener"], ear) for row, ear in ears] == expected
        sides = [EAR_NAMES[row["ear"].lower()] for row, _ in ears]
        assert sides == ["left", "right", "left"]
        people = read_listeners(path)
        assert people == {"A": Listener(left, right), "B": Listener(expected[2][1], None)}


def test_a_data_frame_is_read_as_a_file_is() -> None:
    pandas = pytest.importorskip("pandas")
    columns = {"listener": ["A", "A"], "ear": ["L", "R"], 500: [20.0, None], "4 kHz": [30, 45]}
    frame = pandas.DataFrame(columns, index=[7, 9])
    left, right = Audiogram((20, 30), (500, 4000)), Audiogram((45,), (4000,))
    assert [ear for _, ear in read_audiograms(frame)] == [left, right]
    assert read_listeners(frame, ["A"]) == {"A": Listener(left, right)}
    with pytest.raises(ValueError, match="the table: no listener 'B'"):
        read_listeners(frame, ["B"])
    with pytest.raises(ValueError, match="row 9: column 4 kHz is '450'"):
        read_audiograms(frame.assign(**{"4 kHz": [30, 450]}))
    with pytest.raises(ValueError, match="no rows"):
        read_audiograms(frame[:0])
    with pytest.raises(ValueError, match="ear appears twice"):
        read_audiograms(frame.rename(columns={"listener": "ear"}))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ("hl_500,HL_500,listener,ear", "line 2: columns 'hl_500' and 'HL_500' .*same frequency"),
        ("hl_500,listener,Ear,ear", "ears.csv: the column ear appears twice"),
    ],
)
def test_columns_that_differ_in_capitals_are_not_one_column(
    tmp_path: Path, columns: str, message: str
) -> None:
    path = tmp_path / "ears.csv"
    path.write_text(f"{columns}\n20,60,A,L\n")
    for read in (read_audiograms, read_listeners):
        with pytest.raises(ValueError, match=message):
            read(path)


def test_the_guide_reads_nhanes(monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = pytest.importorskip("pandas")
    guide = (ROOT / "docs/guide/ears.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(import pandas\n.*?)```", guide, re.DOTALL)
    codes = ("500", "1K1", "2K", "3K", "4K", "6K", "8K")
    columns = ["SEQN", "AUXU1K2R", *(f"AUXU{code}{ear}" for code in codes for ear in "LR")]
    rows = [
        [93703.0, 15.0, *(5.0 * n for n in range(14))],
        [93704.0, 15.0, *([None] * 14)],
        [93705.0, 15.0, 10.0, 666.0, *([None] * 11), 888.0],
    ]
    monkeypatch.setattr(pandas, "read_sas", lambda path: pandas.DataFrame(rows, columns=columns))
    names: dict[str, Any] = {"hlsim": hlsim}
    exec(program, names)
    hz = (500, 1000, 2000, 3000, 4000, 6000, 8000)
    both = [Audiogram(tuple(5.0 * n for n in range(first, 14, 2)), hz) for first in (0, 1)]
    expected = {"93703": Listener(*both), "93705": Listener(Audiogram((10,), (500,)), None)}
    assert names["people"] == expected
