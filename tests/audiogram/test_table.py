"""Tables of audiograms: round trips, what spreadsheets write, and refusals that name file and line."""

from pathlib import Path

import pytest

from hlsim.audiogram import Audiogram
from hlsim.audiogram.table import read_audiograms


def test_csv_round_trip(tmp_path: Path) -> None:
    ears = [Audiogram.standard(name) for name in ("N1", "S3")]
    lines = [",".join(("file", *ears[0].to_row()))]
    lines += [
        ",".join((name, *ear.to_row().values())) for name, ear in zip("ab", ears, strict=True)
    ]
    (tmp_path / "ears.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    read = read_audiograms(tmp_path / "ears.csv")
    assert [ear for _, ear in read] == ears
    assert [row["file"] for row, _ in read] == ["a", "b"]


def test_csv_of_a_spreadsheet_keeps_its_first_column(tmp_path: Path) -> None:
    (tmp_path / "ears.csv").write_bytes(b"\xef\xbb\xbfhl_250,hl_500\r\n10,20\r\n")
    ((_, ear),) = read_audiograms(tmp_path / "ears.csv")
    assert ear == Audiogram((10.0, 20.0), (250.0, 500.0))


def test_csv_with_blanks_after_its_commas(tmp_path: Path) -> None:
    path = tmp_path / "ears.csv"
    path.write_text("file, hl_250 , hl_500, ,\na b.wav , 10, 20 ,,\n", encoding="utf-8")
    assert read_audiograms(path) == [
        (
            {"file": "a b.wav", "hl_250": "10", "hl_500": "20"},
            Audiogram((10.0, 20.0), (250.0, 500.0)),
        )
    ]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "no audiograms"),
        ("hl_250,hl_500\n", "no audiograms"),
        ("hl_250,hl_500\n10,20\n10,x\n", "line 3"),
        ("hl_250,hl_500\n10\n", "line 2"),
        ("hl_250,hl_500\n10,20\n10,200\n", "line 3"),
        ("hl_500,hl_250\n10,20\n", "line 2"),
        ("left,right\n10,20\n", "line 2"),
        (
            "hl_250,hl_1k\n10,20\n",
            "line 2",
        ),
        ("hl_250,HL_500\n10,20\n", "line 2"),
        ("hl_250,hl4000\n10,20\n", "line 2"),
        ("hl_250,hl_8000dB\n10,20\n", "line 2"),
        ("hl_250,hl_500, hl_500\n10,20,30\n", "line 1"),
        ("hl_500,hl_500.0\n10,20\n", "line 2"),
        ("hl_250,hl_500\n10,2,5\n", "line 2"),
        ("hl_250,hl_500\n\n\n10,x\n", "line 4"),
    ],
)
def test_csv_errors_begin_with_the_file_and_name_the_line(
    tmp_path: Path, content: str, said: str
) -> None:
    path = tmp_path / "ears.csv"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ValueError, match=said) as caught:
        read_audiograms(path)
    assert str(caught.value).startswith(str(path))


def test_csv_of_an_ear_that_no_simulator_takes(tmp_path: Path) -> None:
    path = tmp_path / "ears.csv"
    path.write_text("hl_250,hl_8000\n10,20\n90,105\n", encoding="utf-8")
    assert len(read_audiograms(path)) == 2
    with pytest.raises(ValueError, match="line 3"):
        read_audiograms(path, simulated=True)


def test_csv_errors_of_files_that_are_none(tmp_path: Path) -> None:
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"hl_250\n\xff\xfe\x80\n")
    for path in (tmp_path / "missing.csv", tmp_path, binary):
        with pytest.raises(ValueError) as caught:
            read_audiograms(path)
        assert str(caught.value).startswith(str(path))
