"""The command ``clarity``."""

from __future__ import annotations

import argparse
from pathlib import Path

from hlsim.cli.evaluation import finish, labelled_names, prepare_study, study_options
from hlsim.cli.inputs import check_paths_exist
from hlsim.cli.options import Parser, count, number, plugin_name
from hlsim.cli.progress import show_progress


def clarity(parser: Parser) -> None:
    parser.set_command(
        _clarity,
        "dev/scenes hearing-aid --listeners listeners.json --scenes-listeners scenes_listeners.dev.json --out judged",
        "dev/scenes mine=my_package.aids:pair --listeners listeners.json --every 15 --out judged",
    )
    option = parser.option
    text = (
        "folder with SCENE_mix_CH1.wav, SCENE_target_anechoic_CH1.wav (or SCENE_reference.wav) and "
        "SCENE_target_CH1.wav"
    )
    option("scenes", Path, text, metavar="SCENES")
    text = (
        "compensators, by name or folder, or aids of your own as package.module:name or "
        "path/to/file.py:name: a callable (waveform, listener, sample_rate) -> waveform or its class, for "
        "(2, time) at the files' scale; LABEL=NAME is called LABEL in the tables"
    )
    option("names", str, text, nargs="+", metavar="NAME")
    text = "Clarity's listeners.json, or a CSV file with the columns listener, ear, hl_250, ..."
    option("--listeners", Path, text, required=True)
    text = "JSON file with each scene's listeners; by default every listener in every scene"
    option("--scenes-listeners", Path, text)
    text = "use every N-th pair of scene and listener"
    option("--every", count, text, 1)
    text = (
        "noise reduction of your own before each aid, package.module:name or path/to/file.py:name: a "
        "callable (waveform, sample_rate) -> waveform or its class, for (2, time) in pascals"
    )
    option("--enhancer", plugin_name, text, [], nargs="+", metavar="NAME", dest="enhancers")
    text = "let one level set the gains of both ears, in a hearing aid or wdrc"
    parser.flag("--linked", text)
    option("--full-scale-spl", number, "level in dB SPL of a file whose RMS is 1.0", 100.0)
    study_options(parser)


def _clarity(options: argparse.Namespace) -> None:
    prepare_study(options)
    check_paths_exist(
        folders=(options.scenes,), files=(options.listeners, options.scenes_listeners)
    )
    from hlsim.evaluation.clarity import evaluate_scenes
    from hlsim.report.clarity import scenes_page, write_scores

    evaluation = evaluate_scenes(
        labelled_names(options.names),
        scenes=options.scenes,
        listeners=options.listeners,
        out=options.out,
        scenes_listeners=options.scenes_listeners,
        every=options.every,
        enhancers=options.enhancers,
        measures=options.measure,
        linked=options.linked,
        full_scale_spl=options.full_scale_spl,
        seed=options.seed,
        jobs=options.jobs,
        dask=options.dask,
        progress=show_progress("values"),
    )
    write_scores(evaluation, options.out)
    finish(evaluation, scenes_page(evaluation, options.listen), options.out)
