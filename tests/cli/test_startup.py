"""Help and errors of options do not import torch, which takes seconds."""

import json
import subprocess
import sys
from pathlib import Path

import hlsim
from hlsim.cli.main import COMMANDS

SCRIPT = """
import json, sys
from hlsim.cli.main import main
for arguments, status in json.loads(sys.argv[1]):
    try:
        ended = main(arguments)
    except SystemExit as end:
        ended = end.code
    names = "torch numpy scipy soundfile lightning clarity matplotlib".split()
    heavy = set(names) & set(sys.modules)
    assert ended == status and not heavy, (arguments, ended, heavy)
"""


def test_help_and_errors_import_nothing_heavy(tmp_path: Path) -> None:
    plain, missing, out = tmp_path / "plain.wav", tmp_path / "missing", tmp_path / "out.wav"
    plain.touch()
    lines = [
        "nothing",
        f"simulate {plain} {out} --audiogram N3 --loud",
        f"simulate {missing} {out} --audiogram N3",
        f"simulate {plain} {out} --audiogram N9",
        f"simulate {plain} {out}.mp3 --audiogram N3",
        "live",
        "live --audiogram N9",
        f"prepare {missing} --out {out}",
        f"train-compensator --speech {missing} --out {out}",
        f"evaluate-simulator msbg --speech {tmp_path} --audiograms {missing} --out {out}",
        f"evaluate-compensator nalr --speech {missing} --out {out}",
        f"haspi-report --manifest {missing} --out {out}",
        f"demo --speech {missing}",
    ]
    helps = [[], ["--help"], ["--version"], *([command, "--help"] for command in COMMANDS)]
    calls = [(call, 0) for call in helps] + [(line.split(), 2) for line in lines]
    command = [sys.executable, "-c", SCRIPT, json.dumps(calls)]
    ended = subprocess.run(
        command, capture_output=True, text=True, cwd=Path(hlsim.__file__).parents[1]
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert not (tmp_path / "out.wav").exists()


def test_names_are_handed_on_when_they_are_asked_for() -> None:
    script = """
import sys, hlsim
assert "torch" not in sys.modules and {*hlsim.__all__, "__version__"} <= set(dir(hlsim))
assert hlsim.HearingLossLoss.__module__ == "hlsim.losses.hearing_loss"
from hlsim import *
assert Audiogram is hlsim.Audiogram and MSBG is hlsim.MSBG and load_pretrained("neuro-msbg")
try:
    hlsim.Audiograms
except AttributeError as error:
    assert "module 'hlsim' has no attribute 'Audiograms'" in str(error)
"""
    subprocess.run([sys.executable, "-c", script], check=True, cwd=Path(hlsim.__file__).parents[1])


def test_models_do_without_modules_that_take_long_to_import() -> None:
    script = """
import sys, torch
slow = {"sympy", "scipy.signal", "scipy.stats", "torch._dynamo"} - set(sys.modules)
import compensators, hlsim
for name in hlsim.__all__:
    getattr(hlsim, name)
speech, ear = 0.02 * torch.randn(8000), hlsim.Audiogram.standard("N3")
hlsim.MSBG(ear, sample_rate=16000)(speech)
hlsim.load_pretrained("neuro-msbg")(speech, ear)
compensators.NALR(ear)(speech)
assert not slow & set(sys.modules), slow & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", script], check=True, cwd=Path(hlsim.__file__).parents[1])
