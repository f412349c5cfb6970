"""A comparison of compensators as JSON, Markdown and one HTML page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hlsim.audiogram import FREQUENCIES
from hlsim.evaluation.previous.comparison import Comparison
from hlsim.evaluation.previous.compensator_result import HARD, NOISIER_DB
from hlsim.evaluation.previous.haspi_report import GAIN_NOTE, HaspiReport
from hlsim.evaluation.previous.measurements import QUIET, UTTERANCES
from hlsim.report.page import Section, render_markdown, render_page, write_files
from hlsim.report.previous.gain_pictures import (
    gain_picture,
    gains_at,
    input_output_picture,
    tone_picture,
)
from hlsim.report.previous.haspi import scored_by
from hlsim.report.previous.pictures import condition_colours, report_pictures
from hlsim.report.previous.tables import (
    Table,
    cells,
    change_name,
    inner,
    number,
    paired_cells,
    spread,
    verdict,
)

FILES = ("compensators.json", "compensators.md", "compensators.html")

GROUPS = {
    "clean": "Clean speech",
    "noisy": "Speech in noise",
    "hard": f"Unaided HASPI under {HARD:g}",
}

Result = Mapping[str, Any]
Beside = Mapping[str, Sequence[str]]

_paired = partial(paired_cells, digits=2)


def write_compensators(result: Result, reports: Mapping[str, HaspiReport], out: str | Path) -> None:
    """Write what ``evaluate_compensators`` returns into a folder, each file whole or not at all, or ValueError."""
    title, sections, lead = "Compensators", _sections(result, reports), " ".join(result["notes"])
    text = json.dumps(result, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    flat = [replace(section, folded=False) for section in sections]
    contents = (text, render_markdown(title, flat, lead), render_page(title, sections, lead))
    write_files(out, dict(zip(FILES, contents, strict=True)))


def _in_short(result: Result, reports: Mapping[str, HaspiReport]) -> list[str]:
    """Each compensator against NAL-R at its own level, and what all is of."""
    told = []
    for group, speech in (("clean", "clean speech"), ("noisy", "speech in noise")):
        for c in reports[group].comparisons if group in reports else ():
            if (c.measure, c.before) == ("haspi", f"NAL-R at {c.after}{_AT_LEVEL}"):
                clause = verdict(
                    reports[group].items, c.before, c.after, c.after, "NAL-R made as loud"
                )
                told.append(f"On {speech} {clause}.")
    return [*told, _about(result)]


def _about(result: Result) -> str:
    levels = ", ".join(f"{level:g}" for level in result["levels"])
    # few items do not come to every ear
    ears = len({row["name"] for row in (*result["rows"], *result["failures"])})
    made_by = scored_by(result["versions"])
    return (
        f"{result['items']} items of {result['seconds']:g} s, {ears} ears in turn, speech at {levels} "
        f"dB SPL in turn, seed {result['seed']}: {', '.join(result['limits'])}. HASPI v2 and HASQI v2, {made_by}, "
        "are against the clean speech, in noise too."
    )


def _sections(result: Result, reports: Mapping[str, HaspiReport]) -> list[Section]:
    whole = [group for group in ("clean", "noisy") if group in reports]
    sections = [Section("In short", _in_short(result, reports))]
    sections += [
        Section(
            GROUPS[group],
            [GAIN_NOTE] if group == "clean" else [],
            [_main_table(result, group)],
            folded=group == "hard",
        )
        for group in reports
    ]
    loudness = [_loudness_table(result, group) for group in whole]
    by_severity = [_severity_table(result, group) for group in whole]
    curves = result["gain_curves"]
    shown = dict.fromkeys(curve["ear"] for curve in curves)
    colours = condition_colours([*next(iter(result["groups"].values()))["conditions"]])
    gains, tones = [gain_picture(ear, curves, colours) for ear in shown], result["steady_tones"]
    as_heard = [tone_picture(ear, tones, colours) for ear in shown]
    if "clean" in reports:
        own = result["groups"]["clean"]["conditions"].items()
        levels = {name: row for name, row in own if not name.endswith(_AT_LEVEL)}
        gains.append(input_output_picture(levels, colours))
    sections += [
        Section("As loud as a normal ear hears it?", [_LOUDNESS], loudness),
        Section("By degree of loss", [_HASQI], by_severity, folded=True),
        Section("The surrogate gap", [_GAP.format(**result)], [_gap_table(result)]),
        Section("Does any output pass the limit?", (), [_peak_table(result)], folded=True),
        Section("Gain curves", [_GAINS], [_gain_table(curves)], gains),
        Section("Steady tones", [_STEADY], [tone_table(tones)], as_heard, folded=True),
        Section("Could it be worn?", [_WEARING], [wearing_table(result["wearing"], tones)]),
    ]
    for group in whole:
        title = f"Pictures: {inner(GROUPS[group])}"
        sections.append(Section(title, pictures=report_pictures(reports[group]), folded=True))
    sections += [
        Section(
            f"Paired tests: {inner(GROUPS[group])}",
            tables=_tests(report, result["beside"]),
            folded=True,
        )
        for group, report in reports.items()
    ]
    by_degree = [_severity_tests(reports[group], group, result["beside"]) for group in whole]
    sections.append(Section("Paired tests by degree of loss", tables=by_degree, folded=True))
    if result["failures"]:
        rows = [
            (str(f["item"]), f["compensator"], f["name"], f["reason"]) for f in result["failures"]
        ]
        table = Table(
            "Outputs that could not be judged", ("Item", "Compensator", "Ear", "Reason"), rows
        )
        sections.append(Section("Failures", ["Items that count in no table."], [table]))
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    notes = [*_NOTES, *(f"Enhancer {name}." for name in result["enhancers"])]
    return [*sections, Section("How the figures were made", [*notes, f"{versions}."], folded=True)]


_LOUDNESS = (
    "RMS level after the exact MSBG, less what a normal ear hears there of the same input. In noise that input has the "
    "noise in it: what takes noise away is held against the speech alone as well."
)
_HASQI = (
    "HASQI's reference is the clean speech amplified by NAL-R, so that NAL-R is its ceiling: what is nearer to "
    "normal hearing than NAL-R loses HASQI by it."
)
_GAP = (
    "The loss is that of HearingLossLoss with the criterion bands, of the outputs above, with the Neuro-MSBG "
    "{simulator}. A compensator that has learned to fool the network has a lower loss under it than under the exact MSBG."
)
_GAINS = (
    f"Power out over power in, in ERB-wide bands, of {UTTERANCES} clips of speech. A linear prescription has one "
    "curve for all levels; less gain for louder speech is compression."
)
_STEADY = (
    "By the exact MSBG, all that is heard. A tone that the ear cannot hear under any output limit is far below 0 "
    "whatever is done. Sidebands are the power of all that is further than 20 Hz from the tone, relative to the tone, in "
    "what the ear is given: modulation, hiss, and the harmonics of a limiter."
)
_WEARING = (
    "Latency: how long before the input becomes another sound the output changes, by more than 1e-4 of its peak; the "
    "longest of 16 places. Gain: of white noise, as soft as a room where nobody speaks. Sidebands: the worst of the "
    "steady tones. Time: of the processor for a second of sound, one thread, whole signals of 3 s; machines differ."
)
_NOTES = (
    "At a compensator's level: what NAL-R, or an equaliser, makes of an item, at the RMS level of what the compensator "
    "made of it. The equaliser is, for each ear, a fixed filter with the compensator's mean insertion gain in 24 bands,"
    f" of {UTTERANCES} clips of speech at the input levels: what is left between the two is not gain.",
    "Bands: median absolute difference between the levels of 24 ERB-wide bands in frames of 32 ms of what the impaired "
    "ear hears and what a normal ear hears of the clean speech, both by the exact MSBG, where the latter is audible; "
    "mean over items.",
    "Holm's family is every pair of conditions by one measure in one group. d is the mean difference over the deviation "
    "of the differences. Intervals are percentiles of 9999 bootstrap resamples of the items, expanded for few "
    "(Hesterberg 2015). Several items share an ear, which makes p too small and intervals too narrow: the last column of "
    "the tests is a t-test of the means of each ear, p not adjusted. Both ears of a person count as two.",
)


_MAIN = {
    "Level (dB SPL)": ("level_mean", ".1f"),
    "Highest peak (dB SPL)": ("peak_max", ".1f"),
    "Heard, against normal (dB)": ("heard_off", "+.1f"),
    "the same, mean absolute": ("heard_off_abs", ".1f"),
    "Bands, against normal (dB)": ("band_error_mean", ".1f"),
}
_BY_SEVERITY = {
    "HASPI over unaided": ("haspi_mean", "+.3f"),
    "HASQI over unaided": ("hasqi_mean", "+.3f"),
    "Heard, mean absolute (dB)": ("heard_off_abs", ".1f"),
    "Bands (dB)": ("band_error_mean", ".1f"),
}
_GAPS = {
    "Neuro-MSBG": ("loss_neuro", ".2f"),
    "exact MSBG": ("loss_msbg", ".2f"),
    "Neuro to exact": ("neuro_to_msbg", "+.1%"),
    "the same, median item": ("item_median", ".1%"),
}
_GIVEN = "What the ear is given"
_AT_LEVEL = "'s level"  # ends the names of what is as loud as a compensator


def _main_table(result: Result, group: str) -> Table:
    """Scores, levels, and how far what is heard lies from what a normal ear hears."""
    conditions = result["groups"][group]["conditions"].items()
    rows = [
        {
            _GIVEN: name,
            **_scores(row),
            **(_by_snr(row) if group == "noisy" else {}),
            **cells(row, _MAIN),
        }
        for name, row in conditions
    ]
    return Table.of(f"{GROUPS[group]}: scores, output and what is heard", rows)


def _by_snr(row: Result) -> dict[str, str]:
    parts = [row["by_snr"].get(name, {}).get("haspi_mean") for name in ("under", "over")]
    return {
        f"HASPI under / over {NOISIER_DB:g} dB SNR": " / ".join(
            number(part, ".3f") for part in parts
        )
    }


def _tests(report: HaspiReport, beside: Beside) -> list[Table]:
    """A table a condition: against those that a user would pick instead."""
    rows: dict[str, list[dict[str, str]]] = {}
    for c in _against(report, beside):
        means = "n/a" if c.listeners is None else _paired(c.listeners)["t-test (paired)"]
        about = {"Against": f"{c.before.replace(c.after + _AT_LEVEL, 'its level')}, {c.title}"}
        paired = _paired(c.overall, c.p_t_holm, c.p_w_holm)
        own = {**about, "n": str(c.overall.n), **paired, "t over means of ears": means}
        rows.setdefault(c.after, []).append(own)
    title = "{}: change, and paired tests with p adjusted by Holm within each measure"
    return [Table.of(title.format(name), own) for name, own in rows.items()]


def _severity_tests(report: HaspiReport, group: str, beside: Beside) -> Table:
    rows = [
        {"Change": f"{severity}, {change_name(c)}", "n": str(row.n), **_paired(row)}
        for c in _against(report, beside)
        for severity, row in c.by_severity.items()
    ]
    return Table.of(f"{GROUPS[group]}: paired tests by degree of loss, p not adjusted", rows)


def _against(report: HaspiReport, beside: Beside) -> list[Comparison]:
    return [c for c in report.comparisons if c.before in beside.get(c.after, ())]


def _loudness_table(result: Result, group: str) -> Table:
    """Level as heard against the normal ear's, a column an input level."""
    rows = []
    for name, row in result["groups"][group]["conditions"].items():
        against = {name: "heard_off"}
        if group == "noisy":
            against[f"{name}, against the speech in it"] = "heard_off_clean"
        for title, key in against.items():
            offs = {
                f"Speech at {level} dB SPL": f"{cell[f'{key}_abs']:.1f} ({cell[key]:+.1f})"
                for level, cell in row["by_level"].items()
            }
            rows.append({_GIVEN: title, **offs})
    return Table.of(
        f"{GROUPS[group]}: mean absolute difference in dB (mean difference)", rows, folded=True
    )


def _severity_table(result: Result, group: str) -> Table:
    conditions = result["groups"][group]["conditions"]
    first = next(iter(conditions.values()))["by_severity"]
    rows = []
    for severity, unaided in first.items():
        for name, condition in conditions.items():
            row = condition["by_severity"][severity]
            over = {key: row[key] - unaided[key] for key in ("haspi_mean", "hasqi_mean")}
            title = {"Degree of loss": f"{severity}, {name}"}
            rows.append({**title, **_scores(row), **cells({**row, **over}, _BY_SEVERITY)})
    return Table.of(f"{GROUPS[group]}, by degree of loss", rows)


def _gap_table(result: Result) -> Table:
    rows = []
    for group, conditions in result["gap"].items():
        for name, row in conditions.items():
            found = {title: cell.replace("%", " %") for title, cell in cells(row, _GAPS).items()}
            rows.append({_GIVEN: f"{group}, {name}", **found})
    return Table.of(
        "Mean loss in dB on the same utterances, and relative differences", rows, folded=True
    )


def _peak_table(result: Result) -> Table:
    rows = [
        {
            _GIVEN: name,
            "Limit (dB SPL)": number(row["limit"], "g", "none"),
            "Highest peak (dB SPL)": f"{row['highest']:.2f}",
            "Outputs beyond": "n/a" if row["over"] is None else f"{row['over']} of {row['n']}",
        }
        for name, row in result["peaks"].items()
    ]
    return Table.of("Peaks of all outputs, a sample of 1.0 being 94 dB SPL", rows)


def _gain_table(curves: Sequence[Result]) -> Table:
    shown = FREQUENCIES[:-1]  # 8 kHz is beyond the bands
    rows = [
        [_tone_name(curve, level), *(f"{gain:+.1f}" for gain in gains_at(shown, curve, gains))]
        for curve in curves
        for level, gains in zip(curve["levels"], curve["gain_db"], strict=True)
    ]
    return Table(
        "Insertion gain in dB", (_TONE, *(f"{hz:g} Hz" for hz in shown)), rows, folded=True
    )


def tone_table(found: Sequence[Result]) -> Table:
    """A row an ear, compensator and level, with the worst sidebands of the row."""
    rows = []
    for row in found:
        hertz = row["frequencies"]
        for level, offs, sidebands in zip(
            row["levels"], row["heard_off_db"], row["sidebands_db"], strict=True
        ):
            worst = int(np.argmax(sidebands))
            heard = {f"{hz} Hz": f"{off:+.1f}" for hz, off in zip(hertz, offs, strict=True)}
            sides = {
                "Worst sidebands (of the tone)": f"{round(sidebands[worst])} ({hertz[worst]} Hz)"
            }
            rows.append({_TONE: _tone_name(row, level), **heard, **sides})
    return Table.of(
        "Level heard less a normal ear's of the same tone, and sidebands of the output, in dB", rows
    )


def wearing_table(found: Sequence[Result], tones: Sequence[Result]) -> Table:
    """A row an ear and aid."""
    worst = {(row["ear"], row["compensator"]): max(map(max, row["sidebands_db"])) for row in tones}
    rows = [
        {
            "Ear, aid": f"{row['ear']}, {row['compensator']}",
            "Latency (ms)": f"{row['latency_ms']:.1f}",
            **{
                f"Gain for noise at {level:g} dB SPL (dB)": f"{gain:+.1f}"
                for level, gain in zip(QUIET, row["quiet_gain_db"], strict=True)
            },
            "Worst sidebands (dB)": f"{worst[row['ear'], row['compensator']]:.0f}",
            "Time for a second (ms)": f"{row['cpu_ms']:.1f}",
        }
        for row in found
    ]
    return Table.of("Latency, gain for quiet noise, sidebands and cost", rows)


_TONE = "Ear, compensator, input"


def _tone_name(row: Result, level: float) -> str:
    return f"{row['ear']}, {row['compensator']}, {level:g} dB SPL"


def _scores(row: Result) -> dict[str, str]:
    means = {
        f"{name.upper()} (mean ± std)": spread(row[f"{name}_mean"], row[f"{name}_std"])
        for name in ("haspi", "hasqi")
    }
    return {"n": str(row["n"]), **means}
