"""The laws of the default criterion: what it does not hear, what costs more than what, and its gradient."""

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
    MAX_GRADIENT_RATIO,
    coherent_band_parts,
    limit_gradient_spikes,
    peak_excess,
)

RATE = 16000


@pytest.fixture
def voice(speech: list[tuple[Tensor, int]]) -> Tensor:
    """A second of two voices at 65 dB SPL, float64. Shape: (2, time)."""
    return set_level(
        torch.cat([waveform[:, 8000:24000] for waveform, _ in speech[:2]]).double(), 65.0
    )


def part(name: str, heard: Tensor, normal: Tensor) -> list[float]:
    return [float(value) for value in coherent_band_parts(heard, normal, RATE)[name]]


def total(heard: Tensor, normal: Tensor) -> Tensor:
    parts = coherent_band_parts(heard, normal, RATE)
    return sum((DEFAULT_WEIGHTS[name] * parts[name] for name in parts), torch.zeros(()))


def noisy(voice: Tensor, snr: float) -> Tensor:
    noise = torch.randn(voice.shape, dtype=voice.dtype, generator=torch.Generator().manual_seed(1))
    return voice + set_level(noise, 65.0 - snr)


def without_highs(voice: Tensor, db: float = 40.0) -> Tensor:
    """Heard as by an ear that misses most of what is above 1 kHz."""
    spectrum = torch.fft.rfft(voice)
    hz = torch.fft.rfftfreq(voice.shape[-1], 1.0 / RATE)
    return torch.fft.irfft(
        spectrum * 10.0 ** (-db / 20.0 * ((hz - 500.0) / 1000.0).clamp(0.0, 1.0)), voice.shape[-1]
    )


def test_equal_signals_cost_nothing(voice: Tensor) -> None:
    for name, values in coherent_band_parts(voice, voice, RATE).items():
        assert values.tolist() == pytest.approx([0.0, 0.0], abs=1e-9), name


@pytest.mark.parametrize("gain", [-60.0, -20.0, -3.0, 0.5, 12.0, 30.0])
def test_a_gain_costs_its_level_and_nothing_else(voice: Tensor, gain: float) -> None:
    parts = coherent_band_parts(voice * 10.0 ** (gain / 20.0), voice, RATE)
    for name in ("incoherence", "misalignment"):
        assert parts[name].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
    # as much up as down
    assert parts["levels"].tolist() == pytest.approx(
        [KNEE * math.log1p(abs(gain) / KNEE)] * 2, rel=1e-4
    )
    louder = max(gain - MARGIN, 0.0)
    assert all(0.5 * louder <= float(value) <= 1.6 * louder for value in parts["louder"])


def test_noise_is_as_incoherent_however_soft(voice: Tensor) -> None:
    for snr in (20.0, 5.0, -5.0):
        given = noisy(voice, snr)
        for db in (-40.0, 20.0):
            heard = part("incoherence", given * 10.0 ** (db / 20.0), voice)
            assert heard == pytest.approx(part("incoherence", given, voice), rel=1e-6)


@pytest.mark.parametrize("level", [-60.0, -30.0, -10.0, 0.0])
def test_noise_never_makes_it_less(voice: Tensor, level: float) -> None:
    """Neither at the right level nor where it fills bands that are too soft."""
    for shape in (lambda wave: wave, without_highs):
        costs = [
            total(10.0 ** (level / 20.0) * shape(noisy(voice, snr)), voice)
            for snr in (99.0, 20.0, 10.0, 0.0, -5.0)
        ]
        for less, more in pairwise(costs):
            assert bool((less < more).all())


def test_noise_that_fills_what_is_missing_costs_more(voice: Tensor) -> None:
    """Only in the bands that are not heard, up to the level that a normal ear hears there."""
    missing = without_highs(voice)
    noise = noisy(voice, 0.0) - voice
    highs = noise - without_highs(noise)
    costs = [
        total(missing + 10.0 ** (db / 20.0) * highs, voice) for db in (-99.0, -60.0, -50.0, -40.0)
    ]
    for less, more in pairwise(costs):
        assert bool((less < more).all())


def test_what_nobody_hears_costs_less_than_noise_at_20_db(voice: Tensor) -> None:
    limit = total(noisy(voice, 20.0), voice)
    for harmless in (-voice, voice.roll(16, -1)):
        assert bool((total(harmless, voice) < limit).all())
        assert max(part("incoherence", harmless, voice)) < 0.02
        assert bool((total(harmless, voice) > 0.0).all())


def test_worse_costs_more(voice: Tensor) -> None:
    limit = float(voice.abs().max())
    clipped = [voice.clamp(-share * limit, share * limit) for share in (1.0, 0.5, 0.25, 0.1)]
    tail = torch.randn(8000, dtype=torch.float64) * 10.0 ** (-3.0 * torch.arange(8000) / 8000)
    wet = torch.fft.irfft(torch.fft.rfft(voice, 32000) * torch.fft.rfft(tail, 32000), 32000)[
        :, :16000
    ]
    reverberant = [voice + share * set_level(wet, 65.0) for share in (0.0, 0.2, 0.5, 1.0)]
    for row in (clipped, reverberant):
        for less, more in pairwise(row):
            assert bool((total(less, voice) < total(more, voice)).all())


def test_noise_in_a_pause_costs(voice: Tensor) -> None:
    clean = torch.cat((voice, torch.zeros_like(voice)), -1)
    noise = torch.zeros_like(clean)
    noise[:, 18000:] = set_level(torch.randn(2, 14000, dtype=torch.float64), 55.0)
    assert min(part("louder", clean + noise, clean)) > 3.0
    assert max(part("louder", clean + 1e-3 * noise, clean)) < 0.01


def test_items_do_not_depend_on_each_other(voice: Tensor) -> None:
    heard = noisy(voice, 5.0) * torch.tensor([[0.1], [3.0]])
    together = coherent_band_parts(heard, voice, RATE)
    for item in range(2):
        alone = coherent_band_parts(heard[item, None], voice[item, None], RATE)
        for name in together:
            torch.testing.assert_close(together[name][item], alone[name][0])


def test_another_rate_is_judged_alike(voice: Tensor) -> None:
    heard = noisy(voice, 10.0)
    low = coherent_band_parts(heard, voice, RATE)
    high = coherent_band_parts(resample(heard, RATE, 48000), resample(voice, RATE, 48000), 48000)
    for name in low:
        torch.testing.assert_close(high[name], low[name], rtol=0.05, atol=0.01)


@pytest.mark.parametrize("time", [60, 700])
def test_gradcheck(voice: Tensor, time: int) -> None:
    """Of the parts whose weights do not depend on what is heard; shorter than a frame, and than a stretch."""
    normal = voice[:, 4000 : 4000 + time] * 30.0
    heard = (0.5 * normal + 0.3 * torch.randn_like(normal)).requires_grad_()
    for name in ("incoherence", "misalignment", "levels"):
        # a few samples at a time, which is quick
        def value(few: Tensor, name: str = name) -> Tensor:
            whole = torch.cat((heard[:, :20].detach(), few, heard[:, 40:].detach()), -1)
            return coherent_band_parts(whole, normal, RATE)[name]

        few = heard[:, 20:40].detach().requires_grad_()
        assert torch.autograd.gradcheck(value, (few,), eps=1e-5, atol=1e-6, rtol=1e-3), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_and_zero_only_where_the_reference_is(
    voice: Tensor, dtype: torch.dtype
) -> None:
    clean = voice.to(dtype)
    silence = torch.zeros_like(clean)
    for heard, normal in (
        (silence, clean),
        (clean, silence),
        (silence, silence),
        (clean * 1e-12, clean),
        (clean[:, :10] * 0.0, clean[:, :10]),
        (clean * 1e-5, clean * 1e-5),
        (clean[:, :1] * 2.0, clean[:, :1]),
        (clean[:, :300] * 2.0, clean[:, :300]),
    ):
        given = heard.clone().requires_grad_()
        value = total(given, normal)
        (gradient,) = torch.autograd.grad(value.sum(), given)
        assert bool(value.isfinite().all()) and bool(gradient.isfinite().all())
        if bool(normal.any()) and bool(heard.any()):
            assert bool(gradient.any())


def test_peaks_over_120_db_spl_cost(voice: Tensor) -> None:
    peak = 10.0 ** ((120.0 - 94.0) / 20.0)
    tone = torch.full((1, 100), 2.0 * peak)
    assert peak_excess(torch.cat((tone, 0.9 * tone / 2.0, -tone))).tolist() == pytest.approx(
        [1.0, 0.0, 1.0]
    )
    assert peak_excess(voice).tolist() == [0.0, 0.0]


def test_spikes_of_the_gradient_are_turned_down_and_nan_is_not_hidden() -> None:
    def through(gradient: Tensor) -> Tensor:
        given = torch.randn(gradient.shape, requires_grad=True)
        assert torch.equal(limit_gradient_spikes(given, 16000), given)
        (found,) = torch.autograd.grad(limit_gradient_spikes(given, 16000), given, gradient)
        return found

    usual = torch.ones(3, 1000)
    usual[:, ::2] = -1.0
    usual[1] = 1e-3 * torch.randn(1000)
    usual[2, 500:] = 0.0  # padded
    assert torch.equal(through(usual), usual)
    spiky = usual.clone()
    spiky[:, 403:406] = 1e6 * torch.tensor([1.0, -0.5, -0.5])
    found = through(spiky)
    # as large as may be, or next to a larger one less, and of the same form; what is 7.5 ms away stays as it is
    assert 0.5 * MAX_GRADIENT_RATIO < float(found[0].abs().max()) <= MAX_GRADIENT_RATIO
    assert 0.0 < float(found[1].abs().max()) < 0.05
    away = torch.arange(1000).sub(400).abs() > 160
    assert torch.equal(found[:, away], usual[:, away])
    # no constant pressure is asked for, which is what cutting the samples one by one would do
    cut = spiky.clamp(-MAX_GRADIENT_RATIO, MAX_GRADIENT_RATIO)
    assert (
        float((found - usual).sum(-1).abs()[0]) < 0.2 < 4.0 < float((cut - usual).sum(-1).abs()[0])
    )
    # in a pause no sample asks for more than those usually do that sound
    speech = (
        torch.randn(1, 1000) * torch.where(torch.arange(1000) < 480, 1e-3, 1.0)
    ).requires_grad_()
    (found,) = torch.autograd.grad(limit_gradient_spikes(speech, 16000), speech, spiky[:1])
    assert 0.5 < float(found[:, 403:406].abs().max()) <= 1.0
    spiky[0, 8] = math.nan
    assert bool(through(spiky)[0, 8].isnan())
    assert not bool(through(torch.zeros(2, 10)).any())
