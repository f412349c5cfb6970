"""The page of ``evaluate-compensator``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hlsim.audiogram import FREQUENCIES, SEVERITIES
from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.compensators import HARD, UNAIDED
from hlsim.evaluation.measurements import QUIET_LEVELS, UTTERANCES
from hlsim.evaluation.measures import title_of
from hlsim.evaluation.result import Evaluation
from hlsim.report.listening import listening_section
from hlsim.report.page import Page, Picture, Section, Table, write_page
from hlsim.report.plots import condition_colours, curves_picture, gain_picture, study_pictures
from hlsim.report.results import (
    GAIN_NOTE,
    STATISTICS_NOTES,
    comparison_name,
    failure_section,
    inner,
    number,
    paired_cells,
    scored_by,
    spread,
    versions_text,
)

if TYPE_CHECKING:
    from pandas import DataFrame

GROUPS = {
    "clean": "Clean speech",
    "noisy": "Speech in noise",
    "hard": f"Items with unaided HASPI below {HARD:g}",
}

NOISIER_DB = 8.0
"""SNR that divides the items in noise."""

_LOWEST_DB = -60.0  # of drawn loudness errors: what is further down is inaudible anyway

_LOUDNESS = (
    "The loudness error is the level that the impaired ear perceives after the exact MSBG minus the level that "
    "a normal ear perceives of the same input. In noise that input has the noise in it, so the rows below "
    "compare with the speech alone as well."
)
_HASQI = (
    "The reference of HASQI is clean speech amplified by NAL-R, which is therefore its ceiling: an output that is "
    "closer to normal hearing than NAL-R's has a lower HASQI."
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
_NOTES = (
    "A condition at a compensator's level is NAL-R, or an equaliser, whose output is brought to the RMS level of "
    "the compensator's output for the same item. The equaliser is for each ear a fixed filter with the "
    f"compensator's mean insertion gain in 24 bands, for {UTTERANCES} clips of speech at the input levels: the "
    "rest of the difference is not gain.",
    "The band error is the median absolute difference between the levels of 24 ERB-wide bands in frames of 32 ms, "
    "perceived by the impaired ear and, for clean speech, by a normal ear, both by the exact MSBG, where the "
    "latter is audible; the tables show its mean over items.",
    "Holm's family is every pair of conditions by one measure in one group, except the planned comparisons of "
    "each compensator with NAL-R at its level by HASPI. Several items share an ear, so that p is too small and "
    "intervals are too narrow: the last column of the tests is a t-test of the means of each ear, not "
    "adjusted. The two ears of a person count as two.",
)


def write_compensators(evaluation: Evaluation, out: str | Path, *, listen: int = 3) -> Path:
    """Write what ``evaluate_compensators`` returns into a folder, as ``write_report`` does."""
    return write_page(compensators_page(evaluation, listen), evaluation.to_dict(), out)


def compensators_page(evaluation: Evaluation, listen: int = 3) -> Page:
    """Return the page of compensators: verdicts, scores, sounds, gains, details."""
    groups = evaluation.groups
    whole = {name: group for name, group in groups.items() if name != "hard"}
    verdicts = [text for name, group in whole.items() for text in _verdicts(name, group)]
    sections = [
        Section(
            "Scores",
            [*evaluation.notes, *verdicts[1:], _about(evaluation), GAIN_NOTE],
            [_main_table(name, group) for name, group in whole.items()],
        )
    ]
    judged = [condition for condition in evaluation.conditions if condition.kind == "aid"]
    heard = [UNAIDED, *judged[0].rivals[:1], *(condition.name for condition in judged)]
    playing = listening_section(next(iter(whole.values())), listen, heard)
    if playing is not None:
        sections.append(playing)
    sections += [
        Section("Gain curves", [_GAINS], [_gain_table(evaluation)], _gain_pictures(evaluation)),
        Section("Could it be worn?", [_WEARING], [_wearing_table(evaluation)]),
        Section("Details", sections=_details(evaluation, whole), folded=True),
    ]
    return Page("Compensators", verdicts[0], sections)


def _verdicts(name: str, group: Evaluation) -> Iterator[str]:
    """Say of each compensator how it does against NAL-R at its level."""
    speech = inner(GROUPS[name])
    for c in group.comparisons:
        if c.planned:
            yield f"On {speech}, {c.verdict(c.after, 'NAL-R at the same level')}"


def _about(evaluation: Evaluation) -> str:
    settings = evaluation.settings
    levels = ", ".join(f"{level:g}" for level in settings["levels"])
    ears = evaluation.table["ear"].nunique()
    return (
        f"{settings['items']} items of {settings['seconds']:g} s, {ears} {'ear' if ears == 1 else 'ears'}, "
        f"speech at {levels} dB SPL in turn, seed {settings['seed']}. {scored_by(evaluation)} Both compare "
        "with the clean speech, in noise too."
    )


def _details(evaluation: Evaluation, whole: Mapping[str, Evaluation]) -> list[Section]:
    groups, simulator = evaluation.groups, evaluation.settings["simulator"]
    sections = []
    if "hard" in groups:
        sections.append(Section(GROUPS["hard"], tables=[_main_table("hard", groups["hard"])]))
    sections += [
        Section("Loudness by input level", [_LOUDNESS], _each(_loudness_table, whole)),
        Section("By degree of loss", [_HASQI], _each(_severity_table, whole)),
        Section("Surrogate gap", [_GAP.format(simulator=simulator)], _each(_gap_table, whole)),
        Section("Peaks and limits", tables=[_peak_table(evaluation)]),
        Section("Steady tones", [_TONES], [_tone_table(evaluation)], _tone_pictures(evaluation)),
    ]
    for name, group in whole.items():
        pictures = study_pictures(group)
        sections.append(Section(f"Pictures: {inner(GROUPS[name])}", pictures=pictures))
    for name, group in groups.items():
        sections.append(Section(f"Paired tests: {inner(GROUPS[name])}", tables=_test_tables(group)))
    by_severity = _each(_severity_tests, whole)
    sections.append(Section("Paired tests by degree of loss", tables=by_severity))
    failures = failure_section(evaluation.failures)
    if failures is not None:
        sections.append(failures)
    enhancers = [f"Enhancer: {name}." for name in evaluation.settings["enhancers"]]
    notes = [*_NOTES, *STATISTICS_NOTES, *enhancers, versions_text(evaluation.versions)]
    return [*sections, Section("How the values were made", notes)]


def _each(table_of: Any, groups: Mapping[str, Evaluation]) -> list[Table]:
    return [table_of(name, group) for name, group in groups.items()]


def _parts(evaluation: Evaluation) -> Iterator[tuple[str, DataFrame]]:
    """Yield the name and the rows of each condition."""
    for name in evaluation.names:
        yield name, evaluation.table[evaluation.table["condition"] == name]


def _score_cells(evaluation: Evaluation, part: DataFrame) -> dict[str, str]:
    columns = evaluation.settings["measures"]
    cells = {"n": str(len(part))}
    for column in columns:
        cells[f"{title_of(column)} (mean ± std)"] = spread(part[column].mean(), part[column].std())
    return cells


def _main_table(name: str, group: Evaluation) -> Table:
    rows = []
    for condition, part in _parts(group):
        row = {"Condition": condition, **_score_cells(group, part)}
        if name == "noisy":
            low, high = part[part["snr"] < NOISIER_DB], part[part["snr"] >= NOISIER_DB]
            scores = [number(half["haspi"].mean(), ".3f") for half in (low, high)]
            row[f"HASPI below / above {NOISIER_DB:g} dB SNR"] = " / ".join(scores)
        rows.append(
            {
                **row,
                "Output level (dB SPL)": f"{part['level'].mean():.1f}",
                "Highest peak (dB SPL)": f"{part['peak'].max():.1f}",
                "Loudness error (dB)": f"{part['loudness_error'].mean():+.1f}",
                "the same, mean absolute": f"{part['loudness_error'].abs().mean():.1f}",
                "Band error (dB)": f"{part['band_error'].mean():.1f}",
            }
        )
    return Table.of(GROUPS[name], rows)


def _loudness_table(name: str, group: Evaluation) -> Table:
    rows = []
    for condition, part in _parts(group):
        errors = {condition: "loudness_error"}
        if name == "noisy":
            errors[f"{condition}, against the speech alone"] = "loudness_error_clean"
        for title, column in errors.items():
            row = {"Condition": title}
            for level, values in part.groupby("input_level")[column]:
                cell = f"{values.abs().mean():.1f} ({values.mean():+.1f})"
                row[f"Speech at {level:g} dB SPL"] = cell
            rows.append(row)
    return Table.of(f"{GROUPS[name]}: mean absolute loudness error in dB (mean)", rows)


def _severity_table(name: str, group: Evaluation) -> Table:
    rows = []
    scores = group.settings["measures"]
    for severity in SEVERITIES:
        chosen = group.table[group.table["severity"] == severity]
        unaided = chosen[chosen["condition"] == UNAIDED]
        for condition in group.names if len(chosen) else ():
            part = chosen[chosen["condition"] == condition]
            row = {"Degree of loss": f"{severity}, {condition}", **_score_cells(group, part)}
            for column in scores:
                gain = part[column].mean() - unaided[column].mean()
                row[f"{title_of(column)} over unaided"] = f"{gain:+.3f}"
            row["Loudness error, absolute (dB)"] = f"{part['loudness_error'].abs().mean():.1f}"
            row["Band error (dB)"] = f"{part['band_error'].mean():.1f}"
            rows.append(row)
    return Table.of(f"{GROUPS[name]}, by degree of loss", rows)


def _gap_table(name: str, group: Evaluation) -> Table:
    rows = []
    for condition, part in _parts(group):
        network, exact = part["loss_neuro"].mean(), part["loss_msbg"].mean()
        known = part[part["loss_msbg"] != 0.0]
        relative = (known["loss_neuro"] / known["loss_msbg"] - 1.0).abs().median()
        rows.append(
            {
                "Condition": condition,
                "Neuro-MSBG": f"{network:.2f}",
                "exact MSBG": f"{exact:.2f}",
                "Neuro to exact": f"{100.0 * (network / exact - 1.0):+.1f} %" if exact else "n/a",
                "the same, median item": number(100.0 * relative, ".1f") + " %",
            }
        )
    return Table.of(f"{GROUPS[name]}: mean loss in dB", rows)


def _peak_table(evaluation: Evaluation) -> Table:
    rows = []
    for condition, part in _parts(evaluation):
        limit, peaks = evaluation.details["limits"][condition], part["peak"].dropna()
        # float32 rounds the limit itself by as little
        over = "n/a" if limit is None else f"{(peaks > limit + 1e-4).sum()} of {len(peaks)}"
        rows.append(
            {
                "Condition": condition,
                "Limit (dB SPL)": number(limit, "g", "none"),
                "Highest peak (dB SPL)": f"{peaks.max():.2f}",
                "Outputs beyond": over,
            }
        )
    return Table.of("Peaks of all outputs; a sample of 1.0 is 94 dB SPL", rows)


def _gain_table(evaluation: Evaluation) -> Table:
    shown = FREQUENCIES[:-1]  # 8 kHz is beyond the bands
    rows = []
    for curve in evaluation.details["gain_curves"]:
        bands = np.log(curve["frequencies"])
        for level, gains in zip(curve["levels"], curve["gain_db"], strict=True):
            row = {"Ear, aid, input": f"{curve['ear']}, {curve['aid']}, {level:g} dB SPL"}
            for hertz, gain in zip(shown, np.interp(np.log(shown), bands, gains), strict=True):
                row[f"{hertz:g} Hz"] = f"{gain:+.1f}"
            rows.append(row)
    return Table.of("Insertion gain in dB", rows, folded=True)


def _gain_pictures(evaluation: Evaluation) -> list[Picture]:
    """Draw one picture for each ear and compensator, and output over input level."""
    curves = evaluation.details["gain_curves"]
    prescriptions = [c.name for c in evaluation.conditions if c.kind == "prescription"]
    judged = [c.name for c in evaluation.conditions if c.kind == "aid"]
    colours = condition_colours(evaluation.conditions)
    pictures = []
    for ear in dict.fromkeys(curve["ear"] for curve in curves):
        for aid in judged:
            chosen = [c for c in curves if c["ear"] == ear and c["aid"] in (*prescriptions, aid)]
            pictures.append(gain_picture(f"{ear}, {aid}", chosen, colours))
    clean = evaluation.groups.get("clean")
    if clean is not None and clean.table["input_level"].nunique() > 1:
        names = [c.name for c in evaluation.conditions if c.kind not in ("same level", "equaliser")]
        levels = clean.table.groupby(["condition", "input_level"])["level"].mean()
        over_input = {name: (list(levels[name].index), list(levels[name])) for name in names}
        text = "Output level over input level, clean speech, means over all ears."
        picture = curves_picture(
            over_input, colours, text, axis="output (dB SPL)", over="speech (dB SPL)"
        )
        pictures.append(picture)
    return pictures


def _tone_pictures(evaluation: Evaluation) -> list[Picture]:
    """Draw the loudness error of tones at the middle level for each ear."""
    results, pictures = evaluation.details["steady_tones"], []
    for ear in dict.fromkeys(row["ear"] for row in results):
        curves = {}
        for row in (row for row in results if row["ear"] == ear):
            middle = len(row["levels"]) // 2
            errors = np.maximum(row["loudness_error_db"][middle], _LOWEST_DB)
            curves[row["aid"]] = (row["frequencies"], list(errors))
        text = f"Loudness error of tones of {row['levels'][middle]:g} dB SPL, {ear}."
        colours = condition_colours(evaluation.conditions)
        pictures.append(curves_picture(curves, colours, text, axis="loudness error (dB)"))
    return pictures


def _tone_table(evaluation: Evaluation) -> Table:
    rows = []
    for row in evaluation.details["steady_tones"]:
        by_level = zip(row["levels"], row["loudness_error_db"], row["sidebands_db"], strict=True)
        for level, errors, sidebands in by_level:
            cells = {"Ear, aid, input": f"{row['ear']}, {row['aid']}, {level:g} dB SPL"}
            for hertz, error in zip(row["frequencies"], errors, strict=True):
                cells[f"{hertz} Hz"] = f"{error:+.1f}"
            worst = int(np.argmax(sidebands))
            side = f"{round(sidebands[worst])} ({row['frequencies'][worst]} Hz)"
            rows.append({**cells, "Worst sidebands (of the tone)": side})
    return Table.of("Loudness error of tones, and sidebands of the output, in dB", rows)


def _wearing_table(evaluation: Evaluation) -> Table:
    worst = {
        (row["ear"], row["aid"]): max(map(max, row["sidebands_db"]))
        for row in evaluation.details["steady_tones"]
    }
    rows = []
    for row in evaluation.details["wearing"]:
        cells = {"Ear, aid": f"{row['ear']}, {row['aid']}"}
        cells["Look-ahead (ms)"] = f"{row['look_ahead_ms']:.1f}"
        for level, gain in zip(QUIET_LEVELS, row["quiet_gain_db"], strict=True):
            cells[f"Gain for noise at {level:g} dB SPL (dB)"] = f"{gain:+.1f}"
        cells["Worst sidebands (dB)"] = f"{worst[row['ear'], row['aid']]:.0f}"
        rows.append({**cells, "Time for a second (ms)": f"{row['cpu_ms']:.1f}"})
    return Table.of("Look-ahead, gain for quiet noise, sidebands and cost", rows)


def _test_tables(group: Evaluation) -> list[Table]:
    """Return one table per condition, against its rivals."""
    tables = []
    for condition in group.conditions:
        rows = []
        for c in _against_rivals(group, condition.name, condition.rivals):
            means = "n/a"
            if c.unit_means is not None:
                means = paired_cells(c.unit_means, c.unit_means.p_t, None, 2)["t-test (paired)"]
            rows.append(
                {
                    "Against": f"{c.before}, {c.title}" + (" (planned)" if c.planned else ""),
                    "n": str(c.overall.n),
                    **paired_cells(c.overall, c.p_t, c.p_w, 2),
                    "t over means of ears": means,
                }
            )
        if rows:
            caption = "paired tests, p adjusted by Holm within each measure but for a planned one"
            tables.append(Table.of(f"{condition.name}: {caption}", rows))
    return tables


def _severity_tests(name: str, group: Evaluation) -> Table:
    rows = [
        {
            "Change": f"{severity}, {comparison_name(c)}",
            "n": str(part.n),
            **paired_cells(part, part.p_t, part.p_w, 2),
        }
        for condition in group.conditions
        for c in _against_rivals(group, condition.name, condition.rivals)
        for severity, part in c.by_severity.items()
    ]
    return Table.of(f"{GROUPS[name]}: paired tests by degree of loss, p not adjusted", rows)


def _against_rivals(group: Evaluation, name: str, rivals: Sequence[str]) -> list[Comparison]:
    found = [c for c in group.comparisons if c.after == name and c.before in rivals]
    return sorted(found, key=lambda c: rivals.index(c.before))
