"""Help and errors of options do not import torch, and models import nothing that takes long."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import hlsim
from hlsim.cli.main import COMMANDS

COMMAND_LINE = """
import json, sys
from hlsim.cli.main import main
names = "torch numpy scipy soundfile lightning clarity matplotlib".split()
for arguments, status in json.loads(sys.argv[1]):
    try:
        ended = main(arguments)
    except SystemExit as end:
        ended = end.code
    heavy = set(names) & set(sys.modules)
    assert ended == status and not heavy, (arguments, ended, heavy)
"""

LINES = """nothing
simulate {plain} {out} --audiogram N3 --loud
simulate {missing} {out} --audiogram N3
live
prepare {missing} --out {out}
train-compensator --speech {missing} --out {out}
evaluate-simulator msbg --speech {missing} --audiograms standard --out {out}
evaluate-compensator nalr --speech {missing} --out {out}
haspi-report --manifest {missing} --out {out}
clarity {missing} wdrc --listeners {plain} --out {out}
demo --speech {missing}"""


def test_help_and_errors_of_options_import_nothing_heavy(tmp_path: Path) -> None:
    names = {"plain": "plain.wav", "missing": "missing", "out": "out.wav", "folder": "."}
    paths = {name: tmp_path / file for name, file in names.items()}
    paths["plain"].touch()
    helps = [[], ["--help"], ["--version"], *([command, "--help"] for command in COMMANDS)]
    calls = [(call, 0) for call in helps]
    calls += [(line.format(**paths).split(), 2) for line in LINES.splitlines()]
    command = [sys.executable, "-c", COMMAND_LINE, json.dumps(calls)]
    root = Path(hlsim.__file__).parents[1]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=root)
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert not paths["out"].exists()


COMMAND = """
from hlsim.cli.main import main
from hlsim.data.bundled import EXAMPLE_FILE
options = ["--audiogram", "N3", "--compensator", "nalr"]
assert main(["compensate", str(EXAMPLE_FILE), sys.argv[1], *options]) == 0
import torch
print(torch.get_num_threads())
"""

LAZY_NAMES = f"""
import sys, hlsim
assert {{*hlsim.__all__, "__version__"}} <= set(dir(hlsim))
assert not [name for name in dir(hlsim) if name.startswith("_") and name != "__version__"]
assert not {{"Any", "TYPE_CHECKING", "annotations", "import_module"}} & set(dir(hlsim))
assert "torch" not in sys.modules
{COMMAND}
assert hlsim.metrics.haspi.__module__ == "hlsim.metrics.haspi_score"
assert callable(hlsim.evaluation.haspi_report) and callable(hlsim.export.export_aid)
assert hlsim.HearingLossLoss.__module__ == "hlsim.losses.hearing_loss"
from hlsim import *
assert Audiogram is hlsim.Audiogram and MSBG is hlsim.MSBG and load_pretrained("neuro-msbg")
try:
    hlsim.Audiograms
except AttributeError as error:
    assert "module 'hlsim' has no attribute 'Audiograms'" in str(error)
"""

MODELS = f"""
import sys, torch
slow = {{"sympy", "torch._dynamo"}} - set(sys.modules)
{COMMAND}
import compensators, hlsim
for name in hlsim.__all__:
    getattr(hlsim, name)
speech, ear = 0.02 * torch.randn(8000), hlsim.Audiogram.standard("N3")
hlsim.MSBG(ear, sample_rate=16000)(speech)
hlsim.load_pretrained("neuro-msbg")(speech, ear)
compensators.NALR(ear)(speech)
assert not slow & set(sys.modules), slow & set(sys.modules)
"""


@pytest.mark.parametrize(
    ("script", "chosen", "expected"), [(LAZY_NAMES, None, "1"), (MODELS, "2", "2")]
)
def test_imports_are_few_and_a_command_runs_in_one_thread_unless_a_user_chooses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, chosen: str | None, expected: str
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if chosen:
        monkeypatch.setenv("OMP_NUM_THREADS", chosen)
    call = [sys.executable, "-c", script, str(tmp_path / "out.wav")]
    root = Path(hlsim.__file__).parents[1]
    ended = subprocess.run(call, capture_output=True, text=True, cwd=root)
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert ended.stdout.split()[-1] == expected
