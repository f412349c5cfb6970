"""One HTML file with everything in it: escaped, closed, and without an address."""

import base64
import hashlib
import re
import time
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from hlsim.evaluation.result import Evaluation
from hlsim.progress import ProgressLine
from hlsim.report.page import Card, Page, Picture, Player, Section, Sound, Table
from hlsim.report.writing import write_results

VOID_TAGS = {"meta", "link", "img", "input", "br"}


class Balance(HTMLParser):
    """Checks that every element that is opened is closed, in order, and notes attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID_TAGS:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


NASTY = '<script>alert("x")</script> & \'quotes\' "too"'


def page() -> str:
    sound = Sound(NASTY, 60.0, b"RIFF123", -30.0, b"\x89PNG")
    inner = Section("Inner", player=Player({NASTY: [sound, sound]}, 1.0, 90.0))
    table = Table(NASTY, ("a", NASTY), [(NASTY, "1"), ("b", "2")])
    pictures = [Picture(lambda: b"\x89PNG", NASTY, NASTY), Picture(lambda: b"<svg/>", "svg")]
    sections = [
        Section(NASTY, paragraphs=[NASTY], tables=[table]),
        Section("Pictures", pictures=pictures, sections=[inner]),
        Section("Folded", paragraphs=["text"], folded=True),
    ]
    return Page(NASTY, f"{NASTY} (5 items).", sections, [Card(NASTY, "1", NASTY, [])]).html()


def test_everything_is_escaped_and_closed() -> None:
    text = page()
    parser = Balance()
    parser.feed(text)
    assert parser.open == []
    # the player's script is the only one, and the page's policy runs no other
    assert text.count("<script") == 1 and text.count("&lt;script&gt;") >= 12
    [script] = re.findall(r"<script>(.*)</script>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'\"" in text
    assert ("img", "alt", NASTY) in parser.attributes
    assert ("audio", "aria-label", NASTY) in parser.attributes


def test_nothing_is_fetched() -> None:
    parser = Balance()
    parser.feed(page())
    names = ("src", "href", "data", "srcset")
    addresses = [value for _, name, value in parser.attributes if name in names]
    assert len(addresses) == 2 + 4 + 1 + 1 + 3  # pictures, sounds, icon, skip link, sections
    assert all(value.startswith(("data:", "#")) for value in addresses)
    types = {value[5:].split(";")[0] for value in addresses if ";" in value}
    assert types == {"image/png", "image/svg+xml", "audio/wav"}
    assert "url(" not in page() and "@import" not in page()
    assert "default-src 'none'" in page()


def test_links_lead_to_sections_and_tables_take_the_focus() -> None:
    text = page()
    names = set(re.findall(r' id="([^"]+)"', text))
    assert set(re.findall(r'href="#([^"]+)"', text)) <= names
    assert re.findall(r"<h(\d)", text) == ["1", "2", "2", "3", "2"]
    assert text.count('role="region" tabindex="0"') == text.count('class="scroll"') == 1
    assert '<html lang="en">' in text and "width=device-width" in text
    assert text.count('<details class="folded">') == text.count("<summary>") == 1


def test_numbers_at_the_end_of_the_verdict_are_printed_smaller() -> None:
    text = Page("Aids", "Mine (new) is better: 0.9 (10 items; p = 0.01).", []).html()
    verdict = "Mine (new) is better: 0.9 <small>(10 items; p = 0.01).</small>"
    assert f'<p class="verdict">{verdict}</p>' in text
    assert '<p class="verdict">' not in Page("Aids", "", []).html()


def test_columns_without_values_are_left_out_of_a_table() -> None:
    rows = [{"Aid": "a", "SNR": "n/a", "n": "n/a"}, {"Aid": "b", "SNR": "n/a", "n": "1"}]
    table = Table.from_rows("Scores", rows)
    assert (table.header, table.rows) == (["Aid", "n"], [["a", "n/a"], ["b", "1"]])


def test_names_have_no_meaning_in_markdown() -> None:
    name = "![x](http://a.b/c.png) *a* `b` | [l][u] ~~c~~ <img> _d_ [r]: e"
    section = Section(name, [name, f"# {name}", f"> {name}"], [Table(name, (name,), [(name,)])])
    text = Page(name, name, [section]).markdown()
    assert not re.search(r"\][(:\[]|<img", text)
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) == 3
    assert all(len(re.findall(r"(?<!\\)\|", row)) == 2 for row in rows)
    assert all(not re.search(r"(?<!\\)[*`~]", row) for row in rows)
    assert "\n\\# " in text
    assert "\n\\> " in text
    assert "[0.1, 0.2]" in Page("p", "an interval [0.1, 0.2]", []).markdown()


def write(title: str, folder: Path, *sections: Section) -> None:
    """Write a page without scores."""
    table = pytest.importorskip("pandas").DataFrame()
    write_results(Page(title, "", sections), Evaluation([], [], [], table), folder)


def test_a_file_that_cannot_be_written_leaves_all_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("first", tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    write_text = Path.write_text

    def fill_disk(path: Path, *arguments: Any, **settings: Any) -> int:
        if path.name == "report.html":
            raise OSError(28, "No space left on device")
        return write_text(path, *arguments, **settings)

    monkeypatch.setattr(Path, "write_text", fill_disk)
    with pytest.raises(ValueError, match="No space left on device"):
        write("second", tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_each_value_of_a_wide_table_has_the_title_of_its_column_on_a_phone() -> None:
    header = ("Condition", "n", "HASPI", "Level")
    tables = [
        Table("wide", header, [("a", "12", "0.5 ± 0.1", "65")]),
        Table("narrow", ("a", "b"), []),
    ]
    text = Page("p", "", [Section("s", tables=tables)]).html()
    assert re.findall(r'<td data-title="(.*?)">', text) == ["n", "HASPI", "Level"]
    assert text.count('<table class="wide">') == 1


def test_pictures_are_counted_while_they_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("hlsim.progress._TICK", 0.01)
    monkeypatch.setattr("hlsim.progress._LINE_INTERVAL", 0.02)

    def draw() -> bytes:
        printed, end = "", time.monotonic() + 10.0
        while "1 of 2 pictures" not in printed and time.monotonic() < end:
            time.sleep(0.02)
            printed += capsys.readouterr().err
        assert "1 of 2 pictures (50%)" in printed
        return b"<svg/>"

    pictures = [Picture(lambda: b"<svg/>", "quick"), Picture(draw, "slow")]
    inner = Section("Details", sections=[Section("Pictures", pictures=pictures)])
    with ProgressLine("scores"):
        write("Aids", tmp_path, inner)
