"""What a comparison of HASPI before and after comes to, written as JSON, as the paper's last table and as a picture."""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from hlsim.audiogram import SEVERITIES, Audiogram
from hlsim.evaluation.figures import draw_report
from hlsim.evaluation.significance import PairedComparison, paired_comparison

REPORT_FILES = ("report.json", "report.md", "before-after.png")

GAIN_SENTENCE = (
    "HASPI rewards any gain, however loud, so the output level stands beside it: a higher score at a much higher level "
    "may be no more than amplification."
)


@dataclass(frozen=True)
class ItemScore:
    """HASPI of one item before and after, with the levels (dB SPL) of what was scored."""

    file: str
    before: float
    after: float
    clean_level: float
    before_level: float
    after_level: float
    audiogram: Audiogram
    sample_rate: int
    seconds: float
    seed: int

    def to_dict(self) -> dict[str, Any]:
        """A plain dictionary that JSON can hold."""
        return {**asdict(self), "audiogram": self.audiogram.to_dict(), "severity": self.audiogram.severity}


@dataclass(frozen=True)
class HaspiReport:
    """HASPI of the same items before and after.

    Args:
        items: a score each.
        full_scale_spl: level in dB SPL that a signal of RMS 1.0 was taken to have.
        seed: that of item 0; item i has ``seed`` + i, before and after alike.
        extra: further keys for ``report.json`` beside the others, such as ``nalr_mean``; what JSON can hold.

    Attributes:
        comparison: means, deviations and tests.
        clean_level_mean, before_level_mean, after_level_mean: means of the items' levels in dB SPL.

    Raises:
        ValueError: no items, a score that is not finite, or an extra key that the report has itself.
    """

    items: Sequence[ItemScore]
    full_scale_spl: float = 94.0
    seed: int = 0
    extra: Mapping[str, Any] = field(default_factory=dict)
    comparison: PairedComparison = field(init=False)
    clean_level_mean: float = field(init=False)
    before_level_mean: float = field(init=False)
    after_level_mean: float = field(init=False)

    def __post_init__(self) -> None:
        comparison = paired_comparison(
            [item.before for item in self.items], [item.after for item in self.items]
        )
        object.__setattr__(self, "comparison", comparison)
        for name in ("clean_level", "before_level", "after_level"):
            levels = [float(getattr(item, name)) for item in self.items]
            object.__setattr__(self, f"{name}_mean", math.fsum(levels) / len(levels))
        taken = sorted(set(self._own()) & set(self.extra))
        if taken:
            raise ValueError(f"extra keys {', '.join(taken)} are the report's own; allowed: other names")

    @property
    def versions(self) -> dict[str, str]:
        """Of the packages that the scores depend on."""
        return {name: _version(name) for name in ("hlsim", "pyclarity", "numpy", "scipy")}

    def to_dict(self) -> dict[str, Any]:
        """A plain dictionary that JSON can hold: what ``report.json`` says."""
        return {**self._own(), **self.extra}

    def to_markdown(self) -> str:
        """The paper's last table, with the levels, the conditions and what the figures show."""
        c = self.comparison
        before, after = _spread(c.before_mean, c.before_std), _spread(c.after_mean, c.after_std)
        louder = self.after_level_mean - self.before_level_mean
        effect = "not defined" if c.cohens_d is None else f"d = {c.cohens_d:+.3f}"
        rows = [
            ("HASPI (mean ± std)", before, after, f"{c.delta:+.3f}"),
            ("*t-test (paired)*", "", "", _test("t", c.t, c.p_t, "+.3f")),
            ("*Wilcoxon signed-rank*", "", "", _test("W", c.w, c.p_w, ".1f")),
            ("*Cohen's d (paired)*", "", "", effect),
            (
                "Level (dB SPL, mean)",
                f"{self.before_level_mean:.1f}",
                f"{self.after_level_mean:.1f}",
                f"{louder:+.1f}",
            ),
        ]
        degrees = [item.audiogram.severity for item in self.items]
        ears = ", ".join(f"{name} {degrees.count(name)}" for name in SEVERITIES if name in degrees)
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        lines = [
            "# HASPI before and after",
            "",
            f"{c.n} items. {GAIN_SENTENCE}",
            "",
            "| Metric | Before | After | Change (Δ) |",
            "|---|---|---|---|",
            *("| " + " | ".join(row) + " |" for row in rows),
            "",
            "![HASPI and level, before against after](before-after.png)",
            "",
            f"- Degrees of hearing loss: {ears}. Clean speech at {self.clean_level_mean:.1f} dB SPL on average. "
            f"A signal of RMS 1.0 is taken as {self.full_scale_spl:g} dB SPL.",
            "- Changes are after minus before, so a gain is positive. Deviations with n - 1; tests two-sided; "
            "d is the mean difference over the deviation of the differences, t / sqrt(n).",
            f"- Wilcoxon: zero differences dropped ({c.zeros} of {c.n}); W is the smaller rank sum.",
            "- The tests take the items as independent; where several share a talker or a listener, p is too small.",
            f"- HASPI v2, numpy's seed {self.seed} + the item's number from 0. {versions}.",
        ]
        lines += [
            f"- {name}: {value}" for name, value in self.extra.items() if isinstance(value, str | int | float)
        ]
        return "\n".join(lines) + "\n"

    def _own(self) -> dict[str, Any]:
        return {
            **self.comparison.to_dict(),
            "wilcoxon_zero_method": "wilcox",
            "full_scale_spl": self.full_scale_spl,
            "clean_level_mean": self.clean_level_mean,
            "before_level_mean": self.before_level_mean,
            "after_level_mean": self.after_level_mean,
            "seed": self.seed,
            "versions": self.versions,
            "note": GAIN_SENTENCE,
            "items": [item.to_dict() for item in self.items],
        }


def write_report(report: HaspiReport, out_dir: str | Path) -> Path:
    """Write ``report.json``, ``report.md`` and ``before-after.png`` into a folder, made where it is missing.

    All are written beside it first and then moved in, so that no file is ever half there. Reports of an earlier run are
    replaced, other files stay.

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
    partial = None
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".part", dir=out.parent))
        (partial / "report.json").write_text(text + "\n", encoding="utf-8")
        (partial / "report.md").write_text(report.to_markdown(), encoding="utf-8")
        draw_report(report, partial / "before-after.png")
        out.mkdir(exist_ok=True)
        for name in REPORT_FILES:
            (partial / name).replace(out / name)
    except OSError as error:
        raise ValueError(f"{out}: report cannot be written ({error})") from error
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
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


def _spread(mean: float, deviation: float | None) -> str:
    return f"{mean:.3f}" if deviation is None else f"{mean:.3f} ± {deviation:.3f}"


def _test(name: str, statistic: float | None, p: float | None, form: str) -> str:
    if statistic is None or p is None:
        return "not defined"
    return f"{name} = {statistic:{form}}, " + ("p < 0.00001" if p < 1e-5 else f"p = {p:.5f}")


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
