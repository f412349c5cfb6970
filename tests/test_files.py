"""Files and tables."""

import os
from pathlib import Path

import pytest

from hlsim.files import atomic_path, path_below, read_table, write_atomically


def test_a_file_takes_its_place_when_it_is_complete(tmp_path: Path) -> None:
    write_atomically(tmp_path / "new" / "a", "old")
    with pytest.raises(KeyboardInterrupt), atomic_path(tmp_path / "new" / "a") as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert (tmp_path / "new" / "a").read_text() == "old"
    write_atomically(tmp_path / "new" / "a", b"new")
    assert os.listdir(tmp_path / "new") == ["a"] and (tmp_path / "new" / "a").read_text() == "new"


def test_a_link_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "store" / "file")
    for text in ("new", "old"):
        write_atomically(tmp_path / "link", text)
        assert (tmp_path / "link").is_symlink()
        assert (tmp_path / "store" / "file").read_text() == text
    assert os.listdir(tmp_path / "store") == ["file"]


def test_links_may_lead_out_of_a_corpus_but_paths_may_not(tmp_path: Path) -> None:
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    (corpus / "bob").symlink_to(tmp_path)
    for name in ("bob/1.wav", "./bob/../bob/1.wav", str(corpus / "bob" / "1.wav")):
        assert path_below(corpus, name) == corpus / "bob" / "1.wav"
    # The system would look for this file beside the folder to which bob links.
    assert path_below(corpus, "bob/../1.wav") == corpus / "1.wav"
    for name in ("", "../1.wav", "bob/../../1.wav", "/1.wav", "../corpus2/1.wav"):
        with pytest.raises(ValueError, match="expected the path of a file below"):
            path_below(corpus, name)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=f"^{tmp_path}/file/a: cannot be written"):
        write_atomically(tmp_path / "file" / "a", "text")


@pytest.mark.parametrize(
    "text",
    ["a,b\n1,ü\n\n3,\n \n", "a;b\r\n1;ü\r\n3;\r\n", "a\tb\n1\tü\n3\t\n", " a , b\n 1,ü\n3,,\n"],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_tables_of_spreadsheets_are_read(tmp_path: Path, text: str, encoding: str) -> None:
    (tmp_path / "t.csv").write_bytes(text.encode(encoding))
    rows = [row for _, row in read_table(tmp_path / "t.csv", "a table")]
    assert rows == [{"a": "1", "b": "ü"}, {"a": "3", "b": ""}]


WITHOUT_MARK = "a,b\n1,2\n".encode("utf-16-le")


@pytest.mark.parametrize("data", [None, b"a,b\n1,2,3\n", b"a\n\x81\n", WITHOUT_MARK])
def test_tables_that_cannot_be_read_are_named(tmp_path: Path, data: bytes | None) -> None:
    if data is not None:
        (tmp_path / "t.csv").write_bytes(data)
    with pytest.raises(ValueError, match=r"t\.csv"):
        read_table(tmp_path / "t.csv", "a table")


def test_what_is_no_table_is_named() -> None:
    with pytest.raises(ValueError, match="CSV file or a pandas DataFrame for the ears, got list"):
        read_table([["A", 20]], "the ears")


def test_a_row_with_fewer_fields_than_the_header_is_named(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("a,b,c,\n1,2,3\n4,,\n5,6\n")
    with pytest.raises(ValueError, match=r"t\.csv, line 4: expected .* got 2, and none for c;"):
        read_table(path, "a table")
    path.write_text("a,b,c,\n1,2,3\n4,,\n,\n")
    assert [row["a"] for _, row in read_table(path, "a table")] == ["1", "4"]
