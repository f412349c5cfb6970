"""Progress and expected end of long work, on stderr."""

import pytest

from hlsim.progress import show_progress


def test_the_end_follows_from_the_pace_since_the_first_call(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [1_000_000.0]
    monkeypatch.setattr("hlsim.progress.time.time", lambda: now[0])
    show = show_progress("scores")
    for done, seconds in ((50, 60.0), (60, 9.0), (61, 231.0), (100, 0.0)):
        show(done, 100, "; no loss")
        now[0] += seconds
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3, "a file gets a line every 10 seconds"
    assert lines[0] == "50 of 100 scores; no loss"
    assert lines[1].startswith("60 of 100 scores, 4.0 min left")
    assert lines[1].endswith("; no loss")
    assert lines[2] == "100 of 100 scores; no loss"


def test_a_terminal_gets_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "30")
    show = show_progress("outputs of a long name that does not fit")
    for done in (1, 2, 2):
        show(done, 2)
    text = capsys.readouterr().err
    assert text.count("\n") == 1 and all(len(line) < 30 for line in text.strip("\r\n").split("\r"))
