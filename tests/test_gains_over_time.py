"""The plug-ins of examples/gains_over_time.py apply the gains of compensator-general."""

import doctest
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import Tensor, nn

import hlsim
from compensators import load_compensator
from hlsim import Audiogram
from hlsim.plugins import load_plugin

FILE = Path(__file__).parents[1] / "examples" / "gains_over_time.py"
EAR = Audiogram.standard("N3")
SECOND = 16000


def plugin(name: str) -> nn.Module:
    return load_plugin(f"{FILE}:{name}", "aid")


@pytest.fixture(scope="module")
def speech() -> Tensor:
    return hlsim.example_speech()[: 2 * SECOND]


def module_of(aid: nn.Module) -> ModuleType:
    return sys.modules[type(aid).__module__]


def residual_db(output: Tensor, reference: Tensor) -> float:
    """Return the power of the difference relative to the reference in dB."""
    error = (output - reference).square().sum() / reference.square().sum()
    return float(10.0 * torch.log10(error))


def test_prompt_gains_give_the_output_of_the_network(speech: Tensor) -> None:
    with torch.no_grad():
        reference = load_compensator("compensator-general")(speech, EAR)
    prompt = residual_db(plugin("PromptGains")(speech, EAR), reference)
    later = residual_db(plugin("LaterGains")(speech, EAR), reference)
    steady = residual_db(plugin("SteadyGains")(speech, EAR), reference)
    assert prompt < -15.0
    assert prompt < later < steady


def test_examples_of_docstrings() -> None:
    result = doctest.testmod(module_of(plugin("PromptGains")))
    assert result.attempted >= 1 and result.failed == 0
