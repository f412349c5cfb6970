"""The demo with few steps: page, sounds and printed table are written, and agree."""

import json
from pathlib import Path
from statistics import fmean

import pytest
import soundfile

from hlsim import Audiogram

pytest.importorskip("lightning")
pytest.importorskip("joblib")

from hlsim.demo import _name_files, _sentence, demo
from tests.helpers import write_short_speech


@pytest.fixture
def short_speech(tmp_path: Path, speech_dir: Path) -> Path:
    """Folder of 24 utterances of a second, of which the demo scores eight."""
    return write_short_speech(tmp_path / "speech", speech_dir)


def test_demo_writes_page_and_sounds_that_agree(tmp_path: Path, short_speech: Path) -> None:
    out = tmp_path / "out"
    ear, seed = Audiogram.standard("N4"), 2**32 - 2
    text = demo(out, ear, speech=short_speech, steps=20, seed=seed, report=lambda line: None)
    report = json.loads((out / "report.json").read_text())
    rows = report["rows"]
    names = ["unaided", "NAL-R", "NAL-R, same level", "trained aid"]
    assert [row["condition"] for row in rows] == names * 8
    # after numpy's last seed comes its first
    assert [row["seed"] for row in rows[::4]] == [seed, seed + 1, 0, 1, 2, 3, 4, 5]
    assert rows[2]["level"] == pytest.approx(rows[3]["level"], abs=1e-3)
    means = {
        name: fmean(row["haspi"] for row in rows if row["condition"] == name) for name in names
    }
    printed = {line[:18].strip(): line[18:].split() for line in text.splitlines()}
    for name, mean in means.items():
        assert printed[name][0] == f"{mean:.3f}"
    # NAL-R, and an aid that starts from it, make speech easier to understand for this ear
    assert means["NAL-R"] > means["unaided"] and means["trained aid"] > means["unaided"]
    # one comparison is planned and tested, so that no adjusted p can contradict it
    [comparison] = report["comparisons"]
    assert comparison["planned"]
    assert (comparison["before"], comparison["after"]) == (names[2], "trained aid")
    page = (out / "report.html").read_text()
    assert text.startswith("\nThe trained aid ")
    assert text.endswith(f"\n{(out / 'report.html').as_uri()}") and len(text.splitlines()) == 10
    evidence = text.splitlines()[1].rpartition(" (")[2]
    assert f"({evidence}</small>" in page and page.count("t-test p = ") == 1
    assert page.count("<audio") == 9 and "N4 (pure-tone average" in page
    for name in names:
        assert f">{means[name]:.3f}</td>" in page
    assert (out / "training" / "checkpoint" / "model.safetensors").stat().st_size > 0
    assert "for 20 steps" in page and "exceeds 110 dB SPL" in page
    assert len(list((out / "audio").glob("*.wav"))) == (4 + 5) * 8
    assert len(list((out / "audio").glob("*-perceived-normal-ear-the-goal.wav"))) == 8


def test_speech_that_cannot_be_scored_is_named_before_the_training(
    tmp_path: Path, short_speech: Path
) -> None:
    first = sorted(short_speech.iterdir())[0]
    samples, rate = soundfile.read(first)
    soundfile.write(first, samples[: rate // 2], rate)
    with pytest.raises(ValueError, match=rf"{first.name} cannot be scored: clean lasts 0.5 s"):
        demo(tmp_path / "out", Audiogram.standard("N4"), speech=short_speech)
    assert not (tmp_path / "out").exists()


def test_names_tell_speakers_apart(tmp_path: Path) -> None:
    files = [tmp_path / "p225" / "001.wav", tmp_path / "p226" / "001.wav"]
    assert _name_files(files, tmp_path) == ["p225-001", "p226-001"]
    assert len(set(_name_files([*files, tmp_path / "p225-001.wav"], tmp_path))) == 3


def test_words_of_bundled_utterances_are_known(tmp_path: Path, speech_dir: Path) -> None:
    sentences = {_sentence(path) for path in (speech_dir / "valid").glob("*.flac")}
    assert len(sentences) == 10 and "" not in sentences
    assert _sentence(tmp_path / "flite-rms-01.flac") == ""


def test_too_little_speech(tmp_path: Path, speech_dir: Path) -> None:
    with pytest.raises(ValueError, match="expected 22 or more"):
        demo(tmp_path / "out", Audiogram.standard("N4"), speech=speech_dir / "valid")
    assert not (tmp_path / "out").exists()
