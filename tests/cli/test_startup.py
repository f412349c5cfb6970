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


SCRIPT = """
import os, sys
import hlsim
from hlsim.cli.inputs import use_one_thread
from hlsim.cli.main import main
from hlsim.data.bundled import EXAMPLE_FILE

assert {*hlsim.__all__, "__version__"} <= set(dir(hlsim))
assert not [name for name in dir(hlsim) if name.startswith("_") and name != "__version__"]
assert not {"Any", "TYPE_CHECKING", "annotations", "import_module"} & set(dir(hlsim))
assert "torch" not in sys.modules

late_imports = []
class Recorder:
    def find_spec(self, name, *_):
        if name in ("sympy", "torch._dynamo") and not sys.modules["torch"].__spec__._initializing:
            late_imports.append(name)
sys.meta_path.insert(0, Recorder())

options = ["--audiogram", "N3", "--compensator", "nalr"]
assert main(["compensate", str(EXAMPLE_FILE), sys.argv[1], *options]) == 0
import torch
assert torch.get_num_threads() == 1
os.environ["OMP_NUM_THREADS"] = "2"
use_one_thread()
assert os.environ["OMP_NUM_THREADS"] == "2"

assert hlsim.metrics.haspi.__module__ == "hlsim.metrics.haspi_score"
assert hlsim.HearingLossLoss.__module__ == "hlsim.losses.hearing_loss"
from hlsim import *
assert Audiogram is hlsim.Audiogram and MSBG is hlsim.MSBG
try:
    hlsim.Audiograms
except AttributeError as error:
    assert "module 'hlsim' has no attribute 'Audiograms'" in str(error)

speech, ear = 0.02 * torch.randn(8000), Audiogram.standard("N3")
MSBG(ear, sample_rate=16000)(speech)
load_pretrained("neuro-msbg")(speech, ear)
NALR(ear)(speech)
hlsim.metrics.haspi(0.02 * torch.randn(16000), 0.02 * torch.randn(16000), ear)
hlsim.metrics.haaqi(0.02 * torch.randn(16000), 0.02 * torch.randn(16000), ear)
assert not {"scipy.signal", "scipy.stats"} & set(sys.modules)  # take a second
assert not late_imports, late_imports
assert callable(hlsim.evaluation.haspi_report) and callable(hlsim.export.export_aid)
"""


@pytest.mark.slow
def test_imports_are_few_and_a_command_runs_in_one_thread_unless_a_user_chooses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    call = [sys.executable, "-c", SCRIPT, str(tmp_path / "out.wav")]
    root = Path(hlsim.__file__).parents[1]
    ended = subprocess.run(call, capture_output=True, text=True, cwd=root)
    assert ended.returncode == 0, ended.stderr[-2000:]


def test_evaluations_without_statistics_do_not_import_them() -> None:
    script = "import sys, hlsim.evaluation.recordings; sys.exit('scipy.special' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


EXIT_SCRIPT = """
import atexit, gc, sys
from hlsim.cli.main import main
atexit.register(lambda: print("frozen", gc.get_freeze_count() > 0))
sys.argv = ["hlsim", "--version"]
try:
    main(*eval(sys.stdin.readline()))
finally:
    for name in sys.stdin:
        from hlsim.plugins import load_plugin
        plugin = load_plugin(name.strip(), "measure")
"""


def end_of_command(standard_input: str, folder: Path) -> str:
    call = [sys.executable, "-c", EXIT_SCRIPT]
    ended = subprocess.run(
        call, input=standard_input, capture_output=True, text=True, check=True, cwd=folder
    )
    return ended.stdout.splitlines()[-1]


def test_a_command_ends_without_a_search_for_unused_objects(tmp_path: Path) -> None:
    assert end_of_command("()", tmp_path) == "frozen True"
    assert end_of_command("(['--version'],)", tmp_path) == "frozen False", "called from Python"


def test_a_file_that_a_plug_in_leaves_open_is_written(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "class Log:\n"
        "    def __init__(self):\n"
        "        self.file = open('log.txt', 'w')\n"
        "        self.file.write('loaded')\n"
        "        self.call = self.__call__\n"
        "    def __call__(self, item, output):\n"
        "        return {}\n"
    )
    assert end_of_command("()\nown.py:Log\n", tmp_path) == "frozen False"
    assert (tmp_path / "log.txt").read_text() == "loaded"
