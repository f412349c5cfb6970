"""What the program says of long work: how much is done, and when the rest will be."""

import pytest

from hlsim.cli.progress import show_progress


def test_the_end_is_told_from_the_pace_since_the_first_call(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [1_000_000.0]
    monkeypatch.setattr("hlsim.cli.progress.time.time", lambda: now[0])
    show = show_progress("scores")
    show(50, 100)  # made by an earlier run
    now[0] += 60.0
    show(60, 100)
    now[0] += 240.0
    show(100, 100)
    first, second, third = capsys.readouterr().err.removeprefix("\r").split("\r")
    assert first.strip() == "50 of 100 scores"
    assert second.startswith("60 of 100 scores, ends about ") and second.rstrip().endswith(
        "(in 4.0 min)"
    )
    assert third.strip() == "100 of 100 scores" and third.endswith("\n")
