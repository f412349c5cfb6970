"""Killed at any moment and started again, or started twice at once: the end is that of an undisturbed run."""

import hashlib
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path
from random import Random
from typing import Any

import pytest

from hlsim.cli.main import main

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="starts copies of this process")


def start(arguments: list[str]) -> Any:
    """The program in a copy of this process, which has imported all and needs no seconds to begin."""

    def child() -> None:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        os._exit(main(arguments))

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    return process


def results(folder: Path) -> dict[str, str]:
    """Digests of all files below a folder but the store, whose lines may be torn and in another order."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "scores.jsonl"
    }


class Command:
    """A command, what it gives undisturbed, and how many seconds that takes."""

    def __init__(self, arguments: list[str], out: Path) -> None:
        self.arguments, self.out = arguments, out
        assert main([*arguments, "--out", str(out / "warm")]) == 0
        before = time.monotonic()
        assert main([*arguments, "--out", str(out / "whole")]) == 0
        self.seconds, self.whole = time.monotonic() - before, results(out / "whole")

    def disturbed(self, given: list[float]) -> None:
        """Kill it after each share of its time, and let it end."""
        target = self.out / f"killed-{time.monotonic_ns()}"
        arguments = [*self.arguments, "--out", str(target)]
        for share in given:
            process = start(arguments)
            process.join(share * self.seconds)
            process.kill()
            process.join()
            assert process.exitcode in (0, -signal.SIGKILL), f"ended with {process.exitcode}"
        assert main(arguments) == 0
        assert results(target) == self.whole, "another result"

    def twice(self, given: list[float]) -> None:
        """Start it again beside the first after a share of its time: one of them may be refused."""
        target = self.out / f"twice-{time.monotonic_ns()}"
        arguments = [*self.arguments, "--out", str(target)]
        first = start(arguments)
        time.sleep(given[0] * self.seconds)
        second = start(arguments)
        first.join()
        second.join()
        statuses = {first.exitcode, second.exitcode}
        assert 0 in statuses and statuses <= {0, 2}, f"ended with {first.exitcode} and {second.exitcode}"
        assert main(arguments) == 0
        assert results(target) == self.whole, "another result"


def shares(draw: Random) -> list[float]:
    return [round(draw.uniform(0.0, 1.1), 3) for _ in range(draw.choice((1, 1, 3)))]


def test_prepare(bench: Any, corpus: Path) -> None:
    options = ["--noise", str(corpus / "noise"), "--write", "--jobs", "1"]
    command = Command(["prepare", str(corpus / "speech"), *options], corpus)
    bench.run("kills of prepare --write", shares, command.disturbed, share=0.2)
    bench.run("two prepares at once", shares, command.twice, share=0.2)


def test_haspi_report(bench: Any, corpus: Path) -> None:
    pytest.importorskip("matplotlib")
    folders = [word for name in ("clean", "before", "after") for word in (f"--{name}", str(corpus / name))]
    for name in ("clean", "before", "after"):
        (corpus / name).symlink_to(corpus / "speech" / "s0")
    options = ["--audiogram", "N3", "--jobs", "1", "--listen", "1"]
    command = Command(["haspi-report", *folders, *options], corpus)
    bench.run("kills of haspi-report", shares, command.disturbed, share=0.12)
    bench.run("two reports at once", shares, command.twice, share=0.08)
