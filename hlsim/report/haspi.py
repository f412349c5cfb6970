"""A report's files, written whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path

from hlsim.evaluation.scores import HaspiReport
from hlsim.report.haspi_page import html
from hlsim.report.haspi_text import latex
from hlsim.report.pictures import draw_report

REPORT_FILES = ("report.json", "report.md", "report.tex", "report.html", "before-after.png")


def write_report(report: HaspiReport, out_dir: str | Path, *, listen: int = 3) -> Path:
    """Write ``report.json``, ``.md``, ``.tex``, ``.html`` and ``before-after.png`` into a folder, there or not.

    All are written into a hidden folder in it first and then moved, so that no file is ever half there. Reports of an
    earlier run are replaced, other files stay.

    Args:
        listen: how many items the page shows with spectrograms and players, where their files are known.

    Returns: the folder.

    Raises:
        ValueError: the path is no folder or cannot be written, or an extra value is nothing that JSON can hold, such
            as NaN.
        MissingExtraError: matplotlib is not installed.
    """
    out = check_out(out_dir)
    try:
        text = json.dumps(report.to_dict(), indent=2, ensure_ascii=False, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"report cannot be written as JSON: {error}") from error
    texts = {
        "report.json": text + "\n",
        "report.md": report.to_markdown(),
        "report.tex": latex(report),
        "report.html": html(report, listen),
    }
    partial, there = None, out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        # in it, not beside it: it may be the root of a drive
        partial = Path(tempfile.mkdtemp(prefix=".report.", suffix=".part", dir=out))
        for name, content in texts.items():
            (partial / name).write_text(content, encoding="utf-8")
        draw_report(report, partial / "before-after.png")
        for name in REPORT_FILES:
            (partial / name).replace(out / name)
    except OSError as error:
        raise ValueError(f"{out}: report cannot be written ({error})") from error
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
        if not there and out.is_dir() and not any(out.iterdir()):
            out.rmdir()
    return out


def check_out(out_dir: str | Path) -> Path:
    """The folder that a report goes to, or ValueError where it cannot be: to be known before hours of scoring."""
    out = Path(out_dir).absolute()
    there = next(path for path in (out, *out.parents) if path.exists())
    if not there.is_dir():
        raise ValueError(f"{there}: not a folder; a report needs a folder, there or not")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{there}: no permission to write a report there")
    return out
