"""The default criterion orders degradations, and spikes of its gradient are limited."""

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.losses.coherent_bands import (
    DEFAULT_WEIGHTS,
    KNEE,
    MARGIN,
    coherent_band_parts,
)
from hlsim.losses.criteria import weighted_sum
from hlsim.losses.gradient_limit import MAX_GRADIENT_RATIO, limit_gradient_spikes
from tests.losses.signals import RATE, add_noise, excerpt, filter_by_gain, frequencies


@pytest.fixture
def voice(speech: list[tuple[Tensor, int]]) -> Tensor:
    """A second of two voices at 65 dB SPL, float64. Shape: (2, 16000)."""
    return excerpt(speech, 8000, 24000).double()


def part(name: str, perceived: Tensor, normal: Tensor) -> list[float]:
    values: list[float] = coherent_band_parts(perceived, normal, RATE)[name].tolist()
    return values


def total(perceived: Tensor, normal: Tensor) -> Tensor:
    weights = {name: weight for name, weight in DEFAULT_WEIGHTS.items() if name != "peaks"}
    return weighted_sum(coherent_band_parts(perceived, normal, RATE), weights)


def remove_highs(voice: Tensor) -> Tensor:
    """Attenuate frequencies above 1.5 kHz by 40 dB."""
    return filter_by_gain(voice, -40.0 * ((frequencies(voice) - 500.0) / 1000.0).clamp(0.0, 1.0))


def assert_rising(costs: list[Tensor]) -> None:
    for less, more in pairwise(costs):
        assert bool((less < more).all())


@pytest.mark.parametrize("gain", [-60.0, -20.0, -3.0, 0.0, 0.5, 12.0, 30.0])
def test_gain_costs_only_its_level(voice: Tensor, gain: float) -> None:
    parts = coherent_band_parts(voice * 10.0 ** (gain / 20.0), voice, RATE)
    for name in ("incoherence", "misalignment"):
        assert parts[name].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
    level_cost = KNEE * math.log1p(abs(gain) / KNEE)
    assert parts["levels"].tolist() == pytest.approx([level_cost] * 2, rel=1e-4, abs=1e-9)
    louder = max(gain - MARGIN, 0.0)
    assert all(0.5 * louder <= float(value) <= 1.6 * louder for value in parts["louder"])


def test_incoherence_of_noise_does_not_depend_on_the_level(voice: Tensor) -> None:
    for snr in (20.0, 5.0, -5.0):
        noisy = add_noise(voice, snr)
        expected = part("incoherence", noisy, voice)
        for gain in (0.01, 10.0):
            assert part("incoherence", gain * noisy, voice) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("level", [-60.0, -30.0, -10.0, 0.0])
def test_more_noise_costs_more(voice: Tensor, level: float) -> None:
    """At the right level, and where noise fills bands that are too soft."""
    gain = 10.0 ** (level / 20.0)
    noisy = [add_noise(voice, snr) for snr in (99.0, 20.0, 10.0, 0.0, -5.0)]
    assert_rising([total(gain * wave, voice) for wave in noisy])
    assert_rising([total(gain * remove_highs(wave), voice) for wave in noisy])


def test_inaudible_changes_cost_less_than_noise_at_20_db(voice: Tensor) -> None:
    limit = total(add_noise(voice, 20.0), voice)
    for harmless in (-voice, voice.roll(16, -1)):
        cost = total(harmless, voice)
        assert bool((cost > 0.0).all()) and bool((cost < limit).all())
        assert max(part("incoherence", harmless, voice)) < 0.02


def test_more_clipping_and_reverberation_cost_more(voice: Tensor) -> None:
    limit = float(voice.abs().max())
    clipped = [voice.clamp(-share * limit, share * limit) for share in (1.0, 0.5, 0.25, 0.1)]
    tail = torch.randn(8000, dtype=torch.float64) * 10.0 ** (-3.0 * torch.arange(8000) / 8000)
    wet = torch.fft.irfft(torch.fft.rfft(voice, 32000) * torch.fft.rfft(tail, 32000), 32000)
    wet = set_level(wet[:, :16000], 65.0)
    for waves in (clipped, [voice + share * wet for share in (0.0, 0.2, 0.5, 1.0)]):
        assert_rising([total(wave, voice) for wave in waves])


def test_noise_in_a_pause_costs(voice: Tensor) -> None:
    clean = torch.cat((voice, torch.zeros_like(voice)), -1)
    noise = torch.zeros_like(clean)
    noise[:, 18000:] = set_level(torch.randn(2, 14000, dtype=torch.float64), 55.0)
    assert min(part("louder", clean + noise, clean)) > 3.0
    assert max(part("louder", clean + 1e-3 * noise, clean)) < 0.01


def test_other_rate_has_similar_parts(voice: Tensor) -> None:
    noisy = add_noise(voice, 10.0)
    low = coherent_band_parts(noisy, voice, RATE)
    high = coherent_band_parts(*(resample(wave, RATE, 48000) for wave in (noisy, voice)), 48000)
    for name in low:
        torch.testing.assert_close(high[name], low[name], rtol=0.05, atol=0.01)


def limit_gradient(gradient: Tensor, waveform: Tensor) -> Tensor:
    """Pass a gradient backwards through the limiter."""
    output = limit_gradient_spikes(waveform.requires_grad_(), RATE)
    assert torch.equal(output, waveform)
    return torch.autograd.grad(output, waveform, gradient)[0]


def test_spikes_of_the_gradient_are_limited_and_nan_stays() -> None:
    usual, waveform = torch.ones(3, 1000), torch.randn(3, 1000)
    usual[:, ::2] = -1.0
    usual[1] = 1e-3 * torch.randn(1000)
    usual[2, 500:] = 0.0  # padding
    assert torch.equal(limit_gradient(usual, waveform), usual)
    spiky = usual.clone()
    spiky[:, 403:406] = 1e6 * torch.tensor([1.0, -0.5, -0.5])
    limited = limit_gradient(spiky, waveform)
    assert 0.5 * MAX_GRADIENT_RATIO < float(limited[0].abs().max()) <= MAX_GRADIENT_RATIO
    assert 0.0 < float(limited[1].abs().max()) < 0.05
    distant = torch.arange(1000).sub(400).abs() > 160  # 10 ms
    assert torch.equal(limited[:, distant], usual[:, distant])
    # The mean of the spike stays 0. Limiting sample by sample would leave a constant pressure.
    assert float((limited - usual).sum(-1).abs()[0]) < 0.2
    # In a pause, the limit is the usual gradient of sounding samples.
    pause_first = torch.randn(1, 1000) * torch.where(torch.arange(1000) < 480, 1e-3, 1.0)
    limited = limit_gradient(spiky[:1], pause_first)
    assert 0.5 < float(limited[:, 403:406].abs().max()) <= 1.0
    spiky[0, 8] = math.nan
    assert bool(limit_gradient(spiky, waveform)[0, 8].isnan())
    assert not bool(limit_gradient(torch.zeros(3, 1000), waveform).any())


def test_a_gradient_after_the_end_of_an_item_does_not_limit_its_last_block() -> None:
    """The gradient is not zero, because what an ear perceives depends on later samples."""
    waveform, gradient = torch.randn(2, 1000), torch.ones(2, 1000)
    waveform[:, 480:] = 0.0
    gradient[:, 480:500] = 1e6
    waveform.requires_grad_()
    output = limit_gradient_spikes(waveform, RATE, torch.tensor([480, 470]))
    limited = torch.autograd.grad(output, waveform, gradient)[0]
    assert torch.equal(limited[0, :480], gradient[0, :480]) and not limited[0, 480:].any()
    assert torch.equal(limited[1, :470], gradient[1, :470]) and not limited[1, 470:].any()
