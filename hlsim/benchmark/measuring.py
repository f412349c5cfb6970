"""What the benchmark takes of each row: one second in rounds, other sizes, and a batch to train on."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.benchmark.models import Row
from hlsim.benchmark.timing import attempt, finish, milliseconds, peak_mib
from hlsim.calibration import set_level
from hlsim.neuro.config import NEURO_RATE

EARS = ("N1", "N2", "N3")
"""One ear of each degree of loss: mild, moderate and severe in MSBG's sense."""

# milliseconds: what takes longer is timed in so many rounds only, with the middle ear and no uncounted call
_SLOW, _SLOW_ROUNDS = 400.0, 2

Key = tuple[str, int, float, int, str]
"""Name, sample rate, seconds, batch, and ``"forward"`` or ``"both"``."""


class Measuring:
    """Times and memory, of what did not fail."""

    def __init__(self, device: torch.device, repeats: int, limit: float, skipped: list[str]) -> None:
        self.device, self.repeats, self.limit, self.skipped = device, repeats, limit, skipped
        self.calls: dict[tuple[str, int, str], Callable[[Tensor], Tensor]] = {}
        self.times: dict[Key, list[float]] = {}
        self.memory: dict[Key, float | None] = {}
        self.failed: set[Key] = set()
        self.probe: dict[tuple[str, int], float] = {}

    def prepare(self, row: Row) -> None:
        def make(rate: int) -> None:
            made = {
                (row.name, rate, ear): row.prepare(rate, Audiogram.standard(ear), self.device) for ear in EARS
            }
            self.calls.update(made)

        for rate in row.rates:
            attempt(f"{row.name}, {rate} Hz", partial(make, rate), self.device, self.skipped)

    def second(self, row: Row, rate: int, turn: int) -> None:
        """One second at batch 1: with every ear in both directions, in round ``turn``, of which 0 does not count."""
        slow = self.probe.get((row.name, rate), math.inf if turn == 0 else 0.0) > _SLOW
        if (row.name, rate, EARS[1]) not in self.calls or (slow and turn > _SLOW_ROUNDS):
            return
        forward, both = ((row.name, rate, 1.0, 1, direction) for direction in ("forward", "both"))
        for ear in EARS[1:2] if slow else EARS:
            for key in (forward, both) if row.differentiable else (forward,):
                if not self.failed & {forward, key}:
                    self._attempt(key, partial(self._round, key, ear, turn, slow))

    def _round(self, key: Key, ear: str, turn: int, slow: bool) -> None:
        call = self._call(key, ear)
        if not slow:
            finish(call, self.device)  # the one before left its own data in the caches
        elapsed = milliseconds(call, self.device)
        if turn == 0 and elapsed > _SLOW:  # a row's first call makes what the later ones find
            elapsed = milliseconds(call, self.device)
        name, rate, _, _, direction = key
        if direction == "forward":
            self.probe[name, rate] = min(self.probe.get((name, rate), math.inf), elapsed)
        if turn:
            self.times.setdefault(key, []).append(elapsed)
        elif ear == EARS[1]:
            self.memory[key] = peak_mib(call, self.device)

    def size(self, row: Row, seconds: float, batch: int) -> None:
        """Another length or batch, forward at the row's own rate, where it does not take too long."""
        times = {
            (s, b): own
            for (name, rate, s, b, direction), own in self.times.items()
            if (name, rate, direction) == (row.name, row.rates[0], "forward")
        }
        if (1.0, 1) not in times:
            return
        line = [(s, statistics.median(own)) for (s, b), own in times.items() if b == 1]
        expected = line[0][1] * batch if batch > 1 else _expected(line, seconds)
        if expected <= 1000.0 * self.limit:
            key = (row.name, row.rates[0], seconds, batch, "forward")
            self._attempt(key, partial(self._repeat, key))

    def training(self, row: Row, seconds: float, batch: int) -> None:
        """A batch to train on, forward plus backward at the network's own rate, where a CPU does not take too long."""
        second = self.times.get((row.name, NEURO_RATE, 1.0, 1, "both"))
        if second is None:
            return
        # a GPU takes much less than what one second tells
        expected = statistics.median(second) * seconds * batch if self.device.type == "cpu" else 0.0
        if expected <= 1000.0 * self.limit:
            key = (row.name, NEURO_RATE, seconds, batch, "both")
            self._attempt(key, partial(self._repeat, key))

    def _repeat(self, key: Key) -> None:
        call = self._call(key, EARS[1])
        self.memory[key] = peak_mib(call, self.device)
        first = milliseconds(call, self.device)
        self.times[key] = [first]
        for _ in range(min(self.repeats, int(3000.0 * self.limit / max(1.0, first))) - 1):
            self.times[key].append(milliseconds(call, self.device))

    def _call(self, key: Key, ear: str) -> Callable[[], None]:
        name, rate, seconds, batch, direction = key
        return partial(_run, self.calls[name, rate, ear], _clip(rate, seconds, batch, self.device), direction)

    def _attempt(self, key: Key, call: Callable[[], None]) -> None:
        name, rate, seconds, batch, direction = key
        what = f"{name}, {rate} Hz, {seconds:g} s, batch {batch}, " + (
            "forward" if direction == "forward" else "forward and backward"
        )
        if not attempt(what, call, self.device, self.skipped):
            self.failed.add(key)


def _expected(line: list[tuple[float, float]], seconds: float) -> float:
    """Milliseconds of a longer clip, by how the time grew so far: attention's grows with the square of the length."""
    power = 1.0
    if len(line) > 1:
        (low, first), (high, last) = line[-2:]
        # no more than that, for what takes microseconds may look as if, where the machine was busy once
        power = min(2.0, max(1.0, math.log(last / first) / math.log(high / low)))
    return line[-1][1] * (seconds / line[-1][0]) ** power


def _clip(rate: int, seconds: float, batch: int, device: torch.device) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    samples = round(rate * seconds)
    syllables = torch.sin(torch.arange(samples) * (2.0 * torch.pi * 4.0 / rate)).clamp_min(0.05)
    return set_level(torch.randn(batch, samples, generator=generator) * syllables, 65.0).to(device)


def _run(call: Callable[[Tensor], Tensor], clip: Tensor, direction: str) -> None:
    if direction == "both":
        call(clip.clone().requires_grad_()).square().sum().backward()
    else:
        with torch.inference_mode():
            call(clip)
