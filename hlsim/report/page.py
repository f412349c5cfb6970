"""One self-contained HTML file: sections with text, tables, pictures and audio players.

Nothing is fetched and no script runs: pictures and sounds are data in the page, and its own policy forbids the rest. It
reads on a phone's width (wide tables scroll by themselves) and by keyboard (a skip link, regions that take the focus).
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

_POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"

_STYLE = """
:root { color-scheme: light; --ink: #1a1a1a; --soft: #555; --line: #bbb; --shade: #f2f4f7; --link: #0b4f9e; }
* { box-sizing: border-box; }
body { margin: 0; font: 1rem/1.55 system-ui, sans-serif; color: var(--ink); background: #fff; }
header, nav, main { max-width: 70rem; margin: 0 auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 1.2rem 0 .4rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .5rem; border-top: 1px solid var(--line); padding-top: 1rem; }
h3 { font-size: 1.05rem; margin: 1.4rem 0 .3rem; overflow-wrap: anywhere; }
p, li { max-width: 44rem; overflow-wrap: anywhere; }
a { color: var(--link); }
nav ul { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; list-style: none; padding: 0; margin: .5rem 0; }
nav a { display: inline-block; padding: .35rem 0; }
summary { padding: .35rem 0; cursor: pointer; }
:focus-visible { outline: 3px solid var(--link); outline-offset: 2px; }
.skip { position: absolute; left: -100vw; background: #fff; padding: .5rem 1rem; }
.skip:focus { left: 0; z-index: 1; }
.lead { font-size: 1.1rem; }
.scroll { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .95rem; }
caption { text-align: left; color: var(--soft); padding: .3rem 0; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
thead th { background: var(--shade); }
td { white-space: nowrap; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 20rem), 1fr)); gap: 1rem; }
figure { margin: 0; }
figure img { display: block; width: 100%; max-width: 42rem; height: auto; }
figcaption { color: var(--soft); font-size: .9rem; }
.players { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 18rem), 1fr)); gap: .8rem; }
audio { display: block; width: 100%; }
@media (max-width: 30rem) {
  table { font-size: .82rem; }
  th, td { padding: .25rem .3rem; }
  td { white-space: normal; }
}
@media print { nav, .skip { display: none; } }
"""


@dataclass(frozen=True)
class Table:
    """Cells of text; the first column names the rows."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


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
    """A part of a page, in this order: paragraphs, tables, pictures, players, and parts of its own.

    Args:
        folded: shown only when it is opened.
    """

    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    players: Sequence[Player] = ()
    sections: Sequence[Section] = field(default_factory=tuple)
    folded: bool = False


def render_page(title: str, sections: Sequence[Section], lead: str = "") -> str:
    """The page as HTML. All text is escaped; ``lead`` stands under the title."""
    links = "".join(f'<li><a href="#s{i}">{escape(s.title)}</a></li>' for i, s in enumerate(sections))
    body = "\n".join(_section(section, f"s{i}", 2) for i, section in enumerate(sections))
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<a class="skip" href="#main">Skip to the report</a>
<header><h1>{escape(title)}</h1>{f'<p class="lead">{escape(lead)}</p>' if lead else ""}</header>
<nav aria-label="Sections"><ul>{links}</ul></nav>
<main id="main" tabindex="-1">
{body}
</main>
</body>
</html>
"""


def _section(section: Section, name: str, depth: int) -> str:
    parts = [f"<p>{escape(text)}</p>" for text in section.paragraphs]
    parts += [_table(table) for table in section.tables]
    if section.pictures:
        parts.append('<div class="figures">' + "".join(map(_picture, section.pictures)) + "</div>")
    if section.players:
        parts.append('<div class="players">' + "".join(map(_player, section.players)) + "</div>")
    parts += [_section(inner, f"{name}-{i}", depth + 1) for i, inner in enumerate(section.sections)]
    content = "\n".join(parts)
    if section.folded:
        content = f"<details><summary>Show {escape(section.title)}</summary>\n{content}\n</details>"
    heading = f'<h{depth} id="{name}-title">{escape(section.title)}</h{depth}>'
    return f'<section id="{name}" aria-labelledby="{name}-title">\n{heading}\n{content}\n</section>'


def _table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.header)
    rows = "\n".join(f'<tr><th scope="row">{escape(row[0])}</th>{_cells(row[1:])}</tr>' for row in table.rows)
    # a region that scrolls must take the focus, or the keyboard cannot scroll it
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(table.caption)}"><table>'
        f"<caption>{escape(table.caption)}</caption>\n<thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody></table></div>"
    )


def _cells(cells: Sequence[str]) -> str:
    if len(cells) > 1 and cells[-1] and not any(cells[:-1]):
        # a figure of the whole row: on a phone it has no room at the end of it
        return f'<td colspan="{len(cells)}">{escape(cells[-1])}</td>'
    return "".join(f"<td>{escape(cell)}</td>" for cell in cells)


def _picture(picture: Picture) -> str:
    kind = "png" if picture.data.startswith(b"\x89PNG") else "svg+xml"
    caption = f"<figcaption>{escape(picture.caption)}</figcaption>" if picture.caption else ""
    source = f"data:image/{kind};base64,{_encoded(picture.data)}"
    return f'<figure><img src="{source}" alt="{escape(picture.alt)}">{caption}</figure>'


def _player(player: Player) -> str:
    kind = "flac" if player.data.startswith(b"fLaC") else "wav"
    source = f"data:audio/{kind};base64,{_encoded(player.data)}"
    label = escape(player.label)
    return (
        f'<figure><figcaption>{label}</figcaption><audio controls preload="metadata" aria-label="{label}" '
        f'src="{source}"></audio></figure>'
    )


def _encoded(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
