"""Models are built in float32 on the CPU, whatever torch's default type and device."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from compensators import NALR, WDRC, HearingAid, MappingCompensator, load_compensator
from compensators.aid import Aid
from hlsim import MSBG, HASPILoss, HearingLossLoss, NeuroMSBG, load_pretrained
from hlsim.simulators import Attenuation, PluginSimulator, load_simulator
from tests.helpers import default_type

EAR = [22.3, 27.7, 31.1, 40.9, 50.3, 55.7, 60.1, 60.9]
"""Thresholds that bfloat16 would round."""


LOADERS: dict[str, Callable[[], nn.Module]] = {
    "neuro-msbg": lambda: load_pretrained("neuro-msbg"),
    "hearing-aid": lambda: load_compensator("hearing-aid"),
    "compensator-general": lambda: load_compensator("compensator-general"),
    "PluginSimulator": lambda: PluginSimulator("hlsim:MSBG"),
}
FITTED: dict[str, Callable[[], nn.Module]] = {
    "MSBG": lambda: MSBG(EAR),
    "Attenuation": lambda: Attenuation(EAR),
    "NALR": lambda: NALR(EAR),
    "WDRC": lambda: WDRC(EAR),
}
LOSSES: dict[str, Callable[[], nn.Module]] = {
    "HearingLossLoss": lambda: HearingLossLoss(EAR),
    "HearingLossLoss, msbg": lambda: HearingLossLoss(EAR, simulator="msbg"),
    "HASPILoss": lambda: HASPILoss(EAR),
}
UNTRAINED: dict[str, Callable[[], nn.Module]] = {
    "MappingCompensator": MappingCompensator,
    "HearingAid": HearingAid,
    "NeuroMSBG": NeuroMSBG,
}
BUILDERS = LOADERS | FITTED | LOSSES | UNTRAINED


@pytest.fixture
def clean(speech: list[tuple[Tensor, int]]) -> Tensor:
    """0.75 s of speech. Shape: (1, 12000)."""
    return speech[0][0][:, 10000:22000]


def call(name: str, model: nn.Module, clean: Tensor) -> Tensor:
    """Return the output of a model, or the value of a loss."""
    torch.manual_seed(0)
    with torch.no_grad():
        if name in LOSSES:
            return model(3.0 * clean, clean)
        return model(clean) if name in FITTED else model(clean, EAR)


def build(name: str) -> nn.Module:
    torch.manual_seed(0)
    return BUILDERS[name]()


@pytest.mark.parametrize("name", BUILDERS)
def test_results_do_not_depend_on_the_default_type(name: str, clean: Tensor) -> None:
    expected = call(name, build(name), clean)
    with default_type(torch.bfloat16):
        result = call(name, build(name), clean)
        assert torch.get_default_dtype() == torch.bfloat16
    assert torch.equal(result, expected)


@pytest.mark.parametrize("kind", [NALR, WDRC, HearingAid, MappingCompensator])
def test_gains_do_not_depend_on_the_default_type(kind: Callable[..., Aid]) -> None:
    torch.manual_seed(0)
    expected = kind(EAR).gains()
    with default_type(torch.bfloat16):
        torch.manual_seed(0)
        aid = kind(EAR)
        assert torch.equal(aid.gains(), expected)
        assert torch.equal(aid.gains(EAR), expected)


@pytest.mark.parametrize("name", [*LOADERS, *FITTED, *LOSSES])
def test_models_with_values_are_not_built_on_the_meta_device(name: str, clean: Tensor) -> None:
    """The library transformers builds the modules that it loads on this device."""
    with torch.device("meta"):
        model = build(name)
    assert torch.equal(call(name, model, clean), call(name, build(name), clean))


@pytest.mark.parametrize("kind", [HearingAid, MappingCompensator, NeuroMSBG])
def test_network_without_weights_says_so(kind: type[nn.Module], clean: Tensor) -> None:
    with torch.device("meta"):
        network = kind()
    calls = [lambda: network(clean, EAR)]
    if isinstance(network, Aid):
        calls.append(lambda: network.gains(EAR))
    for call in calls:
        with pytest.raises(ValueError, match="has no weights; build it on the CPU"):
            call()


@pytest.mark.parametrize("name", LOSSES)
def test_loss_keeps_its_simulator_when_its_host_is_emptied(name: str, clean: Tensor) -> None:
    expected = call(name, build(name), clean)
    host = nn.ModuleDict({"loss": build(name), "network": nn.Linear(3, 3)})
    host.to("meta")
    host.to_empty(device="cpu")
    assert torch.equal(call(name, host["loss"], clean), expected)


NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "HearingAid": lambda: HearingAid(EAR),
    "MappingCompensator": lambda: MappingCompensator(EAR),
}


@pytest.mark.parametrize("name", FITTED | NETWORKS)
def test_model_keeps_its_ear_when_it_is_emptied(name: str, clean: Tensor) -> None:
    model = (FITTED | NETWORKS)[name]()
    expected, weights = model(clean), model.state_dict()
    model.to("meta").to_empty(device="cpu")
    model.load_state_dict(weights)
    assert torch.equal(model(clean), expected)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
@pytest.mark.parametrize("name", FITTED)
def test_model_keeps_its_ear_in_another_type(name: str, dtype: torch.dtype, clean: Tensor) -> None:
    model = FITTED[name]()
    expected = model(clean)
    assert torch.equal(model.to(dtype)(clean), expected)


def test_a_simulator_loads_under_another_default_device() -> None:
    with torch.device("meta"):
        assert isinstance(load_simulator("hlsim:MSBG"), PluginSimulator)
