"""Files and folders are there whole or not at all."""

from pathlib import Path

import pytest

from hlsim.files import Whole, file_lock, repair_folder, whole_folder, write_whole


def test_a_library_writes_under_the_temporary_name(tmp_path: Path) -> None:
    with Whole(tmp_path / "a") as file:
        file.partial.write_bytes(b"by a library")
        assert not (tmp_path / "a").exists()
        file.keep()
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_bytes() == b"by a library"
    with Whole(tmp_path / "a") as file:
        file.write("left without keep")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_folder_is_made_where_that_is_wanted(tmp_path: Path) -> None:
    write_whole(tmp_path / "new" / "a", "text")
    assert (tmp_path / "new" / "a").read_text() == "text"
    with pytest.raises(ValueError, match=r"other/a: cannot be written \(No such file"):
        Whole(tmp_path / "other" / "a", new_folder=False).__enter__()
    assert not (tmp_path / "other").exists()


def test_a_folder_takes_its_name_at_the_end(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "folder"
    for text in ("first", "second"):
        with whole_folder(folder) as staging:
            (staging / "a").write_text(text)
            assert folder.exists() == (text == "second")
        assert (folder / "a").read_text() == text
    with pytest.raises(KeyboardInterrupt), whole_folder(folder) as staging:
        (staging / "a").write_text("third")
        raise KeyboardInterrupt
    assert (folder / "a").read_text() == "second"
    assert [path.name for path in folder.parent.iterdir()] == ["folder"]


def test_what_a_kill_left_is_repaired(tmp_path: Path) -> None:
    for name in (".folder.old", ".folder.abcd_123", ".folder.er.abcd_123"):
        (tmp_path / name).mkdir()
    (tmp_path / ".folder.old" / "a").write_text("kept")
    repair_folder(tmp_path / "folder")
    assert {path.name for path in tmp_path.iterdir()} == {"folder", ".folder.er.abcd_123"}
    assert (tmp_path / "folder" / "a").read_text() == "kept"


def test_one_process_holds_a_file(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    (tmp_path / "a").touch()
    refused = pytest.raises(ValueError, match="another process is writing there")
    with file_lock(tmp_path / "a"), refused, file_lock(tmp_path / "a"):
        pass
    with file_lock(tmp_path / "a"):
        pass
