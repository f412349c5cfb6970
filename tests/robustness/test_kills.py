"""Killed at any moment, out of disk, or started twice at once, then started again: it ends as an undisturbed run."""

import hashlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import time
from pathlib import Path
from random import Random
from typing import Any

import pytest

from compensators import load_compensator
from hlsim.cli.main import main

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="starts copies of this process")


def start(arguments: list[str], largest: int | None = None) -> Any:
    """The program in a copy of this process, which has imported all and needs no seconds to begin.

    Where it may write no file over ``largest`` bytes, the system refuses more, as where a disk is full.
    """

    def child() -> None:
        if largest is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        sys.stdout = sys.stderr = os.fdopen(
            quiet, "w"
        )  # pytest's are files, which fill like others
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

    def __init__(self, words: list[str], folder: Path) -> None:
        self.words, self.folder = words, folder
        for name in ("warm", "whole"):
            before = time.monotonic()
            assert main([*words, "--out", str(folder / name)]) == 0
        self.seconds, self.whole = time.monotonic() - before, results(folder / "whole")
        sizes = [path.stat().st_size for path in (folder / "whole").rglob("*") if path.is_file()]
        self.largest = max(sizes)

    def killed(self, shares: list[float]) -> None:
        """Kill it after each share of its time, and let it end."""
        arguments, target = self._anew()
        for share in shares:
            process = start(arguments)
            process.join(share * self.seconds)
            process.kill()
            process.join()
            assert process.exitcode in (0, -signal.SIGKILL), f"ended with {process.exitcode}"
        self._same(arguments, target)

    def twice(self, shares: list[float]) -> None:
        """Start it again beside the first after a share of its time: one of them may be refused."""
        arguments, target = self._anew()
        first = start(arguments)
        time.sleep(shares[0] * self.seconds)
        second = start(arguments)
        for process in (first, second):
            process.join()
        statuses = {first.exitcode, second.exitcode}
        assert 0 in statuses and statuses <= {0, 2}, (
            f"ended with {first.exitcode} and {second.exitcode}"
        )
        self._same(arguments, target)

    def filled(self, share: float) -> None:
        """Let it write no file over a share of its largest one: it says so in a line, or that share is enough."""
        arguments, target = self._anew()
        process = start(arguments, largest=round(share * self.largest))
        process.join()
        assert process.exitcode in (0, 2), f"ended with {process.exitcode}"
        self._same(arguments, target)

    def _anew(self) -> tuple[list[str], Path]:
        target = self.folder / f"out-{time.monotonic_ns()}"
        return [*self.words, "--out", str(target)], target

    def _same(self, arguments: list[str], target: Path) -> None:
        assert main(arguments) == 0
        assert results(target) == self.whole, "another result"
        shutil.rmtree(target)


class Training(Command):
    """A training ends with the weights of an undisturbed one; states and events tell how long it took."""

    def _same(self, arguments: list[str], target: Path) -> None:
        assert main(arguments) == 0
        weights = "checkpoint/model.safetensors"
        assert results(target)[weights] == self.whole[weights]
        load_compensator(target / "checkpoint")
        assert main(arguments) == 0  # there is nothing left to do
        shutil.rmtree(target)


def share_of_a_disk(draw: Random) -> float:
    return draw.choice((0.0, 0.01, draw.random(), draw.random()))


def moments(draw: Random) -> list[float]:
    """Shares of the time that a command takes."""
    return [round(draw.uniform(0.0, 1.1), 3) for _ in range(draw.choice((1, 1, 3)))]


def test_haspi_report(bench: Any, corpus: Path) -> None:
    pytest.importorskip("matplotlib")
    words = ["haspi-report", "--audiogram", "N3", "--jobs", "1", "--listen", "1"]
    for name in ("clean", "before", "after"):
        (corpus / name).symlink_to(corpus / "speech" / "s0")
        words += [f"--{name}", str(corpus / name)]
    command = Command(words, corpus)
    bench.run("kills of haspi-report", moments, command.killed, share=0.08)
    bench.run("two reports at once", moments, command.twice, share=0.04)
    bench.run("haspi-report on a full disk", share_of_a_disk, command.filled, share=0.04)


def test_training(bench: Any, corpus: Path) -> None:
    pytest.importorskip("lightning")
    recipe = corpus / "recipe.yaml"
    recipe.write_text(
        "steps: 6\nbatch: 2\nseconds: 0.4\nvalidate_every: 2\nvalidation_items: 2\nmodel: {channels: 4, blocks: 1}\n"
    )
    words = [
        "train-compensator",
        "--config",
        str(recipe),
        "--audiogram",
        "N3",
        "--quiet",
    ]
    command = Training([*words, "--speech", str(corpus / "speech")], corpus)
    bench.run("kills of train-compensator", moments, command.killed, share=0.08)
    bench.run("train-compensator on a full disk", share_of_a_disk, command.filled, share=0.08)
