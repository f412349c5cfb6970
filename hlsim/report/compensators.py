"""The page of ``evaluate-compensator``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hlsim.audiogram import FREQUENCIES
from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.compensators import HARD, UNAIDED
from hlsim.evaluation.measurements import QUIET_LEVELS, UTTERANCES
from hlsim.evaluation.result import Evaluation
from hlsim.report.listening import listening_section
from hlsim.report.page import Page, Picture, Section, Table, write_page
from hlsim.report.plots import (
    condition_colours,
    curves_picture,
    gain_picture,
    means_picture,
    pictures_section,
)
from hlsim.report.results import (
    GAIN_NOTE,
    STATISTICS_NOTE,
    Columns,
    comparison_table,
    detail_section,
    inner,
    of,
    paired_table,
    parts,
    score_cells,
    scored_by,
    summary_table,
)

GROUPS = {
    "clean": "Clean speech",
    "noisy": "Speech in noise",
    "hard": f"Items with unaided HASPI below {HARD:g}",
}

COLUMNS: Columns = {
    "Output level (dB SPL)": (of("level"), ".1f"),
    "Highest peak (dB SPL)": (of("peak", "max"), ".1f"),
    "Peaks beyond the limit": (of("beyond_limit", "sum"), "g"),
    "Loudness error (dB)": (of("loudness_error"), "+.1f"),
    "the same, mean absolute": (of("loudness_error", "mean absolute"), ".1f"),
    "against speech alone": (of("loudness_error_clean"), "+.1f"),
    "Band error (dB)": (of("band_error"), ".1f"),
}
"""Columns of the tables by title."""

_GAP_COLUMNS: Columns = {
    "Neuro-MSBG (dB)": (of("loss_neuro"), ".2f"),
    "Exact MSBG (dB)": (of("loss_msbg"), ".2f"),
    "Relative difference, median item": (of("gap", "median absolute"), ".1%"),
}

_COLUMN_NOTES = (
    "The loudness error is the level that the impaired ear perceives after the exact MSBG minus the level that "
    "a normal ear perceives of the same input; in noise that input has the noise in it, so that a further column "
    "compares with the speech alone. The band error is the median absolute difference between the levels of 24 "
    "ERB-wide bands in frames of 32 ms, perceived by the impaired ear and, for clean speech, by a normal ear, both "
    "by the exact MSBG, where the latter is audible. A peak of 94 dB SPL is a sample of 1.0; the limit is that of "
    "the compensator.",
    "The reference of HASQI is clean speech amplified by NAL-R, which is therefore its ceiling: an output that is "
    "closer to normal hearing than NAL-R's has a lower HASQI.",
    "A condition at a compensator's level is NAL-R, or an equaliser, whose output is brought to the RMS level of "
    "the compensator's output for the same item. The equaliser is for each ear a fixed filter with the "
    f"compensator's mean insertion gain in 24 bands, for {UTTERANCES} clips of speech at the input levels: the "
    "rest of the difference is not gain.",
    "Holm's family is every pair of conditions by one measure in one group, except the planned comparisons of "
    "each compensator with NAL-R at its level by HASPI. Several items share an ear, so that p is too small and "
    "intervals are too narrow; the tests of the means of each ear take that into account. The two ears of a "
    "person count as two.",
)
_GAP = (
    "The loss is that of HearingLossLoss with the criterion bands, once with the Neuro-MSBG {simulator} and once with "
    "the exact MSBG. A compensator that has learned to exploit the network has a lower loss under the network."
)
_GAINS = (
    f"Output power over input power in ERB-wide bands, for {UTTERANCES} clips of speech. A linear prescription "
    "has one curve for all levels; less gain for louder speech is compression."
)
_TONES = (
    "Loudness error of steady tones by the exact MSBG. A tone that the ear cannot perceive under any output limit "
    "is far below 0 whatever is done. Sidebands are the power of the output further than 20 Hz from the tone, "
    "relative to the tone: modulation, hiss, and the harmonics of a limiter."
)
_WEARING = (
    "The look-ahead is how long before the input becomes another sound the output changes by more than 1e-4 of "
    "its peak, the longest of 16 places. The gain is that for white noise as soft as a quiet room. The sidebands "
    "are the worst of the steady tones. The time is that of the processor for one second of sound, on one "
    "thread and whole signals of 3 s; it depends on the machine."
)


def write_compensators(evaluation: Evaluation, out: str | Path, *, listen: int = 3) -> Path:
    """Write what ``evaluate_compensators`` returns into a folder, as ``write_report`` does."""
    return write_page(compensators_page(evaluation, listen), evaluation.to_dict(), out)


def compensators_page(evaluation: Evaluation, listen: int = 3) -> Page:
    """Return the page of compensators: verdicts, scores, sounds, gains, details."""
    main = {name: group for name, group in evaluation.groups.items() if name != "hard"}
    verdicts = [text for name, group in main.items() for text in _verdicts(name, group)]
    aids = [condition for condition in evaluation.conditions if condition.kind == "aid"]
    shown = [UNAIDED, *aids[0].rivals[:1], *(aid.name for aid in aids)]
    tables = [summary_table(GROUPS[name], *_rows(group)) for name, group in main.items()]
    about = [*evaluation.notes, *verdicts[1:], _about(evaluation), GAIN_NOTE]
    sections = [
        Section("Scores", about, tables),
        listening_section(next(iter(main.values())), listen, shown),
        Section("Gain curves", [_GAINS], [_gain_table(evaluation)], _gain_pictures(evaluation)),
        Section("Could it be worn?", [_WEARING], [_wearing_table(evaluation)]),
        _details(evaluation),
    ]
    return Page("Compensators", verdicts[0], [s for s in sections if s is not None])


def _verdicts(name: str, group: Evaluation) -> Iterator[str]:
    """Say of each compensator how it does against NAL-R at its level."""
    for c in group.comparisons:
        if c.planned:
            verdict = c.verdict(c.after, "NAL-R at the same level")
            yield f"On {inner(GROUPS[name])}, {verdict}"


def _about(evaluation: Evaluation) -> str:
    settings = evaluation.settings
    levels = ", ".join(f"{level:g}" for level in settings["levels"])
    return (
        f"{settings['items']} items of {settings['seconds']:g} s, {evaluation.table['ear'].nunique()} ears in turn, "
        f"speech at {levels} dB SPL in turn, seed {settings['seed']}. {scored_by(evaluation)} Both compare "
        "with the clean speech, in noise too."
    )


def _rows(group: Evaluation, fact: str = "") -> tuple[Any, Columns]:
    """Return the rows of a table and its columns."""
    return parts(group.table, fact), {**score_cells(group), **COLUMNS}


def _details(evaluation: Evaluation) -> Section:
    """Return further tables, tones, pictures and tests of each group, and notes, folded."""
    simulator = evaluation.settings["simulator"]
    sections = []
    for name, group in evaluation.groups.items():
        tables = [
            summary_table(f"By {title}", *_rows(group, fact), folded=True)
            for fact, title in {
                "input_level": "input level (dB SPL)",
                "severity": "degree of loss",
                "snr": "SNR (dB)",
            }.items()
            if group.table[fact].nunique() > 1
        ]
        gap = [_GAP.format(simulator=simulator)]
        gaps = summary_table("Mean loss", parts(group.table), _GAP_COLUMNS)
        pictures = pictures_section(group)
        inner_sections = [
            Section("Paired tests", tables=list(_test_tables(group))),
            Section("Surrogate gap", gap, [gaps]),
            *([] if pictures is None else [pictures]),
        ]
        if name == "hard":
            tables.insert(0, summary_table("All items", *_rows(group)))
        sections.append(Section(GROUPS[name], tables=tables, sections=inner_sections))
    tones = Section("Steady tones", [_TONES], [_tone_table(evaluation)], _tone_pictures(evaluation))
    enhancers = [f"Enhancer: {name}." for name in evaluation.settings["enhancers"]]
    notes = [*_COLUMN_NOTES, STATISTICS_NOTE, *enhancers]
    return detail_section(evaluation, *sections, tones, notes=notes)


def _gain_table(evaluation: Evaluation) -> Table:
    shown = FREQUENCIES[:-1]  # 8 kHz is beyond the bands
    rows = []
    for curve in evaluation.details["gain_curves"]:
        bands = np.log(curve["frequencies"])
        for level, gains in zip(curve["levels"], curve["gain_db"], strict=True):
            values = np.interp(np.log(shown), bands, gains)
            name = f"{curve['ear']}, {curve['aid']}, {level:g} dB SPL"
            rows.append((name, *(f"{gain:+.1f}" for gain in values)))
    header = ("Ear, aid, input", *(f"{hertz:g} Hz" for hertz in shown))
    return Table("Insertion gain in dB", header, rows, folded=True)


def _gain_pictures(evaluation: Evaluation) -> list[Picture]:
    """Draw one picture for each ear and compensator, and output over input level."""
    curves = evaluation.details["gain_curves"]
    colours = condition_colours(evaluation.conditions)
    pictures = []
    for ear in dict.fromkeys(curve["ear"] for curve in curves):
        for aid in evaluation.of_kind("aid"):
            chosen = [*evaluation.of_kind("prescription"), aid]
            shown = [c for c in curves if c["ear"] == ear and c["aid"] in chosen]
            pictures.append(gain_picture(f"{ear}, {aid}", shown, colours))
    clean = evaluation.groups.get("clean")
    if clean is not None:
        title = "output level in clean speech (dB SPL)"
        pictures.append(means_picture(clean, "level", "input_level", title, "speech (dB SPL)"))
    return pictures


def _tone_pictures(evaluation: Evaluation) -> list[Picture]:
    """Draw the loudness error of tones at the middle level for each ear."""
    colours, pictures = condition_colours(evaluation.conditions), []
    results = evaluation.details["steady_tones"]
    for ear in dict.fromkeys(row["ear"] for row in results):
        curves = {}
        for row in results:
            middle = len(row["levels"]) // 2
            errors = np.maximum(
                row["loudness_error_db"][middle], -60.0
            )  # lower is inaudible anyway
            if row["ear"] == ear:
                style = {"color": colours[row["aid"]]}
                curves[row["aid"]] = (row["frequencies"], list(errors), style)
        text = f"Loudness error of tones of {row['levels'][middle]:g} dB SPL, {ear}."
        pictures.append(curves_picture(curves, text, "loudness error (dB)"))
    return pictures


def _tone_table(evaluation: Evaluation) -> Table:
    rows = []
    for row in evaluation.details["steady_tones"]:
        by_level = zip(row["levels"], row["loudness_error_db"], row["sidebands_db"], strict=True)
        for level, errors, sidebands in by_level:
            worst = int(np.argmax(sidebands))
            side = f"{round(sidebands[worst])} ({row['frequencies'][worst]} Hz)"
            name = f"{row['ear']}, {row['aid']}, {level:g} dB SPL"
            rows.append((name, *(f"{error:+.1f}" for error in errors), side))
    tones = [f"{hertz} Hz" for hertz in row["frequencies"]]
    header = ("Ear, aid, input", *tones, "Worst sidebands (of the tone)")
    return Table("Loudness error of tones, and sidebands of the output, in dB", header, rows)


def _wearing_table(evaluation: Evaluation) -> Table:
    tones = evaluation.details["steady_tones"]
    worst = {(row["ear"], row["aid"]): max(map(max, row["sidebands_db"])) for row in tones}
    rows = []
    for row in evaluation.details["wearing"]:
        gains = [f"{gain:+.1f}" for gain in row["quiet_gain_db"]]
        sidebands = f"{worst[row['ear'], row['aid']]:.0f}"
        name, ahead = f"{row['ear']}, {row['aid']}", f"{row['look_ahead_ms']:.1f}"
        rows.append((name, ahead, *gains, sidebands, f"{row['cpu_ms']:.1f}"))
    quiet = [f"Gain for noise at {level:g} dB SPL (dB)" for level in QUIET_LEVELS]
    header = (
        "Ear, aid",
        "Look-ahead (ms)",
        *quiet,
        "Worst sidebands (dB)",
        "Time for a second (ms)",
    )
    return Table("Look-ahead, gain for quiet noise, sidebands and cost", header, rows)


def _test_tables(group: Evaluation) -> Iterator[Table]:
    """Yield for each condition the comparisons with its rivals, over items and over means of ears."""
    for condition in group.conditions:
        found = _against_rivals(group, condition.name, list(condition.rivals))
        if found:
            adjusted = "p adjusted by Holm within each measure but for a planned one"
            yield comparison_table(found, f"{condition.name} against others; {adjusted}")
            means = {f"{c.title}: {c.before} to {c.after}": c.unit_means for c in found}
            known = {name: c for name, c in means.items() if c is not None}
            if known:
                yield paired_table(f"{condition.name} against others, means of each ear", known)


def _against_rivals(group: Evaluation, name: str, rivals: list[str]) -> list[Comparison]:
    found = [c for c in group.comparisons if c.after == name and c.before in rivals]
    return sorted(found, key=lambda c: rivals.index(c.before))
