"""The command ``clarity``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hlsim.cli.evaluation import labelled, tell_page
from hlsim.cli.inputs import check_there, need
from hlsim.cli.options import Parser, count, foreign_name, natural, number
from hlsim.cli.progress import show_progress


def clarity(parser: Parser) -> None:
    parser.runs(
        _clarity,
        "dev/scenes hearing-aid --listeners listeners.json --scenes-listeners scenes_listeners.dev.json --out judged",
        "dev/scenes mine=my_package.aids:pair --listeners listeners.json --every 15 --out judged",
    )
    option = parser.option
    text = "folder of SCENE_mix_CH1.wav, SCENE_target_anechoic_CH1.wav (or SCENE_reference.wav) and SCENE_target_CH1.wav"
    option("scenes", Path, text, metavar="SCENES")
    text = (
        "compensators, by name or folder, or package.module:name or path/to/file.py:name: a callable "
        "(waveform, listener, sample_rate) -> waveform or its class, of (2, time) at the files' scale; LABEL=NAME is "
        "LABEL in the tables"
    )
    option("names", str, text, nargs="+", metavar="NAME")
    text = "Clarity's listeners.json, or a CSV file with columns listener, ear, hl_250, ..."
    option("--listeners", Path, text, required=True)
    option(
        "--scenes-listeners",
        Path,
        "JSON file of each scene's listeners; every listener in every scene by default",
    )
    option(
        "--every", count, "take the first pair of scene and listener, and then each so manyth", 1
    )
    text = (
        "what takes noise off before each aid, package.module:name: a callable (waveform, sample_rate) -> waveform or "
        "its class, of (2, time) in pascals"
    )
    option("--enhancer", foreign_name, text, [], nargs="+", metavar="NAME", dest="enhancers")
    parser.flag(
        "--linked", "the level at both ears sets the gains of each: of a hearing aid or wdrc"
    )
    option("--full-scale-spl", number, "level in dB SPL of a file whose RMS is 1.0", 100.0)
    option("--listen", natural, "items with players in report.html", 3)
    parser.jobs()
    parser.seed()
    parser.out()


def _clarity(options: argparse.Namespace) -> None:
    need("eval", "joblib", "matplotlib")
    check_there(folders=(options.scenes,), files=(options.listeners, options.scenes_listeners))
    from hlsim.evaluation.previous.clarity import evaluate_scenes
    from hlsim.report.previous.clarity import conditions_table, write_scenes

    aids = dict(map(labelled, options.names))
    if len(aids) < len(options.names):
        raise ValueError(f"aids {', '.join(options.names)}; allowed: one a label")
    report = evaluate_scenes(
        aids,
        scenes=options.scenes,
        listeners=options.listeners,
        out=options.out,
        scenes_listeners=options.scenes_listeners,
        every=options.every,
        enhancers=options.enhancers,
        linked=options.linked,
        full_scale_spl=options.full_scale_spl,
        seed=options.seed,
        jobs=options.jobs,
        progress=show_progress,
    )
    write_scenes(report, options.out, listen=options.listen)
    print(f"{conditions_table(report).text()}\n\n{report.headline.in_short()}")
    if failed := len(report.failures):
        text = f"{failed} scores could not be made; the reasons are in {options.out / 'report.md'}"
        print(f"hlsim: {text}", file=sys.stderr)
    tell_page(options.out / "report.html")
