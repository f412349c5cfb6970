"""Every option of an evaluation reaches the parameter of its function."""

import inspect
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from hlsim import Audiogram
from hlsim.cli.main import main
from hlsim.progress import ProgressLine

STUDY = "--measure my:measure --jobs 3 --dask tcp://host:8786 --seed 7 --out {out}"
ITEMS = "--speech {a} --noise {b} --items 5 --seconds 1.5 --levels 55 75"

CALLS = {
    "hlsim.evaluation.simulators:evaluate_simulators": (
        f"evaluate-simulator msbg --audiograms standard --teacher my:teacher {ITEMS} "
        f"--inputs as-is compensated --compensator nalr {STUDY}"
    ),
    "hlsim.evaluation.compensators:evaluate_compensators": (
        f"evaluate-compensator wdrc --audiograms standard --audiogram N3 {ITEMS} --enhancer my:e "
        f"--simulator neuro-msbg --gain-ears n1 --srt --rival for-ear --loudness 50:0,80:-9 "
        f"--limit-to-ear --ucl 500:90 --root {{e}} {STUDY}"
    ),
    "hlsim.evaluation.recordings:haspi_report": (
        "haspi-report --clean {a} --before {b} --after {c} --manifest {d} --root {e} --audiogram "
        "N3 --audiograms {f} --measures stoi,haspi --baseline noisy --better-ear --spl 60 "
        f"--condition A={{a}} --condition B={{b}} {STUDY}"
    ),
    "hlsim.evaluation.clarity:evaluate_scenes": (
        "clarity {a} mine=nalr --listeners {b} --scenes-listeners {c} --every 3 --enhancer my:e "
        "--microphones 1 3 "
        f"--outputs A={{a}} --outputs B={{b}} --linked --full-scale-spl 110 {STUDY}"
    ),
}
"""Command with all its options, by the function that it calls."""

EXPECTED: dict[str, Any] = {
    "speech": "a", "noise": "b", "items": 5, "seconds": 1.5, "levels": [55.0, 75.0],
    "teacher": "my:teacher", "inputs": ["as-is", "compensated"], "enhancers": ["my:e"],
    "simulator": "neuro-msbg", "gain_ears": ["N1"],
    "rival": "for-ear", "loudness": {50.0: 0.0, 80.0: -9.0},
    "srt": True, "clean": "a", "before": "b", "after": "c",
    "manifest": "d", "root": "e", "baseline": "noisy", "better_ear": True, "spl": 60.0,
    "conditions": {"A": "a", "B": "b"}, "outputs": {"A": "a", "B": "b"},
    "microphones": [1, 3], "scenes": "a", "listeners": "b", "scenes_listeners": "c",
    "stride": 3, "linked": True, "aids": {"mine": "nalr"}, "seed": 7, "jobs": 3,
    "dask": "tcp://host:8786",
}  # fmt: skip
"""Expected argument by parameter; single letters are paths."""


@pytest.mark.parametrize("target", CALLS)
def test_every_option_reaches_its_parameter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str
) -> None:
    pytest.importorskip("matplotlib")
    paths = {letter: tmp_path / letter for letter in "abcdef"}
    for path in paths.values():
        path.mkdir()
    module, _, name = target.partition(":")
    function = getattr(import_module(module), name)
    called = Mock(side_effect=ValueError("called"))
    monkeypatch.setattr(f"{module}.{name}", called)
    words = CALLS[target].format(**paths, out=tmp_path / "out").split()
    assert main(words) == 2
    signature = inspect.signature(function)
    bound = signature.bind(*called.call_args.args, **called.call_args.kwargs)
    arguments = {**bound.arguments, **bound.arguments.get("running", {})}
    missing = signature.parameters.keys() - bound.arguments.keys()
    assert not missing, "an argument is left at its default"
    expected = dict(EXPECTED)
    if name == "evaluate_compensators":
        expected["manifest"] = None  # which --speech excludes
    for parameter, value in expected.items():
        if parameter in arguments:
            actual = arguments[parameter]
            if isinstance(actual, dict):
                actual = {key: _letter(item) for key, item in actual.items()}
            assert _letter(actual) == value, parameter
    named_measures = ["stoi", "haspi"] if name == "haspi_report" else []
    assert arguments["measures"] == [*named_measures, "my:measure"]
    assert isinstance(arguments["progress"], ProgressLine)
    if name == "evaluate_compensators":
        assert arguments["compensators"]["wdrc"].limit_to_ear
        assert arguments["audiogram"].ucl == ((500.0, 90.0),)
    if "audiogram" in arguments:
        assert arguments["audiogram"].levels == Audiogram.standard("N3").levels
    if name == "evaluate_scenes":
        assert arguments["out"] == tmp_path / "out" and arguments["full_scale_spl"] == 110.0
    else:
        assert arguments["store"] == tmp_path / "out" / "scores.jsonl"


@pytest.mark.parametrize(
    ("words", "levels"),
    [
        ("", ""),
        (" --limit-to-ear", "of the file of ears, or predicted ones. The prescriptions"),
        (" --limit-to-ear --audiogram N3 --ucl 500:90", "levels of 90 dB HL at 500 Hz."),
    ],
)
def test_a_page_says_that_aids_were_limited_to_the_ear(
    words: str, levels: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Mock()
    monkeypatch.setattr("hlsim.cli.evaluation._run_study", run)
    command = f"evaluate-compensator wdrc --speech {tmp_path} --out {tmp_path}{words}"
    assert main(command.split()) == 0
    notes = " ".join(run.call_args.kwargs["notes"])
    assert ("limited to the ear" in notes) == bool(words)
    assert levels in notes


def _letter(value: Any) -> Any:
    """Return the name of a path of one letter, and any other value unchanged."""
    return value.name if isinstance(value, Path) and len(value.name) == 1 else value
