"""The manifest: rows as they were written, read from their places, and paths that stay below the root."""

import pickle
from pathlib import Path

import pytest

from hlsim.data.manifest import UTTERANCE_COLUMNS, Rows, Utterance, csv_line, inside


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    rows = [
        Utterance(
            'a, "b"', "ö", "train", "c/a.wav", "n/a.wav", "bus", 5.0, None, 16000, 1.5, -20.25
        ),
        Utterance("b", "s", "valid", "b.wav", "", "noise/x.wav", -2.5, 1.25, 48000, 2.0, -30.5),
        Utterance("c", "s", "test", "c.wav", rate=44100, seconds=0.75, active_level=1.0),
    ]
    text = csv_line(UTTERANCE_COLUMNS) + "".join(csv_line(row.to_row().values()) for row in rows)
    (tmp_path / "m.csv").write_text(text, encoding="utf-8")
    read = Rows(tmp_path / "m.csv", UTTERANCE_COLUMNS)
    for source in (read, pickle.loads(pickle.dumps(read))):
        assert len(source) == 3
        assert [Utterance.from_row(row) for row in source] == rows
        assert Utterance.from_row(source[-1]) == rows[2]
    assert [row.mixed for row in rows] == [False, True, False]


def test_what_is_no_manifest_is_named(tmp_path: Path) -> None:
    path = tmp_path / "m.csv"
    with pytest.raises(ValueError, match="cannot be read"):
        Rows(path, UTTERANCE_COLUMNS)
    path.write_text("id,speaker\na,b\n")
    with pytest.raises(ValueError, match="no column split, clean"):
        Rows(path, UTTERANCE_COLUMNS)
    path.write_text(csv_line(UTTERANCE_COLUMNS) + "a,b\n")
    with pytest.raises(ValueError, match="line 2: 2 cells"):
        Rows(path, UTTERANCE_COLUMNS)[0]
    path.write_bytes(csv_line(UTTERANCE_COLUMNS).encode() + b"\xff\n")
    with pytest.raises(ValueError, match="line 2: cannot be read as CSV"):
        Rows(path, UTTERANCE_COLUMNS)[0]
    row = Utterance("a", "b", "train", "c", rate=1).to_row()
    for changed, said in (
        ({"rate": "fast"}, "no row of a manifest"),
        ({"split": "dev"}, "split 'dev'; allowed: train"),
    ):
        with pytest.raises(ValueError, match=said):
            Utterance.from_row(row | changed)


def test_no_path_leads_out_of_the_root(tmp_path: Path) -> None:
    root, outside = tmp_path / "root", tmp_path / "outside"
    for folder in (root / "a", outside):
        folder.mkdir(parents=True)
        (folder / "x.wav").write_text("x")
    (root / "link.wav").symlink_to(outside / "x.wav")
    (root / "folder").symlink_to(outside)
    (root / "within.wav").symlink_to(root / "a" / "x.wav")
    (root / "loop.wav").symlink_to(root / "loop.wav")
    assert (
        inside(root, "loop.wav") == root / "loop.wav"
    )  # to be refused as a file that is not there
    (tmp_path / "root2").mkdir()
    assert inside(root, "a/x.wav") == root / "a" / "x.wav"
    assert inside(root, "within.wav").read_text() == "x"
    for bad in (
        "../outside/x.wav",
        str(outside / "x.wav"),
        "a/../a/x.wav",
        "link.wav",
        "folder/x.wav",
        "a/../../root2/x",
    ):
        with pytest.raises(ValueError, match="leads out of") as caught:
            inside(root, bad)
        assert str(caught.value).startswith(bad)
    linked = tmp_path / "linked"
    linked.symlink_to(root)
    assert inside(linked, "a/x.wav").read_text() == "x"
