"""Helpers of several tests: corpora, tables of ears, short speech, and modules of examples."""

import importlib.util
import sys
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import pytest
import soundfile
import torch

from hlsim import Audiogram

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
FIGURES = ROOT / "docs" / "figures"


@contextmanager
def default_type(dtype: torch.dtype) -> Iterator[None]:
    """Set torch's default type in a ``with`` block."""
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


def mostly_slow(cases: Iterable[Any], fast: Container[Any]) -> list[Any]:
    """Mark the cases of a sweep as slow, except those that every run of the tests shall cover."""
    return [case if case in fast else pytest.param(case, marks=pytest.mark.slow) for case in cases]


def touch_files(folder: Path, files: Iterable[str]) -> Path:
    """Create empty files, and return their folder."""
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    return folder


def write_table(path: Path, rows: Sequence[Mapping[str, str]]) -> Path:
    """Write rows with equal columns as a CSV file."""
    lines = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_ears(path: Path, *names: str) -> Path:
    """Write standard ears as a table of audiograms."""
    rows = [{"listener": name, **Audiogram.standard(name).to_row()} for name in names]
    return write_table(path, rows)


def copy_excerpts(paths: Iterable[Path], speech_dir: Path, folder: Path, seconds: int) -> None:
    """Copy a part of each file below a folder to another one, from half a second on."""
    for path in paths:
        samples, rate = soundfile.read(path)
        target = folder / path.relative_to(speech_dir)
        target.parent.mkdir(parents=True, exist_ok=True)
        soundfile.write(target, samples[rate // 2 : rate // 2 + seconds * rate], rate)


def measure_aids_briefly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let evaluations measure the properties of aids with one utterance, tone and position."""
    monkeypatch.setattr("hlsim.evaluation.aid_properties.TONES", (1000,))
    monkeypatch.setattr("hlsim.evaluation.aid_properties.CHANGE_POSITIONS", [24001])
    monkeypatch.setattr("hlsim.evaluation.compensators.UTTERANCES", 1)


def run_short_demo(folder: Path, speech_dir: Path, steps: int) -> str:
    """Run the demo for an N4 ear, with a second of the last bundled utterances."""
    from hlsim.cli.demo_run import run_demo

    copy_excerpts(speech_dir.rglob("*-0[34].flac"), speech_dir, folder, seconds=1)
    with patch("hlsim.data.bundled.SPEECH", folder):
        return run_demo(folder / "out", Audiogram.standard("N4"), steps=steps, jobs=1)


def load_example(name: str) -> ModuleType:
    """Import a file of the folder ``examples``."""
    return load_file(EXAMPLES / name)


def load_figure(name: str) -> ModuleType:
    """Import a script of the folder ``docs/figures``."""
    return load_file(FIGURES / name)


def load_file(path: Path) -> ModuleType:
    """Import a Python file, which may import others from its folder."""
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses and pickle look for it
    spec.loader.exec_module(module)
    return module
