"""The demo with few steps: page, sounds and printed table are written, and agree."""

import json
from pathlib import Path
from statistics import fmean
from types import SimpleNamespace

import pytest

from hlsim.cli.demo_run import DurationEstimate
from hlsim.data.bundled import SPEECH
from tests.helpers import run_short_demo

pytest.importorskip("lightning")
pytest.importorskip("joblib")


@pytest.mark.slow
def test_demo_writes_a_page_that_agrees_with_the_table(
    tmp_path: Path,
    speech_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(DurationEstimate, "first_step", 2)
    monkeypatch.setattr(DurationEstimate, "last_step", 3)
    text = run_short_demo(tmp_path, speech_dir, steps=4)
    assert capsys.readouterr().out.count("The demo will take about ") == 1
    out = tmp_path / "out"
    report = json.loads((out / "report.json").read_text())
    rows = report["rows"]
    names = ["unaided", "NAL-R", "NAL-R, same level", "trained aid"]
    assert [row["condition"] for row in rows] == names * 4
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
    # four utterances have three voices, whose means are compared
    assert comparison["overall"]["n"] == 3
    assert "(3 voices, " in text
    assert comparison["overall"]["before_mean"] == pytest.approx(
        fmean(
            fmean(
                row["haspi"]
                for row in rows
                if row["condition"] == names[2] and row["voice"] == voice
            )
            for voice in {row["voice"] for row in rows}
        )
    )
    page = (out / "report.html").read_text()
    assert text.startswith("\nBy the means of 3 voices, the trained aid ")
    assert text.endswith(f"\n{(out / 'report.html').as_uri()}") and len(text.splitlines()) == 10
    evidence = text.splitlines()[1].rpartition(" (")[2]
    assert f"({evidence}</small>" in page and page.count("t-test p = ") == 1
    assert page.count("<audio") == 9 and "N4 (pure-tone average" in page
    # NAL-R at the level of the aid has a row, and so a gain, of its own: other sounds can be heard
    rows_of_sounds = ("Perceived by this ear", "Perceived of NAL-R at the", "Output of the aids")
    first, loud, outputs = (page.index(heading) for heading in rows_of_sounds)
    assert first < loud < outputs and page[loud:outputs].count("<audio") == 1
    for name in names:
        assert f">{means[name]:.3f}</td>" in page
    assert (out / "training" / "checkpoint" / "model.safetensors").stat().st_size > 0
    # the words beside the player are those of the utterance that is played, the last one
    transcripts = (SPEECH / "README.md").read_text().splitlines()
    (row,) = [line for line in transcripts if f"/{rows[-1]['name']}.flac" in line]
    assert f"Its words: {row.split(' | ')[2]}" in page
    assert "for 4 steps" in page and "exceeds 110 dB SPL" in page


def test_the_duration_follows_from_the_pace_of_the_first_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 0.0
    monkeypatch.setattr("hlsim.cli.demo_run.time.monotonic", lambda: now)
    lines: list[str] = []
    estimate, module = DurationEstimate(), SimpleNamespace(print=lines.append)
    for step in range(1, 101):
        now += 5.0 if step <= estimate.first_step else 0.06
        trainer = SimpleNamespace(global_step=step, max_steps=3000)
        estimate.on_train_batch_end(trainer, module)
    seconds = 0.06 * (3000 - estimate.last_step + estimate.scoring_steps)
    assert lines == [f"The demo will take about {seconds / 60.0:.1f} minutes more"]
