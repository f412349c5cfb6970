"""Processor time of whole commands, with start-up and page, beside pyclarity's own recipes.

    python docs/figures/whole_commands.py [ROUNDS]

Two scenes of 4 s at 44.1 kHz, of bundled speech in babble, are scored for two listeners, with the
output of pyclarity's NAL-R; the rows of 3 s have the noisy or clean speech itself. Each command
runs as a process of its own. The times are those of all its processes, with one thread each; the
commands run in turn, and the table has the median of the rounds. A first round, which is not
counted, compiles the packages to bytecode, as pip does when it installs them.
"""

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from clarity.enhancer.nalr import NALR
from numpy.typing import NDArray
from scipy.io import wavfile

from hlsim import Audiogram
from hlsim.audio import read_audio
from hlsim.calibration import set_level
from hlsim.data.bundled import SPEECH
from hlsim.dsp.resample import resample

RATE = 44100
SECONDS = 4
EARS = {"L1": ("N2", "N3"), "L2": ("N3", "S2")}
SCENES = ("S00001", "S00002")
SHORT_SAMPLES = 3 * RATE
SPEECH_SPL = 65.0
SNR = 3.0
FULL_SCALE_SPL = 100.0  # of pyclarity's haspi_v2 and hasqi_v2

PAIR = """
import numpy as np
from clarity.evaluator.haspi import haspi_v2
from clarity.utils.audiogram import Audiogram
from scipy.io import wavfile
rate, clean = wavfile.read("pair/clean/a.wav")
_, output = wavfile.read("pair/output/a.wav")
ear = Audiogram(levels=np.array({levels}), frequencies=np.array({frequencies}))
print(haspi_v2(clean, rate, output, rate, ear, level1=100.0)[0])
"""

SIMULATE = """
from clarity.evaluator.msbg.msbg import Ear
from clarity.utils.audiogram import Audiogram
from scipy.io import wavfile
import numpy as np
rate, clean = wavfile.read("pair/clean/a.wav")
ear = Ear(src_pos="ff", equiv_0db_spl=100.0)
ear.set_audiogram(Audiogram(levels=np.array({levels}), frequencies=np.array({frequencies})))
wavfile.write("perceived.wav", rate, ear.process(clean)[0].astype(np.float32))
"""

MUSIC = """
import numpy as np
from clarity.evaluator.haaqi import compute_haaqi
from clarity.utils.audiogram import Audiogram
from scipy.io import wavfile
ear = Audiogram(levels=np.array({levels}), frequencies=np.array({frequencies}))
rate, clean = wavfile.read("music/clean/a.wav")
_, output = wavfile.read("music/output/a.wav")
for channel in (0, 1):
    print(compute_haaqi(output[:, channel], clean[:, channel], rate, rate, ear, 1, 100.0))
"""

Signals = NDArray[np.float64]


def make_scene(number: int) -> tuple[Signals, Signals]:
    """Make clean speech and speech in babble. Shape: -> (time, 2) twice, full scale 100 dB SPL."""
    files = sorted((SPEECH / "valid").glob("*.flac"))
    voices = []
    for path in files[6 * number : 6 * number + 6]:
        waveform, rate = read_audio(path)
        voice = resample(waveform[0].double(), rate, RATE).repeat(4)[: SECONDS * RATE]
        voices.append(set_level(voice, SPEECH_SPL, full_scale_spl=FULL_SCALE_SPL))
    speech, *maskers = voices
    babble = set_level(torch.stack(maskers).sum(0), SPEECH_SPL - SNR, full_scale_spl=FULL_SCALE_SPL)
    clean = torch.stack((speech, 0.8 * speech), -1)
    mixture = clean + torch.stack((babble, babble.roll(20)), -1)
    return clean.numpy(), mixture.numpy()


def write(path: Path, signals: Signals) -> None:
    """Write a file of 16 bits, as those of the challenges are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    wavfile.write(path, RATE, np.round(32768.0 * signals).clip(-32768, 32767).astype(np.int16))


def write_data(root: Path) -> None:
    """Write scenes, outputs, listeners and manifests in the layout of pyclarity's recipes."""
    scenes = root / "clarity_data" / "dev" / "scenes"
    metadata = root / "clarity_data" / "metadata"
    metadata.mkdir(parents=True)
    listeners = {}
    for name, ears in EARS.items():
        left, right = (list(Audiogram.standard(ear).thresholds) for ear in ears)
        frequencies = Audiogram.standard("N3").to_clarity().frequencies.tolist()
        listeners[name] = {
            "name": name,
            "audiogram_cfs": frequencies,
            "audiogram_levels_l": left,
            "audiogram_levels_r": right,
        }
    (metadata / "listeners.json").write_text(json.dumps(listeners))
    pairs = json.dumps({scene: list(EARS) for scene in SCENES})
    (metadata / "scenes_listeners.dev.json").write_text(pairs)
    rows = ["listener,ear,condition,clean,processed,item"]
    aid = NALR(220, RATE)
    for number, scene in enumerate(SCENES):
        clean, mixture = make_scene(number)
        for kind, signals in {"mix": mixture, "target": clean, "target_anechoic": clean}.items():
            write(scenes / f"{scene}_{kind}_CH1.wav", signals)
        for name, ears in EARS.items():
            filtered = []
            for channel, ear in enumerate(ears):
                taps, _ = aid.build(Audiogram.standard(ear).to_clarity())
                filtered.append(aid.apply(taps, mixture[:, channel])[: len(mixture)])
            output = root / "enhanced_signals" / f"{scene}_{name}_HA-output.wav"
            write(output, np.tanh(np.stack(filtered, -1)))
            write(root / "enhanced_signals" / f"{scene}_{name}_enhanced.wav", mixture)
            for ear in ("left", "right"):
                start = f"{name},{ear}"
                reference = f"{scenes}/{scene}_target_anechoic_CH1.wav"
                rows.append(f"{start},noisy,{reference},{scenes}/{scene}_mix_CH1.wav,{scene}")
                rows.append(f"{start},aid,{reference},{output},{scene}")
    (root / "two_conditions.csv").write_text("\n".join(rows))
    aided = [rows[0], *(row for row in rows if ",aid," in row)]
    (root / "one_condition.csv").write_text("\n".join(aided))
    for folder, channels in {"pair": slice(0, 1), "music": slice(0, 2)}.items():
        for name, signals in {"clean": clean, "output": mixture}.items():
            write(root / folder / name / "a.wav", signals[:SHORT_SAMPLES, channels].squeeze())
    music = ["ear,condition,clean,processed,audiogram"]
    music += [f"{ear},aid,music/clean/a.wav,music/output/a.wav,N3" for ear in ("left", "right")]
    (root / "music.csv").write_text("\n".join(music))


def commands(root: Path) -> dict[str, tuple[Sequence[str], Sequence[str]]]:
    """Return pyclarity's and hlsim's command for each row of the table."""
    ear = Audiogram.standard("N3").to_clarity()
    levels = {"levels": ear.levels.tolist(), "frequencies": ear.frequencies.tolist()}
    python, hlsim = [sys.executable], [sys.executable, "-m", "hlsim"]
    recipe = [f"path.root={root}", f"path.exp_folder={root}"]
    report = [*hlsim, "haspi-report", "--full-scale-spl", "100", "--jobs", "1"]
    listeners = ["--audiograms", f"{root}/clarity_data/metadata/listeners.json"]
    both_scores = ["--measures", "haspi,hasqi", "--out", "icassp"]
    folders = ["--clean", "pair/clean", "--after", "pair/output"]
    return {
        "CEC2 evaluation, 16 HASPI": (
            [*python, "-m", "recipes.cec2.baseline.evaluate", *recipe],
            [*report, "--manifest", "two_conditions.csv", *listeners, "--out", "cec2"],
        ),
        "ICASSP 2023, 8 HASPI and 8 HASQI": (
            [*python, "-m", "recipes.icassp_2023.baseline.evaluate", *recipe],
            [*report, "--manifest", "one_condition.csv", *listeners, *both_scores],
        ),
        "HAAQI of 3 s, stereo": (
            [*python, "-c", MUSIC.format(**levels)],
            [*report, "--manifest", "music.csv", "--measures", "haaqi", "--out", "haaqi"],
        ),
        "HASPI of 3 s": (
            [*python, "-c", PAIR.format(**levels)],
            [*report, *folders, "--audiogram", "N3", "--out", "haspi"],
        ),
        "MSBG of 3 s": (
            [*python, "-c", SIMULATE.format(**levels)],
            [*hlsim, "simulate", "pair/clean/a.wav", "perceived.wav", "--audiogram", "N3"],
        ),
    }


def run(command: Sequence[str], root: Path) -> float:
    """Return the processor time in seconds of a command and of the processes that it starts."""
    results = [root / "si.csv", root / "si_unproc.csv", root / "scores.csv"]
    folders = [root / name for name in ("cec2", "icassp", "haaqi", "haspi")]
    for path in [*results, *(folder / "scores.jsonl" for folder in folders)]:
        path.unlink(missing_ok=True)  # stored scores are not computed again
    settings = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    settings |= {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(root / "bytecode")}
    before = os.times()
    finished = subprocess.run(
        command, cwd=root, env=settings, capture_output=True, text=True, check=False
    )
    if finished.returncode:
        raise SystemExit(f"{' '.join(command)}\n{finished.stdout}\n{finished.stderr}")
    after = os.times()
    return (after.children_user - before.children_user) + (
        after.children_system - before.children_system
    )


def main(rounds: str = "3") -> None:
    with TemporaryDirectory() as folder:
        root = Path(folder)
        write_data(root)
        pairs = commands(root)
        times: dict[str, list[list[float]]] = {name: [[], []] for name in pairs}
        for round_ in range(int(rounds) + 1):
            for name, pair in pairs.items():
                for command, seconds in zip(pair, times[name], strict=True):
                    elapsed = run(command, root)
                    if round_ > 0:
                        seconds.append(elapsed)
    print("| | pyclarity (s) | hlsim (s) | ratio |\n|---|---|---|---|")
    for name, seconds in times.items():
        pyclarity, hlsim = map(statistics.median, seconds)
        print(f"| {name} | {pyclarity:.1f} | {hlsim:.1f} | {pyclarity / hlsim:.1f} |")


if __name__ == "__main__":
    main(*sys.argv[1:])
