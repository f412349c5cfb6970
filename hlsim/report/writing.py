"""Files of an evaluation: its page, its data and its scores."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.audiogram.scale import FREQUENCIES
from hlsim.evaluation.result import Evaluation
from hlsim.report.page import Page, write_page
from hlsim.report.verdict import limits, verdict

if TYPE_CHECKING:
    from pandas import DataFrame


def write_results(page: Page, evaluation: Evaluation, out: str | Path) -> Path:
    """Write an evaluation as ``report.html``, ``report.md``, ``report.json`` and ``scores.csv``.

    ``report.json`` contains the settings, comparisons and scores, see ``Evaluation.to_dict``, and
    each comparison in words. ``scores.csv`` has one row per item and condition. Either all files
    are written or all stay as they were.

    Args:
        page: Page of the evaluation.
        evaluation: Evaluation whose data are written.
        out: Folder of the files.

    Returns: The path of ``report.html``.

    Raises:
        ValueError: The files cannot be written.
        MissingExtraError: jinja2 is not installed, or for pictures matplotlib.

    >>> import pandas, tempfile
    >>> table = pandas.DataFrame([{"item": 0, "condition": "aid", "haspi": 0.5}])
    >>> with tempfile.TemporaryDirectory() as out:
    ...     _ = write_results(Page("Aids", "", []), Evaluation([], [], [], table), out)
    ...     print((Path(out) / "scores.csv").read_text().splitlines()[1])
    0,aid,0.5
    """
    data = evaluation.to_dict()
    data["comparisons"] = _add_words(evaluation, data["comparisons"])
    for name, group in evaluation.groups.items():
        data["groups"][name] = _add_words(group, data["groups"][name])
    scores = scores_table(evaluation).to_csv(index=False, float_format="%.9g")
    return write_page(page, data, out, {"scores.csv": scores})


def _add_words(evaluation: Evaluation, comparisons: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the dicts of comparisons for ``report.json``, each with a text, ``in_words``.

    Args:
        evaluation: Evaluation with the comparisons.
        comparisons: Dicts of these comparisons, in the same order.
    """
    return [
        {**data, "in_words": f"{verdict(c)} {limits(c)}"}
        for c, data in zip(evaluation.comparisons, comparisons, strict=True)
    ]


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
