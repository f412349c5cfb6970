"""Sections of text, tables, pictures and players, as Markdown or as one HTML file, and the files of a report.

Nothing is fetched and no script runs in the HTML: pictures and sounds are data in the page, and its policy forbids
the rest. It reads on a phone's width (wide tables scroll by themselves) and by keyboard (a skip link, regions that take
the focus).
"""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hlsim.extras import require
from hlsim.files import Whole
from hlsim.report.tables import Table


@dataclass(frozen=True)
class Picture:
    """An SVG or PNG file's contents, with the words that stand for it where it is not seen."""

    data: bytes
    alt: str
    caption: str = ""


@dataclass(frozen=True)
class Player:
    """A FLAC or WAV file's contents, to be played."""

    data: bytes
    label: str


@dataclass(frozen=True)
class Section:
    """A part of a page, in this order: paragraphs, tables, pictures, players, and inner parts.

    Args:
        folded: shown only when it is opened.
    """

    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    players: Sequence[Player] = ()
    sections: Sequence[Section] = ()
    folded: bool = False


def render_page(title: str, sections: Sequence[Section], lead: str = "") -> str:
    """HTML. All text is escaped; ``lead`` stands under the title."""
    return str(_template().render(title=title, sections=sections, lead=lead)) + "\n"


def render_markdown(title: str, sections: Sequence[Section], lead: str = "") -> str:
    """Text and tables; what is drawn, played, folded or in parts of parts is on the page alone. Tags stay text."""
    blocks = [f"# {title}", *([lead] if lead else [])]
    for section in sections:
        if (section.paragraphs or section.tables) and not (section.sections or section.folded):
            blocks += [f"## {section.title}", *section.paragraphs]
            blocks += [f"**{table.caption}**\n\n{table.markdown()}" for table in section.tables]
    return re.sub(r"<(?=[A-Za-z/!?])", "&lt;", "\n\n".join(blocks)) + "\n"


def write_files(out: str | Path, contents: Mapping[str, str | bytes]) -> Path:
    """Write files into a folder, there or not, by name; others in it stay. Returns the folder; ValueError if it cannot.

    All are written under hidden names in it before the first takes its name.
    """
    folder = check_out(out)
    there = folder.exists()
    try:
        with ExitStack() as stack:
            files = [stack.enter_context(Whole(folder / name)) for name in contents]
            for file, data in zip(files, contents.values(), strict=True):
                file.write(data)
            for file in files:
                file.keep()
    finally:
        if not there and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    return folder


def check_out(out: str | Path) -> Path:
    """The folder that a report goes to, or ValueError where it cannot be: to be known before hours of scoring."""
    folder = Path(out).absolute()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir():
        raise ValueError(f"{there}: not a folder; a report needs a folder, there or not")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{there}: no permission to write a report there")
    return folder


@cache
def _template() -> Any:
    jinja2 = require("jinja2", "eval")
    source = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(source, {"uri": _uri})


def _uri(data: bytes) -> str:
    """Of a file's contents, whose kind its first bytes tell."""
    kinds = {b"\x89PNG": "image/png", b"fLaC": "audio/flac", b"RIFF": "audio/wav"}
    kind = kinds.get(data[:4], "image/svg+xml")
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
