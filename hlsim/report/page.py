"""Pages: sections of text, tables, pictures and players, as one HTML file or as Markdown.

The HTML fetches nothing and runs no script: pictures and sounds are data in the page. It can be read on a
phone, where wide tables scroll by themselves, and with a keyboard.
"""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hlsim.extras import require
from hlsim.files import write_atomically


@dataclass(frozen=True)
class Table:
    """Cells of text; the first column names the rows. A folded table is shown when it is opened."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    folded: bool = False

    @classmethod
    def of(cls, caption: str, rows: Sequence[Mapping[str, str]], *, folded: bool = False) -> Table:
        """Make a table of rows by column title; all rows have the same titles."""
        header = list(rows[0]) if rows else []
        return cls(caption, header, [list(row.values()) for row in rows], folded)

    def markdown(self) -> str:
        """Return the table in Markdown, without the caption."""
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        escaped = [[cell.replace("|", "\\|") for cell in line] for line in lines]
        return "\n".join(f"| {' | '.join(line)} |" for line in escaped)

    def text(self) -> str:
        """Return the table for a terminal, without the caption."""
        lines = [self.header, *self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        return "\n".join(_aligned(line, widths) for line in lines)


def _aligned(line: Sequence[str], widths: Sequence[int]) -> str:
    """Align the first cell to the left and the others to the right."""
    first, *others = [(cell, width) for cell, width in zip(line, widths, strict=True)]
    cells = [first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)]
    return "  ".join(cells)


@dataclass(frozen=True)
class Picture:
    """Contents of an SVG or PNG file, a text for readers who do not see it, and a caption."""

    data: bytes
    alt: str
    caption: str = ""


@dataclass(frozen=True)
class Player:
    """Contents of a FLAC or WAV file to be played, and a picture of the sound."""

    data: bytes
    label: str
    picture: Picture | None = None


@dataclass(frozen=True)
class Section:
    """A part of a page: paragraphs, tables, players, pictures and inner parts, in this order.

    Args:
        folded: whether it is shown only when it is opened.
    """

    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    players: Sequence[Player] = ()
    sections: Sequence[Section] = ()
    folded: bool = False


@dataclass(frozen=True)
class Page:
    """A title, a verdict in one sentence, and the sections that support it."""

    title: str
    verdict: str
    sections: Sequence[Section]

    def html(self) -> str:
        """Return the page as one HTML file; all text is escaped."""
        return (
            str(_template().render(title=self.title, sections=self.sections, lead=self.verdict))
            + "\n"
        )

    def markdown(self) -> str:
        """Return text and tables without what is played or drawn; HTML tags stay text."""
        blocks = [f"# {self.title}", self.verdict, *_markdown_blocks(self.sections, depth=2)]
        return re.sub(r"<(?=[A-Za-z/!?])", "&lt;", "\n\n".join(filter(None, blocks))) + "\n"


def _markdown_blocks(sections: Sequence[Section], depth: int) -> list[str]:
    blocks: list[str] = []
    for section in sections:
        inner = [*section.paragraphs]
        inner += [f"**{table.caption}**\n\n{table.markdown()}" for table in section.tables]
        inner += _markdown_blocks(section.sections, depth + 1)
        if inner:
            blocks += [f"{'#' * depth} {section.title}", *inner]
    return blocks


def write_page(page: Page, data: Mapping[str, Any], out: str | Path) -> Path:
    """Write ``report.html``, ``report.md`` and ``report.json``, which holds the data, into a folder.

    Files of these names are replaced; others stay.

    Returns: the path of ``report.html``.

    Raises:
        ValueError: the files cannot be written, or JSON cannot hold the data.
        MissingExtraError: jinja2 is not installed.
    """
    folder = check_out(out)
    try:
        text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the results cannot be written as JSON: {error}") from error
    contents = {
        "report.json": f"{text}\n",
        "report.md": page.markdown(),
        "report.html": page.html(),
    }
    for name, content in contents.items():
        write_atomically(folder / name, content)
    return folder / "report.html"


def check_out(out: str | Path) -> Path:
    """Return the folder of a report; ValueError if no report can be written there."""
    folder = Path(out).absolute()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        raise ValueError(f"{existing} is not a folder, so that no report can be written there")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise ValueError(f"there is no permission to write a report into {existing}")
    return folder


@cache
def _template() -> Any:
    jinja2 = require("jinja2", "eval")
    source = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(source, {"uri": data_uri})


def data_uri(data: bytes) -> str:
    """Return the contents of a file as a URI; its first bytes tell its kind."""
    kinds = {b"\x89PNG": "image/png", b"fLaC": "audio/flac", b"RIFF": "audio/wav"}
    kind = kinds.get(data[:4], "image/svg+xml")
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
