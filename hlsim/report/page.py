"""Pages: sections of text, tables, players and pictures, as one HTML file or as Markdown.

The HTML fetches nothing: pictures and sounds are data in the page, and its only script is that of
the players. It can be read with a keyboard, and on a phone, where each value of a wide table has a
line of its own. The templates are in the folder ``templates``.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from hlsim.extras import require
from hlsim.files import write_atomically

SPECTROGRAM_LEVELS = (0.0, 90.0)
"""Levels in dB SPL of a bin of 50 Hz at the lower and the upper end of the colour scale."""

SPECTROGRAM_COLOURS = ("#000004", "#3b0f70", "#8c2981", "#de4968", "#fe9f6d", "#fcfdbf")
"""Colours from the lowest level of a spectrogram to the highest, those of matplotlib's magma."""

_TEMPLATES = Path(__file__).with_name("templates")


@dataclass(frozen=True)
class Table:
    """A table of texts.

    Attributes:
        caption: Caption.
        header: Titles of the columns.
        rows: Texts of each row, one per column. The first is the name of the row.

    >>> Table.from_rows("Scores", [{"Aid": "NAL-R", "HASPI": "0.93"}]).header
    ['Aid', 'HASPI']
    """

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    @classmethod
    def from_rows(cls, caption: str, rows: Sequence[Mapping[str, str]]) -> Table:
        """Build a table from rows, without columns that are "n/a" in all rows.

        Args:
            caption: Caption.
            rows: One dict per row from the title of a column to its text. All rows have the same
                titles.
        """
        titles = rows[0] if rows else ()
        header = [title for title in titles if any(row[title] != "n/a" for row in rows)]
        return cls(caption, header, [[row[title] for title in header] for row in rows])

    def text(self) -> str:
        """Return the table as text for a terminal, without caption and title of the first column.

        Raises:
            MissingExtraError: pandas is not installed.

        >>> print(Table("Scores", ("Aid", "HASPI"), [("none", "0.27"), ("NAL-R", "0.9")]).text())
              HASPI
        none   0.27
        NAL-R   0.9
        """
        frame = require("pandas", "eval").DataFrame(self.rows, columns=self.header)
        return frame.set_index(self.header[0]).rename_axis(None).to_string()


@dataclass(frozen=True)
class Picture:
    """A picture of a page, which is drawn when it is needed.

    Attributes:
        draw: Function that returns the contents of an SVG or PNG file.
        title: Heading above the picture, and text for readers who do not see it.
        note: Sentence below the picture.

    >>> Picture(lambda: b"<svg/>", "An empty picture").data
    b'<svg/>'
    """

    draw: Callable[[], bytes]
    title: str
    note: str = ""

    @cached_property
    def data(self) -> bytes:
        """Contents of the SVG or PNG file, which is drawn at the first access."""
        return self.draw()


@dataclass(frozen=True)
class Sound:
    """One sound of a player.

    Attributes:
        label: Name on the button.
        level: Level in dB SPL, which is shown beside the name.
        audio: Contents of a WAV file.
        loudness: RMS level of the WAV file in dB relative to full scale, an RMS of 1.0.
        spectrogram: Contents of a PNG file with the spectrogram, without axes or margins.
        note: Text on the spectrogram, which says why it is black; empty if it is not.

    >>> Sound("unaided", 10.2, b"RIFF", -30.0, b"\\x89PNG").label
    'unaided'
    """

    label: str
    level: float
    audio: bytes
    loudness: float
    spectrogram: bytes
    note: str = ""


@dataclass(frozen=True)
class Player:
    """A player with which a reader of a page compares sounds, such as outputs of hearing aids.

    A notebook displays it. A sound to which the reader switches continues at the position of the
    one before.

    Attributes:
        groups: Sounds by the heading of their group, which may be empty. The sounds of a group have
            one gain.
        seconds: Duration of the longest sound in seconds.
        full_scale: Level in dB SPL of a signal with RMS 1.0 in the WAV files of the first group.

    >>> sounds = [Sound("unaided", 10.2, b"RIFF", -30.0, b"\\x89PNG")]
    >>> player = Player({"": sounds}, seconds=4.0, full_scale=94.0)
    >>> player.sounds[0].label
    'unaided'
    """

    groups: Mapping[str, Sequence[Sound]]
    seconds: float
    full_scale: float

    @property
    def sounds(self) -> list[Sound]:
        """All sounds of the player, in order."""
        return [sound for group in self.groups.values() for sound in group]

    def __repr__(self) -> str:
        levels = ", ".join(f"{sound.label} {sound.level:.0f} dB SPL" for sound in self.sounds)
        return f"Player({levels})"

    def _repr_html_(self) -> str:
        """Return the player as HTML for a notebook, with its sounds, style and script embedded."""
        return _render("fragment.html", player=self)

    def save(self, path: str | Path) -> None:
        """Write the player as one HTML file, which a browser opens offline.

        Args:
            path: File to write.

        Raises:
            ValueError: The file cannot be written.
            MissingExtraError: jinja2 is not installed.
        """
        title = ", ".join(sound.label for sound in self.sounds)
        title = title[:1].upper() + title[1:]
        page = Page(title, "", [Section("Listen", player=self)])
        write_atomically(Path(path), page.html())


@dataclass(frozen=True)
class Card:
    """A number at the top of a page that a reader should remember, with bars that compare it.

    Attributes:
        title: Name of the number.
        value: The number, as text.
        meaning: Sentence that explains the number.
        bars: Name, number as text, and length of the bar from 0 to 1 of each condition. The bar of
            the last condition is highlighted.

    >>> card = Card("HASPI", "0.93", "Predicted intelligibility.", [("NAL-R", "0.93", 0.93)])
    >>> "width: 93.0%" in Page("Aids", "", [], [card]).html()
    True
    """

    title: str
    value: str
    meaning: str
    bars: Sequence[tuple[str, str, float]]


@dataclass(frozen=True)
class Section:
    """A part of a page.

    Attributes:
        title: Heading.
        paragraphs: Paragraphs of text, below the tables.
        tables: Tables.
        pictures: Pictures, below the player.
        player: Player of sounds, below the paragraphs.
        sections: Inner sections, at the end.
        folded: Whether the page shows only the heading until a reader opens the section.

    >>> Section("Scores", ["The mean of ten items."]).folded
    False
    """

    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    player: Player | None = None
    sections: Sequence[Section] = ()
    folded: bool = False


@dataclass(frozen=True)
class Page:
    """A page about the results of an evaluation.

    Attributes:
        title: Heading.
        verdict: Result in one sentence, below the heading.
        sections: Sections of the page, in their order.
        cards: Numbers to remember, above the verdict.

    >>> print(Page("Aids", "NAL-R is better.", [Section("Scores", ["See below."])]).markdown())
    # Aids
    <BLANKLINE>
    NAL-R is better.
    <BLANKLINE>
    ## Scores
    <BLANKLINE>
    See below.
    <BLANKLINE>
    """

    title: str
    verdict: str
    sections: Sequence[Section]
    cards: Sequence[Card] = ()

    def html(self) -> str:
        """Return the page as the text of one HTML file, which needs no network.

        Raises:
            MissingExtraError: jinja2 is not installed.
        """
        return _render("page.html", page=self)

    def markdown(self) -> str:
        """Return text and tables in Markdown, without sounds and pictures.

        Characters of the texts that have a meaning in Markdown are escaped.

        Raises:
            MissingExtraError: jinja2 is not installed.
        """
        return _render("page.md", page=self)


@cache
def _environment() -> Any:
    """Return jinja2's environment with the templates and the script of the players.

    Raises:
        MissingExtraError: jinja2 is not installed.
    """
    jinja2 = require("jinja2", "eval")
    loader = jinja2.FileSystemLoader(_TEMPLATES)
    environment = jinja2.Environment(
        loader=loader,
        autoescape=jinja2.select_autoescape(["html"]),
        undefined=jinja2.StrictUndefined,
    )
    script = (_TEMPLATES / "player.js").read_text(encoding="utf-8")
    digest = hashlib.sha256(script.encode()).digest()
    environment.globals |= {
        "script": script,
        "script_hash": base64.b64encode(digest).decode(),
        "levels": SPECTROGRAM_LEVELS,
        "colours": SPECTROGRAM_COLOURS,
    }
    environment.filters["uri"] = _data_uri
    environment.filters["plain"] = _escape_markdown
    return environment


def _render(template: str, **values: Any) -> str:
    return _environment().get_template(template).render(**values) + "\n"


def _escape_markdown(text: str) -> str:
    """Escape the characters of a text that have a meaning in Markdown, and join its lines.

    Closing brackets have a meaning only before a parenthesis, a colon or other brackets.
    """
    marks = r"([\\`*|~]|(?<!\w)_|_(?!\w)|^>|^[#+-](?=[\s#])|(?<=\])[(:\[])"
    return re.sub(r"<(?=[A-Za-z/!?])", "&lt;", re.sub(marks, r"\\\1", " ".join(text.split())))


def _data_uri(data: bytes) -> str:
    """Return the contents of a PNG, WAV or SVG file as a data URI, with base64."""
    types = {b"\x89PNG": "image/png", b"RIFF": "audio/wav"}
    media_type = types.get(data[:4], "image/svg+xml")
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"
