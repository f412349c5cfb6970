"""Options and files that the program cannot use: status 2, one line, in seconds, and nothing left behind."""

import io
import re
from contextlib import redirect_stderr, redirect_stdout
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import pytest

from hlsim.cli.main import main

CALLS = {  # of each command one whose values may be replaced; most of them end early, for want of files
    "simulate": "IN out.wav --audiogram N3 --simulator msbg --full-scale-spl 94",
    "compensate": "IN out.wav --audiogram N3 --compensator nalr --full-scale-spl 94",
    "prepare": "speech --out new.csv --folders speaker --valid-share 0.1",
    "haspi-report": "--manifest m.csv --out new --measures haspi --jobs 1 --spl 65 --listen 0 --seed 0 --audiogram N3",
    "train-compensator": "--speech empty --out new --max-minutes 1 --device cpu --audiogram N3",
    "train-simulator": "--config r.yaml --speech empty --out new --max-minutes 1 --device cpu --teacher msbg",
    "evaluate-simulator": "msbg --speech empty --audiograms e.csv --out new --items 1 --seconds 1 --levels 65",
    "evaluate-compensator": "nalr --speech empty --out new --items 1 --seconds 1 --jobs 1 --audiogram N3",
}
ASIDE = re.compile(r"^\d+ of \d+ |: warning: ")
LEFT = {
    "scores.jsonl",
    "lock",
}  # reports that a refusal names, and what a claim leaves


@pytest.fixture
def place(corpus: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, deep enough for ``../..`` to stay in the test's own folder."""
    folder = corpus / "a" / "b" / "c"
    folder.mkdir(parents=True)
    (corpus / "speech").rename(folder / "speech")
    (folder / "empty").mkdir()
    (folder / "m.csv").write_text("condition,clean,processed\na,x.wav,y.wav\nb,x.wav,z.wav\n")
    (folder / "e.csv").write_text("hl_250,hl_8000\n20,60\n")
    (folder / "r.yaml").write_text("batch: 1\n")
    monkeypatch.chdir(folder)
    return folder


def call(arguments: list[str]) -> tuple[int, str]:
    """Exit status, and what the program said on stderr but for progress and warnings."""
    said = io.StringIO()
    with redirect_stderr(said), redirect_stdout(io.StringIO()):
        try:
            status = main(arguments)
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else -1
    lines = said.getvalue().splitlines()
    return status, "\n".join(line for line in lines if line and not ASIDE.search(line))


def test_options(bench: Any, place: Path) -> None:
    texts = [text for text in bench.texts if "\x00" not in text]  # which no system passes on
    texts += [
        "speech",
        "empty",
        "m.csv",
        "speech/s0/0.wav",
        f"{'x' * 300}.wav",
        "\udcff.wav",
        "-5",
        "--",
        "--out",
    ]

    def make(draw: Random) -> list[str]:
        command = draw.choice(sorted(CALLS))
        words = CALLS[command].replace("IN", "speech/s0/0.wav").split()
        for _ in range(draw.choice((1, 1, 2))):
            words[draw.randrange(len(words))] = draw.choice(texts)
        return [command, *words]

    def attempt(arguments: list[str]) -> None:
        before = set(place.parents[2].rglob("*"))
        status, said = call(arguments)
        assert status in (0, 2), f"status {status}"
        if status == 2:
            one_line = (
                len(said.splitlines()) == 1 and said.startswith("hlsim") and ": error: " in said
            )
            assert one_line and len(said) < 12_000, f"said {said[:300]!r}"
        new = sorted(set(place.parents[2].rglob("*")) - before, reverse=True)
        left = [path for path in new if path.is_file() and path.name not in LEFT]
        for path in new:
            path.rmdir() if path.is_dir() else path.unlink()
        assert status == 0 or not left, f"left {left}"

    bench.run("options of the program", make, attempt, share=2.0)


TRAIN = "train-compensator --config r.yaml --speech speech --out new"
REPORT = "haspi-report --manifest m.csv --out new --audiogram N3 --jobs 1"
HEAD = "condition,clean,processed\n"
LAUGHS = "".join(
    f"{c}: &{c} {{x: *{b}, y: *{b}}}\n" for b, c in pairwise("abcdefghijklmnopqrstuvwx")
)
TABLE: list[tuple[dict[str, str], str, str]] = [
    ({"r.yaml": "[" * 3000}, TRAIN, "not readable as YAML"),
    ({"r.yaml": "batch: 1\nbatch: 2"}, TRAIN, "batch is there twice"),
    ({"r.yaml": f"a: &a {{x: 1}}\n{LAUGHS}"}, TRAIN, "has an alias"),
    ({"m.csv": f"{HEAD}a,loop,b\nb,loop,b\n"}, REPORT, "loop: cannot be read"),
    ({"m.csv": f"{HEAD}a,{'x' * 300},b\nb,{'x' * 300},b\n"}, REPORT, "File name too long"),
    ({"m.csv": f'{HEAD}"a\n\\input{{x}}",x,b\nb,x,b\n'}, REPORT, "not a printable name"),
    ({"x.wav": "RIFF"}, "simulate x.wav out.wav --audiogram N3", "not readable as audio"),
    ({}, "simulate loop out.wav --audiogram N3", "loop: no such file"),
    ({}, "simulate speech loop --audiogram N3", "loop: not a folder"),
    ({}, "compensate speech/s0/0.wav loop/o.wav --audiogram N3", "loop: no such folder"),
    ({}, "prepare loop --out new.csv", "loop: no such folder"),
    ({}, "prepare speech --out new", "choose a name that ends in .csv"),
    ({"t.csv": "path\nloop.wav\n"}, "prepare t.csv --out new.csv", "loop.wav, is not in"),
    (
        {"t.csv": "path\na\0.wav\n"},
        "prepare t.csv --out new.csv",
        "t.csv, line 2: holds a null character",
    ),
    ({}, "compensate speech out --audiogram N3 --compensator loop", "no checkpoint 'loop'"),
]


def test_files(bench: Any, place: Path) -> None:
    for loop in (place / "loop", place / "speech" / "loop.wav"):
        loop.symlink_to(loop)

    def attempt(given: tuple[dict[str, str], str, str]) -> None:
        files, arguments, words = given
        for name, text in files.items():
            (place / name).write_text(text)
        before = set(place.rglob("*"))
        status, said = call(arguments.split())
        assert status == 2 and len(said.splitlines()) == 1 and words in said, (
            f"status {status}, {said[:500]!r}"
        )
        left = {path.name for path in set(place.rglob("*")) - before if path.is_file()}
        assert left <= LEFT, f"left {left}"

    rows = iter(TABLE)
    bench.run("bad files by table", lambda draw: next(rows), attempt, count=len(TABLE))
