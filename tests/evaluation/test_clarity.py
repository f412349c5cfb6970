"""Clarity's scenes: files, levels, parity with pyclarity, continued runs, and errors."""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from torch import Tensor

from compensators import MappingCompensator, MappingConfig, save_compensator
from hlsim.audio import read_audio
from hlsim.audiogram.listener import Listener
from hlsim.audiogram.table import read_listeners
from hlsim.cli.main import main
from hlsim.data import bundled
from hlsim.dsp.resample import resample
from hlsim.evaluation.clarity import evaluate_scenes
from hlsim.evaluation.result import Evaluation
from hlsim.files import lock_folder
from hlsim.report import recordings_page
from hlsim.report.recordings_page import _conditions_table, scenes_page

RATE = 44100
LOW_RATE = 16000
SPEECH = bundled.SPEECH / "valid"
CFS = [250, 500, 1000, 2000, 3000, 4000, 6000, 8000]
EARS = {
    "L0001": ([35, 35, 35, 40, 50, 55, 60, 65], [20, 20, 25, 35, 45, 50, 55, 55]),
    "L0002": ([10, 15, 20, 30, 35, 45, 50, 50], [55, 55, 60, 65, 70, 75, 80, 80]),
}
LISTENERS = {
    name: {"audiogram_cfs": CFS, "audiogram_levels_l": left, "audiogram_levels_r": right}
    for name, (left, right) in EARS.items()
}
PAIRS = {"S06001": ["L0001", "L0002"], "S06002": ["L0001"]}


def spread(signal: np.ndarray, delay: int, softer_db: float) -> np.ndarray:
    """Return a signal from one side: delayed and softer at the other ear."""
    other = np.concatenate([np.zeros(delay), signal[:-delay]]) * 10 ** (-softer_db / 20)
    return np.stack([signal, other], 1)


def write(path: Path, signal: np.ndarray, rate: int = LOW_RATE) -> None:
    soundfile.write(path, signal, rate, subtype="PCM_16")


def make_scenes(folder: Path, rate: int, seconds: float = 1.0) -> Path:
    """Write two scenes with noise from the other side, in a room with one reflection."""
    (folder / "scenes").mkdir(parents=True)
    generator = np.random.default_rng(0)
    for name, path in zip(PAIRS, sorted(SPEECH.iterdir()), strict=False):
        waveform, speech_rate = read_audio(path)
        speech = resample(waveform[0], speech_rate, rate).double().numpy()
        speech = speech[: round(seconds * rate)]
        anechoic = spread(0.02 * speech / speech.std(), 20, 5.0)
        target = 0.7 * (anechoic + 0.4 * np.roll(anechoic[:, ::-1], 900, 0))
        noise = spread(0.008 * generator.standard_normal(len(speech)), 25, 6.0)[:, ::-1]
        signals = {"mix": target + noise, "target": target, "target_anechoic": anechoic}
        for kind, signal in signals.items():
            write(folder / "scenes" / f"{name}_{kind}_CH1.wav", signal, rate)
    (folder / "no reference").mkdir()
    (folder / "no reference" / "S1_mix_CH1.wav").touch()
    (folder / "one output").mkdir()
    for name in ("S_mix_CH1", "S_reference", "S_L_mix_CH1", "S_L_reference"):
        (folder / "one output" / f"{name}.wav").touch()
    (folder / "listeners.json").write_text(json.dumps(LISTENERS))
    (folder / "pairs.json").write_text(json.dumps(PAIRS))
    return folder


@pytest.fixture(scope="module")
def clarity(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scenes(tmp_path_factory.mktemp("clarity"), LOW_RATE)


def options(folder: Path, **changes: Any) -> dict[str, Any]:
    files = {"listeners": folder / "listeners.json", "scenes_listeners": folder / "pairs.json"}
    return {"scenes": folder / "scenes", "jobs": 1, **files, **changes}


class Baseline:
    """Baseline of Clarity: pyclarity's NAL-R, which returns 220 samples more, and compressor."""

    def __call__(self, waveform: Tensor, listener: Listener, sample_rate: int) -> Tensor:
        from clarity.enhancer.compressor import Compressor
        from clarity.enhancer.nalr import NALR
        from clarity.utils.audiogram import Audiogram

        # from recipes/icassp_2023/baseline/config.yaml
        settings = {"attack": 50, "release": 1000, "threshold": 0.35, "attenuation": 0.1}
        settings |= {"makeup_gain": 1, "rms_buffer_size": 0.064}
        nalr = NALR(nfir=220, sample_rate=sample_rate)
        compressor = Compressor(fs=sample_rate, **settings)
        outputs = []
        for channel, ear in zip(
            waveform.double().numpy(), (listener.left, listener.right), strict=True
        ):
            filtered = nalr.apply(nalr.build(Audiogram(ear.thresholds, CFS))[0], channel)
            outputs.append(np.tanh(compressor.process(filtered)[0]))
        return torch.from_numpy(np.stack(outputs))


def score_by_pyclarity(folder: Path, scene: str, name: str) -> dict[str, float]:
    """Score the baseline by pyclarity, in the steps of its script of ICASSP 2023."""
    from clarity.evaluator.haspi import haspi_v2_be
    from clarity.evaluator.hasqi import hasqi_v2_better_ear
    from clarity.utils.audiogram import Audiogram, Listener as ClarityListener

    mix, target, anechoic = (
        soundfile.read(folder / "scenes" / f"{scene}_{kind}_CH1.wav")[0].T
        for kind in ("mix", "target", "target_anechoic")
    )
    listener = read_listeners(folder / "listeners.json")[name]
    np.random.seed(int(hashlib.md5(scene.encode()).hexdigest(), 16) % 10**8)
    output = Baseline()(torch.from_numpy(mix), listener, RATE).float().numpy()[:, : mix.shape[1]]
    level = (target**2).mean(1, keepdims=True) / (anechoic**2).mean(1, keepdims=True)
    signals = {"reference": anechoic * level**0.5, "processed": output}
    sides = {
        f"{kind}_{side}": signal[channel]
        for kind, signal in signals.items()
        for channel, side in enumerate(("left", "right"))
    }
    person = ClarityListener(*(Audiogram(levels, CFS) for levels in EARS[name]))
    arguments = {**sides, "sample_rate": RATE, "listener": person}
    return {"haspi": haspi_v2_be(**arguments), "hasqi": hasqi_v2_better_ear(**arguments)}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the input has")
def test_the_baseline_has_the_scores_of_the_challenge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("clarity")
    monkeypatch.setattr("hlsim.evaluation.clarity._CHANGES", 2)
    folder = make_scenes(tmp_path / "clarity", RATE, seconds=0.7)
    aids = {"baseline": f"{__name__}:Baseline"}
    study = evaluate_scenes(aids, out=tmp_path / "out", **options(folder, stride=3))
    assert study.failures.empty
    (row,) = study.table[study.table.condition == "baseline"].itertuples()
    for measure, expected in score_by_pyclarity(folder, row.utterance, row.listener).items():
        assert getattr(row, measure) == pytest.approx(expected, abs=1e-3), measure
    look_ahead = study.details["look_ahead_ms"]
    assert look_ahead["baseline"] == 0.0, "2.5 ms late, but never early"
    assert 2.0 < look_ahead["NAL-R"] <= 5.0


class Anticipating:
    """Aid with a look-ahead of 8 ms."""

    fingerprint = "1"

    def __call__(self, waveform: Tensor, listener: Listener, sample_rate: int) -> Tensor:
        return 4.0 * waveform.roll(-(sample_rate * 8 // 1000), -1)


class Halving:
    """Enhancer, which receives pascals."""

    fingerprint = "1"

    def __call__(self, waveform: Tensor, sample_rate: int) -> Tensor:
        if waveform.ndim == 2:  # RMS 0.014 at 100 dB SPL full scale is 0.028 pascals.
            assert 0.02 < float(waveform.square().mean().sqrt()) < 0.06
        return 0.5 * waveform


@pytest.mark.slow
@pytest.mark.usefixtures("quick_scores")
def test_the_command_writes_page_scores_and_signals_and_continues(
    clarity: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["clarity", clarity / "scenes", "soft=wdrc", f"early={__name__}:Anticipating"]
    arguments += ["--listeners", clarity / "listeners.json", "--jobs", "1", "--every", "2"]
    arguments += ["--scenes-listeners", clarity / "pairs.json", "--out", out]
    command = [*map(str, arguments), "--enhancer", f"{__name__}:Halving"]
    assert main(command) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Halving + soft" in printed and "75.5 8.0" in printed
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
    mix, _ = soundfile.read(clarity / "scenes" / "S06001_mix_CH1.wav")
    output, rate = soundfile.read(signal)
    assert rate == LOW_RATE and np.allclose(output, 4 * np.roll(mix, -128, 0), atol=1e-6)
    assert (out / "report.html").read_text().count("<audio") == 10
    stored, report = (out / "scores.jsonl").read_text(), (out / "report.json").read_text()
    assert main(command) == 0
    assert (out / "report.json").read_text() == report
    assert (out / "scores.jsonl").read_text() == stored


@pytest.mark.usefixtures("quick_scores")
def test_linked_gains_and_a_reference_with_one_channel(clarity: Path, tmp_path: Path) -> None:
    folder = tmp_path / "third"  # names of the third challenge, whose reference has its level
    folder.mkdir()
    for scene in PAIRS:
        signal, _ = soundfile.read(clarity / "scenes" / f"{scene}_target_anechoic_CH1.wav")
        write(folder / f"{scene}_reference.wav", signal[:, 0])
        for ending in ("_mix_CH1.wav", "_target_CH1.wav"):
            (folder / f"{scene}{ending}").symlink_to(clarity / "scenes" / f"{scene}{ending}")
    settings = options(clarity, scenes=folder, scenes_listeners=None, stride=4)
    separate, linked = (
        evaluate_scenes({"aid": "wdrc"}, out=tmp_path / str(flag), linked=flag, **settings).table
        for flag in (False, True)
    )
    assert set(separate.name) == {"L0001 S06001"}
    assert (separate.haspi == linked.haspi).tolist() == [True, True, False]
    written, _ = soundfile.read(tmp_path / "True" / "reference" / "S06001.wav")
    original, _ = soundfile.read(folder / "S06001_reference.wav")
    assert np.allclose(written, original[:, None])


def fail_for_loud_scenes(waveform: Tensor, listener: Listener, sample_rate: int) -> Tensor:
    if waveform.abs().max() > HIGHEST_PEAK[0]:
        raise ValueError("too loud")
    return 2.0 * waveform


HIGHEST_PEAK = [np.inf]


@pytest.mark.usefixtures("quick_scores")
def test_a_pair_for_which_one_aid_fails_counts_in_no_mean(
    clarity: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mixes = [clarity / "scenes" / f"{name}_mix_CH1.wav" for name in PAIRS]
    peaks = [np.abs(soundfile.read(mix)[0]).max() for mix in mixes]
    HIGHEST_PEAK[0] = sum(peaks) / 2
    aids = {"choosy": f"{__name__}:fail_for_loud_scenes", "soft": "wdrc"}
    study = evaluate_scenes(aids, out=tmp_path / "out", **options(clarity, stride=2))
    (failure,) = study.failures.itertuples()
    assert failure.condition == "choosy" and "too loud" in failure.failure
    table = _conditions_table(study)
    caption = "Means of the 1 that all conditions have scores of, of 2 pairs of scene and listener"
    assert table.caption == caption
    scored = study.table[study.table.item != failure.item]
    assert [row[1] for row in table.rows] == [f"{score:.3f}" for score in scored.haspi]
    drawn: list[Evaluation] = []
    monkeypatch.setattr(recordings_page, "means_pictures", lambda part: drawn.append(part) or [])
    scenes_page(study)
    assert drawn[0].wide("haspi").index.tolist() == scored.item.unique().tolist()
    assert (study.details["look_ahead_ms"]["choosy"] is None) == (peaks[0] > peaks[1])
    signals = tmp_path / "out" / "signals" / "choosy"
    assert len([*signals.iterdir()]) == 1
    HIGHEST_PEAK[0] = 0.0
    evaluate_scenes(aids, out=tmp_path / "out", **options(clarity, stride=2))
    assert not [*signals.iterdir()], "an output of an earlier run stays although the aid fails"


class Adapting:
    calls = 0

    def __call__(self, waveform: Tensor, listener: Listener, sample_rate: int) -> Tensor:
        self.calls += 1
        return waveform / self.calls


@pytest.mark.usefixtures("quick_scores")
def test_an_aid_of_ones_own_that_keeps_a_state_causes_a_warning(
    clarity: Path, tmp_path: Path
) -> None:
    with pytest.warns(UserWarning, match=r"aid .*:Adapting returns another output"):
        evaluate_scenes(
            {"mine": f"{__name__}:Adapting"}, out=tmp_path, **options(clarity, stride=4)
        )


def longer_by_220(waveform: Tensor, listener: Listener, sample_rate: int) -> Tensor:
    return torch.cat((waveform, waveform[:, :220]), -1)


@pytest.mark.usefixtures("quick_scores")
@pytest.mark.filterwarnings("ignore:.*both are cut")
def test_lengths_may_differ_by_a_tenth_of_a_second(clarity: Path, tmp_path: Path) -> None:
    scenes = Path(shutil.copytree(clarity / "scenes", tmp_path / "scenes"))
    settings = options(clarity, scenes=scenes, stride=2, out=tmp_path)

    def change_length(kind: str, change: int) -> None:
        path = scenes / f"S06002_{kind}_CH1.wav"
        signal, _ = soundfile.read(path)
        write(path, np.concatenate((signal, signal))[: len(signal) + change])

    change_length("target_anechoic", 100)
    change_length("mix", -100)
    with pytest.warns(UserWarning, match="15900 to 16100 samples; all are cut to the shortest"):
        study = evaluate_scenes({"mine": f"{__name__}:longer_by_220"}, **settings)
    output = soundfile.info(tmp_path / "signals" / "mine" / "S06001_L0001_HA-output.wav")
    assert study.failures.empty and output.frames == LOW_RATE
    change_length("target", -8000)
    with pytest.raises(ValueError, match=r"target_CH1\.wav with 16000 Hz and 8000"):
        evaluate_scenes({}, **settings)


@pytest.mark.usefixtures("quick_scores")
def test_existing_outputs_are_scored_like_those_of_an_aid(clarity: Path, tmp_path: Path) -> None:
    aided = evaluate_scenes({"soft": "wdrc"}, out=tmp_path / "aided", **options(clarity)).table
    folder = tmp_path / "aided" / "signals" / "soft"
    recorded = evaluate_scenes({}, outputs={"mine": folder}, out=tmp_path / "1", **options(clarity))
    assert recorded.notes == [] and recorded.details["look_ahead_ms"]["mine"] is None
    assert [(c.before, c.after) for c in recorded.comparisons if c.planned] == [("NAL-R", "mine")]
    scores = recorded.table[recorded.table.condition == "mine"].haspi.tolist()
    assert scores == aided[aided.condition == "soft"].haspi.tolist()
    first, second, third = sorted(folder.iterdir())
    first.rename(folder / "S06001_L0001_enhanced.wav")
    signal, _ = soundfile.read(second)
    write(second, signal[:, 0])
    recorded = evaluate_scenes({}, outputs={"mine": folder}, out=tmp_path / "2", **options(clarity))
    failures = recorded.failures.set_index("name").failure
    assert "S06001_L0001_HA-output.wav: there is no such audio file" in failures["L0001 S06001"]
    assert "expected 2 channels" in failures["L0002 S06001"] and len(failures) == 2
    (note,) = recorded.notes
    assert note.startswith("1 files of mine") and "S06001_L0001_enhanced.wav" in note
    assert second.exists(), "a file of the user that is not valid was removed"
    third.unlink()
    second.unlink()
    with pytest.raises(ValueError, match=r"no file is an output of mine .* S06001_L0001_HA-output"):
        evaluate_scenes({}, outputs={"mine": folder}, out=tmp_path / "3", **options(clarity))


class Beamformer:
    """Aid of its own that uses the first and the third microphone."""

    fingerprint = "1"
    takes_microphones = True

    def __call__(self, waveform: Tensor, listener: Listener, sample_rate: int) -> Tensor:
        assert waveform.shape[:2] == (3, 2)
        return waveform[0] - waveform[2]


@pytest.mark.usefixtures("quick_scores")
def test_three_microphones_are_averaged_or_handed_to_an_aid(clarity: Path, tmp_path: Path) -> None:
    scenes = Path(shutil.copytree(clarity / "scenes", tmp_path / "scenes"))
    settings = options(clarity, scenes=scenes, stride=2, out=tmp_path)
    mix, _ = soundfile.read(scenes / "S06001_mix_CH1.wav")
    for scene in PAIRS:
        for number in (2, 3):
            shutil.copy(scenes / f"{scene}_target_CH1.wav", scenes / f"{scene}_mix_CH{number}.wav")
    target, _ = soundfile.read(scenes / "S06001_target_CH1.wav")
    (note,) = evaluate_scenes({}, **settings).notes
    assert note.startswith("2 of 2 scenes have signals of other microphones than 1,")
    network = MappingCompensator(config=MappingConfig(channels=4, blocks=1, microphones=3, ears=2))
    save_compensator(network, tmp_path / "trained")
    aids = {"pair": f"{__name__}:Beamformer", "trained": str(tmp_path / "trained")}
    study = evaluate_scenes(aids, microphones=[1, 2, 3], **settings)
    (note,) = study.notes  # The aid returns noise alone.
    assert "outputs are not similar to their clean speech" in note and " under pair." in note
    assert study.failures.empty
    for name, expected in (("unaided", (mix + 2 * target) / 3), ("pair", mix - target)):
        written, _ = soundfile.read(tmp_path / "signals" / name / "S06001_L0001_HA-output.wav")
        assert np.allclose(written, expected, atol=1e-6), name
    written, _ = soundfile.read(tmp_path / "signals" / "trained" / "S06001_L0001_HA-output.wav")
    assert written.shape == mix.shape and written.any()
    write(scenes / "S06002_mix_CH3.wav", np.concatenate((mix, mix), 1))
    with pytest.raises(ValueError, match="got 8 channels for 3 microphones at 16000 Hz"):
        evaluate_scenes(aids, microphones=[1, 2, 3], **settings)
    for path in scenes.glob("S06002_*.wav"):
        write(path, soundfile.read(path)[0], 2 * LOW_RATE)
    with pytest.raises(ValueError, match=r"first scene, 16000 Hz, .* at 32000 Hz"):
        evaluate_scenes(aids, microphones=[1, 2, 3], **settings)
    (scenes / "S06002_mix_CH3.wav").unlink()
    with pytest.raises(ValueError, match=r"S06002_mix_CH3\.wav: there is no such audio file"):
        evaluate_scenes(aids, microphones=[1, 2, 3], **settings)


def test_existing_outputs_that_an_aid_would_replace_are_rejected(
    clarity: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "signals" / "mine"
    folder.mkdir(parents=True)
    output = folder / "S06001_L0001_HA-output.wav"
    shutil.copy(clarity / "scenes" / "S06001_mix_CH1.wav", output)
    contents = output.read_bytes()
    with pytest.raises(ValueError, match="outputs of mine would replace those of old; choose"):
        evaluate_scenes({"mine": "wdrc"}, out=tmp_path, **options(clarity, outputs={"old": folder}))
    settings = options(clarity, outputs={"Halving + NAL-R": folder})
    with pytest.raises(ValueError, match=r"Halving \+ NAL-R is already evaluated"):
        evaluate_scenes({}, out=tmp_path / "2", enhancers=[f"{__name__}:Halving"], **settings)
    assert output.read_bytes() == contents


EAR = LISTENERS["L0001"]
LEFT_EAR_ONLY = {"L0001": {**EAR, "audiogram_levels_r": None}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenes": ".", "scenes_listeners": None}, "expected files that end with _mix_CH1"),
        ({"scenes": "no reference", "scenes_listeners": None}, "put S1_target_anechoic_CH1.wav or"),
        ({"scenes_listeners": {"S06001": ["L0009"]}}, "listener 'L0009'"),
        ({"scenes_listeners": {"S9": ["L0001"]}}, "scene 'S9'"),
        ({"scenes_listeners": []}, "cannot be read"),
        ({"scenes_listeners": {"S06001": [["L0001"]]}}, "a name is not a text"),
        ({"scenes_listeners": {"S06001": "L0001"}}, "a text instead of a list"),
        ({"scenes_listeners": {"S06001": ["L0001", "L0001"]}}, "the same listener twice"),
        ({"scenes_listeners": {}}, "no scene has a listener"),
        ({"listeners": LEFT_EAR_ONLY}, "L0001"),
        ({"listeners": {"../L1": LISTENERS["L0001"]}}, "cannot name a file"),
        ({"scenes": "one output", "listeners": {"1": EAR, "L_1": EAR}}, "be the same file, S_L_1_"),
        ({"aids": {"NAL-R": "wdrc"}}, "another label"),
        ({"aids": {"a b": "wdrc", "a-b": "wdrc"}}, "the same folder"),
        ({"aids": {"mine": "wdrc", "Mine": "wdrc"}}, "the same folder, mine, where"),
        ({"aids": {"a": "no.such:thing"}}, "aid no.such:thing"),
        ({"aids": {"a": "torch:neg"}, "linked": True}, "torch:neg has no setting linked"),
        ({"aids": {}, "linked": True}, "no effect on existing outputs"),
        ({"full_scale_spl": float("nan")}, "full_scale_spl"),
        ({"precision": 16}, "expected precision 32 or 64"),
        ({"stride": 0}, "expected stride to be a whole number from 1"),
        ({"outputs": {"aid": SPEECH}}, "no file is an output of aid"),
    ],
)
def test_invalid_settings_are_rejected_before_anything_is_written(
    clarity: Path, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    settings = {**options(clarity), "aids": {"aid": "wdrc"}, **change}
    if "listeners" in change:
        settings["scenes_listeners"] = None
    for name in change.keys() & {"listeners", "scenes_listeners"}:
        if change[name] is not None:
            settings[name] = tmp_path / f"{name}.json"
            settings[name].write_text(json.dumps(change[name]))
    settings["scenes"] = clarity / settings["scenes"]
    with pytest.raises(ValueError, match=message):
        evaluate_scenes(settings.pop("aids"), out=tmp_path / "out", **settings)
    assert not (tmp_path / "out").exists()


def test_another_evaluation_in_one_folder_is_rejected(clarity: Path, tmp_path: Path) -> None:
    """The first evaluation would score the outputs of the second one as its own."""
    with (
        lock_folder(tmp_path / "out"),
        pytest.raises(ValueError, match="another process is writing to this folder"),
    ):
        settings = options(clarity)
        settings["scenes"] = clarity / settings["scenes"]
        evaluate_scenes({"aid": "nalr"}, out=tmp_path / "out", **settings)
    assert not (tmp_path / "out" / "signals").exists()
