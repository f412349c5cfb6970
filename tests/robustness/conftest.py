"""How trials are run: seeded, with limits of time and memory, counted by kind, and told so that one can be run again.

``pytest tests/robustness --trials 2000`` runs more of each kind; ``--trials 1 --first-seed 137 -k recipes`` one again.
"""

import linecache
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any, NoReturn

import pytest
import torch

from hlsim.audio import write_audio

ROOT = Path(__file__).parents[2]
OURS = tuple(str(ROOT / name) for name in ("hlsim", "compensators"))
MOST_MEMORY = 4 << 30  # bytes more than before the trial
LONGEST_MESSAGE = 16_000  # it quotes what was given

# what people and spreadsheets leave in cells and settings, and what no one should
TEXTS = [
    "", " ", "nan", "inf", "-inf", "-1", "0", "-0", "1e400", "1e308", "9" * 30, "9" * 5000, "0x10", "1_000", "１２",
    "1,5", "N9", "n3", "true", "null", "[]", "{}", "[1, 2]", "..", "../..", "/", "/dev/null", "~", "*", "%s", "a\nb",
    "a\tb", "\x00", "\u202e", "é" * 130, "x" * 300, "=1+1", "@x", "<b>", "{x}", '"', "'", "|", "#", "&a", "*a",
    "!!python/name:os.system",
]  # fmt: skip
VALUES: list[Any] = [
    *TEXTS, None, True, -1, 0, 1, 7, 10**6, 10**12, 10**400, 1e308, float("nan"), float("inf"), [], {}, [[]], [0, 0],
    {"x": 1}, [1] * 1000,
]  # fmt: skip


class Overtime(BaseException):
    """No Exception, so that nothing that is tried catches it."""


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("robustness")
    group.addoption(
        "--trials", type=int, help="trials of a kind; some have a multiple or a share (default: 25)"
    )
    group.addoption("--first-seed", type=int, help="of the trials of each kind (default: 0)")


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise Overtime after so many seconds, and let the system refuse memory that grows without end."""

    def end(number: int, frame: FrameType | None) -> NoReturn:
        raise Overtime(f"longer than {seconds:g} s")

    kept, before = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGALRM, end)
    if (counts := Path("/proc/self/statm")).exists():
        used = int(counts.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY, kept[1]))
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, kept)


class Bench:
    """Runs trials of a kind; see ``run``."""

    texts, values = TEXTS, VALUES

    def __init__(self, config: pytest.Config, record: Callable[[str, object], None]) -> None:
        self.trials = config.getoption("trials", None) or 25
        self.first = config.getoption("first_seed", None) or 0
        self.record = record

    def run(
        self,
        kind: str,
        make: Callable[[Random], Any],
        attempt: Callable[[Any], object],
        *,
        share: float = 1.0,
        count: int | None = None,
    ) -> None:
        """Make an input from each seed and try it: it passes, or raises a ValueError of hlsim's own.

        Args:
            share: of the trials asked for; one at least.
            count: or else how many, whatever was asked for.
        """
        first, failures = 0 if count else self.first, []
        seeds = range(first, first + (count or max(1, round(share * self.trials))))
        for seed in seeds:
            given = make(Random(f"{kind}:{seed}"))
            try:
                with limited(60.0):
                    attempt(given)
            except (Exception, Overtime) as error:
                if not self.own_words(error):
                    said = f"{type(error).__name__}: {str(error)[:300]}"
                    failures.append(f"{kind}, seed {seed}: {said}\n  input: {repr(given)[:600]}")
        self.record("robustness", [kind, len(seeds), len(failures)])  # counted in tests/conftest.py
        if failures:
            pytest.fail(
                "\n".join([f"{len(failures)} of {len(seeds)} failed", *failures[:10]]),
                pytrace=False,
            )

    @staticmethod
    def own_words(error: BaseException) -> bool:
        """Whether it is a ValueError that hlsim itself raised, not what it calls, with a message that says something."""
        trace, kind = error.__traceback__, type(error)
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        assert trace is not None
        file = trace.tb_frame.f_code.co_filename
        raised = linecache.getline(file, trace.tb_lineno).strip().startswith("raise ")
        own = kind is ValueError or (
            isinstance(error, ValueError) and kind.__module__.startswith("hlsim")
        )
        return own and raised and file.startswith(OURS) and 10 < len(str(error)) < LONGEST_MESSAGE

    @staticmethod
    def damage(draw: Random, whole: bytes) -> bytes:
        """Bytes flipped, cut off, left out, put in or twice there; in the header more than in the rest."""
        data = bytearray(whole)
        for _ in range(draw.choice((1, 1, 2, 8))):
            place = draw.randrange(max(1, min(len(data), draw.choice((64, 256, len(data))))))
            piece, way = draw.randrange(1, 65), draw.randrange(6)
            if way == 0:
                data[place : place + 1] = draw.randbytes(1)
            elif way == 1:
                data[place : place + 1] = bytes(
                    byte ^ (1 << draw.randrange(8)) for byte in data[place : place + 1]
                )
            elif way == 2:
                data[place : place + 4] = draw.choice((0, 1, 2**31 - 1, 2**31, 2**32 - 1)).to_bytes(
                    4, "little"
                )
            elif way == 3:
                del data[place : place + piece]
            elif way == 4:
                data[place:place] = draw.choice(
                    (draw.randbytes(piece), bytes(data[place : place + piece]))
                )
            elif draw.random() < 0.5:
                del data[draw.randrange(len(data) + 1) :]
        return bytes(data)


@pytest.fixture
def bench(pytestconfig: pytest.Config, record_property: Callable[[str, object], None]) -> Bench:
    return Bench(pytestconfig, record_property)


@pytest.fixture
def corpus(tmp_path: Path) -> Path:
    """Three speakers of three utterances of 0.8 s each, and two files of noise."""
    generator, envelope = torch.Generator().manual_seed(0), torch.linspace(0.0, 9.0, 12800).sin()
    for name in (
        *(f"speech/s{n // 3}/{n}.wav" for n in range(9)),
        "noise/hum/1.wav",
        "noise/hiss/2.wav",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write_audio(
            tmp_path / name, 0.1 * envelope * torch.randn(12800, generator=generator), 16000
        )
    return tmp_path
