"""Neuro-MSBG has the shape of its input, obeys laws and is close to MSBG."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from compensators import MappingCompensator
from hlsim import MSBG, Audiogram, NeuroMSBG, load_pretrained
from hlsim.calibration import level_spl, set_level
from hlsim.data.ears import draw_thresholds
from hlsim.dsp.resample import resample
from hlsim.losses.teacher_distance import noise_to_signal_db
from hlsim.neuro import NeuroConfig, network
from hlsim.neuro.decoders import phase_factor
from hlsim.neuro.family.sequences import BidirectionalLSTM, EncoderLayer
from tests.helpers import mostly_slow

N3 = Audiogram.standard("N3")


@pytest.fixture(scope="module")
def trained() -> NeuroMSBG:
    return load_pretrained("neuro-msbg")


@pytest.fixture
def clips(speech: list[tuple[Tensor, int]]) -> Tensor:
    clips = [resample(waveform, rate, 16000)[0, 4000:28000] for waveform, rate in speech]
    return set_level(torch.stack(clips), 65.0)


@pytest.mark.parametrize("rate", [16000, 22050, 44100, 48000])
def test_output_has_the_shape_of_the_input_broadcast_over_ears(rate: int) -> None:
    model = NeuroMSBG(NeuroConfig(channels=4, blocks=1), sample_rate=rate)
    for shape in ((1600,), (2, 4801), (2, 3, 2000)):
        assert model(0.02 * torch.randn(shape), "N2").shape == shape
    waveform, ears = 0.02 * torch.randn(2000), draw_thresholds(3)
    output = model(waveform, ears)
    torch.testing.assert_close(output[1], model(waveform, ears[1]), atol=1e-7, rtol=1e-4)
    assert output.shape == (3, 2000)


def output_and_gradient(model: nn.Module, waveform: Tensor, ears: Any) -> tuple[Tensor, Tensor]:
    waveform = waveform.clone().requires_grad_()
    output = model(waveform, ears)
    (gradient,) = torch.autograd.grad(output.square().sum(), waveform)
    return output.detach(), gradient


DUAL_PATH = {"structure": "dual-path", "channels": 4, "blocks": 1}
PAPER = {"fft": 400, "window": 400, "hop": 100, "stride": (3, 2), "prior": False}
LIMITED_FIELD: dict[str, Any] = {
    "default": {"channels": 8},
    "narrow": {**DUAL_PATH, "blocks": 3, "stride": (4, 3), "kernel": (7, 7)},
    "dense": {**DUAL_PATH, "dense_depth": 3, "stride": (2, 3), "kernel": (3, 5)},
    "paper's transform": {**DUAL_PATH, "kernel": (11, 3), **PAPER},
    "monolithic": {"fft": 256, "window": 96, "hop": 24, "channels": 8, "structure": "monolithic"},
    "compensator": None,
}


@pytest.mark.parametrize(
    "kind", mostly_slow(LIMITED_FIELD, ["default", "paper's transform", "monolithic"])
)
def test_items_and_blocks_one_by_one_equal_processing_at_once(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = LIMITED_FIELD[kind]
    model = NeuroMSBG(NeuroConfig(**sizes)) if sizes else MappingCompensator()
    model.double()
    # Random weights make every layer depend on its whole receptive field.
    for parameter in model.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    # The blocks of the default network begin 1.28 s apart, and have a lead of as much.
    is_default = kind == "default"
    time, hop, longest = (60_000, 20_480, 61_440) if is_default else (24_000, 7_200, 16_000)
    waveforms, ears = 0.02 * torch.randn(2, time, dtype=torch.float64), draw_thresholds(2)
    shapes: list[torch.Size] = []
    process: Any = model.process_items

    def process_and_record(signals: Tensor, ears: Tensor) -> Tensor:
        shapes.append(signals.shape)
        return process(signals, ears)

    monkeypatch.setattr(model, "process_items", process_and_record)
    expected = output_and_gradient(model, waveforms, ears)
    monkeypatch.setattr(network, "_CPU_SAMPLES", hop)
    results = output_and_gradient(model, waveforms, ears)
    assert shapes[0] == (2, time)
    assert len(shapes) == 7 and all(items == 1 and size < longest for items, size in shapes[1:])
    for result, expected_result in zip(results, expected, strict=True):
        assert float((result - expected_result).norm() / expected_result.norm()) < 1e-12


def test_blocks_begin_with_a_step_where_1_28_s_are_no_whole_number_of_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = NeuroMSBG(NeuroConfig(channels=4, stride=(4, 1))).double()
    waveform = 0.02 * torch.randn(110_000, dtype=torch.float64)
    with torch.no_grad():
        expected = model(waveform, "N4")
        monkeypatch.setattr(network, "_CPU_SAMPLES", 40_960)
        output = model(waveform, "N4")
    assert not torch.equal(output, expected)  # so it was computed in blocks
    assert float((output - expected).norm() / expected.norm()) < 1e-12


def test_some_networks_depend_on_the_whole_signal() -> None:
    blocks = [{"block": block} for block in ("lstm", "mamba", "transformer")]
    for change in (*blocks, {"level_aware": False}):
        assert NeuroConfig.from_dict(DUAL_PATH | change).receptive_field is None


BAD_CONFIGURATIONS: list[Any] = [
    *[{"channel": 3}, {"channels": 0}, {"channels": True}, {"blocks": 1.5}, {"states": 0}],
    *[{"kernel": [4, 7]}, {"kernel": [7]}, {"stride": 4}, {"stride": [4, 3, 2]}],
    *[{"hop": 60}, {"hop": 33}, {"hop": 24.0}, {"fft": "400"}, {"window": 300}],
    *[{"prior": "no"}, {"level_aware": 0}, {"block": "gru"}, {"structure": "cascade"}],
    *[{"audiogram": "none"}, {"phase": "random"}],
    {"block": "transformer", "channels": 10, "heads": 4},
    *[{"prior": False}, {"block": "lstm"}, {"level_aware": False}, {"phase": "input"}],
]
BAD_CALLS: list[tuple[Tensor, Any]] = [
    (torch.zeros(10, dtype=torch.int16), torch.zeros(8)),
    (torch.zeros(100), torch.full((8,), 101.0)),
    (torch.zeros(2, 100), torch.zeros(3, 8)),
    (torch.zeros(100), None),
    (torch.zeros(4000, device="meta"), N3),
]


def test_bad_configurations_settings_and_calls_raise_value_error(trained: NeuroMSBG) -> None:
    for change in BAD_CONFIGURATIONS:
        with pytest.raises(ValueError):
            NeuroConfig.from_dict(change)
    with pytest.raises(ValueError):
        NeuroMSBG(sample_rate=8000)
    for waveform, ear in BAD_CALLS:
        with pytest.raises(ValueError):
            trained(waveform, ear)


def test_the_network_of_an_older_checkpoint_on_other_frames_is_trained_again() -> None:
    with pytest.raises(ValueError, match="train the network of an older checkpoint again"):
        NeuroConfig.from_dict({"structure": "bands", "fft": 128, "window": 96, "hop": 24})


def test_an_impaired_ear_expands_levels(trained: NeuroMSBG, clips: Tensor) -> None:
    """10 dB more input give more than 10 dB more output with a loss, and 10 dB without one."""
    for name, lowest, highest in (("NH", 9.9, 10.1), ("N3", 14.0, 25.0)):
        growth = level_spl(trained(10.0**0.5 * clips, name)) - level_spl(trained(clips, name))
        assert lowest < float(growth.mean()) < highest


@pytest.mark.parametrize("checkpoint", ["neuro-msbg", "neuro-msbg-cnn-narrow", "before training"])
@pytest.mark.parametrize(
    ("name", "trained_snr", "first_snr"),
    [("NH", 30, 15), ("N1", 26, 15), ("N2", 22, 15), ("S1", 22, 15), ("N3", 16, 11)],
)
def test_networks_are_close_to_msbg(
    checkpoint: str, clips: Tensor, name: str, trained_snr: float, first_snr: float
) -> None:
    is_trained = checkpoint != "before training"
    model = load_pretrained(checkpoint) if is_trained else NeuroMSBG()
    with torch.no_grad():
        snr = -noise_to_signal_db(model(clips, name), MSBG(name)(clips))
    assert float(snr.median()) > (trained_snr if is_trained else first_snr)


def test_input_at_a_higher_rate_gives_the_band_below_8_khz(
    trained: NeuroMSBG, clips: Tensor
) -> None:
    model = load_pretrained("neuro-msbg", sample_rate=48000)
    output, expected = model(resample(clips, 16000, 48000), "N2"), trained(clips, "N2")
    error = resample(output, 48000, 16000) - expected
    assert float(error.norm() / expected.norm()) < 0.02
    powers = torch.fft.rfft(output).abs().square().mean(0)
    above_9600_hz = powers[powers.shape[0] * 2 // 5 :]
    assert float(above_9600_hz.sum() / powers.sum()) < 1e-6


@pytest.mark.parametrize("layer", [BidirectionalLSTM(8, 4), EncoderLayer(8, 2, 16)], ids=type)
def test_recurrent_and_attention_layers_run_in_float32_under_autocast(layer: nn.Module) -> None:
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        assert layer(torch.randn(3, 12, 8).bfloat16()).dtype == torch.float32


def test_the_phase_factor_equals_its_formula_and_has_exact_gradients() -> None:
    maps = torch.randn(2, 2, 9, 17, dtype=torch.float64, requires_grad=True)
    log_gain = torch.randn(2, 9, 17, dtype=torch.float64, requires_grad=True)
    expected = torch.polar(log_gain.exp(), torch.atan2(maps[:, 1], 1.0 + maps[:, 0]))
    torch.testing.assert_close(phase_factor(maps, log_gain), expected, atol=1e-12, rtol=1e-12)
    few = maps[..., :3, :4], log_gain[..., :3, :4]
    assert torch.autograd.gradcheck(phase_factor, few)
    assert torch.autograd.gradgradcheck(phase_factor, few)
    undefined = torch.stack((-torch.ones(1, 3, 3), torch.zeros(1, 3, 3)), 1).requires_grad_()
    phase_factor(undefined, torch.zeros(1, 3, 3)).abs().sum().backward()
    assert undefined.grad is not None and undefined.grad.isfinite().all()


@pytest.mark.slow
def test_a_compiled_network_has_the_same_output_and_gradient(
    trained: NeuroMSBG, clips: Tensor
) -> None:
    results = []
    for model in (trained, torch.compile(trained, backend="aot_eager")):
        signal = clips[:1, :4000].clone().requires_grad_()
        output = model(signal, N3)
        results.append((output.detach(), *torch.autograd.grad(output.square().sum(), signal)))
    for expected, actual in zip(*results, strict=True):
        assert float((actual - expected).norm() / expected.norm()) < 1e-4
