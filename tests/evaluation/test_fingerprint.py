"""Fingerprints differ for modules with different outputs, and nothing else changes them."""

import io
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import hlsim
from compensators import NALR, WDRC, load_compensator
from hlsim import MSBG, Audiogram
from hlsim.checkpoint import list_pretrained
from hlsim.evaluation.conditions import AtLevelOf
from hlsim.evaluation.running.fingerprint import _hash_sources, fingerprint, value_hash
from hlsim.plugins import WaveformPlugin, load_plugin

N3 = Audiogram.standard("N3")


def test_settings_and_ears_distinguish_modules() -> None:
    modules = [
        *(MSBG(), MSBG(rescale_active=True), MSBG(N3), NALR(), NALR(N3), WDRC(), WDRC(release=0.2)),
        load_compensator("hearing-aid"),
        load_compensator("hearing-aid", linked=True),
        load_compensator("hearing-aid", limit_to_ear=True),
        load_compensator("hearing-aid", loudness=-10.0),
    ]
    fingerprints = set(map(fingerprint, modules))
    assert len(fingerprints) == len(modules) and None not in fingerprints
    assert fingerprint(MSBG()) == fingerprint(modules[0])


@pytest.mark.parametrize(("name", "load"), list_pretrained().items())
def test_a_checkpoint_has_one_fingerprint(name: str, load: str) -> None:
    first, second = (getattr(hlsim, load)(name) for _ in range(2))
    shape = (2, 2, 1600) if getattr(first, "takes_microphones", False) else (1600,)
    second(torch.full(shape, 0.01), N3)  # Use changes nothing.
    assert fingerprint(first) == fingerprint(second) is not None


@dataclass
class Options:
    gain: float


class Foreign(nn.Module):
    """A module of another package with a setting and one weight."""

    def __init__(self, setting: Any) -> None:
        super().__init__()
        self.setting = setting
        self.weight = nn.Parameter(torch.ones(1))


class Amplifier(nn.Module):
    """An aid of another package, without weights."""


def test_aids_within_conditions_count_as_they_do_alone() -> None:
    aid = Amplifier()
    assert fingerprint(AtLevelOf(NALR(), aid)) is None
    fingerprints = []
    for version in ("1", "2"):
        Amplifier.fingerprint = version  # type: ignore[attr-defined]
        fingerprints.append(fingerprint(AtLevelOf(NALR(), aid)))
    del Amplifier.fingerprint  # type: ignore[attr-defined]
    assert None not in fingerprints and len(set(fingerprints)) == 2


def test_settings_of_any_describable_type_count() -> None:
    settings: list[Any] = [
        *([1.0], [2.0], {"a": 1.0}, {"a": 2.0}, None, max, min),
        *(np.ones(2), np.zeros(2), torch.ones(3), Options(0.0), Options(20.0)),
    ]
    fingerprints = [fingerprint(Foreign(setting)) for setting in settings]
    assert None not in fingerprints and len(set(fingerprints)) == len(settings)
    assert fingerprints == [fingerprint(Foreign(setting)) for setting in settings]
    unknown = type("Foreign", (Foreign,), {"__module__": "notebook"})
    assert fingerprint(unknown(1.0)) is None, "a class without a source file"


class Gain(nn.Module):
    """A gain that is a plain attribute."""

    def __init__(self, gain: float) -> None:
        super().__init__()
        self.gain = gain
        self.config = "none"

    def forward(self, waveform: Tensor) -> Tensor:
        return self.gain * waveform


def test_the_object_of_a_method_counts() -> None:
    fingerprints = [fingerprint(Foreign(Gain(gain).forward)) for gain in (1.0, 1.0, 2.0)]
    assert None is not fingerprints[0] == fingerprints[1] != fingerprints[2]
    assert fingerprint(Foreign(Path().exists)) is None, "the object is unknown"
    aid = Foreign(1.0)
    aid.setting = aid.parameters
    assert fingerprint(aid) is not None, "the method of the module itself"
    first, second = Gain(1.0), Gain(1.0)
    first.gain, second.gain = second.forward, first.forward  # type: ignore[assignment]
    assert fingerprint(first) is None


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")
def test_the_program_of_a_module_of_torch_counts() -> None:
    for translate in (torch.jit.script, torch.fx.symbolic_trace):
        modules = [nn.Sequential(translate(Gain(gain)), nn.Linear(1, 1)) for gain in (1.0, 2.0)]
        modules[1][1] = modules[0][1]
        modules.append(nn.Sequential(translate(Gain(1.0)), modules[0][1]))
        first, second, third = map(fingerprint, modules)
        assert None is not first == third != second


@pytest.mark.filterwarnings("ignore:`torch.jit.*` is deprecated")
def test_a_program_that_cannot_be_saved_is_unknown() -> None:
    layers = nn.Sequential(nn.Conv2d(1, 4, 3), nn.BatchNorm2d(4), nn.ReLU()).eval()
    program = torch.jit.optimize_for_inference(torch.jit.script(layers))
    can_be_saved = True
    try:
        torch.jit.load(io.BytesIO(program.save_to_buffer()))
    except RuntimeError:  # with weights in the format of oneDNN
        can_be_saved = False
    assert (fingerprint(Foreign(program)) is not None) == can_be_saved


def test_hooks_count() -> None:
    aid = nn.Linear(1, 1)
    alone = fingerprint(aid)
    aid.register_forward_hook(_double)
    assert fingerprint(aid) not in (None, alone)
    aid.register_forward_pre_hook(lambda module, inputs: inputs)
    assert fingerprint(aid) is None, "a lambda is unknown"


def _double(module: nn.Module, inputs: Any, output: Tensor) -> Tensor:
    return 2.0 * output


MODULE = """
import torch
from torch import Tensor, nn
class Aid(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Identity()
        self.layer.weight = nn.Parameter(torch.ones(1))
        self._gain = 1
    def forward(self, waveform, rate):
        return self._gain * waveform
"""


def test_the_source_and_private_attributes_of_a_module_of_a_user_count(tmp_path: Path) -> None:
    sources = [MODULE, MODULE, MODULE.replace("return self", "return -self")]
    fingerprints = []
    for number, source in enumerate(sources):
        (tmp_path / f"{number}.py").write_text(source)
        aid = load_plugin(f"{tmp_path / str(number)}.py:Aid", "aid")
        fingerprints.append(fingerprint(aid))
        aid._gain = 2
        assert fingerprint(aid) not in (None, fingerprints[-1])
    assert fingerprints[0] == fingerprints[1] != fingerprints[2], "the place of a file is ignored"


def test_files_that_a_module_of_a_user_imports_count(tmp_path: Path) -> None:
    """A helper may change while the weights and the file of a network do not."""
    package = tmp_path / "helpers_of_an_aid"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "gains.py").write_text("from .constants import GAIN")
    attempt = "try:\n    from .gains import GAIN\nexcept ImportError:\n    GAIN = 1.0\n"
    (tmp_path / "aid.py").write_text(f"{attempt}from helpers_of_an_aid import gains\n{MODULE}")
    fingerprints = []
    for gain in (1.0, 1.0, 2.0):
        (package / "constants.py").write_text(f"GAIN = {gain}")
        fingerprints.append(fingerprint(load_plugin(f"{tmp_path}/aid.py:Aid", "aid")))
    assert None is not fingerprints[0] == fingerprints[1] != fingerprints[2]


def test_functions_of_one_name_in_two_files_have_two_fingerprints(tmp_path: Path) -> None:
    fingerprints = set()
    for name in ("a.py", "b.py"):
        (tmp_path / name).write_text("def half(x, rate): return x / 2\nhalf.fingerprint = '1'")
        fingerprints.add(fingerprint(WaveformPlugin(f"{tmp_path / name}:half", "enhancer")))
    assert len(fingerprints) == 2 and None not in fingerprints


def test_classes_of_one_name_in_two_folders_have_two_fingerprints(tmp_path: Path) -> None:
    plugins = []
    for number in (1, 2):
        file = tmp_path / f"variant-{number}" / "enhancer.py"
        file.parent.mkdir()
        file.write_text(
            "from torch import nn\nclass Enhancer(nn.Module):\n    config = {}\n"
            f"    def forward(self, x, rate):\n        return x / {number}\n"
        )
        plugins.append(WaveformPlugin(f"{file}:Enhancer", "enhancer"))
    fingerprints = {fingerprint(plugin) for plugin in plugins}
    assert len(fingerprints) == 2 and None not in fingerprints


def test_a_condition_that_contains_a_function_of_a_user_needs_its_fingerprint(
    tmp_path: Path,
) -> None:
    aid = nn.Linear(2, 2)
    fingerprints = []
    for number, source in enumerate(("", "aid.fingerprint = '1'", "aid.fingerprint = '2'")):
        path = tmp_path / f"{number}.py"
        path.write_text(f"def aid(signal, ear): return signal\n{source}")
        function = load_plugin(f"{path}:aid", "aid")
        fingerprints.append(fingerprint(AtLevelOf(aid, function)))
    assert fingerprints[0] is None
    assert None is not fingerprints[1] != fingerprints[2]


def test_the_source_of_a_function_counts_and_not_only_its_name(tmp_path: Path) -> None:
    hashes = []
    for number, factor in enumerate((1.0, 2.0)):
        path = tmp_path / f"{number}.py"
        path.write_text(f"def gain(signal): return {factor} * signal")
        hashes.append(value_hash(load_plugin(f"{path}:gain", "aid")))
    assert hashes[0] != hashes[1]
    notebook: dict[str, Any] = {"__name__": "__main__"}
    exec("def gain(signal): return signal", notebook)
    with pytest.raises(TypeError, match="source"):
        value_hash(notebook["gain"])


@pytest.mark.parametrize(
    "thing",
    [Foreign(lambda: 1.0), Foreign(partial(max, 1.0)), nn.Identity(), lambda waveform: waveform],
)
def test_objects_that_cannot_be_described_need_an_attribute(thing: Any) -> None:
    assert fingerprint(thing) is None
    thing.fingerprint = "version 1"
    first = fingerprint(thing)
    thing.fingerprint = "version 2"
    assert None is not first != fingerprint(thing)


@pytest.mark.parametrize(
    ("file", "counts"),
    [
        ("metrics/new.py", True),
        ("metrics/table.json", True),
        ("cli/new.py", False),
        ("notes.md", False),
    ],
)
def test_the_hash_of_the_code_covers_all_that_scores_depend_on(
    tmp_path: Path, file: str, counts: bool
) -> None:
    (tmp_path / "calibration.py").write_text("LEVEL = 94.0")
    before = _hash_sources.__wrapped__(tmp_path)
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text("LEVEL = 90.0")
    assert (_hash_sources.__wrapped__(tmp_path) != before) == counts
