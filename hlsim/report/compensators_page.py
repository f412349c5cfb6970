"""The page of ``evaluate-compensator``: it presents what ``evaluation.compensators`` computes."""

from collections.abc import Mapping
from typing import Any

from hlsim.calibration import Loudness
from hlsim.evaluation.aid_properties import QUIET_LEVELS
from hlsim.evaluation.compensators import UTTERANCES
from hlsim.evaluation.conditions import COMPRESSION, NAL_R
from hlsim.evaluation.digits import Estimate
from hlsim.evaluation.result import Evaluation
from hlsim.report.page import Page, Picture, Section, Table
from hlsim.report.players import listening_sections
from hlsim.report.plots import (
    condition_colours,
    curves_picture,
    ears_picture,
    gain_picture,
    means_pictures,
    scores_pictures,
)
from hlsim.report.tables import (
    GAIN_NOTE,
    HASQI_NOTE,
    SEVERITY_NOTE,
    STATISTICS_NOTE,
    VERSION_NOTE,
    Columns,
    comparison_table,
    detail_section,
    fact_tables,
    score_columns,
    statistic,
    summary_table,
)
from hlsim.report.verdict import count_items, verdict

_GROUPS = {"clean": "Clean speech", "noisy": "Speech in noise"}

_COLUMNS: Columns = {
    "Output level minus NAL-R's (dB)": (statistic("level_over_nal_r"), "+.1f"),
    "Highest peak (dB SPL)": (statistic("peak", "max"), ".1f"),
    "Loudness error from {target} (dB)": (statistic("loudness_error"), "+.1f"),
    "Mean absolute loudness error from {target} (dB)": (
        statistic("loudness_error", "mean absolute"),
        ".1f",
    ),
    "Band error (dB)": (statistic("band_error"), ".1f"),
}
"""Columns beside the scores, by title, in which ``{target}`` is the target of loudness."""

_GAP_COLUMNS: Columns = {
    "Neuro-MSBG (dB)": (statistic("loss_neuro"), ".2f"),
    "Exact MSBG (dB)": (statistic("loss_msbg"), ".2f"),
    "Relative difference, median item": (statistic("gap", "median absolute"), ".1%"),
}
"""Columns of the training loss through the network and through the exact MSBG, by title."""

_COLUMN_NOTES = (
    "The loudness error is the level that the impaired ear perceives after the exact MSBG minus "
    "the level that a normal ear perceives of the same input, with its noise, and minus the "
    "target of --loudness. Its default of 0 dB, normal loudness, is louder than most people "
    "prefer. The band error is "
    "the median absolute difference between the levels of 24 bands in frames of 32 ms, "
    "perceived by the impaired ear and, for clean speech, by a normal ear, both by the exact "
    "MSBG, where the latter is audible. A peak of 94 dB SPL is a sample of 1.0.",
    "A condition at a compensator's level is a prescription (NAL-R, unless --rival chose another "
    "one: 'prescription for the ear' is NAL-RP if the threshold at 2 kHz is above 90 dB HL, and "
    "otherwise NAL-R), or an equaliser, whose output is brought to the RMS level of the "
    "compensator's output for the same item. The equaliser is for each ear "
    f"a fixed filter with the compensator's mean insertion gain in 24 bands, for {UTTERANCES} "
    "clips of speech at the input levels: the rest of the difference is not gain.",
    "Holm's family is every pair of conditions by one measure in one group, except the planned "
    "comparisons of each compensator with the prescription at its level by HASPI. Several items "
    "share an ear, so that p is too small and intervals are too narrow; the tests of the means "
    "of each ear take that into account. The two ears of a person count as two.",
)
_FACTS = {
    "input_level": "By input level (dB SPL)",
    "severity": "By MSBG's degree of loss",
    "snr": "By SNR (dB)",
}
"""Captions of tables by the property of items that they show."""

_GAP = (
    "The loss is that of HearingLossLoss with the criterion bands, once with the Neuro-MSBG "
    "{simulator} and once with the exact MSBG. A compensator that has learned to exploit the "
    "network has a lower loss under the network."
)
_GAINS = (
    f"Output power over input power in 24 bands, for {UTTERANCES} clips of speech. A linear "
    "prescription has one curve for all levels; less gain for louder speech is compression."
)
_TONES = (
    "Loudness error of steady tones by the exact MSBG. A tone that the ear cannot perceive under "
    "any output limit is far below 0 for every aid."
)
_WEARING = (
    "The look-ahead is how long before the input becomes another sound the output changes by "
    "more than 1e-4 of its peak, the longest of 16 places. The gain is that for white noise as "
    "soft as a quiet room. Sidebands are the power of the output further than 20 Hz from a "
    "steady tone, relative to the tone, for the worst of the tones: modulation, hiss, and the "
    "harmonics of a limiter. The time is that of the processor for one second of sound, on one "
    "thread and whole signals of 3 s; it depends on the machine."
)


_DIGITS = (
    "The speech reception threshold is the signal-to-noise ratio at which half of the triplets of "
    "digits are understood in noise of 65 dB SPL, the lower the better: by a small network behind "
    "the exact MSBG, which tells an ear or an aid from another one but has not the skill of a "
    "person. The benefit is the threshold without an aid minus that with it. In brackets: "
    "intervals of 95 %. All ears and aids get the same triplets and noises."
)


def compensators_page(evaluation: Evaluation) -> Page:
    """Return the page of ``evaluate-compensator``.

    Its sections are scores, sounds and digits in noise if there are any, gains,
    "Could it be worn?" and details. The players have items of the first group, which is clean
    speech if there is any.

    Args:
        evaluation: Evaluation of ``evaluate_compensators``.
    """
    groups = evaluation.groups
    rival = f"{evaluation.settings['rival']} at the same level"
    first_verdict, *further_verdicts = [
        f"On {_GROUPS[name].lower()}, {verdict(c, c.after, rival)}"
        for name, group in groups.items()
        for c in group.comparisons
        if c.planned
    ]
    names = evaluation.aids
    tables = [
        summary_table(_GROUPS[name], group.table, _columns(group)) for name, group in groups.items()
    ]
    means = [
        picture
        for name, group in groups.items()
        for picture in means_pictures(group, _GROUPS[name])
    ]
    about = [*evaluation.notes, *further_verdicts, _about(evaluation), GAIN_NOTE, HASQI_NOTE]
    sections = [
        Section("Scores", about, tables, means),
        *listening_sections(evaluation),
        Section("Gain", [_GAINS], pictures=_gain_pictures(evaluation)),
        *_digit_sections(evaluation),
        Section("Could it be worn?", [_WEARING], [_wearing_table(evaluation)]),
        _details(evaluation),
    ]
    return Page(f"Hearing aids compared: {', '.join(names)}", first_verdict, sections)


def _about(evaluation: Evaluation) -> str:
    """Return a text about items, ears, levels and scores for the section "Scores"."""
    settings = evaluation.settings
    levels = ", ".join(f"{level:g}" for level in settings["levels"])
    ears = evaluation.table["ear"].nunique()
    incomplete = evaluation.failures["item"].nunique()
    left_out = ""
    if incomplete:
        left_out = (
            f" Tables and pictures leave out {count_items(incomplete)} without all values, which "
            "the section Failures lists."
        )
    return (
        f"{settings['items']} items of {settings['seconds']:g} s; ears: {ears}; speech at "
        f"{levels} dB SPL in turn; seed {settings['seed']}.{left_out} {VERSION_NOTE} Both compare "
        "with clean speech, in noise too."
    )


def _columns(group: Evaluation) -> Columns:
    """Return the columns of a table of scores: those of ``score_columns``, and ``_COLUMNS``."""
    target = _describe_loudness(group.settings["loudness"])
    columns = {title.format(target=target): column for title, column in _COLUMNS.items()}
    return {**score_columns(group), **columns}


def _describe_loudness(loudness: Loudness) -> str:
    """Describe a target of loudness for the title of a column.

    >>> _describe_loudness(0.0), _describe_loudness(-5.0), _describe_loudness({50.0: 0.0, 80.0: -9})
    ('normal', '-5 dB', '0 dB at 50, -9 dB at 80')
    """
    if not isinstance(loudness, Mapping):
        return f"{loudness:g} dB" if loudness else "normal"
    return ", ".join(f"{value:g} dB at {level:g}" for level, value in loudness.items())


def _details(evaluation: Evaluation) -> Section:
    """Return the folded section "Details".

    It has tables, tests and the surrogate gap of each group, and pictures of steady tones.
    """
    gap = _GAP.format(simulator=evaluation.settings["simulator"])
    sections = []
    for name, group in evaluation.groups.items():
        tables = fact_tables(group.table, _columns(group), _FACTS)
        gaps = summary_table("Mean loss", group.table, _GAP_COLUMNS)
        tests = comparison_table(
            [c for c in group.comparisons if c.after in group.aids],
            "All items; p adjusted by Holm within each measure but for a planned comparison",
        )
        inner_sections = [
            Section("Paired tests", tables=[tests], pictures=scores_pictures(group)),
            Section("Surrogate gap", [gap], [gaps]),
        ]
        sections.append(Section(_GROUPS[name], tables=tables, sections=inner_sections))
    sections.append(Section("Steady tones", [_TONES], pictures=_tone_pictures(evaluation)))
    enhancers = [f"Enhancer: {name}." for name in evaluation.settings["enhancers"]]
    return detail_section(
        evaluation, sections, [*_COLUMN_NOTES, SEVERITY_NOTE, STATISTICS_NOTE, *enhancers]
    )


def _gain_pictures(evaluation: Evaluation) -> list[Picture]:
    """Return one picture per ear and aid, also of WDRC, with the gains of the aid and the rival."""
    colours = condition_colours(evaluation.conditions)
    curves = evaluation.details["gain_curves"]
    rival = evaluation.settings["rival"]
    pictures = []
    for ear in dict.fromkeys(row["ear"] for row in curves):
        of_ear = {row["aid"]: row for row in curves if row["ear"] == ear}
        baseline = of_ear.get(rival, of_ear[NAL_R])  # the rule may choose NAL-R for this ear
        for aid in [COMPRESSION, *evaluation.aids]:
            pictures.append(gain_picture(f"{aid}, ear {ear}", [baseline, of_ear[aid]], colours))
    return pictures


def _digit_sections(evaluation: Evaluation) -> list[Section]:
    """Return a list with the section about reception thresholds, or an empty list without them."""
    results = evaluation.details.get("reception_thresholds")
    if results is None:
        return []
    rows = [
        {
            "Ear, aid": f"{row['ear']}, {row['aid']}",
            "Threshold (dB SNR)": _format_estimate(row["threshold_db"], ".1f"),
            "Benefit (dB)": _format_estimate(row["benefit_db"], "+.1f"),
        }
        for row in results
    ]
    table = Table.from_rows("Speech reception thresholds in noise", rows)
    colours = condition_colours(evaluation.conditions)
    picture = ears_picture(
        "Speech reception threshold by ear",
        "threshold (dB SNR)",
        [(row["ear"], row["aid"], row["threshold_db"]) for row in results],
        colours,
    )
    return [Section("Digits in noise", [_DIGITS], [table], [picture])]


def _format_estimate(estimate: Estimate, spec: str) -> str:
    """Format an estimate with its interval in brackets; ``spec`` is the format of the numbers."""
    value, low, high = (format(number, spec) for number in estimate)
    return f"{value} [{low}, {high}]"


def _tone_pictures(evaluation: Evaluation) -> list[Picture]:
    """Return one picture per ear: loudness errors of tones over frequency, one curve per aid.

    The tones have the middle one of the measured levels.
    """
    colours = condition_colours(evaluation.conditions)
    curves: dict[str, dict[str, Any]] = {}
    for row in evaluation.details["steady_tones"]:
        middle = len(row["levels"]) // 2
        title = f"Tones of {row['levels'][middle]:g} dB SPL, ear {row['ear']}"
        errors = row["loudness_error_db"][middle]
        style = {"color": colours[row["aid"]]}
        curves.setdefault(title, {})[row["aid"]] = (row["frequencies"], errors, style)
    return [
        curves_picture(of_ear, title, "loudness error (dB)", axis_range=(-60.0, None))
        for title, of_ear in curves.items()
    ]


def _wearing_table(evaluation: Evaluation) -> Table:
    """Return a table, by ear and aid, of properties that decide whether an aid can be worn.

    These are its look-ahead in ms, its gain for quiet noise in dB, its worst sidebands in dB
    relative to the tone, and the processor time in ms for one second of sound.
    """
    sidebands = {
        (row["ear"], row["aid"]): max(map(max, row["sidebands_db"]))
        for row in evaluation.details["steady_tones"]
    }
    rows = []
    for row in evaluation.details["wearing"]:
        ear, aid = row["ear"], row["aid"]
        gains = {
            f"Gain for noise at {level:g} dB SPL (dB)": f"{gain:+.1f}"
            for level, gain in zip(QUIET_LEVELS, row["quiet_gain_db"], strict=True)
        }
        rows.append(
            {
                "Ear, aid": f"{ear}, {aid}",
                "Look-ahead (ms)": f"{row['look_ahead_ms']:.1f}",
                **gains,
                "Worst sidebands (dB)": f"{sidebands[ear, aid]:.0f}",
                "Time for a second (ms)": f"{row['cpu_ms']:.1f}",
            }
        )
    return Table.from_rows("Look-ahead, gain for quiet noise, sidebands and cost", rows)
