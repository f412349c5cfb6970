"""The paper's last table: python examples/paper/haspi_table.py VOICEBANK OUT --audiograms EARS.csv

HASPI before and after compensation of VoiceBank's 824 test utterances, two ears each, n = 1648, with paired tests.
VOICEBANK holds clean_testset_wav and noisy_testset_wav. Writes the files and a manifest into OUT, and the report into
OUT/report; if it is stopped, the same command continues. The paper has 0.428 before and 0.616 after, d = 0.594.
"""

import argparse
import csv
import sys
from pathlib import Path

import torch

from compensators import load_compensator
from hlsim.audio import write_audio
from hlsim.audiogram.table import read_audiograms
from hlsim.cli.progress import show_progress
from hlsim.evaluation import haspi_report
from hlsim.neuro.config import NEURO_RATE
from hlsim.report.recordings import write_report
from hlsim.training.corpora.instances import Instances, draw_ears
from hlsim.training.corpora.layouts import find_corpus


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("corpus", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--audiograms", type=Path, help="CSV of unseen ears; drawn ears, mild to severe, without"
    )
    parser.add_argument("--input", choices=("clean", "noisy"), default="clean")
    parser.add_argument("--compensators", nargs="+", default=["nalr", "compensator-general"])
    parser.add_argument("--jobs", type=int, help="processes; all cores by default")
    options = parser.parse_args(arguments)
    out = options.out
    test = [row for row in find_corpus(options.corpus).utterances if row.split == "test"]
    if options.audiograms is None:
        ears = draw_ears(2 * len(test), "test")
    else:
        ears = [ear for _, ear in read_audiograms(options.audiograms, simulated=True)]
    instances = Instances(test, options.corpus, ears)  # at 65 dB SPL, active speech level
    models = {Path(name).name: load_compensator(name) for name in options.compensators}
    if len(models) < len(options.compensators):
        sys.exit(f"{', '.join(options.compensators)}: two have one name; give folders of others")
    for condition in ("clean", "unaided", *models):
        (out / condition).mkdir(parents=True, exist_ok=True)
    chosen = [(utterance, ear) for utterance, ear, name in instances.items if name == options.input]
    rows = []
    show = show_progress("ears")
    for number, (utterance, ear) in enumerate(chosen):
        name = f"{Path(utterance.path).stem}-{number}.wav"
        clean, noisy = instances.read(utterance)
        signal = clean if options.input == "clean" else noisy
        with torch.no_grad():
            aided = {condition: model(signal, ear) for condition, model in models.items()}
        for condition, output in {"clean": clean, "unaided": signal, **aided}.items():
            write_audio(out / condition / name, output, NEURO_RATE)
            if condition != "clean":
                files = {"clean": f"clean/{name}", "processed": f"{condition}/{name}"}
                rows.append({"condition": condition, **files, **ear.to_row()})
        show(number + 1, len(chosen))
    write_table(out / "table.csv", rows)
    report = haspi_report(
        manifest=out / "table.csv",
        store=out / "report" / "scores.jsonl",
        jobs=options.jobs,
        progress=show_progress("values"),
    )
    assert report.headline is not None
    print(report.headline.verdict())
    print(write_report(report, out / "report", listen=0))


def write_table(path: Path, rows: list[dict[str, str]]) -> None:
    if not rows:
        sys.exit(f"{path}: no rows; the corpus needs clean_testset_wav and noisy_testset_wav")
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main(sys.argv[1:])
