"""All kinds of blocks, baselines and ablations have their size and obey laws."""

import copy
import pickle
from pathlib import Path

import pytest
import torch

from hlsim import Audiogram, NeuroMSBG
from hlsim.data.ears import draw_thresholds
from hlsim.neuro import NeuroConfig
from hlsim.neuro.model import BandNeuroMSBG, DualPathNeuroMSBG
from hlsim.training.recipes import SimulatorRecipe

yaml = pytest.importorskip("yaml")

N3 = Audiogram.standard("N3")

PAPER = Path(__file__).parents[2] / "examples" / "paper"
MILLIONS = dict.fromkeys(
    ("mamba", "transformer", "cnn", "monolithic-cnn", "monolithic-lstm", "monolithic-transformer"),
    1.45,
) | {"lstm": 1.47}
SMALL = {"channels": 8, "blocks": 1, "states": 4, "heads": 2}
DUAL_PATH = {"structure": "dual-path", "stride": (4, 3), "kernel": (7, 7)}
BLOCKS = ("cnn", "mamba", "lstm", "transformer")
MONOLITHIC = {"structure": "monolithic", "prior": False}
KINDS = {
    **{block: {"block": block} for block in BLOCKS},
    **{f"monolithic {b}": {"block": b, "level_aware": False, **MONOLITHIC} for b in BLOCKS},
    "magnitude only": {"phase": "input", "prior": False},
    "concatenated": {"audiogram": "concatenated", "prior": False},
    "concatenated monolithic": {"audiogram": "concatenated", **MONOLITHIC},
    "normalised": {"level_aware": False, "prior": False, "dense_depth": 2},
    "normalised with prior": {"level_aware": False},
    "bands": {"structure": "bands", "stride": (2, 1)},
}


def network(kind: str) -> NeuroMSBG:
    torch.manual_seed(0)
    model = NeuroMSBG(NeuroConfig.from_dict(SMALL | DUAL_PATH | KINDS[kind]))
    # Decoders are zero before training, so that layers before them would have no effect.
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    return model.eval()


def recipe(name: str) -> SimulatorRecipe:
    return SimulatorRecipe(**yaml.safe_load((PAPER / f"{name}.yaml").read_text(encoding="utf-8")))


@pytest.mark.parametrize("name", MILLIONS)
def test_networks_have_the_sizes_of_the_papers(name: str) -> None:
    model = NeuroMSBG(NeuroConfig.from_dict(recipe(name).model))
    count = sum(parameter.numel() for parameter in model.parameters())
    assert count / 1e6 == pytest.approx(MILLIONS[name], rel=0.03)
    assert model.config.prior is False and model.config.level_aware is False


def test_ablations_change_one_setting() -> None:
    base = NeuroConfig.from_dict(recipe("mamba").model).to_dict()
    for name, setting in (("mamba-magnitude-only", "phase"), ("mamba-concatenated", "audiogram")):
        other = NeuroConfig.from_dict(recipe(name).model).to_dict()
        assert {key for key in base if base[key] != other[key]} == {setting}


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_equals_its_items_and_has_the_shape_of_the_input(kind: str) -> None:
    model = network(kind)
    generator = torch.Generator().manual_seed(2)
    waveforms = 0.02 * torch.randn(3, 3201, generator=generator)
    ears = draw_thresholds(3, generator)
    with torch.no_grad():
        batch = model(waveforms, ears)
        assert batch.shape == waveforms.shape and bool(torch.isfinite(batch).all())
        for i in range(3):
            item = model(waveforms[i], ears[i])
            assert float((batch[i] - item).norm() / item.norm()) < 1e-4


@pytest.mark.parametrize("block", ["lstm", "transformer"])
def test_sequence_layers_stay_in_training_mode(block: str) -> None:
    """In evaluation mode, cuDNN has no gradient, and attention stores all pairs of times."""
    layer = network(block).blocks[0].get_submodule("time.core")
    assert all(module.training for module in layer.modules())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("level", [-torch.inf, -20.0, 65.0, 120.0])
def test_every_parameter_has_a_finite_gradient_and_silence_stays_silent(
    kind: str, level: float
) -> None:
    model = network(kind).train()
    waveform = torch.randn(2, 2000, generator=torch.Generator().manual_seed(3))
    waveform = (waveform * 10.0 ** ((level - 94.0) / 20.0)).requires_grad_()
    output = model(waveform, torch.tensor([[0.0] * 8, [70.0] * 8]))
    assert bool(output.any()) == bool(waveform.any())
    output.square().mean().backward()
    for name, tensor in [("waveform", waveform), *model.named_parameters()]:
        assert tensor.grad is not None and bool(torch.isfinite(tensor.grad).all()), name
        assert level != 65.0 or bool(tensor.grad.any()), name


def test_networks_depend_on_the_level_except_with_the_papers_normalisation() -> None:
    waveform = 0.02 * torch.randn(4000)
    for kind, is_linear in (("normalised", True), ("magnitude only", False)):
        model = network(kind)
        with torch.no_grad():
            output_of_louder = model(10.0 * waveform, N3)
            louder_output = 10.0 * model(waveform, N3)
        error = (output_of_louder - louder_output).norm() / louder_output.norm()
        assert (float(error) < 1e-3) == is_linear


def test_ablations_lack_a_part_and_a_concatenated_audiogram_affects_the_output() -> None:
    model = network("concatenated")
    waveform = 0.02 * torch.randn(1600)
    with torch.no_grad():
        outputs = [model(waveform, name) for name in ("N1", "N4")]
    assert model.audiogram_encoder is None and not torch.allclose(*outputs)
    assert network("magnitude only").phase_decoder is None


@pytest.mark.parametrize("kind", [*BLOCKS, "bands"])
def test_derivatives_are_exact_or_raise(kind: str) -> None:
    """The docstring of NeuroMSBG states which derivatives work for each kind of block."""
    model = network(kind).double()
    wave = 0.02 * torch.randn(2, 400, dtype=torch.float64)
    direction = torch.randn(400, dtype=torch.float64)

    def energy(waveform: torch.Tensor) -> torch.Tensor:
        return model(waveform, N3).square().sum()

    def slope(waveform: torch.Tensor, create_graph: bool = False) -> torch.Tensor:
        leaf = waveform if create_graph else waveform.detach().requires_grad_()
        return torch.autograd.grad(energy(leaf), leaf, create_graph=create_graph)[0]

    torch.testing.assert_close(torch.func.grad(energy)(wave), slope(wave))
    leaf = wave.clone().requires_grad_()
    directional_slope = (slope(leaf, create_graph=True) * direction).sum()
    if kind in ("mamba", "transformer"):
        with pytest.raises(RuntimeError, match=r"no second derivative|is not implemented"):
            torch.autograd.grad(directional_slope, leaf)
        return
    (curvature,) = torch.autograd.grad(directional_slope, leaf)
    expected = (slope(wave + 1e-8 * direction) - slope(wave - 1e-8 * direction)) / 2e-8
    assert float((curvature - expected).norm() / expected.norm()) < 1e-4


def test_structure_decides_the_class() -> None:
    for structure, kind in (("dual-path", DualPathNeuroMSBG), ("bands", BandNeuroMSBG)):
        model = NeuroMSBG(NeuroConfig(structure=structure, channels=8))
        assert type(model) is kind
        twin = pickle.loads(pickle.dumps(copy.deepcopy(model)))
        assert type(twin) is kind and twin.config == model.config
