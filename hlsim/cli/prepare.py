"""The command ``prepare``, which writes the manifest of a corpus."""

import argparse
from pathlib import Path

from hlsim.cli.options import Parser, count, input_path, share
from hlsim.progress import ProgressLine


def prepare(parser: Parser) -> None:
    """Declare the options of the command ``prepare``."""
    parser.set_command(
        _prepare,
        "VoiceBank-DEMAND --out VoiceBank-DEMAND/manifest.csv --valid-share 0.1",
        "recordings --folders speaker --valid-share 0.1 --out recordings/manifest.csv",
    )
    option = parser.option
    option(
        "corpus",
        input_path,
        "folder of VoiceBank-DEMAND, LibriSpeech, LibriTTS or Clarity's scenes, or another folder "
        "with the folders train, valid and test; or a CSV file with the column path, and "
        "optionally noisy, speaker, split and reference",
    )
    option(
        "--folders",
        str,
        "levels of folders in any other corpus, each split, speaker, condition (clean or noisy) "
        "or other; for example speaker, or split/speaker",
    )
    option(
        "--microphones",
        count,
        "numbers of the microphones of Clarity's scenes, the reference first; by default all",
        [],
        nargs="+",
    )
    option(
        "--valid-share",
        share,
        "share of the training speakers that are used for validation, if the corpus has no "
        "validation split",
        0.0,
    )
    option("--out", Path, "CSV file to write; its paths are relative to the corpus", required=True)


def _prepare(options: argparse.Namespace) -> None:
    from hlsim.data.layouts import prepare

    folders = options.folders.split("/") if options.folders else None
    with ProgressLine("files", "reading the corpus"):
        text = prepare(
            options.corpus,
            options.out,
            folders=folders,
            valid_share=options.valid_share,
            microphones=options.microphones,
        )
    print(text)
    root = options.corpus if options.corpus.is_dir() else options.corpus.parent
    print(f"written: {options.out}; train on it with --manifest {options.out} --root {root}")
