"""The demo, cut short: everything it promises lies there, and agrees with itself."""

import json
from pathlib import Path

import pytest
import soundfile

from hlsim import Audiogram

pytest.importorskip("lightning")
pytest.importorskip("joblib")

from hlsim.demo import _names, demo


@pytest.fixture
def short_speech(tmp_path: Path, speech_dir: Path) -> Path:
    """24 utterances of a second, so that eight are scored."""
    folder = tmp_path / "speech"
    folder.mkdir()
    for path in sorted(speech_dir.rglob("*.flac")):
        samples, rate = soundfile.read(path)
        soundfile.write(folder / path.name, samples[rate // 2 : rate // 2 + rate], rate)
    return folder


def test_demo_writes_report_audio_and_pictures(tmp_path: Path, short_speech: Path) -> None:
    out = tmp_path / "out"
    lines: list[str] = []
    ear, seed = Audiogram.standard("N4"), 2**32 - 2
    text = demo(out, ear, speech=short_speech, steps=60, seed=seed, report=lines.append)
    report = json.loads((out / "report.json").read_text())
    assert report["n"] == len(report["items"]) == 8
    # after numpy's last seed comes its first
    assert [item["seed"] for item in report["items"]] == [seed, seed + 1, 0, 1, 2, 3, 4, 5]
    names = {"unaided": "unaided", "nalr": "NAL-R", "nalr_as_loud": "NAL-R as loud as trained"}
    names |= {"initial": "untrained start", "compensated": "trained"}
    rows = {line[:24].strip(): line[24:].split() for line in text.splitlines()}
    for key, name in names.items():
        assert 0.0 <= report[f"{key}_mean"] <= 1.0
        assert rows[name][:2] == [
            f"{report[f'{key}_mean']:.3f}",
            f"{report[f'{key}_level_mean']:.1f}",
        ]
    assert report["nalr_as_loud_level_mean"] == pytest.approx(
        report["compensated_level_mean"], abs=1e-3
    )
    page = (out / "report.html").read_text()
    assert text.startswith("\nThe trained aid ")
    assert f"seed {seed}, 60 training steps" in text
    assert text.endswith(f"\nThe page: {out / 'report.html'}")
    assert text.splitlines()[1] in page and page.count("<audio") == 5 and "N4 (severe loss)" in page
    assert report["before_mean"] == pytest.approx(report["unaided_mean"])
    assert report["after_mean"] == pytest.approx(report["compensated_mean"])
    # NAL-R and what starts from it make speech louder and easier to understand for this ear
    assert report["nalr_mean"] > report["unaided_mean"]
    assert report["compensated_mean"] > report["unaided_mean"]
    assert report["nalr_level_mean"] > report["unaided_level_mean"] + 10.0
    assert report["unaided_heard_difference_db"] < -20.0
    for name in (
        "report.md",
        "before-after.png",
        "spectrograms.png",
        "training/checkpoint/model.safetensors",
    ):
        assert (out / name).stat().st_size > 0
    assert len(list((out / "audio").glob("*.wav"))) == 6 * 8


def test_speech_that_cannot_be_scored_is_named_before_the_training(
    tmp_path: Path, short_speech: Path
) -> None:
    first = sorted(short_speech.iterdir())[0]
    samples, rate = soundfile.read(first)
    soundfile.write(first, samples[: rate // 2], rate)
    with pytest.raises(ValueError, match=rf"{first.name} lasts 0.5 s; a score needs 0.7 s"):
        demo(tmp_path / "out", Audiogram.standard("N4"), speech=short_speech)
    assert not (tmp_path / "out").exists()


def test_names_tell_speakers_apart(tmp_path: Path) -> None:
    files = [tmp_path / "p225" / "001.wav", tmp_path / "p226" / "001.wav"]
    assert _names(files, tmp_path) == ["p225-001", "p226-001"]
    assert len(set(_names([*files, tmp_path / "p225-001.wav"], tmp_path))) == 3


def test_too_little_speech(tmp_path: Path, speech_dir: Path) -> None:
    with pytest.raises(ValueError, match="allowed: 22 or more"):
        demo(tmp_path / "out", Audiogram.standard("N4"), speech=speech_dir / "valid")
    assert not (tmp_path / "out").exists()
