"""Clarity's scenes, made in the challenges' layout: names, levels, parity with pyclarity, resuming, errors."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from torch import Tensor

import hlsim
from hlsim.audio import read_audio
from hlsim.audiogram.listener import Listener
from hlsim.audiogram.table import read_listeners
from hlsim.cli.main import main
from hlsim.dsp.resample import resample
from hlsim.evaluation.clarity import (
    _conditions,
    _look_ahead,
    evaluate_scenes,
    read_pairs,
    read_scenes,
)
from hlsim.report.clarity import conditions_table, scenes_page

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
COMPRESSOR = {"fs": RATE, "attack": 50, "release": 1000, "threshold": 0.35, "attenuation": 0.1}
COMPRESSOR |= {
    "makeup_gain": 1,
    "rms_buffer_size": 0.064,
}  # recipes/icassp_2023/baseline/config.yaml
PAIRS = {"S06001": ["L0001", "L0002"], "S06002": ["L0001"]}


def ears(signal: np.ndarray, late: int, softer_db: float) -> np.ndarray:
    """What comes from one side: later and softer at the other ear."""
    other = np.concatenate([np.zeros(late), signal[: len(signal) - late]]) * 10 ** (-softer_db / 20)
    return np.stack([signal, other], 1)


def make_scenes(folder: Path, seconds: float = 1.0) -> Path:
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
        for end, signal in (
            ("mix_CH1", target + noise),
            ("target_CH1", target),
            ("target_anechoic_CH1", anechoic),
        ):
            soundfile.write(
                str(folder / "scenes" / f"{name}_{end}.wav"), signal, RATE, subtype="PCM_16"
            )
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

    def __call__(
        self, waveform: torch.Tensor, listener: Listener, sample_rate: int
    ) -> torch.Tensor:
        from clarity.enhancer.compressor import Compressor
        from clarity.enhancer.nalr import NALR
        from clarity.utils.audiogram import Audiogram

        nalr = NALR(nfir=220, sample_rate=sample_rate)
        compressor = Compressor(**COMPRESSOR)
        made = []
        for channel, ear in zip(
            waveform.double().numpy(), (listener.left, listener.right), strict=True
        ):
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
    for channel, ear in zip(
        signals["mix_CH1"].T, (person.audiogram_left, person.audiogram_right), strict=True
    ):
        amplified.append(compressor.process(nalr.apply(nalr.build(ear)[0], channel))[0])
    given = np.tanh(np.stack(amplified, 1)).astype(np.float32)
    level = (signals["target_CH1"] ** 2).mean(0) ** 0.5 / (
        signals["target_anechoic_CH1"] ** 2
    ).mean(0) ** 0.5
    reference = signals["target_anechoic_CH1"] * level
    both = {
        "reference_left": reference[:, 0],
        "reference_right": reference[:, 1],
        "sample_rate": RATE,
    }
    both |= {"processed_left": given[:, 0], "processed_right": given[:, 1], "listener": person}
    return {"haspi": haspi_v2_be(**both), "hasqi": hasqi_v2_better_ear(**both)}


@pytest.mark.slow
def test_the_challenges_baseline_has_its_scores(clarity: Path, tmp_path: Path) -> None:
    pytest.importorskip("clarity")
    aids = {"baseline": f"{__name__}:Baseline"}
    study = evaluate_scenes(aids, out=tmp_path, **options(clarity))
    assert study.failures.empty and study.table.item.nunique() == 3
    for row in study.table[study.table.condition == "baseline"].itertuples():
        for measure, expected in pyclaritys(clarity, row.utterance, row.listener).items():
            assert getattr(row, measure) == pytest.approx(expected, abs=1e-3), (row.name, measure)
    ahead = study.details["look_ahead_ms"]
    assert ahead["baseline"] == 0.0, "2.5 ms late, but never early"
    assert 2.0 < ahead["NAL-R"] <= 5.0


class FromTheFuture:
    """An aid that knows what comes in 8 ms."""

    fingerprint = "1"

    def __call__(self, waveform: Tensor, listener: Listener, sample_rate: int) -> Tensor:
        return 4.0 * waveform.roll(-(sample_rate * 8 // 1000), -1)


class HalfTheNoise:
    """An enhancer, which gets pascals."""

    fingerprint = "1"

    def __call__(self, waveform: Tensor, sample_rate: int) -> Tensor:
        if sample_rate == RATE:  # 0.014 in the file: 100 to 94 dB SPL
            assert 0.02 < float(waveform.square().mean().sqrt()) < 0.06
        return 0.5 * waveform


def test_the_command_writes_page_scores_and_signals_and_continues(
    clarity: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["clarity", clarity / "scenes", "soft=wdrc", f"early={__name__}:FromTheFuture"]
    arguments += ["--listeners", clarity / "listeners.json", "--jobs", "1", "--every", "2"]
    arguments += ["--scenes-listeners", clarity / "pairs.json", "--listen", "1", "--out", out]
    command = [*map(str, arguments), "--enhancer", f"{__name__}:HalfTheNoise"]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "HalfTheNoise + soft" in printed and "8.0 no" in " ".join(printed.split())
    with open(out / "scores.csv", newline="") as file:
        rows = [*csv.DictReader(file)]
    pairs = [(row["scene"], row["listener"]) for row in rows[::7]]
    assert pairs == [("S06001", "L0001"), ("S06002", "L0001")]
    for row in rows:
        mean = (float(row["haspi"]) + float(row["hasqi"])) / 2
        assert float(row["combined"]) == pytest.approx(mean, abs=1e-5)
    levels = {row["condition"]: float(row["level"]) for row in rows[:7]}
    assert levels["early"] - levels["unaided"] == pytest.approx(20 * np.log10(4), abs=0.1)
    signal = out / "signals" / "early" / "S06001_L0001_HA-output.wav"
    mix, _ = soundfile.read(str(clarity / "scenes" / "S06001_mix_CH1.wav"))
    output, rate = soundfile.read(str(signal))
    assert rate == RATE and np.allclose(output, 4 * np.roll(mix, -352, 0), atol=1e-6)
    assert (out / "report.html").read_text().count("<audio") == 5
    stored, report = (out / "scores.jsonl").read_text(), (out / "report.json").read_text()
    signal.unlink()
    other = out / "signals" / "soft" / "S06001_L0001_HA-output.wav"
    written = other.stat().st_mtime_ns
    assert main(command) == 0
    assert np.allclose(soundfile.read(str(signal))[0], output), "a lost signal is written again"
    assert other.stat().st_mtime_ns == written and (out / "report.json").read_text() == report
    assert (out / "scores.jsonl").read_text().startswith(stored)


def test_signals_of_another_aid_of_the_same_label_are_replaced(
    clarity: Path, tmp_path: Path
) -> None:
    signal = tmp_path / "signals" / "aid" / "S06001_L0001_HA-output.wav"
    outputs = []
    for name in ("wdrc", f"{__name__}:FromTheFuture", "wdrc"):
        evaluate_scenes({"aid": name}, out=tmp_path, **options(clarity, every=4))
        outputs.append(signal.read_bytes())
    assert outputs[0] == outputs[2] != outputs[1]


def test_linked_gains_and_a_reference_of_one_channel(clarity: Path, tmp_path: Path) -> None:
    folder = tmp_path / "third"  # names of the third challenge: the reference has its level
    folder.mkdir()
    for scene in PAIRS:
        signal, _ = soundfile.read(str(clarity / "scenes" / f"{scene}_target_anechoic_CH1.wav"))
        soundfile.write(str(folder / f"{scene}_reference.wav"), signal[:, 0], RATE)
        for ending in ("_mix_CH1.wav", "_target_CH1.wav"):
            (folder / f"{scene}{ending}").symlink_to(clarity / "scenes" / f"{scene}{ending}")
    settings = options(clarity, scenes=folder, scenes_listeners=None, every=4)
    apart, linked = (
        evaluate_scenes({"aid": "wdrc"}, out=tmp_path / str(own), linked=own, **settings).table
        for own in (False, True)
    )
    assert set(apart.name) == {"L0001 S06001"}
    assert (apart.haspi == linked.haspi).tolist() == [True, True, False]
    written, _ = soundfile.read(str(tmp_path / "True" / "reference" / "S06001.wav"))
    original, _ = soundfile.read(str(folder / "S06001_reference.wav"))
    assert np.allclose(written, original[:, None])


class Choosy:
    """Refuses loud scenes."""

    def __call__(self, waveform: Tensor, listener: Listener, sample_rate: int) -> Tensor:
        if waveform.abs().max() > LOUDEST[0]:
            raise ValueError("too loud for me")
        return 2.0 * waveform


LOUDEST = [math.inf]


def test_a_pair_that_one_aid_refuses_counts_in_no_mean_and_stops_nothing(
    clarity: Path, tmp_path: Path
) -> None:
    mixes = [clarity / "scenes" / f"{name}_mix_CH1.wav" for name in PAIRS]
    peaks = [np.abs(soundfile.read(str(mix))[0]).max() for mix in mixes]
    LOUDEST[0] = sum(peaks) / 2
    aids = {"choosy": f"{__name__}:Choosy", "soft": "wdrc"}
    study = evaluate_scenes(aids, out=tmp_path / "out", **options(clarity, every=2))
    (failure,) = study.failures.itertuples()  # of the better ear; both have the reason
    assert failure.condition == "choosy" and "too loud for me" in failure.failure
    table = conditions_table(study)
    caption = "Means of the 1 that all conditions have scores of, of 2 pairs of scene and listener"
    assert table.caption == caption
    kept = study.table[study.table.item != failure.item]
    assert [row[1] for row in table.rows] == [f"{score:.3f}" for score in kept.haspi]
    assert (study.details["look_ahead_ms"]["choosy"] is None) == (peaks[0] > peaks[1])
    nothing = study.table.assign(haspi=study.table.haspi.where(study.table.condition != "choosy"))
    cells = [row[1] for row in conditions_table(replace(study, table=nothing)).rows]
    assert cells[2] == "n/a" and "n/a" not in (cells[0], cells[1], cells[3])


def test_a_broken_scene_is_a_failure_with_its_file(clarity: Path, tmp_path: Path) -> None:
    folder = tmp_path / "scenes"
    shutil.copytree(clarity / "scenes", folder)
    signal, rate = soundfile.read(str(folder / "S06002_target_CH1.wav"))
    soundfile.write(str(folder / "S06002_target_CH1.wav"), signal[: len(signal) // 2], rate)
    settings = options(clarity, scenes=folder, every=2)
    study = evaluate_scenes({"aid": "wdrc"}, out=tmp_path / "out", **settings)
    assert set(study.failures.name) == {"L0001 S06002"}
    assert "S06002_target_CH1.wav has" in scenes_page(study, listen=0).markdown()


def test_the_look_ahead_is_known_for_a_scene_that_begins_in_silence(tmp_path: Path) -> None:
    sound = 0.02 * np.sin(np.arange(2.0 * RATE)).reshape(-1, 2)
    soundfile.write(tmp_path / "mix.wav", np.concatenate([np.zeros((5 * RATE, 2)), sound]), RATE)
    (tmp_path / "listeners.json").write_text(json.dumps(LISTENERS))
    listener = read_listeners(tmp_path / "listeners.json")["L0001"]
    conditions = _conditions({}, [], False, RATE, 94.0)
    ahead = _look_ahead(conditions, tmp_path / "mix.wav", listener)
    assert ahead["unaided"] == 0.0 and 1.0 < ahead["NAL-R"] <= 5.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenes": "listeners.json"}, "no such folder"),
        ({"scenes": "."}, "has no files"),
        ({"scenes_listeners": {"S06001": ["L0009"]}}, "listener 'L0009'"),
        ({"scenes_listeners": {"S9": ["L0001"]}}, "scene 'S9'"),
        ({"scenes_listeners": []}, "cannot be read"),
        ({"scenes_listeners": {}}, "no scene has a listener"),
        ({"every": 0}, "every is 0"),
        ({"aids": {"NAL-R": "wdrc"}}, "another label"),
        ({"aids": {"a b": "wdrc", "a-b": "wdrc"}}, "different names"),
        ({"aids": {"a": "no.such:thing"}}, "aid no.such:thing"),
        ({"full_scale_spl": float("nan")}, "full_scale_spl"),
    ],
)
def test_what_cannot_be_judged_is_rejected_before_anything_is_written(
    clarity: Path, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    settings = options(clarity, aids={"aid": "wdrc"}) | change
    if isinstance(pairs := settings["scenes_listeners"], dict | list):
        (tmp_path / "own.json").write_text(json.dumps(pairs))
        settings["scenes_listeners"] = tmp_path / "own.json"
    settings["scenes"] = clarity / settings["scenes"]
    with pytest.raises(ValueError, match=message):
        evaluate_scenes(settings.pop("aids"), out=tmp_path / "out", **settings)
    assert not (tmp_path / "out").exists()


def test_listeners_without_an_ear_or_with_odd_names_are_rejected(
    clarity: Path, tmp_path: Path
) -> None:
    scenes, people = read_scenes(clarity / "scenes"), read_listeners(clarity / "listeners.json")
    with pytest.raises(ValueError, match="the right ear of listener one is missing"):
        read_pairs(None, scenes, {"one": Listener(people["L0001"].left, None)})
    with pytest.raises(ValueError, match="a name that no file can have"):
        read_pairs(None, scenes, {"../x": people["L0001"]})
    (tmp_path / "S1_mix_CH1.wav").write_bytes(b"")
    with pytest.raises(ValueError, match=r"no reference; put S1_target_anechoic_CH1\.wav or"):
        read_scenes(tmp_path)
