"""Clarity's scenes, made here in the challenges' layout: names, levels, scores beside pyclarity's, resuming, errors."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

import hlsim
from hlsim.audio import read_audio
from hlsim.audiogram.listener import Listener, read_listeners
from hlsim.cli.main import main
from hlsim.dsp.resample import resample
from hlsim.evaluation.previous.clarity import (
    _conditions,
    _looks_ahead,
    evaluate_scenes,
    read_pairs,
    read_scenes,
)
from hlsim.report.previous.clarity import conditions_table, write_scenes

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


def test_the_challenges_baseline_has_its_scores(clarity: Path, tmp_path: Path) -> None:
    pytest.importorskip("clarity")
    aids = {"baseline": f"{__name__}:Baseline"}
    report = evaluate_scenes(aids, out=tmp_path, **options(clarity))
    assert not report.failures and len(report.items) == 3
    for item in report.items:
        scene = item.file.removeprefix(f"{item.listener} ")
        for measure, expected in pyclaritys(clarity, scene, item.listener).items():
            assert item.scores[measure]["baseline"] == pytest.approx(expected, abs=1e-3), (
                item.file,
                measure,
            )
    assert report.extra["looks_ahead_ms"]["baseline"] == 0.0  # late by 2.5 ms, but never early
    assert 2.0 < report.extra["looks_ahead_ms"]["NAL-R"] <= 5.0


def test_a_scene_that_begins_in_silence_still_tells_how_far_an_aid_looks_ahead(
    tmp_path: Path,
) -> None:
    mix = tmp_path / "mix.wav"
    soundfile.write(
        mix,
        np.concatenate(
            [np.zeros((5 * RATE, 2)), 0.02 * np.sin(np.arange(2.0 * RATE)).reshape(-1, 2)]
        ),
        RATE,
    )
    (tmp_path / "listeners.json").write_text(json.dumps(LISTENERS))
    listener = read_listeners(tmp_path / "listeners.json")["L0001"]
    ahead = _looks_ahead(_conditions({}, [], False, RATE, 94.0), mix, listener)
    assert ahead["unaided"] == 0.0 and 1.0 < ahead["NAL-R"] <= 5.0


def unchanged(waveform: torch.Tensor, sample_rate: int) -> torch.Tensor:
    return waveform


def test_two_enhancers_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match="the same name after the colon"):
        _conditions({}, [f"{__name__}:unchanged", f"{__name__}:unchanged"], False, RATE, 94.0)


class FromTheFuture:
    """An aid that knows what comes in 8 ms."""

    def __call__(
        self, waveform: torch.Tensor, listener: Listener, sample_rate: int
    ) -> torch.Tensor:
        return 4.0 * waveform.roll(-(sample_rate * 8 // 1000), -1)


class HalfTheNoise:
    """An enhancer, which is given pascals."""

    def __call__(self, waveform: torch.Tensor, sample_rate: int) -> torch.Tensor:
        if sample_rate == RATE:
            assert (
                0.02 < float(waveform.square().mean().sqrt()) < 0.06
            )  # 0.014 in the file: 100 to 94 dB SPL
        return 0.5 * waveform


def test_the_command_writes_page_scores_and_signals_and_goes_on(
    clarity: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["clarity", clarity / "scenes", "soft=wdrc", f"early={__name__}:FromTheFuture"]
    arguments += [
        "--listeners",
        clarity / "listeners.json",
        "--scenes-listeners",
        clarity / "pairs.json",
    ]
    arguments += [
        "--enhancer",
        f"{__name__}:HalfTheNoise",
        "--out",
        out,
        "--jobs",
        "1",
        "--every",
        "2",
    ]
    text = [*map(str, arguments)]
    assert main(text) == 0
    printed = capsys.readouterr().out
    assert "HalfTheNoise + soft" in printed and "8.0 no" in " ".join(printed.split())
    assert {"report.html", "report.json", "scores.csv"} <= {path.name for path in out.iterdir()}
    with open(out / "scores.csv", newline="") as file:
        rows = [*csv.DictReader(file)]
    assert [(row["scene"], row["listener"]) for row in rows[::7]] == [
        ("S06001", "L0001"),
        ("S06002", "L0001"),
    ]
    for row in rows:
        assert float(row["combined"]) == pytest.approx(
            (float(row["haspi"]) + float(row["hasqi"])) / 2, abs=1e-5
        )
    levels = {row["condition"]: float(row["level"]) for row in rows[:7]}
    assert levels["early"] - levels["unaided"] == pytest.approx(20 * np.log10(4), abs=0.1)
    signal = out / "signals" / "early" / "S06001_L0001_HA-output.wav"
    mix, _ = soundfile.read(str(clarity / "scenes" / "S06001_mix_CH1.wav"))
    made, rate = soundfile.read(str(signal))
    assert rate == RATE and np.allclose(made, 4 * np.roll(mix, -352, 0), atol=1e-6)

    stored = {
        name: (out / name).read_text() for name in ("signals.jsonl", "scores.jsonl", "report.json")
    }
    signal.write_bytes(b"gone")
    assert main(text) == 0
    assert np.allclose(soundfile.read(str(signal))[0], made)  # made anew; no other, and no score
    assert (out / "scores.jsonl").read_text() == stored["scores.jsonl"]
    assert (out / "report.json").read_text() == stored["report.json"]
    assert (
        len((out / "signals.jsonl").read_text().splitlines())
        == len(stored["signals.jsonl"].splitlines()) + 1
    )


def test_linked_gains_and_a_reference_of_one_channel(clarity: Path, tmp_path: Path) -> None:
    folder = tmp_path / "third"  # the third challenge's names: the reference has its level
    folder.mkdir()
    for scene in PAIRS:
        signal, _ = soundfile.read(str(clarity / "scenes" / f"{scene}_target_anechoic_CH1.wav"))
        soundfile.write(str(folder / f"{scene}_reference.wav"), signal[:, 0], RATE)
        (folder / f"{scene}_mix_CH1.wav").symlink_to(clarity / "scenes" / f"{scene}_mix_CH1.wav")
        (folder / f"{scene}_target_CH1.wav").symlink_to(
            clarity / "scenes" / f"{scene}_target_CH1.wav"
        )
    given = options(clarity, scenes=folder, scenes_listeners=None, every=4)
    apart, linked = (
        evaluate_scenes({"aid": "wdrc"}, out=tmp_path / str(own), linked=own, **given)
        for own in (False, True)
    )
    assert [item.file for item in apart.items] == ["L0001 S06001"]
    assert apart.items[0].scores["haspi"]["unaided"] == linked.items[0].scores["haspi"]["unaided"]
    assert apart.items[0].scores["hasqi"]["aid"] != linked.items[0].scores["hasqi"]["aid"]
    made, _ = soundfile.read(str(tmp_path / "True" / "reference" / "S06001.wav"))
    original, _ = soundfile.read(str(folder / "S06001_reference.wav"))
    assert np.allclose(made, original[:, None])


def test_one_broken_scene_is_told_and_the_others_go_on(clarity: Path, tmp_path: Path) -> None:
    folder = tmp_path / "scenes"
    folder.mkdir()
    for path in (clarity / "scenes").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    cut, rate = soundfile.read(str(folder / "S06002_target_CH1.wav"))
    soundfile.write(str(folder / "S06002_target_CH1.wav"), cut[:-5], rate)
    report = evaluate_scenes(
        {"aid": "wdrc"}, out=tmp_path / "out", **options(clarity, scenes=folder, every=2)
    )
    assert [item.file for item in report.items] == ["L0001 S06001"]
    assert len(report.failures) == 6 and "allowed: the mix's" in report.failures[0].reason
    write_scenes(report, tmp_path / "page", listen=0)
    assert "S06002" in (tmp_path / "page" / "report.md").read_text()
    assert len(conditions_table(report).rows) == 3


class Choosy:
    """Refuses the first listener's second scene, and so does not look ahead on the first pair."""

    def __call__(
        self, waveform: torch.Tensor, listener: Listener, sample_rate: int
    ) -> torch.Tensor:
        if waveform.abs().max() > float(LOUDEST[0]):
            raise ValueError("too loud for me")
        return 2.0 * waveform


LOUDEST = [torch.inf]


def test_means_are_of_the_pairs_that_all_have_and_a_refused_pair_stops_nothing(
    clarity: Path, tmp_path: Path
) -> None:
    peaks = [
        np.abs(soundfile.read(str(clarity / "scenes" / f"{name}_mix_CH1.wav"))[0]).max()
        for name in PAIRS
    ]
    LOUDEST[0] = sum(peaks) / 2
    own = options(clarity, every=2)
    report = evaluate_scenes(
        {"choosy": f"{__name__}:Choosy", "soft": "wdrc"}, out=tmp_path / "out", **own
    )
    assert (
        report.conditions == ("unaided", "NAL-R", "choosy", "soft")
        and report.headline.after == "soft"
    )
    table = conditions_table(report)
    assert (
        table.caption == "Means of the 1 that all have scores of, of 2 pairs of scene and listener"
    )
    kept = int(np.isfinite(report.scores("haspi")[:, 2]).argmax())
    assert [row[1] for row in table.rows] == [
        f"{score:.3f}" for score in report.scores("haspi")[kept]
    ]
    scores = np.array([[0.1, 0.2, np.nan, 0.4], [0.3, 0.4, np.nan, 0.6]])
    none = SimpleNamespace(
        scores=lambda measure: scores,
        levels=lambda: 100.0 * scores,
        **{name: getattr(report, name) for name in ("items", "conditions", "extra")},
    )
    assert [row[1] for row in conditions_table(none).rows] == ["0.200", "0.300", "n/a", "0.500"]
    looks = report.extra["looks_ahead_ms"]
    assert (looks["choosy"] is None) == (peaks[0] > peaks[1]) and looks["soft"] > 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenes": "listeners.json"}, "no such folder"),
        ({"scenes": "."}, "no scenes"),
        ({"scenes_listeners": {"S06001": ["L0009"]}}, "no listener 'L0009'"),
        ({"scenes_listeners": {"S9": ["L0001"]}}, "no scene 'S9'"),
        ({"scenes_listeners": []}, "cannot be read"),
        ({"scenes_listeners": {}}, "no scene has a listener"),
        ({"every": 0}, "every is 0"),
        ({"aids": {"NAL-R": "wdrc"}}, "other names"),
        ({"aids": {"a b": "wdrc", "a-b": "wdrc"}}, "letters and digits"),
        ({"aids": {"a": "no.such:thing"}}, "aid no.such:thing"),
        ({"full_scale_spl": float("nan")}, "full_scale_spl"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(
    clarity: Path, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    given = options(clarity, aids={"aid": "wdrc"}) | change
    if isinstance(pairs := given["scenes_listeners"], dict | list):
        (tmp_path / "own.json").write_text(json.dumps(pairs))
        given["scenes_listeners"] = tmp_path / "own.json"
    given["scenes"] = clarity / given["scenes"]
    with pytest.raises(ValueError, match=message):
        evaluate_scenes(given.pop("aids"), out=tmp_path / "out", **given)
    assert not (tmp_path / "out").exists()


def test_listeners_without_an_ear_or_of_odd_names_are_refused(clarity: Path) -> None:
    scenes, people = read_scenes(clarity / "scenes"), read_listeners(clarity / "listeners.json")
    with pytest.raises(ValueError, match="the right ear is missing"):
        read_pairs(None, scenes, {"one": Listener(people["L0001"].left, None)})
    with pytest.raises(ValueError, match="a name that a file can have"):
        read_pairs(None, scenes, {"../x": people["L0001"]})
    (clarity / "lost").mkdir()
    (clarity / "lost" / "S1_mix_CH1.wav").write_bytes(b"")
    with pytest.raises(ValueError, match=r"no reference; allowed: S1_target_anechoic_CH1\.wav or"):
        read_scenes(clarity / "lost")
