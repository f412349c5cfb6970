"""The commands and programs of the guides run as printed, on a small corpus.

Trainings take two steps, and studies two items of one second. The bundled speech is two seconds of
four utterances, the properties of aids are measured with one of them, one tone and one position,
and evaluations have quick scores and no pictures.
"""

import csv
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

import hlsim
from hlsim.audio import write_audio
from hlsim.cli.main import main
from tests.helpers import copy_excerpts, measure_aids_briefly

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs/guide").glob("*.md"))]

NOT_RUN = {
    "python3 -m venv": "installs hlsim",
    ". .venv": "belongs to the line above it",
    "pip install": "installs packages",
    "hlsim live": "needs a microphone",
    "RNNoise": "needs pyrnnoise",
    "machine_listener.py": "needs a model of Whisper",
    "aid_loudness.py": "needs moonshine_voice",
    "listening_page.py": "needs npm",
    "http.server": "does not end",
    "HLSIM_GOLDEN": "takes minutes, and .ci/run does the same",
    "push_to_hub": "needs a network",
    "--srt": "takes minutes; tests/evaluation/test_compensators.py measures thresholds in noise",
    "speechbrain": "needs the toolkit; tests/test_toolkits.py runs it",
    "asteroid": "needs the toolkit; tests/test_toolkits.py runs it",
    "espnet2": "needs the toolkit; tests/test_toolkits.py runs it",
    "LightningModule": "is part of a program",
    "mine.ckpt": "is part of a program",
    "read_sas": "needs a file of NHANES; tests/audiogram/test_table.py runs it",
    'loss = hlsim.HearingLossLoss("N3", simulator': "is part of a program",
}
"""Texts in commands and programs that are not run, with the reason."""

SHORTER = {
    "hlsim train-": "--recipe.steps 2 --recipe.batch 2 --recipe.seconds 1 "
    "--recipe.validation_items 2",
    "hlsim evaluate-": "--items 2 --seconds 1 --jobs 1",
    "hlsim haspi-report": "--jobs 1",
    "hlsim clarity": "--jobs 1",
    "examples.training.dead_region_aid": "S2 2",
}
"""Options that commands that contain a text have instead of their own, or in addition."""


def _read_steps(page: Path) -> list[tuple[str, str]]:
    """Return the shell commands and Python programs of a page, in its order, with their kind."""
    text = page.read_text(encoding="utf-8")
    steps = []
    for kind, block in re.findall(r"```(sh|python)\n(.*?)```", text, re.DOTALL):
        if kind == "python":
            steps.append((kind, block))
        else:
            lines = re.sub(r"\\\n\s*", "", block).splitlines()
            commands = [line.strip() for line in lines]
            steps += [(kind, line) for line in commands if line and not line.startswith("#")]
    return [step for step in steps if not any(part in step[1] for part in NOT_RUN)]


UTTERANCES = (
    "train/flite-slt-01",
    "train/espeak-rp-f5-01",
    "valid/flite-rms-01",
    "valid/espeak-us-annie-01",
)
"""Bundled utterances of four voices, of which the guides find two seconds each."""


def _write_corpus(folder: Path) -> None:
    """Write the folders and files that the guides name."""
    for name in ("compensators", "checkpoints", "examples", "docs"):
        (folder / name).symlink_to(ROOT / name)
    bundled = ROOT / "hlsim" / "data" / "speech"
    paths = [bundled / f"{utterance}.flac" for utterance in UTTERANCES]
    for name in ("hlsim/data/speech", "speech"):
        copy_excerpts(paths, bundled, folder / name, seconds=2)
    (folder / "audiograms").mkdir()
    for split in ("train", "valid"):
        shutil.copy(ROOT / "examples" / "ears.csv", folder / "audiograms" / f"{split}.csv")

    clean = [hlsim.load_audio(path, sample_rate=16000)[0][:32000] for path in paths]
    generator = torch.Generator().manual_seed(0)
    noise = 0.005 * torch.randn(32000, generator=generator)
    recordings = {
        "noise/train": [noise],
        "noise/valid": [noise],
        "clean": clean,
        "before": [waveform + noise for waveform in clean],
        "after": [4.0 * waveform for waveform in clean],
        "recordings/train": clean[:2],
        "recordings/valid": clean[2:],
        **{f"VoxCeleb/id{number:02}/session": clean[:1] for number in range(20)},
        **{f"TIMIT/{split}/DR1/{split.lower()}1": clean[:1] for split in ("TRAIN", "TEST")},
        **{f"collection/set/clean/{speaker}": clean[:1] for speaker in ("a", "b")},
        **{f"collection/set/noisy/{speaker}": clean[:1] for speaker in ("a", "b")},
    }
    noisy = [waveform + noise for waveform in clean]
    for split in ("trainset_28spk", "testset"):
        recordings[f"VoiceBank-DEMAND/clean_{split}_wav"] = clean[:2]
        recordings[f"VoiceBank-DEMAND/noisy_{split}_wav"] = noisy[:2]
    for name, waveforms in recordings.items():
        (folder / name).mkdir(parents=True)
        for number, waveform in enumerate(waveforms):
            speaker = "p232_" if "testset" in name else "p226_"
            file = f"{speaker if 'VoiceBank' in name else ''}{number:03}.wav"
            write_audio(folder / name / file, waveform, 16000)
    for kind in ("clean", "noisy"):
        (folder / "dns" / "training" / kind).mkdir(parents=True)
        for number, waveform in enumerate(clean):
            file = f"{kind}_fileid_{number + 6}.wav"
            write_audio(folder / "dns" / "training" / kind / file, waveform, 16000)
    # the same recording for all microphones, which only a test may have
    for name, channels, reference in (("manifest", 4, "1 2"), ("array", 6, "1")):
        rows = ["path,noisy,split,reference"]
        for number, split in enumerate(("train", "train", "valid", "test")):
            (folder / name).mkdir(exist_ok=True)
            write_audio(folder / name / f"{number}.wav", noisy[number].expand(channels, -1), 16000)
            rows.append(f"clean/{number:03}.wav,{name}/{number}.wav,{split},{reference}")
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")
    (folder / "ears.csv").write_text("listener,ear,hl_500,hl_4000\nL1,left,30,60\nL1,right,20,50\n")
    _write_listeners(folder, clean[0])
    hlsim.save_compensator(hlsim.MappingCompensator(), folder / "runs" / "aid" / "checkpoint")


def _write_listeners(folder: Path, clean: torch.Tensor) -> None:
    """Write two listeners, a scene of two channels, and a study of recordings."""
    levels = [35, 35, 35, 40, 50, 55, 60, 65]
    entry = {
        "audiogram_cfs": [250, 500, 1000, 2000, 3000, 4000, 6000, 8000],
        "audiogram_levels_l": levels,
        "audiogram_levels_r": levels,
    }
    listeners = json.dumps({"L0001": entry, "L0002": entry})
    clarity = folder / "clarity_data"
    (clarity / "dev" / "scenes").mkdir(parents=True)
    (clarity / "metadata").mkdir()
    for path in (folder / "listeners.json", clarity / "metadata" / "listeners.json"):
        path.write_text(listeners)
    pairs = json.dumps({"S06001": ["L0001"]})
    (clarity / "metadata" / "scenes_listeners.dev.json").write_text(pairs)
    scene = torch.stack([clean, 0.7 * clean])
    write_audio(folder / "scene.wav", scene, 16000)
    for kind in ("mix", "target", "target_anechoic"):
        write_audio(clarity / "dev" / "scenes" / f"S06001_{kind}_CH1.wav", scene, 16000)
    outputs = folder / "exp" / "amplified_signals"
    outputs.mkdir(parents=True)
    write_audio(outputs / "S06001_L0001_HA-output.wav", scene, 16000)

    header = ["listener", "ear", *(f"hl_{hz}" for hz in entry["audiogram_cfs"])]
    with open(folder / "listeners.csv", "w", newline="") as file:
        csv.writer(file).writerows([header, ["L0001", "left", *levels]])
    with open(folder / "study.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["listener", "ear", "condition", "clean", "processed", "snr"])
        for condition, processed in (("unaided", "before"), ("NAL-R", "after")):
            for item in range(4):
                paths = [f"clean/{item:03}.wav", f"{processed}/{item:03}.wav"]
                table.writerow(["L0001", "left", condition, *paths, 10])


def _with_options(words: list[str], options: list[str]) -> list[str]:
    """Return the words of a command with options in place of those of the same names."""
    shorter = list(words)
    for option in options:
        if option.startswith("--") and option in shorter:
            place = shorter.index(option)
            del shorter[place : place + 2]
    return shorter + options


def _cases() -> Iterator[Any]:
    for page in PAGES:
        kinds = {kind for kind, _ in _read_steps(page)}
        if kinds:
            yield pytest.param(page, id=page.stem)


@pytest.mark.slow
@pytest.mark.usefixtures("quick_scores")
@pytest.mark.parametrize("page", list(_cases()))
def test_commands_and_programs_of_a_page_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for extra in ("lightning", "pandas", "matplotlib", "joblib", "torchmetrics"):
        pytest.importorskip(extra)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.syspath_prepend(ROOT)
    measure_aids_briefly(monkeypatch)
    # tests/report and those of the commands draw pictures
    monkeypatch.setattr("hlsim.report.plots._draw_svg", lambda *_: b"<svg></svg>")
    _write_corpus(tmp_path)
    names: dict[str, object] = {}  # each program goes on from the one before it
    for kind, text in _read_steps(page):
        if kind == "python":
            exec(compile(text.replace("items=12", "items=2, seconds=1.0"), page, "exec"), names)
            continue
        words = shlex.split(text.replace("network.pt N3 200", "network.pt N3 2"), comments=True)
        for part, options in SHORTER.items():
            words = _with_options(words, shlex.split(options)) if part in text else words
        if words[0] == "hlsim":
            assert main(words[1:]) == 0, text
        else:
            subprocess.run([sys.executable, *words[1:]], check=True, timeout=1200)
