"""The better ear of two: of scores, and in a report of a manifest."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.evaluation import ItemScore, haspi_report
from hlsim.evaluation.previous.scores import better_ears, check_both_ears
from hlsim.report.previous.haspi import html, markdown

EARS = {"left": Audiogram.standard("N2"), "right": Audiogram.standard("N4")}


def one(
    ear: str, before: float | None, after: float | None, level: float, listener: str = "L1"
) -> ItemScore:
    scores = {"before": before, "after": after}
    return ItemScore(
        file=f"{listener} {ear} s01",
        listener=listener,
        ear=ear,
        audiogram=EARS[ear],
        clean_level=65.0,
        levels={"before": level, "after": level + 10.0},
        scores={"haspi": {name: score for name, score in scores.items() if score is not None}},
        sample_rate=16000,
        seconds=1.0,
        seed=0,
    )


def test_each_condition_has_the_better_ears_score_and_its_level() -> None:
    (found,) = better_ears([one("left", 0.7, 0.8, 60.0), one("right", 0.4, 0.9, 50.0)])
    assert found.scores == {"haspi": {"before": 0.7, "after": 0.9}}
    assert found.levels == {"before": 60.0, "after": 60.0}  # the right ear's 50 + 10
    assert (found.file, found.ear, found.audiogram) == ("L1 s01", "right", EARS["right"])


def test_an_ear_without_a_score_loses() -> None:
    (found,) = better_ears([one("left", None, 0.8, 60.0), one("right", 0.1, 0.9, 50.0)])
    assert found.scores == {"haspi": {"before": 0.1, "after": 0.9}}
    (found,) = better_ears([one("left", None, 0.8, 60.0), one("right", None, 0.9, 50.0)])
    assert found.scores == {"haspi": {"after": 0.9}}


def test_a_missing_ear_is_refused_and_listeners_are_kept_apart() -> None:
    both = [one(ear, 0.1, 0.2, 60.0, name) for name in ("L1", "L2") for ear in EARS]
    assert [item.file for item in better_ears(both)] == ["L1 s01", "L2 s01"]
    named = [(item.file, item.listener, item.ear) for item in both]
    check_both_ears(named)
    with pytest.raises(ValueError, match="L2 s01: no right ear"):
        check_both_ears(named[:3])
    with pytest.raises(ValueError, match="allowed: left and right"):
        check_both_ears([("L1 s01", "L1", "")])
    with pytest.raises(ValueError, match="L1 left s01: two items of this name and ear"):
        check_both_ears([*named, named[0]])


def test_an_ear_of_which_nothing_can_be_scored_is_told_and_loses(
    tmp_path: Path, speech_dir: Path
) -> None:
    (tmp_path / "speech.flac").write_bytes(
        (speech_dir / "valid" / "espeak-us-annie-01.flac").read_bytes()
    )
    (tmp_path / "broken.wav").write_text("no sound")
    rows = ["listener,ear,condition,clean,processed,audiogram"]
    for condition in ("before", "after"):
        rows += [
            f"L1,left,{condition},speech.flac,broken.wav,N4",
            f"L1,right,{condition},speech.flac,speech.flac,N4",
        ]
    (tmp_path / "study.csv").write_text("\n".join(rows))
    report = haspi_report(manifest=tmp_path / "study.csv", better_ear=True, jobs=1)
    assert [item.ear for item in report.items] == ["right"] and len(report.failures) == 2
    (tmp_path / "study.csv").write_text("\n".join(row for row in rows if ",left," not in row))
    with pytest.raises(ValueError, match="no left ear"):
        haspi_report(manifest=tmp_path / "study.csv", better_ear=True, jobs=1)


def test_a_report_of_two_ears(tmp_path: Path, speech_dir: Path) -> None:
    waveform, rate = read_audio(speech_dir / "valid" / "espeak-us-annie-01.flac")
    clean = waveform[:, rate : 2 * rate].expand(2, -1)
    noise = 0.01 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    noise[0] *= 0.1  # the left ear has less
    write_audio(tmp_path / "clean.wav", clean, rate)
    rows = ["listener,ear,condition,clean,processed,audiogram"]
    for condition, gain in (("before", 1.0), ("after", 5.0)):
        write_audio(tmp_path / f"{condition}.wav", gain * (clean + noise), rate)
        rows += [f"L1,{ear},{condition},clean.wav,{condition}.wav,N4" for ear in EARS]
    (tmp_path / "study.csv").write_text("\n".join(rows))
    report = haspi_report(manifest=tmp_path / "study.csv", better_ear=True, jobs=1)
    each = haspi_report(manifest=tmp_path / "study.csv", jobs=1)
    assert [ear.to_dict() for ear in report.ears] == [item.to_dict() for item in each.items]
    np.testing.assert_array_equal(
        report.scores("haspi"), each.scores("haspi").max(0, keepdims=True)
    )
    assert report.items[0].ear == "left" and len(report.to_dict()["ears"]) == 2
    text = markdown(report)
    assert "Each is the better ear's." in text and "Scores and levels of each ear" in html(report)
