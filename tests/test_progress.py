"""Progress and expected end of long work, on stderr."""

import time
from collections.abc import Callable

import pytest

from hlsim.progress import ProgressLine, track


@pytest.fixture
def wait_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str], str]:
    """Return a function that waits until a text appears on stderr, and returns what was printed.

    Lines come often, and the clock stands still, so that the load of the machine has no influence.
    """
    now = time.time()
    monkeypatch.setattr("hlsim.progress.time.time", lambda: now)
    monkeypatch.setattr("hlsim.progress._TICK", 0.01)
    monkeypatch.setattr("hlsim.progress._LINE_INTERVAL", 0.0)

    def wait(text: str) -> str:
        printed = ""
        end = time.monotonic() + 10.0
        while text not in printed:
            assert time.monotonic() < end, printed
            time.sleep(0.02)
            printed += capsys.readouterr().err
        return printed

    return wait


def test_the_end_follows_from_the_pace_since_the_first_call(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [1_000_000.0]
    monkeypatch.setattr("hlsim.progress.time.time", lambda: now[0])
    show = ProgressLine("scores")
    for done, seconds in ((50, 20.0), (60, 1.0), (61, 240.0), (100, 0.0)):
        show(done, 100, "; loss 1")
        now[0] += seconds
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3, "a file gets a line every ten seconds"
    assert lines[0] == "50 of 100 scores (50%); loss 1"
    assert lines[1].startswith("60 of 100 scores (60%), 1.3 min left")
    assert lines[1].endswith("; loss 1")
    assert lines[2] == "100 of 100 scores (100%); loss 1"


def test_a_terminal_gets_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "30")
    with ProgressLine("outputs of a long name that does not fit") as progress:
        progress(1, 2)
        progress.print("a result")
        progress(2, 2)
        progress(2, 2)
    printed = capsys.readouterr()
    assert printed.out == "a result\n"
    lines = printed.err.split("\r")
    assert "\n" not in printed.err and all(len(line) < 30 for line in lines)
    assert not lines[-1] and not lines[-2].strip(), "the line is cleared at the end"


def test_the_line_of_a_part_of_the_work_replaces_that_of_the_whole(
    wait_for: Callable[[str], str],
) -> None:
    with ProgressLine("scores", "training"):
        with ProgressLine("steps", "preparing"):
            wait_for("preparing, 0 s")
            assert "training" not in wait_for("preparing, 0 s")
        wait_for("training, 0 s")


def test_the_parts_of_a_stage_are_counted_with_the_time_that_is_left(
    wait_for: Callable[[str], str],
) -> None:
    with ProgressLine("scores", "reading", "drawing the page") as progress:
        stage = track("ab", "aids", 2)
        assert next(stage) == "a"
        wait_for("0 of 2 aids (0%)")
        assert next(stage) == "b"
        wait_for("1 of 2 aids (50%), 0.0 min left")
        assert [*stage] == []
        wait_for("reading, ")
        progress(4, 4)
        pictures = track("abc", "pictures", 3)
        assert [next(pictures), next(pictures)] == ["a", "b"]
        wait_for("1 of 3 pictures (33%), 0.0 min left")
        pictures.close()  # type: ignore[attr-defined]
        wait_for("drawing the page, ")


def test_there_is_a_sign_of_life_before_between_and_after_the_calls(
    wait_for: Callable[[str], str], capsys: pytest.CaptureFixture[str]
) -> None:
    with ProgressLine("scores", "reading", "drawing the page") as progress:
        wait_for("reading, 0 s")
        progress(1, 4)
        progress(2, 4)
        capsys.readouterr()
        wait_for("2 of 4 scores (50%), 0.0 min left")
        progress(4, 4)
        wait_for("drawing the page, 0 s")
    capsys.readouterr()
    time.sleep(0.1)
    assert not capsys.readouterr().err, "nothing is shown after the end"
