"""The mapping compensator: its start, its limit, and what every module of signals must do."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from compensators import NALR, MappingCompensator, MappingConfig
from compensators.limiter import soft_limit
from hlsim import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.resample import resample
from hlsim.losses.band_levels import band_levels
from hlsim.neuro import NeuroConfig
from hlsim.training.ears import draw_thresholds

SMALL = MappingConfig(channels=8, blocks=1)


def bands_db(waveform: torch.Tensor) -> torch.Tensor:
    """Level of each of 24 bands over the whole signal. Shape: (..., time) -> (..., 24)."""
    return 10.0 * torch.log10((10.0 ** (band_levels(waveform, 16000) / 10.0)).mean(-2))


def trained(config: MappingConfig = SMALL, **options: float) -> MappingCompensator:
    """A network whose correction is not 0: about 5 dB."""
    torch.manual_seed(5)
    model = MappingCompensator(config, **options)
    for decoder in (model.magnitude_decoder, model.phase_decoder):
        if decoder is not None:
            torch.nn.init.normal_(decoder.leave.weight, std=0.1)
    return model.eval()


@pytest.fixture
def utterance(speech: list[tuple[torch.Tensor, int]]) -> torch.Tensor:
    """1.5 s of speech at 65 dB SPL. Shape: (time,) at 16 kHz."""
    waveform, rate = speech[0]
    return set_level(resample(waveform, rate, 16000)[0, 8000:32000], 65.0)


@pytest.mark.parametrize("name", ["NH", "N2", "N4", "S2"])
def test_starts_as_nalr(name: str, utterance: torch.Tensor) -> None:
    ear = Audiogram.standard(name)
    start = MappingCompensator()(utterance, ear)
    prescribed = NALR(ear)(utterance)
    assert (bands_db(start) - bands_db(prescribed)).abs().max() < 1.0
    assert (level_spl(start) - level_spl(prescribed)).abs() < 0.5


def test_starts_as_nalr_on_drawn_ears(utterance: torch.Tensor) -> None:
    ears = draw_thresholds(8, torch.Generator().manual_seed(1))
    difference = bands_db(MappingCompensator()(utterance, ears)) - bands_db(NALR(ears)(utterance))
    assert difference.abs().max() < 1.5
    assert difference.abs().mean() < 0.3


def test_starts_as_a_share_of_the_loss() -> None:
    noise = set_level(torch.randn(16000), 40.0)
    flat = torch.full((8,), 50.0)
    start = MappingCompensator(replace(SMALL, start=0.4))(noise, flat)
    torch.testing.assert_close(start, 10.0 * noise, rtol=1e-3, atol=1e-3 * float(noise.max()))


def test_level_counts(utterance: torch.Tensor) -> None:
    model, ear = trained(), Audiogram.standard("N3")
    louder = model(10.0 * utterance, ear) / 10.0
    assert (louder - model(utterance, ear)).norm() > 0.01 * louder.norm()


def test_correction_is_smooth_over_frequency() -> None:
    model = trained()
    features = torch.randn(1, SMALL.channels, 20, 67)
    correction = model._correction(features, (40, 201)).squeeze(0).detach().double()
    erb_number = 21.4 * torch.log10(1.0 + 0.00437 * 40.0 * torch.arange(201, dtype=torch.float64))
    centres = torch.linspace(float(erb_number[2:4].mean()), float(erb_number[-1]), SMALL.bands)
    between = correction[:, (erb_number > centres[-2] + 0.1) & (erb_number < centres[-1])]
    line = erb_number[(erb_number > centres[-2] + 0.1) & (erb_number < centres[-1])]
    assert between.shape[-1] > 20 and between.std() > 0.02
    slopes = between.diff() / line.diff()  # one slope from one band's centre to the next
    torch.testing.assert_close(slopes, slopes[:, :1].expand_as(slopes), rtol=1e-3, atol=1e-4)
    assert torch.linalg.matrix_rank(correction, rtol=1e-5) <= 20


@pytest.mark.parametrize("level", [65.0, 110.0, 160.0])
def test_never_passes_its_limit(level: float, utterance: torch.Tensor) -> None:
    config = replace(SMALL, limit_spl=100.0)
    for rate in (16000, 44100):
        model = trained(config, sample_rate=rate)
        aided = model(set_level(utterance, level), Audiogram.standard("N6"))
        assert 20.0 * torch.log10(aided.abs().max()) + 94.0 <= 100.0 + 1e-4


def test_soft_limit_is_smooth_monotonic_and_linear_below() -> None:
    x = torch.linspace(-6.0, 6.0, 2001, dtype=torch.float64)
    y = soft_limit(x, 2.0)
    assert y.diff().min() >= 0.0 and y.abs().max() <= 2.0
    assert (y[x.abs() < 1.0] / x[x.abs() < 1.0] - 1.0).abs().nan_to_num().max() < 6e-4
    samples = torch.tensor([-3.0, -2.0, 0.0, 1.0, 2.5], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: soft_limit(x, 2.0), (samples,))
    assert soft_limit(torch.tensor([1e30, float("inf")]), 2.0).tolist() == pytest.approx([2.0, 2.0])


@pytest.mark.parametrize("samples", [1, 37, 1600, 16001])
def test_length_and_silence(samples: int) -> None:
    model = trained()
    silence = torch.zeros(2, samples, requires_grad=True)
    out = model(silence, Audiogram.standard("N4"))
    assert out.shape == silence.shape and not out.any()
    gradients = torch.autograd.grad(out.square().sum() + out.sum(), [silence, *model.parameters()])
    assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)


@pytest.mark.parametrize("rate", [22050, 44100, 48000])
def test_other_rates_give_the_same_band(rate: int, utterance: torch.Tensor) -> None:
    ear = Audiogram.standard("N3")
    at_neuro_rate = trained()(utterance, ear)
    faster = resample(utterance, 16000, rate)
    aided = trained(sample_rate=rate)(faster, ear)
    assert aided.shape == faster.shape
    difference = (
        bands_db(resample(aided, rate, 16000)[: len(utterance)])[:22] - bands_db(at_neuro_rate)[:22]
    )
    assert difference.abs().max() < 0.2


def test_full_scale(utterance: torch.Tensor) -> None:
    ear = Audiogram.standard("N3")
    softer = utterance / 10.0  # 94 dB SPL at RMS 1.0 is 114 at RMS 10
    torch.testing.assert_close(
        trained(full_scale_spl=114.0)(softer, ear) * 10.0, trained()(utterance, ear)
    )


def test_aligned(utterance: torch.Tensor) -> None:
    aided = MappingCompensator(SMALL)(utterance, Audiogram.standard("N3"))
    spectra = (
        torch.fft.rfft(aided, 2 * len(aided)) * torch.fft.rfft(utterance, 2 * len(aided)).conj()
    )
    assert int(torch.fft.irfft(spectra).argmax()) == 0


def test_batch_equals_its_items(utterance: torch.Tensor) -> None:
    model = trained()
    ears = torch.tensor([Audiogram.standard(name).thresholds for name in ("NH", "N2", "S3")])
    batch = torch.stack([utterance[:12000], 3.0 * utterance[4000:16000], 0.1 * utterance[-12000:]])
    together = model(batch, ears)
    for item, ear, result in zip(batch, ears, together, strict=True):
        torch.testing.assert_close(
            model(item, ear), result, rtol=1e-4, atol=1e-5 * result.detach().abs().max().item()
        )
    assert model(batch[0], ears).shape == (3, 12000)
    assert model(batch.reshape(3, 1, 12000), ears[:2]).shape == (3, 2, 12000)


def test_configuration_survives_json() -> None:
    import json

    config = MappingConfig(start=0.4, stride=(1, 2))
    assert MappingConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    "setting",
    [
        {"layers": 3},
        {"start": "none"},
        {"start": 2.0},
        {"start": True},
        {"bands": 2},
        {"bands": "a"},
        {"bands": 20.0},
        {"reach_db": None},
        {"limit_spl": 200.0},
        {"channels": 0},
        {"fft": 400, "window": 400, "hop": 200},
        {"phase": "minimum"},
    ],
)
def test_bad_setting_raises_value_error(setting: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        MappingConfig.from_dict(setting)


@pytest.mark.parametrize("config", [5, {}, MappingConfig, NeuroConfig()])
def test_bad_configuration_raises_value_error(config: Any) -> None:
    with pytest.raises(ValueError):
        MappingCompensator(config)


def test_an_ear_beyond_the_range_raises_value_error() -> None:
    with pytest.raises(ValueError):
        MappingCompensator(SMALL)(torch.randn(100), Audiogram.standard("N7"))


def spectrum_of_a_tone(model: MappingCompensator, hertz: int) -> torch.Tensor:
    """Of the middle second of three, a line a Hz."""
    time = torch.arange(48000, dtype=torch.float64)
    tone = set_level(torch.sin(2.0 * torch.pi * hertz / 16000 * time), 65.0)
    aided = model.double()(tone, Audiogram.standard("N3")).detach()
    return torch.fft.rfft(aided[16000:32000] * torch.hann_window(16000, dtype=torch.float64)).abs()


def test_a_tone_stays_a_tone() -> None:
    """The gain does not follow where a frame falls, nor do a decoder's patches leave their period."""
    for stride in ((2, 3), (3, 3)):
        spectrum = spectrum_of_a_tone(trained(replace(SMALL, stride=stride)), 1013)
        beside = torch.cat((spectrum[:1003], spectrum[1024:]))
        assert beside.max() < 1e-3 * spectrum[1013]
    # what it is there for
    predicted = spectrum_of_a_tone(trained(replace(SMALL, phase="predicted")), 1013)
    assert torch.cat((predicted[:1003], predicted[1024:])).max() > 0.01 * predicted[1013]


def test_phase_stays_or_is_predicted(utterance: torch.Tensor) -> None:
    ear = Audiogram.standard("N3")
    turned = []
    for phase in ("input", "predicted"):
        model = trained(MappingConfig(channels=8, blocks=1, phase=phase))
        assert MappingConfig.from_dict(model.config.to_dict()) == model.config
        given, aided = (
            model.stft.analyse(signal[None]) for signal in (utterance, model(utterance, ear))
        )
        loud = given.abs() > 0.1 * given.abs().max()
        turned.append((aided * given.conj())[loud].angle().abs().mean().item())
    assert turned[0] < 0.1 < 0.2 < turned[1]
