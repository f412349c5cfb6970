"""Files of an evaluation: its page, its data and its scores."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from hlsim.audiogram.scale import FREQUENCIES
from hlsim.evaluation.result import Evaluation
from hlsim.files import atomic_path
from hlsim.progress import track
from hlsim.report.page import Page, Picture, Section
from hlsim.report.verdict import limits, verdict

if TYPE_CHECKING:
    from pandas import DataFrame


def write_results(page: Page, evaluation: Evaluation, out: str | Path) -> Path:
    """Write an evaluation as ``report.html``, ``report.md``, ``report.json`` and ``scores.csv``.

    ``report.json`` contains the settings, comparisons and scores, see ``Evaluation.to_dict``, and
    each comparison in words. ``scores.csv`` has one row per item and condition. No file is replaced
    before all are on the disk, so that a full disk leaves all as they were.

    Args:
        page: Page of the evaluation.
        evaluation: Evaluation whose data are written.
        out: Folder of the files. Files of these names are replaced; others stay.

    Returns: The path of ``report.html``.

    Raises:
        ValueError: The files cannot be written.
        TypeError: The evaluation contains an object that JSON cannot represent.
        MissingExtraError: jinja2 is not installed, or for pictures matplotlib.

    >>> import pandas, tempfile
    >>> table = pandas.DataFrame([{"item": 0, "condition": "aid", "haspi": 0.5}])
    >>> with tempfile.TemporaryDirectory() as out:
    ...     _ = write_results(Page("Aids", "", []), Evaluation([], [], [], table), out)
    ...     print((Path(out) / "scores.csv").read_text().splitlines()[1])
    0,aid,0.5
    """
    data = evaluation.to_dict()
    parts = [(evaluation, data["comparisons"])]
    parts += [(group, data["groups"][name]) for name, group in evaluation.groups.items()]
    for part, comparisons in parts:
        for c, values in zip(part.comparisons, comparisons, strict=True):
            values["in_words"] = f"{verdict(c)} {limits(c)}"
    pictures = [*_find_pictures(page.sections)]
    for picture in track(pictures, "pictures", len(pictures)):
        _ = picture.data
    contents = {
        "report.json": json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n",
        "report.md": page.markdown(),
        "report.html": page.html(),
        "scores.csv": scores_table(evaluation).to_csv(index=False, float_format="%.9g"),
    }
    folder = Path(out).absolute()
    with ExitStack() as stack:  # Files are replaced at its end, when all are on the disk.
        for name, content in contents.items():
            stack.enter_context(atomic_path(folder / name)).write_text(content, encoding="utf-8")
    return folder / "report.html"


def _find_pictures(sections: Sequence[Section]) -> Iterator[Picture]:
    """Yield the pictures of sections and of their inner sections."""
    for section in sections:
        yield from section.pictures
        yield from _find_pictures(section.sections)


def scores_table(evaluation: Evaluation) -> DataFrame:
    """Return the table of an evaluation for ``scores.csv``.

    The column ``audiogram`` is replaced by one column per threshold, and the column ``source`` is
    left out. For Clarity's scenes, the column ``utterance`` is called ``scene``.

    Args:
        evaluation: Evaluation with the table.

    >>> import pandas
    >>> row = {"item": 0, "condition": "aid", "audiogram": [20.0] * 8, "haspi": 0.5}
    >>> list(scores_table(Evaluation([], [], [], pandas.DataFrame([row]))))[-2:]
    ['hl_6000', 'hl_8000']
    """
    table = evaluation.table.drop(columns="source", errors="ignore")
    if "combined" in table:  # A study of Clarity's scenes, each of which is an utterance.
        table = table.rename(columns={"utterance": "scene"})
    if "audiogram" not in table:
        return table
    columns = [f"hl_{frequency:g}" for frequency in FREQUENCIES]
    thresholds = type(table)(table["audiogram"].tolist(), columns=columns, index=table.index)
    return table.drop(columns="audiogram").join(thresholds)
