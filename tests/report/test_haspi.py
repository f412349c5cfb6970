"""The report's figures, its tables and its files."""

import json
import math
import shutil
import struct
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from hlsim.audiogram import Audiogram
from hlsim.evaluation import Failure, HaspiReport, ItemScore, bootstrap_interval
from hlsim.files import Whole
from hlsim.report.previous.haspi import REPORT_FILES, html, markdown, write_report
from hlsim.report.previous.pictures import report_pictures

for module in ("joblib", "matplotlib"):
    pytest.importorskip(module)

STATED = {
    "n",
    "before_mean",
    "before_std",
    "after_mean",
    "after_std",
    "delta",
    "t",
    "p_t",
    "w",
    "p_w",
    "cohens_d",
}


def make_report(n: int = 12, **options: object) -> HaspiReport:
    rng = np.random.default_rng(0)
    names = ("N1", "N3", "N4", "NH")
    items = [
        ItemScore(
            file=f"p1/{i:02}",
            scores={"haspi": {"before": float(low), "after": float(min(1.0, low + high))}},
            clean_level=65.0,
            levels={"before": 64.0 + i, "after": 74.0 + i},
            audiogram=Audiogram.standard(names[i % 4]),
            sample_rate=16000,
            seconds=2.5,
            seed=i,
        )
        for i, (low, high) in enumerate(
            zip(rng.uniform(0, 0.6, n), rng.uniform(-0.05, 0.5, n), strict=True)
        )
    ]
    return HaspiReport(items, **options)


def test_figures_are_scipys(tmp_path: Path) -> None:
    report = make_report()
    write_report(report, tmp_path / "out")
    data = json.loads((tmp_path / "out" / "report.json").read_text())
    before, after = ([item[key] for item in data["items"]] for key in ("before", "after"))
    assert data.keys() >= STATED
    assert data["n"] == 12
    assert data["t"] == stats.ttest_rel(after, before).statistic
    assert data["p_w"] == stats.wilcoxon(after, before).pvalue
    assert data["cohens_d"] == pytest.approx(data["t"] / math.sqrt(12))
    assert data["after_std"] == pytest.approx(np.std(after, ddof=1))
    assert (data["before_level_mean"], data["after_level_mean"], data["full_scale_spl"]) == (
        69.5,
        79.5,
        94.0,
    )
    assert data["wilcoxon_zero_method"] == "wilcox"
    assert set(data["versions"]) == {"hlsim", "numpy", "scipy"}
    assert (data["ci_low"], data["ci_high"]) == bootstrap_interval(np.subtract(after, before))
    assert data["versions"]["numpy"] == np.__version__
    assert data["items"][2]["severity"] == "severe" and data["items"][2]["file"] == "p1/02"


def test_the_change_is_told_in_words_where_haspi_is_the_headlines() -> None:
    report = make_report()
    words = report.words
    assert (
        words is not None and words.low < words.change < words.high and words.before < words.after
    )
    said = f"{100 * words.after:.0f} % after, a change of {100 * words.change:+.0f} points"
    assert said in markdown(report) and said in html(report)
    assert report.to_dict()["words"] == words._asdict()
    items = [replace(item, scores={"stoi": item.scores["haspi"]}) for item in report.items]
    assert HaspiReport(items).words is None and "In words" not in markdown(HaspiReport(items))


def test_an_item_without_the_measure_does_not_count() -> None:
    items = make_report(8).items
    by_another = replace(items[0], scores={"hasqi": items[0].scores["haspi"]})
    report = HaspiReport([*items[1:], by_another])
    assert report.headline.overall.n == 7 and report.headline.left_out == 1


def test_markdown_is_the_papers_table() -> None:
    report = make_report(seed=3, extra={"nalr_mean": 0.5125})
    text, c = markdown(report), report.comparison
    assert "| Metric | Before | After | Change (Δ) |" in text
    assert (
        f"| {c.before_mean:.3f} ± {c.before_std:.3f} | {c.after_mean:.3f} ± {c.after_std:.3f} | +"
        in text
    )
    assert (
        f"t = +{c.t:.3f}, p " in text
        and f"W = {c.w:.1f}, p " in text
        and f"d = +{c.cohens_d:.3f}" in text
    )
    assert "| 69.5 | 79.5 | +10.0 |" in text
    assert "HASPI rewards any gain" in text
    assert "none 3, mild 3, severe 6" in text
    assert "seed 3" in text and "nalr_mean: 0.5125" in text
    large = make_report(400)
    assert markdown(large).count("p < 0.00001") >= 2


def test_undefined_tests_are_said_and_never_nan(tmp_path: Path) -> None:
    report = make_report(1)
    write_report(report, tmp_path)
    assert (tmp_path / "report.md").read_text(encoding="utf-8").count("| not defined |") == 4
    text = (tmp_path / "report.json").read_text()
    assert "NaN" not in text and json.loads(text)["t"] is None


def test_extra_keys_stand_beside_the_others() -> None:
    report = replace(make_report(), extra={"nalr_mean": 0.5, "initial_mean": 0.25})
    assert (
        report.to_dict()["nalr_mean"],
        report.to_dict()["initial_mean"],
        report.to_dict()["n"],
    ) == (
        0.5,
        0.25,
        12,
    )
    with pytest.raises(ValueError, match="extra keys items, t are the report's own"):
        make_report(extra={"t": 1.0, "items": [], "other": 2})
    with pytest.raises(ValueError, match="no items"):
        HaspiReport([])
    item = make_report(1).items[0]
    with pytest.raises(ValueError, match="p1/00: a score under 'after' without its level"):
        replace(item, levels={"before": 65.0, "after": None})
    unlike = replace(item, levels={"before": 65.0, "after": 65.0, "later": 65.0})
    with pytest.raises(ValueError, match="two or more, the same of every item"):
        HaspiReport([item, unlike])


def test_picture_is_a_png(tmp_path: Path) -> None:
    write_report(make_report(), tmp_path / "a" / "b", listen=0)
    data = (tmp_path / "a" / "b" / "before-after.png").read_bytes()
    width, height = struct.unpack(">II", data[16:24])
    assert data.startswith(b"\x89PNG\r\n\x1a\n") and data.endswith(b"IEND\xaeB`\x82")
    assert width > 800 and height > 400


def test_names_of_conditions_are_no_markup(tmp_path: Path) -> None:
    first, last = "_a", "c $5_$6"
    items = [
        replace(
            item,
            levels={first: 65.0, last: 75.0},
            scores={"haspi": {first: item.before or 0.0, last: item.after or 0.0}},
        )
        for item in make_report(4).items
    ]
    report = HaspiReport(items)
    # as matplotlib writes a label's text beside its outlines
    pictures = [picture.data.decode() for picture in report_pictures(report)]
    assert f"<!-- HASPI, {last} -->" in pictures[0]
    for picture in pictures[2:4]:  # the ticks, and the legend by severity
        assert f"<!-- \u200b{first} -->" in picture and f"<!-- {last} -->" in picture
    write_report(report, tmp_path)


def test_files_are_replaced_and_others_stay(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert write_report(make_report(4), out) == out
    (out / "heard.wav").write_text("audio")
    write_report(make_report(5), out)
    assert json.loads((out / "report.json").read_text())["n"] == 5
    assert sorted(p.name for p in out.iterdir()) == sorted([*REPORT_FILES, "heard.wav"])
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_nothing_is_written_beside_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be the root of a drive."""
    original, seen = Whole.write, set()

    def look(file: Whole, data: str | bytes) -> None:
        seen.update(own.name for own in tmp_path.iterdir())
        original(file, data)

    monkeypatch.setattr(Whole, "write", look)
    write_report(make_report(5), tmp_path / "out")
    assert seen == {"out"} and sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(
        REPORT_FILES
    )


@pytest.mark.parametrize("broken", ["picture", "nan"])
def test_a_failure_leaves_the_earlier_report_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    out = tmp_path / "out"
    write_report(make_report(4), out)
    earlier = {p.name: p.read_bytes() for p in out.iterdir()}
    report = make_report(5)
    if broken == "picture":
        original = Whole.write

        def fail(file: Whole, data: str | bytes) -> None:
            if file.path.suffix == ".png":
                raise ValueError("disk full")
            original(file, data)

        monkeypatch.setattr(Whole, "write", fail)
    else:
        report = make_report(5, extra={"nalr_mean": math.nan})
    for target in (out, tmp_path / "new"):
        with pytest.raises(ValueError, match=r"disk full|JSON"):
            write_report(report, target)
    assert {p.name: p.read_bytes() for p in out.iterdir()} == earlier
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_out_must_be_a_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match="file: not a folder"):
            write_report(make_report(), out)


def three_conditions() -> HaspiReport:
    """Nine items of three listeners, by two measures; one score is missing."""
    rng = np.random.default_rng(1)
    items = []
    for i in range(9):
        low = rng.uniform(0.1, 0.5)
        scores = {
            "haspi": {
                "unaided": low,
                "NAL-R": low + 0.3,
                "new_one": low + 0.35 + 0.01 * rng.normal(),
            },
            "stoi": {"unaided": 0.7, "NAL-R": 0.7 + 0.01 * rng.normal(), "new_one": 0.7},
        }
        if i == 4:
            del scores["stoi"]["new_one"]
        items.append(
            ItemScore(
                file=f"s{i}",
                audiogram=Audiogram.standard(("N1", "N3")[i % 2]),
                clean_level=65.0,
                levels={"unaided": 65.0, "NAL-R": 80.0, "new_one": 80.5},
                scores=scores,
                sample_rate=16000,
                seconds=2.0,
                seed=i,
                full_scale_spl=90.0 + i,
                listener=f"L{i % 3}",
                ear="left",
                snr=(0.0, 5.0, 10.0)[i % 3],
            )
        )
    failures = [Failure("s4", "new_one", "stoi", "a|b & 100 %")]
    return HaspiReport(items, measures=("haspi", "stoi"), failures=failures)


def test_every_pair_of_conditions_by_every_measure() -> None:
    report = three_conditions()
    assert [(c.measure, c.before, c.after) for c in report.comparisons] == [
        (measure, *pair)
        for measure in ("haspi", "stoi")
        for pair in (("unaided", "NAL-R"), ("unaided", "new_one"), ("NAL-R", "new_one"))
    ]
    assert report.headline is report.comparisons[1] and report.comparison.n == 9
    assert [c.overall.n for c in report.comparisons[3:]] == [9, 8, 8]
    one = replace(report, baseline="unaided")
    assert [(c.before, c.after) for c in one.comparisons[:2]] == [
        ("unaided", "NAL-R"),
        ("unaided", "new_one"),
    ]
    assert len(one.comparisons) == 4
    with pytest.raises(
        ValueError, match="baseline is 'NAL-R'; allowed: the first condition, 'unaided'"
    ):
        replace(report, baseline="NAL-R")


def test_table_is_pandas_with_a_row_an_item_and_condition() -> None:
    table = three_conditions().table
    assert len(table) == 27 and list(table.condition[:3]) == ["unaided", "NAL-R", "new_one"]
    assert table.groupby("condition").haspi.mean()["NAL-R"] == pytest.approx(
        table[table.condition == "unaided"].haspi.mean() + 0.3
    )
    assert table.stoi.isna().sum() == 1 and set(table.severity) == {"mild", "severe"}
    assert list(table.level[:3]) == [65.0, 80.0, 80.5] and table.full_scale_spl.max() == 98.0


def test_texts_of_three_conditions(tmp_path: Path) -> None:
    report = three_conditions()
    write_report(report, tmp_path)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert text.startswith(
        "# HASPI, STOI: unaided, NAL-R, new_one\n\nFrom unaided to new_one, HASPI rose by "
    )
    assert "## Result\n\n9 items. HASPI rewards any gain" in text
    assert "| Metric | Unaided | New_one | Change (Δ) |" in text
    assert "| s4 | new_one | STOI | a\\|b & 100 % |" in text
    assert "| listener means | 3 |" in text and "| HASPI: NAL-R to new_one | 9 |" in text
    assert "RMS 1.0 is taken as 90.0 to 98.0 dB SPL, by item" in text
    data = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert data == report.to_dict() and data["full_scale_spl"] is None
    assert data["failures"] == [
        {"file": "s4", "condition": "new_one", "measure": "stoi", "reason": "a|b & 100 %"}
    ]
    tex = (tmp_path / "report.tex").read_text(encoding="utf-8")
    assert tex.count("\\begin{table}") == tex.count("\\end{table}") == 4
    body = "\n".join(line for line in tex.splitlines() if not line.startswith("%"))
    assert "new\\_one" in body and "new_one" not in body and "$\\pm$" in body and "95 \\%" in body
    assert not set(body) - set(map(chr, range(128)))
    for row in body.split("\\begin{tabular}")[1:]:
        columns = row.split("}")[0].count("r") + 1
        lines = [line for line in row.splitlines() if line.endswith("\\\\")]
        assert lines and all(line.count("&") == columns - 1 for line in lines)


def test_of_haspis_gain_only_where_it_is_a_measure() -> None:
    items = [
        replace(item, scores={"stoi": dict(item.scores["stoi"])})
        for item in three_conditions().items
    ]
    report = HaspiReport(items)
    assert report.to_dict()["note"] == "" and "\n\n8 items.\n\n" in markdown(report)
    assert "HASPI rewards" not in markdown(report) + html(report, 0)
    both = three_conditions()
    assert both.to_dict()["note"].startswith("HASPI rewards") and "HASPI rewards" in html(both, 0)


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex here")
@pytest.mark.parametrize("made_by", [make_report, three_conditions])
def test_latex_compiles(made_by: Callable[[], HaspiReport], tmp_path: Path) -> None:
    write_report(made_by(), tmp_path)
    lines = (
        r"\documentclass{article}",
        r"\usepackage{booktabs}",
        r"\begin{document}",
        r"\input{report.tex}",
    )
    (tmp_path / "paper.tex").write_text("\n".join([*lines, r"\end{document}"]))
    call = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    made = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout[-1500:]
