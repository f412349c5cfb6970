"""Neuro-MSBG: shapes, laws, and how near it is to MSBG."""

from typing import Any

import pytest
import torch
from torch import Tensor

from compensators import MappingCompensator
from hlsim import MSBG, Audiogram, NeuroMSBG, load_pretrained
from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.losses.waveform import noise_to_signal_db
from hlsim.neuro import NeuroConfig
from hlsim.neuro.blocks import BidirectionalLSTM, EncoderLayer, SequencePath
from hlsim.neuro.network import EarNetwork
from hlsim.training.ears import draw_thresholds

N3 = Audiogram.standard("N3")
PAPER = NeuroConfig(
    fft=400,
    window=400,
    hop=100,
    channels=8,
    dense_depth=2,
    stride=(1, 2),
    blocks=1,
    prior=False,
    level_aware=False,
)


@pytest.fixture(scope="module")
def trained() -> NeuroMSBG:
    return load_pretrained("neuro-msbg")


@pytest.fixture
def clips(speech: list[tuple[Tensor, int]]) -> Tensor:
    cut = [resample(waveform, rate, 16000)[0, 4000:28000] for waveform, rate in speech]
    return set_level(torch.stack(cut), 65.0)


@pytest.mark.parametrize("rate", [16000, 22050, 44100, 48000])
@pytest.mark.parametrize("shape", [(1600,), (2, 4801), (2, 3, 2000)])
def test_keeps_the_shape_at_any_rate(rate: int, shape: tuple[int, ...]) -> None:
    model = NeuroMSBG(NeuroConfig(channels=4, blocks=1), sample_rate=rate)
    assert model(0.02 * torch.randn(shape), Audiogram.standard("N2")).shape == shape


def test_waveform_broadcasts_over_ears(trained: NeuroMSBG) -> None:
    waveform, ears = 0.02 * torch.randn(8000), draw_thresholds(3)
    heard = trained(waveform, ears)
    assert heard.shape == (3, 8000)
    torch.testing.assert_close(heard[1], trained(waveform, ears[1]), atol=1e-7, rtol=1e-4)


def test_batch_of_mixed_severities_equals_its_items(trained: NeuroMSBG, clips: Tensor) -> None:
    ears = torch.tensor([Audiogram.standard(name).thresholds for name in ("NH", "N1", "N2", "N4")])
    together = trained(clips, ears)
    for i in range(4):
        alone = trained(clips[i], ears[i])
        assert float((together[i] - alone).norm() / alone.norm()) < 1e-5


@pytest.mark.parametrize("rate", [16000, 44100])
def test_items_that_run_one_after_the_other_are_as_together(
    rate: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = NeuroMSBG(NeuroConfig(channels=4, blocks=1), sample_rate=rate)
    given, ears = (0.02 * torch.randn(5, 2 * rate)).requires_grad_(), draw_thresholds(5)
    sizes = []
    process = model._process

    def counted(signals: Tensor, own: Tensor) -> Tensor:
        sizes.append(len(signals))
        return process(signals, own)

    monkeypatch.setattr(model, "_process", counted)
    monkeypatch.setattr(NeuroMSBG, "_at_once", 64_000)
    apart = model(given, ears)
    (gradient,) = torch.autograd.grad(apart.square().sum(), given)
    monkeypatch.setattr(NeuroMSBG, "_at_once", 10**9)
    together = model(given, ears)
    assert sizes == [2, 2, 1, 5]
    torch.testing.assert_close(apart, together, atol=1e-6, rtol=1e-4)
    expected = torch.autograd.grad(together.square().sum(), given)[0]
    assert float((gradient - expected).norm() / expected.norm()) < 1e-4


def test_wider_networks_take_fewer_samples_at_once() -> None:
    sizes = [
        NeuroMSBG(NeuroConfig(channels=channels, blocks=1))._at_once
        for channels in (4, 32, 64, 512)
    ]
    assert sizes == sorted(sizes, reverse=True) and sizes[1] > 1.9 * sizes[2]
    assert sizes[0] == 128_000 and sizes[-1] == 16_000


LOCAL = {
    "default": lambda: NeuroMSBG(NeuroConfig(channels=8)),
    "dense": lambda: NeuroMSBG(
        NeuroConfig(channels=4, dense_depth=3, stride=(2, 3), blocks=1, kernel=(3, 5))
    ),
    "paper's transform": lambda: NeuroMSBG(
        NeuroConfig(
            fft=400,
            window=400,
            hop=100,
            stride=(3, 2),
            kernel=(11, 3),
            channels=4,
            blocks=1,
            prior=False,
        )
    ),
    "monolithic": lambda: NeuroMSBG(
        NeuroConfig(fft=256, window=96, hop=24, channels=8, structure="monolithic")
    ),
    "compensator": MappingCompensator,
}


@pytest.mark.parametrize("kind", LOCAL)
def test_long_signals_by_blocks_are_as_whole(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model = LOCAL[kind]().double()
    for parameter in model.parameters():  # so that everything reaches as far as it can
        parameter.data += 0.05 * torch.randn_like(parameter)
    time = 40_000
    given = (0.02 * torch.randn(1, time, dtype=torch.float64)).requires_grad_()
    whole = model(given, N3)
    monkeypatch.setattr(EarNetwork, "_at_once", 12_000)
    calls = []
    process = model._process

    def counted(signals: Tensor, ears: Tensor) -> Tensor:
        calls.append(signals.shape[-1])
        return process(signals, ears)

    monkeypatch.setattr(model, "_process", counted)
    blocks = model(given, N3)
    assert len(calls) == 3 and max(calls) < time / 2
    assert float((blocks - whole).detach().norm() / whole.detach().norm()) < 1e-12
    first, second = (
        torch.autograd.grad(heard.square().sum(), given)[0] for heard in (whole, blocks)
    )
    assert float((second - first).norm() / first.norm()) < 1e-12


@pytest.mark.parametrize(
    "change",
    [{"block": "lstm"}, {"block": "mamba"}, {"block": "transformer"}, {"level_aware": False}],
)
def test_networks_that_look_at_all_of_a_signal_take_it_whole(
    change: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = NeuroMSBG(NeuroConfig(channels=4, blocks=1, **change))
    waveform = 0.02 * torch.randn(9600)
    with torch.no_grad():
        expected = model(waveform, N3)
        monkeypatch.setattr(NeuroMSBG, "_at_once", 2400)
        assert torch.equal(model(waveform, N3), expected)


@pytest.mark.slow
@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("items", [1, 5])
def test_compiled_gives_the_same(items: int) -> None:
    model = NeuroMSBG(NeuroConfig(channels=4, blocks=1))
    # five items are more than run together when it is not compiled
    waveform, ears = 0.02 * torch.randn(items, 20_000), draw_thresholds(items)
    with torch.no_grad():
        heard = torch.compile(model, backend="eager")(waveform, ears)
        torch.testing.assert_close(heard, model(waveform, ears), atol=1e-6, rtol=1e-4)


def test_is_deterministic_under_a_seed() -> None:
    waveform, ear = 0.02 * torch.randn(4000), Audiogram.standard("N3")
    models = []
    for _ in range(2):
        torch.manual_seed(1)
        models.append(NeuroMSBG())
    assert torch.equal(models[0](waveform, ear), models[1](waveform, ear))


@pytest.mark.parametrize("config", [NeuroConfig(), PAPER], ids=["default", "paper"])
def test_configuration_survives_json(config: NeuroConfig) -> None:
    import json

    assert NeuroConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    "change",
    [
        {"channel": 3},
        {"channels": 0},
        {"channels": True},
        {"kernel": [4, 7]},
        {"kernel": [7]},
        {"stride": 4},
        {"stride": [4, 3, 2]},
        {"hop": 60},
        {"hop": 33},
        {"hop": 24.0},
        {"fft": "400"},
        {"window": 300},
        {"blocks": 1.5},
        {"prior": "no"},
        {"level_aware": 0},
        3,
    ],
)
def test_bad_configuration_raises_value_error(change: Any) -> None:
    with pytest.raises(ValueError):
        NeuroConfig.from_dict(change)


def test_replicas_of_data_parallel_list_no_parameters(clips: Tensor) -> None:
    """As ``torch.nn.parallel.replicate`` makes them, which needs GPUs itself."""
    for module in (NeuroMSBG().eval(), MappingCompensator().eval()):
        replicas = {own: own._replicate_for_data_parallel() for own in module.modules()}
        for own, replica in replicas.items():
            for name, child in own._modules.items():
                replica._modules[name] = None if child is None else replicas[child]
            for name, weight in own._parameters.items():
                setattr(replica, name, None if weight is None else weight.clone())
        replica = replicas[module]
        assert not list(replica.parameters())
        ear = Audiogram.standard("N3")
        torch.testing.assert_close(replica(clips, ear), module(clips, ear))


def test_paper_like_network_trains_a_step() -> None:
    model = NeuroMSBG(PAPER)
    heard = model(0.02 * torch.randn(2, 4000), draw_thresholds(2))
    heard.square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and bool(torch.isfinite(parameter.grad).all()), name


@pytest.mark.parametrize("level", [-20.0, 20.0, 65.0, 100.0, 120.0])
def test_gradients_are_finite_at_all_levels(trained: NeuroMSBG, level: float) -> None:
    waveform = set_level(torch.randn(2, 4000), level).requires_grad_()
    heard = trained(waveform, torch.tensor([[0.0] * 8, [70.0] * 8]))
    heard.square().sum().backward()
    assert bool(torch.isfinite(heard).all()) and bool(torch.isfinite(waveform.grad).all())


def test_silence_stays_silent(trained: NeuroMSBG) -> None:
    waveform = torch.zeros(1600, requires_grad=True)
    heard = trained(waveform, Audiogram.standard("N4"))
    heard.sum().backward()
    assert not bool(heard.any()) and bool(torch.isfinite(waveform.grad).all())


def test_full_scale_is_a_change_of_units(trained: NeuroMSBG, clips: Tensor) -> None:
    other = load_pretrained("neuro-msbg", full_scale_spl=120.0)
    scale = 10.0 ** ((94.0 - 120.0) / 20.0)
    ear = Audiogram.standard("N3")
    heard = other(clips * scale, ear) / scale
    assert float((heard - trained(clips, ear)).norm() / heard.norm()) < 1e-4


def test_an_impaired_ear_expands(trained: NeuroMSBG, clips: Tensor) -> None:
    """Recruitment: 10 dB more in is more than 10 dB more out where there is a loss, and 10 dB where there is none."""
    for name, least, most in (("NH", 9.9, 10.1), ("N3", 14.0, 25.0)):
        soft, loud = (
            trained(clips * gain, Audiogram.standard(name)).square().mean()
            for gain in (1.0, 10**0.5)
        )
        growth = 10.0 * float(torch.log10(loud / soft))
        assert least < growth < most


@pytest.mark.parametrize("checkpoint", ["neuro-msbg", "neuro-msbg-light"])
@pytest.mark.parametrize(
    ("name", "least"), [("NH", 30.0), ("N1", 26.0), ("N2", 22.0), ("S1", 22.0), ("N3", 16.0)]
)
def test_trained_is_near_msbg(checkpoint: str, clips: Tensor, name: str, least: float) -> None:
    trained, ear = load_pretrained(checkpoint), Audiogram.standard(name)
    with torch.no_grad():
        truth = MSBG(ear, sample_rate=16000)(clips)
        snr = -noise_to_signal_db(trained(clips, ear), truth)
    assert float(snr.median()) > least


def test_untrained_default_starts_near_msbg(clips: Tensor) -> None:
    model = NeuroMSBG()
    for name in ("NH", "N1", "N2", "S1"):
        ear = Audiogram.standard(name)
        with torch.no_grad():
            truth = MSBG(ear, sample_rate=16000)(clips)
            assert float(-noise_to_signal_db(model(clips, ear), truth).median()) > 15.0


def test_faster_input_gives_the_band_under_8_khz(trained: NeuroMSBG, clips: Tensor) -> None:
    ear = Audiogram.standard("N2")
    fast = load_pretrained("neuro-msbg", sample_rate=48000)(resample(clips, 16000, 48000), ear)
    back = resample(fast, 48000, 16000)
    slow = trained(clips, ear)
    assert float((back - slow).norm() / slow.norm()) < 0.02
    spectrum = torch.fft.rfft(fast).abs().square().mean(0)
    assert float(spectrum[spectrum.shape[0] * 2 // 5 :].sum() / spectrum.sum()) < 1e-6


@pytest.mark.parametrize(
    ("waveform", "ear"),
    [
        (torch.zeros(0), torch.zeros(8)),
        (torch.zeros(10, dtype=torch.int16), torch.zeros(8)),
        (torch.zeros(100), torch.full((8,), 101.0)),
        (torch.zeros(100), torch.zeros(7)),
        (torch.zeros(2, 100), torch.zeros(3, 8)),
        (torch.zeros(100), None),
        (torch.zeros(4000, device="meta"), N3),
    ],
)
def test_bad_call_raises_value_error(
    trained: NeuroMSBG, waveform: Tensor, ear: Audiogram | Tensor | None
) -> None:
    with pytest.raises(ValueError):
        trained(waveform, ear)


@pytest.mark.parametrize(
    "options",
    [{"config": 5}, {"sample_rate": 8000}],
)
def test_bad_setting_raises_value_error(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        NeuroMSBG(**options)


@pytest.mark.parametrize(
    "core", [BidirectionalLSTM(8, 4), EncoderLayer(8, 2, 16)], ids=["lstm", "attention"]
)
def test_what_stays_in_float32_under_autocast(core: torch.nn.Module) -> None:
    torch.manual_seed(0)
    path = SequencePath(8, 0, core, 8)
    seen: list[torch.dtype] = []
    path.core.register_forward_hook(lambda core, given, output: seen.append(output.dtype))
    features = torch.randn(1, 12, 3, 8)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        path(features.bfloat16())
    assert seen == [torch.float32]
