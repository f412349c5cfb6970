"""The paper's last table: HASPI before and after compensation.

    python examples/paper/haspi_table.py VOICEBANK OUT --audiograms EARS.csv

The 824 test utterances of VoiceBank are scored for two ears each (n = 1648), with paired tests.
VOICEBANK contains clean_testset_wav and noisy_testset_wav. The audio files and a manifest are
written into OUT, and the report into OUT/report. If the command is stopped, the same command
continues. The paper has 0.428 before and 0.616 after compensation, with d = 0.594.
"""

import argparse
import csv
import sys
from pathlib import Path

import torch
from instances import Instances, draw_ears

from compensators import load_compensator
from hlsim.audio import write_audio
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import NEURO_RATE
from hlsim.data.layouts import find_corpus
from hlsim.evaluation import haspi_report
from hlsim.progress import ProgressLine
from hlsim.report.recordings_page import write_report
from hlsim.report.verdict import verdict


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("corpus", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--audiograms",
        type=Path,
        help="CSV file of ears that were not trained on; random ears by default",
    )
    parser.add_argument("--input", choices=("clean", "noisy"), default="clean")
    parser.add_argument("--compensators", nargs="+", default=["nalr", "compensator-general"])
    parser.add_argument("--jobs", type=int, help="number of processes; one per core by default")
    options = parser.parse_args(arguments)
    out = options.out
    _, utterances = find_corpus(options.corpus)
    test = [row for row in utterances if row.split == "test"]
    if options.audiograms is None:
        ears = draw_ears(2 * len(test), "test")
    else:
        ears = [ear for _, ear in read_audiograms(options.audiograms, simulated=True)]
    instances = Instances(test, options.corpus, ears)  # at an active level of 65 dB SPL
    models = {Path(name).name: load_compensator(name) for name in options.compensators}
    if len(models) < len(options.compensators):
        sys.exit(f"{', '.join(options.compensators)}: two have the same name; rename a folder")
    for condition in ("clean", "unaided", *models):
        (out / condition).mkdir(parents=True, exist_ok=True)
    items = [(utterance, ear) for utterance, ear, name in instances.items if name == options.input]
    rows = []
    progress = ProgressLine("ears")
    for number, (utterance, ear) in enumerate(items):
        name = f"{Path(utterance.path).stem}-{number}.wav"
        clean, noisy = instances.read(utterance)
        signal = clean if options.input == "clean" else noisy
        with torch.no_grad():
            outputs = {condition: model(signal, ear) for condition, model in models.items()}
        for condition, output in {"clean": clean, "unaided": signal, **outputs}.items():
            write_audio(out / condition / name, output, NEURO_RATE)
            if condition != "clean":
                files = {"clean": f"clean/{name}", "processed": f"{condition}/{name}"}
                rows.append({"condition": condition, **files, **ear.to_row()})
        progress(number + 1, len(items))
    write_table(out / "table.csv", rows)
    with ProgressLine("values") as progress:
        report = haspi_report(
            manifest=out / "table.csv",
            store=out / "report" / "scores.jsonl",
            jobs=options.jobs,
            progress=progress,
        )
    assert report.headline is not None
    print(verdict(report.headline))
    print(write_report(report, out / "report"))


def write_table(path: Path, rows: list[dict[str, str]]) -> None:
    """Write rows as a CSV file, or exit if there are none."""
    if not rows:
        sys.exit(f"{path}: no rows; the corpus requires clean_testset_wav and noisy_testset_wav")
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main(sys.argv[1:])
