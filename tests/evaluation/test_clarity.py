"""Clarity's scenes, made here in the challenges' layout: names, levels, scores beside pyclarity's, resuming, errors."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

import hlsim
from hlsim.audio import read_audio
from hlsim.cli.main import main
from hlsim.dsp.resample import resample
from hlsim.evaluation.clarity import evaluate_scenes, read_pairs, read_scenes
from hlsim.listener import Listener, read_listeners
from hlsim.report.clarity import conditions_table, write_scenes

RATE = 44100
SPEECH = Path(hlsim.__file__).parent / "data" / "speech" / "valid"
CFS = [250, 500, 1000, 2000, 3000, 4000, 6000, 8000]
LISTENERS = {
    "L0001": {
        "name": "L0001",
        "audiogram_cfs": CFS,
        "audiogram_levels_l": [35, 35, 35, 40, 50, 55, 60, 65],
        "audiogram_levels_r": [20, 20, 25, 35, 45, 50, 55, 55],
    },
    "L0002": {
        "name": "L0002",
        "audiogram_cfs": CFS,
        "audiogram_levels_l": [10, 15, 20, 30, 35, 45, 50, 50],
        "audiogram_levels_r": [55, 55, 60, 65, 70, 75, 80, 80],
    },
}
COMPRESSOR = {"fs": RATE, "attack": 5, "release": 20, "threshold": 0.35, "attenuation": 0.1}
COMPRESSOR |= {"makeup_gain": 1, "rms_buffer_size": 0.064}  # pyclarity's recipe
PAIRS = {"S06001": ["L0001", "L0002"], "S06002": ["L0001"]}


def ears(signal: np.ndarray, late: int, softer_db: float) -> np.ndarray:
    """What comes from one side: later and softer at the other ear."""
    other = np.concatenate([np.zeros(late), signal[: len(signal) - late]]) * 10 ** (-softer_db / 20)
    return np.stack([signal, other], 1)


def make_scenes(folder: Path, seconds: float = 1.5) -> Path:
    """Two scenes, noise from the other side than speech, in a room of one reflection, 16-bit."""
    (folder / "scenes").mkdir(parents=True)
    generator = np.random.default_rng(0)
    for name, path in zip(PAIRS, sorted(SPEECH.iterdir()), strict=False):
        waveform, rate = read_audio(path)
        speech = resample(waveform[0], rate, RATE).double().numpy()[: int(seconds * RATE)]
        speech = 0.02 * speech / speech.std()
        anechoic = ears(speech, 20, 5.0)
        target = 0.7 * (anechoic + 0.4 * np.roll(anechoic[:, ::-1], 900, 0))
        noise = ears(0.008 * generator.standard_normal(len(speech)), 25, 6.0)[:, ::-1]
        for end, signal in (("mix_CH1", target + noise), ("target_CH1", target), ("target_anechoic_CH1", anechoic)):
            soundfile.write(str(folder / "scenes" / f"{name}_{end}.wav"), signal, RATE, subtype="PCM_16")
    (folder / "listeners.json").write_text(json.dumps(LISTENERS))
    (folder / "pairs.json").write_text(json.dumps(PAIRS))
    return folder


@pytest.fixture(scope="module")
def clarity(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scenes(tmp_path_factory.mktemp("clarity"))


def options(folder: Path, **more: Any) -> dict[str, Any]:
    own = {"scenes": folder / "scenes", "listeners": folder / "listeners.json", "jobs": 1}
    return own | {"scenes_listeners": folder / "pairs.json"} | more


class Baseline:
    """Clarity's own: pyclarity's NAL-R and compressor with the challenge's settings, its delay kept, its tail cut."""

    def __call__(self, waveform: torch.Tensor, listener: Listener, sample_rate: int) -> torch.Tensor:
        from clarity.enhancer.compressor import Compressor
        from clarity.enhancer.nalr import NALR
        from clarity.utils.audiogram import Audiogram

        nalr = NALR(nfir=220, sample_rate=sample_rate)
        compressor = Compressor(**COMPRESSOR)
        made = []
        for channel, ear in zip(waveform.double().numpy(), (listener.left, listener.right), strict=True):
            assert ear is not None
            filtered = nalr.apply(nalr.build(Audiogram(ear.thresholds, CFS))[0], channel)
            made.append(np.tanh(compressor.process(filtered)[0]))
        return torch.from_numpy(np.stack(made)[:, : waveform.shape[-1]])


def pyclaritys(folder: Path, scene: str, listener: str) -> dict[str, float]:
    """The challenge's scores of its own baseline, all by pyclarity, in the steps of its script of ICASSP 2023."""
    from clarity.enhancer.compressor import Compressor
    from clarity.enhancer.nalr import NALR
    from clarity.evaluator.haspi import haspi_v2_be
    from clarity.evaluator.hasqi import hasqi_v2_better_ear
    from clarity.utils.audiogram import Listener as Clarity

    signals = {
        end: soundfile.read(str(folder / "scenes" / f"{scene}_{end}.wav"))[0]
        for end in ("mix_CH1", "target_CH1", "target_anechoic_CH1")
    }
    person = Clarity.from_dict(LISTENERS[listener])
    np.random.seed(int(hashlib.md5(scene.encode()).hexdigest(), 16) % 10**8)
    nalr, compressor = NALR(nfir=220, sample_rate=RATE), Compressor(**COMPRESSOR)
    amplified = []
    for channel, ear in zip(signals["mix_CH1"].T, (person.audiogram_left, person.audiogram_right), strict=True):
        amplified.append(compressor.process(nalr.apply(nalr.build(ear)[0], channel))[0])
    given = np.tanh(np.stack(amplified, 1)).astype(np.float32)
    level = (signals["target_CH1"] ** 2).mean(0) ** 0.5 / (signals["target_anechoic_CH1"] ** 2).mean(0) ** 0.5
    reference = signals["target_anechoic_CH1"] * level
    both = {"reference_left": reference[:, 0], "reference_right": reference[:, 1], "sample_rate": RATE}
    both |= {"processed_left": given[:, 0], "processed_right": given[:, 1], "listener": person}
    return {"haspi": haspi_v2_be(**both), "hasqi": hasqi_v2_better_ear(**both)}


def test_the_challenges_baseline_has_its_scores(clarity: Path, tmp_path: Path) -> None:
    pytest.importorskip("clarity")
    aids = {"baseline": f"{__name__}:Baseline"}
    report = evaluate_scenes(aids, out=tmp_path, **options(clarity))
    assert not report.failures and len(report.items) == 3
    for item in report.items:
        scene = item.file.removeprefix(f"{item.listener} ")
        for measure, expected in pyclaritys(clarity, scene, item.listener).items():
            assert item.scores[measure]["baseline"] == pytest.approx(expected, abs=1e-3), (item.file, measure)
