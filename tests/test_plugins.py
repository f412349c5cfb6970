"""Plug-ins are loaded by name, and their outputs are validated."""

import importlib
import pickle
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim.calibration import set_level
from hlsim.plugins import WaveformPlugin, load_plugin
from hlsim.simulators import check_aligned

CODE = """
import torch
from torch import nn
from neighbour import GAIN

def half(waveform, *_):
    return waveform * GAIN

class Quieter(nn.Module):
    fingerprint = "version 2"
    def forward(self, waveform, *_):
        assert not self.training and not torch.is_grad_enabled()
        return waveform * GAIN

def short(waveform):
    return waveform[..., 1:]

def complex_numbers(waveform):
    return waveform + 0j

def integers(waveform):
    return (32767 * waveform).to(torch.int16)

def offset(waveform):
    return waveform + 10.0

def silent(waveform):
    return 0.0 * waveform

def array(waveform):
    return waveform.numpy()

def infinite(waveform):
    return waveform / 0

def broken(waveform):
    return waveform @ nobody

def late(waveform):
    return waveform.roll(80, -1)

def mean(waveform):
    return waveform.mean()

def negative(waveform):
    return torch.complex(waveform, -waveform).conj().imag

number = 3
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Write a module into the working directory and return its name, which no other test uses."""
    name = f"plugins_{tmp_path.name}".replace("-", "_")
    (tmp_path / f"{name}.py").write_text(CODE)
    (tmp_path / "neighbour.py").write_text("GAIN = 0.5\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "neighbour", raising=False)
    importlib.invalidate_caches()  # or a module that was written a moment ago may not be found
    return name


def noise() -> Tensor:
    return set_level(torch.randn(2, 8000), 65.0)


def test_a_module_and_a_file_give_the_same_plugin(module: str) -> None:
    waveform = noise()
    for name in (f"{module}:half", f"{module}.py:half", f"./{module}.py:Quieter"):
        torch.testing.assert_close(WaveformPlugin(name, "teacher")(waveform), waveform / 2)
    Path(f"{module}.py").write_text("def four(): return 4")  # a changed file is loaded again
    assert load_plugin(f"{module}.py:four", "measure")() == 4


def test_modules_beside_two_plugins_are_not_mixed_up(module: str) -> None:
    load_plugin(f"{module}.py:half", "aid")
    Path("louder").mkdir()
    Path(f"louder/{module}.py").write_text(CODE)
    Path("louder/neighbour.py").write_text("GAIN = 2.0\n")
    with pytest.raises(ValueError, match=r"the module neighbour of .* would be used instead"):
        load_plugin(f"louder/{module}.py:half", "aid")


def test_another_process_loads_the_plugin_once_under_the_same_name(module: str) -> None:
    plugin = WaveformPlugin(f"{module}.py:Quieter", "aid")
    copy = pickle.loads(pickle.dumps(plugin))
    assert copy is pickle.loads(pickle.dumps(plugin))
    assert str(copy) == str(plugin) == f"{module}.py:Quieter"


@pytest.mark.parametrize(
    "attribute", ["short", "complex_numbers", "integers", "array", "infinite", "broken"]
)
def test_outputs_that_are_no_waveform_are_rejected(module: str, attribute: str) -> None:
    plugin = WaveformPlugin(f"{module}:{attribute}", "teacher")
    with pytest.raises(ValueError, match=f"^teacher {module}:{attribute} "):
        plugin(noise())


@pytest.mark.parametrize("waveform", [torch.ones(100), torch.ones(2, 100)])
def test_a_scalar_is_no_output_of_an_aid(module: str, waveform: Tensor) -> None:
    WaveformPlugin(f"{module}:short", "aid")(waveform)
    with pytest.raises(ValueError, match=r"returned torch.float32 of shape \(\)"):
        WaveformPlugin(f"{module}:mean", "aid")(waveform)


def test_outputs_with_the_negative_bit_are_accepted(module: str) -> None:
    plugin = WaveformPlugin(f"{module}:negative", "teacher")
    assert plugin(noise()).is_neg()
    check_aligned(plugin, noise(), 16000)


def test_outputs_that_are_not_aligned_are_rejected(module: str) -> None:
    for attribute in ("half", "offset"):
        check_aligned(WaveformPlugin(f"{module}:{attribute}", "teacher"), noise(), 16000)
    for attribute, words in (("late", r"delays by 5\.0 ms"), ("silent", "returned silence")):
        plugin = WaveformPlugin(f"{module}:{attribute}", "teacher")
        with pytest.raises(ValueError, match=words):
            check_aligned(plugin, noise(), 16000)


def test_names_that_cannot_be_loaded_are_rejected(module: str) -> None:
    unknown = f"{module}:nobody"
    for name in ("msbg", "no_such_module:half", "none.py:half", ":half", "x:", unknown):
        with pytest.raises(ValueError, match=name):
            load_plugin(name, "teacher")
    with pytest.raises(ValueError, match=r"No module named 'no_such_module'$"):
        load_plugin("no_such_module:half", "teacher")
    Path("imports.py").write_text("\nimport no_such_module\n")
    with pytest.raises(ValueError, match=r"No module named 'no_such_module' \(imports\.py, line 2"):
        load_plugin("imports.py:half", "teacher")
    for load in (load_plugin, WaveformPlugin):
        with pytest.raises(ValueError, match="got an object of type int"):
            load(f"{module}:number", "teacher")
