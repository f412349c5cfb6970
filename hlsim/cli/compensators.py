"""The command ``evaluate-compensator``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hlsim.cli.options import (
    EARS_TABLE,
    Commands,
    add_command,
    audiogram_option,
    count,
    number,
    other_ear,
    out_option,
    positive,
    read_ear,
    seed_option,
    show_progress,
)
from hlsim.extras import require

GAIN_EARS = ["N3", "S2"]


def add(commands: Commands) -> None:
    sub = add_command(
        commands,
        "evaluate-compensator",
        _evaluate_compensator,
        "judge compensators beside no aid and NAL-R: HASPI, HASQI, loudness as heard, surrogate gap, gain curves, tones",
    )
    sub.add_argument(
        "names",
        nargs="+",
        metavar="NAME",
        help="compensators, by name or folder; LABEL=FOLDER is LABEL in the tables",
    )
    sub.add_argument("--speech", type=Path, required=True, help="folder of clean speech of unseen speakers")
    sub.add_argument(
        "--audiograms",
        type=Path,
        help=f"{EARS_TABLE}; its ears join Bisgaard's N2 to N6 and S1 to S3",
    )
    audiogram_option(sub, text="; one ear in place of all, for a compensator trained for it")
    sub.add_argument(
        "--noise", type=Path, help="folder of noises; every second item is then noisy, at 2.5 to 17.5 dB"
    )
    sub.add_argument(
        "--simulator", default="neuro-msbg", help="Neuro-MSBG of the surrogate gap, by name or folder"
    )
    sub.add_argument(
        "--levels", type=number, nargs="+", default=[50, 65, 80], help="of the speech in dB SPL, in turn"
    )
    sub.add_argument("--items", type=count, default=400, help="how many in all")
    sub.add_argument("--seconds", type=positive, default=3.0, help="length of an item")
    sub.add_argument(
        "--gain-ears",
        nargs="+",
        default=GAIN_EARS,
        metavar="EAR",
        help="standard ears of the gain curves and tones; with --audiogram that ear's are drawn",
    )
    sub.add_argument("--jobs", type=count, help="processes; all cores by default")
    seed_option(sub)
    out_option(sub)


def _evaluate_compensator(options: argparse.Namespace) -> None:
    if options.audiogram and options.gain_ears != GAIN_EARS:
        raise ValueError("--gain-ears with --audiogram; allowed: without it, for that ear's gains are drawn")
    for module in ("clarity", "matplotlib"):
        require(module, "eval")
    from compensators import load_compensator
    from hlsim.evaluation.compensators import evaluate_compensators
    from hlsim.report.compensators import write_compensators
    from hlsim.report.page import check_out

    named = dict(map(_labelled, options.names))
    if len(named) < len(options.names):
        raise ValueError(f"compensators {', '.join(options.names)}; allowed: one a label")
    loaded = {label: load_compensator(name) for label, name in named.items()}
    ear = read_ear(options.audiogram) if options.audiogram else None
    notes = [line for label, name in named.items() for line in other_ear(label, name, ear)]
    for line in notes:
        print(f"hlsim: warning: {line}", file=sys.stderr)
    done = evaluate_compensators(
        loaded,
        speech=options.speech,
        audiograms=options.audiograms,
        audiogram=ear,
        noise=options.noise,
        simulator=options.simulator,
        store=check_out(options.out) / "scores.jsonl",
        items=options.items,
        seconds=options.seconds,
        levels=options.levels,
        gain_ears=options.gain_ears,
        notes=notes,
        seed=options.seed,
        jobs=options.jobs,
        progress=show_progress("outputs"),
    )
    write_compensators(done.result, done.reports, options.out)
    print((options.out / "compensators.md").read_text(encoding="utf-8"))
    if done.result["failures"]:
        print(
            f"hlsim: {len(done.result['failures'])} outputs could not be judged; the reasons are in "
            f"{options.out / 'compensators.md'}",
            file=sys.stderr,
        )


def _labelled(text: str) -> tuple[str, str]:
    """Label and name; a folder by itself is called by its path."""
    label, sign, name = text.partition("=")
    return (text, text) if Path(text).exists() or not (sign and label) else (label, name)
