"""The command ``prepare``."""

from __future__ import annotations

import argparse
from pathlib import Path

from hlsim.cli.options import Parser, slider


def prepare(parser: Parser) -> None:
    parser.runs(
        _prepare,
        "VoiceBank-DEMAND --out VoiceBank-DEMAND/manifest.csv --valid-share 0.1",
        "recordings --folders speaker --valid-share 0.1 --out recordings/manifest.csv",
    )
    option = parser.option
    option(
        "corpus",
        Path,
        "VoiceBank-DEMAND, LibriSpeech, LibriTTS or another folder with train, valid and test in it; or a CSV file with "
        "the column path, and any of noisy, speaker and split",
    )
    option(
        "--folders",
        str,
        "meaning of each level of folders in any other corpus, such as speaker, or split/speaker: split, speaker, "
        "condition (clean and noisy) or other",
        metavar="LEVEL/LEVEL",
    )
    option(
        "--valid-share",
        slider,
        "share of the training speakers to validate on, for a corpus without a validation split",
        0.0,
    )
    option("--out", Path, "CSV file to write, with paths relative to the corpus", required=True)


def _prepare(options: argparse.Namespace) -> None:
    if not options.corpus.exists():
        raise ValueError(f"{options.corpus}: no such folder or CSV file")
    from hlsim.training.corpora.layouts import prepare

    folders = options.folders.split("/") if options.folders else None
    corpus = prepare(options.corpus, options.out, folders=folders, valid_share=options.valid_share)
    root = options.corpus if options.corpus.is_dir() else options.corpus.parent
    print(corpus.to_text())
    print(f"written: {options.out}; to train on it: --manifest {options.out} --root {root}")
