"""Tables of audiograms as spreadsheets, clinics and apps write them."""

from pathlib import Path

import pytest

import hlsim
from hlsim import Audiogram
from hlsim.audiogram import STANDARD
from hlsim.audiogram.table import read_audiograms

EARS_FILE = Path(__file__).parents[2] / "examples" / "ears.csv"


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
    ],
)
def test_columns_are_found_whatever_their_order_case_and_delimiter(
    tmp_path: Path, text: str
) -> None:
    assert read_text(tmp_path, text) == [Audiogram((10, 22.5, 30), (250, 500, 1000))]


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
        ("0.5,1,2\n10,20,30\n", ["line 2", "multiply kHz by 1000"]),
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
