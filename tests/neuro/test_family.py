"""The family: blocks, baselines and ablations, their sizes and laws."""

from pathlib import Path

import pytest
import torch

from hlsim import Audiogram, NeuroMSBG
from hlsim.neuro import NeuroConfig
from hlsim.training.ears import draw_thresholds
from hlsim.training.recipes import SimulatorRecipe

yaml = pytest.importorskip("yaml")

RECIPES = sorted((Path(__file__).parents[2] / "examples").glob("**/*.yaml"))
SIMULATORS = {
    path.stem: path for path in RECIPES if not path.stem.startswith(("compensator", "hearing-aid"))
}
MILLIONS = {
    "mamba": 1.45,
    "transformer": 1.45,
    "cnn": 1.45,
    "lstm": 1.47,
    "monolithic-cnn": 1.45,
    "monolithic-lstm": 1.45,
    "monolithic-transformer": 1.45,
}
SMALL = {"channels": 8, "blocks": 1, "states": 4, "heads": 2}
KINDS = {
    **{block: {"block": block} for block in ("cnn", "mamba", "lstm", "transformer")},
    **{
        f"monolithic {block}": {
            "block": block,
            "structure": "monolithic",
            "prior": False,
            "level_aware": False,
        }
        for block in ("cnn", "mamba", "lstm", "transformer")
    },
    "magnitude only": {"phase": "input", "prior": False},
    "concatenated": {"audiogram": "concatenated", "prior": False},
    "concatenated monolithic": {
        "audiogram": "concatenated",
        "structure": "monolithic",
        "prior": False,
    },
    "normalised": {"level_aware": False, "prior": False, "dense_depth": 2},
    "normalised with prior": {"level_aware": False},
    "bands": {"structure": "bands"},
    "bands magnitude only": {"structure": "bands", "phase": "input"},
}


def network(kind: str) -> NeuroMSBG:
    torch.manual_seed(0)
    model = NeuroMSBG(NeuroConfig.from_dict(SMALL | KINDS[kind]))
    with torch.no_grad():  # decoders start at zero: what is before them would not be seen
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    return model.eval()


def recipe(name: str) -> SimulatorRecipe:
    return SimulatorRecipe(**yaml.safe_load(SIMULATORS[name].read_text(encoding="utf-8")))


@pytest.mark.parametrize("name", MILLIONS)
def test_paper_sizes(name: str) -> None:
    model = NeuroMSBG(NeuroConfig.from_dict(recipe(name).model))
    count = sum(parameter.numel() for parameter in model.parameters())
    assert count / 1e6 == pytest.approx(MILLIONS[name], rel=0.03)
    assert model.config.prior is False and model.config.level_aware is False


@pytest.mark.parametrize("name", SIMULATORS)
def test_every_recipe_makes_a_network(name: str) -> None:
    model = NeuroMSBG(NeuroConfig.from_dict(recipe(name).model))
    with torch.no_grad():
        assert model(0.02 * torch.randn(2, 1600), Audiogram.standard("N3")).shape == (2, 1600)


def test_ablations_differ_from_their_counterpart_in_one_setting() -> None:
    base = NeuroConfig.from_dict(recipe("mamba").model).to_dict()
    for name, setting in (("mamba-magnitude-only", "phase"), ("mamba-concatenated", "audiogram")):
        other = NeuroConfig.from_dict(recipe(name).model).to_dict()
        assert {key for key in base if base[key] != other[key]} == {setting}


@pytest.mark.parametrize("kind", KINDS)
def test_keeps_shapes_and_gives_items_what_they_would_get_alone(kind: str) -> None:
    model, generator = network(kind), torch.Generator().manual_seed(2)
    waveforms = 0.02 * torch.randn(3, 3201, generator=generator)
    ears = draw_thresholds(3, generator)
    with torch.no_grad():
        together = model(waveforms, ears)
        assert together.shape == waveforms.shape and bool(torch.isfinite(together).all())
        for i in range(3):
            alone = model(waveforms[i], ears[i])
            assert float((together[i] - alone).norm() / alone.norm()) < 1e-4


def test_attention_takes_no_shortcut_that_holds_every_pair_of_times(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = network("transformer").eval()
    waveform, ear = 0.02 * torch.randn(1, 1600), Audiogram.standard("N3")
    expected = model(waveform, ear).detach()

    def refuse(*arguments: object) -> None:
        raise AssertionError("torch's shortcut")

    for name in ("_transformer_encoder_layer_fwd", "_native_multi_head_attention"):
        monkeypatch.setattr(torch, name, refuse)
    with torch.no_grad():
        torch.testing.assert_close(model(waveform, ear), expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("level", [-20.0, 65.0, 120.0])
def test_gradients_are_finite_and_reach_every_parameter(kind: str, level: float) -> None:
    model = network(kind).train()
    waveform = torch.randn(2, 2000, generator=torch.Generator().manual_seed(3))
    waveform = (waveform * 10.0 ** ((level - 94.0) / 20.0)).requires_grad_()
    model(waveform, torch.tensor([[0.0] * 8, [70.0] * 8])).square().mean().backward()
    assert waveform.grad is not None and bool(torch.isfinite(waveform.grad).all())
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and bool(torch.isfinite(parameter.grad).all()), name


@pytest.mark.parametrize("kind", ["cnn", "mamba", "monolithic lstm", "bands"])
def test_is_deterministic_and_survives_saving(kind: str, tmp_path: Path) -> None:
    from hlsim import load_pretrained
    from hlsim.pretrained import save_checkpoint

    model, again = network(kind), network(kind)
    waveform, ear = 0.02 * torch.randn(1600), Audiogram.standard("N2")
    save_checkpoint(tmp_path / "kept", "neuro-msbg", model, model.config.to_dict(), {})
    with torch.no_grad():
        heard = model(waveform, ear)
        assert torch.equal(heard, again(waveform, ear))
        loaded = load_pretrained(tmp_path / "kept")
        # the weights to the bit; what is heard need not be, on processors that mind where in memory they lie
        for name, value in model.state_dict().items():
            assert torch.equal(value, loaded.state_dict()[name])
        torch.testing.assert_close(loaded(waveform, ear), heard, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_silence_stays_silent(kind: str) -> None:
    waveform = torch.zeros(1600, requires_grad=True)
    heard = network(kind)(waveform, Audiogram.standard("N4"))
    heard.sum().backward()
    assert not bool(heard.any()) and bool(torch.isfinite(waveform.grad).all())


def test_magnitude_only_keeps_the_phase() -> None:
    model = network("magnitude only")
    waveform = 0.02 * torch.randn(1, 4000, generator=torch.Generator().manual_seed(4))
    calls = []
    synthesise = type(model.stft).synthesise
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            type(model.stft),
            "synthesise",
            lambda s, x, n: (calls.append(x), synthesise(s, x, n))[1],
        )
        model(waveform, Audiogram.standard("N3"))
    spectrum = model.stft.analyse(waveform)
    factor = calls[0] / spectrum
    assert float((factor.imag.abs().max() / factor.real.abs().max()).detach()) < 1e-4 and bool(
        (factor.real > 0.0).all()
    )


def test_the_paper_s_normalisation_hides_the_level_and_ours_does_not() -> None:
    waveform, ear = 0.02 * torch.randn(4000), Audiogram.standard("N3")
    for kind, hidden in (("normalised", True), ("magnitude only", False)):
        model = network(kind)
        with torch.no_grad():
            louder, scaled = model(10.0 * waveform, ear), 10.0 * model(waveform, ear)
        assert (float((louder - scaled).norm() / scaled.norm()) < 1e-3) == hidden


def test_the_concatenated_audiogram_is_seen() -> None:
    model, waveform = network("concatenated"), 0.02 * torch.randn(1600)
    with torch.no_grad():
        heard = [model(waveform, Audiogram.standard(name)) for name in ("N1", "N4")]
    assert model.audiogram_encoder is None and not torch.allclose(*heard)


@pytest.mark.parametrize(
    "change",
    [
        {"block": "gru"},
        {"structure": "cascade"},
        {"audiogram": "none"},
        {"phase": "random"},
        {"block": "transformer", "channels": 10, "heads": 4},
        {"states": 0},
    ],
)
def test_a_bad_choice_raises_value_error(change: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        NeuroConfig.from_dict(change)


@pytest.mark.parametrize("block", ["cnn", "lstm", "transformer", "mamba"])
def test_derivatives_are_right_or_refused(block: str) -> None:
    """What the docstring of NeuroMSBG says of each kind of block."""
    model, ear = network(block).double(), Audiogram.standard("N3")
    wave, along = (
        0.02 * torch.randn(2, 400, dtype=torch.float64),
        torch.randn(400, dtype=torch.float64),
    )

    def energy(waveform: torch.Tensor) -> torch.Tensor:
        return model(waveform, ear).square().sum()

    def slope(waveform: torch.Tensor, create_graph: bool = False) -> torch.Tensor:
        given = waveform if create_graph else waveform.detach().requires_grad_()
        return torch.autograd.grad(energy(given), given, create_graph=create_graph)[0]

    torch.testing.assert_close(torch.func.grad(energy)(wave), slope(wave))
    given = wave.clone().requires_grad_()
    first = (slope(given, create_graph=True) * along).sum()
    if block in ("mamba", "transformer"):
        with pytest.raises(RuntimeError, match=r"no second derivative|is not implemented"):
            torch.autograd.grad(first, given)
        return
    (found,) = torch.autograd.grad(first, given)
    expected = (slope(wave + 1e-8 * along) - slope(wave - 1e-8 * along)) / 2e-8
    assert float((found - expected).norm() / expected.norm()) < 1e-4
