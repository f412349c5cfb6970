import math

import numpy as np
import pytest
import torch

from hlsim.msbg.cochlea import hear
from hlsim.msbg.filterbank import BANKS, erb, gammatone_response
from hlsim.msbg.recruitment import (
    STEP,
    detect,
    envelope,
    envelope_lowpass,
    expand,
    interpolate,
    interpolation_kernel,
)
from hlsim.msbg.tiers import assign, make_plan

POINTS = 50400
CPU = torch.device("cpu")


@pytest.mark.parametrize("name", ["mild", "moderate", "severe"])
@pytest.mark.parametrize("step", [1, 2])
def test_every_channel_has_one_tier_that_holds_its_band(name: str, step: int) -> None:
    bank, tiers = BANKS[name], assign(BANKS[name], step)
    assert [channel for own, *_ in tiers for channel in range(bank.channels)[own]] == list(
        range(bank.channels)
    )
    for own, rate_step, detector in tiers:
        highest = 44100.0 / rate_step / (2.0 if detector == "itself" else 1.0)
        hz = np.array(bank.centre_frequencies)[own]
        reach = hz + 5.0 * bank.broadening * erb(hz)
        assert np.all(reach <= highest) or rate_step == 1 or step == 2


# white noise is the worst case: it has as much where channels are cut off as in their bands
@pytest.mark.parametrize(
    ("name", "step", "error"), [("mild", 1, 2e-3), ("moderate", 1, 2e-3), ("severe", 1, 5e-4)]
)
def test_tiers_equal_all_channels_at_44_khz(name: str, step: int, error: float) -> None:
    bank = BANKS[name]
    wave = torch.zeros(POINTS, dtype=torch.float64)
    wave[4000:40000] = 0.03 * torch.randn(36000, dtype=torch.float64)
    spectrum = torch.fft.rfft(wave)[None]
    ratios = torch.linspace(1.4, 2.6, bank.channels, dtype=torch.float64)[None]
    heard = torch.fft.irfft(
        hear(spectrum, ratios, make_plan(name, POINTS, step, torch.float64, CPU), False), POINTS
    )
    channels = torch.fft.irfft(
        spectrum.unsqueeze(-2) * torch.from_numpy(gammatone_response(bank, POINTS)), POINTS
    )
    envelopes = envelope(channels, torch.from_numpy(envelope_lowpass(bank, POINTS)))
    truth = expand(channels, envelopes, ratios)
    assert torch.linalg.norm(heard - truth) < error * torch.linalg.norm(truth)


def test_what_a_rectifier_makes_of_an_analytic_signal() -> None:
    phase = torch.arange(2400, dtype=torch.float64) * (2.0 * math.pi / 2400.0)
    signal = 0.3 * torch.polar(torch.ones_like(phase), phase)
    torch.testing.assert_close(detect(signal, harmonics=False), signal.abs())
    fine = torch.fft.rfft(detect(signal, harmonics=True) * (2.0 / math.pi))[:5]
    torch.testing.assert_close(fine, torch.fft.rfft(signal.real.abs())[:5], atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("harmonics", [False, True])
def test_gradients_of_detection(harmonics: bool) -> None:
    signals = torch.randn(2, 5, dtype=torch.complex128, requires_grad=True)
    assert torch.equal(detect(signals, harmonics), detect(signals.detach(), harmonics))
    assert torch.autograd.gradcheck(lambda z: detect(z, harmonics), signals)
    assert torch.autograd.gradgradcheck(lambda z: detect(z, harmonics), signals)


def test_detection_of_silence_has_a_gradient() -> None:
    silence = torch.zeros(16, dtype=torch.complex64, requires_grad=True)
    for harmonics in (False, True):
        (gradient,) = torch.autograd.grad(detect(silence, harmonics).sum(), silence)
        assert torch.isfinite(torch.view_as_real(gradient)).all()


@pytest.mark.parametrize("steps", [16, 21, 40])
@pytest.mark.parametrize("step", [1, 2, 4, 8])
@pytest.mark.parametrize("together", [5, 8])
def test_interpolation_is_exact_for_polynomials_of_fifth_order(steps: int, step: int, together: int) -> None:
    powers = torch.randn(6, dtype=torch.float64)

    def polynomial(place: torch.Tensor) -> torch.Tensor:
        return (powers * ((place - steps / 2) / steps).unsqueeze(-1) ** torch.arange(6)).sum(-1)

    each = STEP // step
    places = torch.arange(steps * each, dtype=torch.float64) / each
    kernel = torch.from_numpy(interpolation_kernel(step, together=together))
    fine = interpolate(polynomial(torch.arange(steps, dtype=torch.float64))[None], kernel)[0]
    inside = slice(2 * each, (steps - 3) * each)  # it is taken as periodic
    torch.testing.assert_close(fine[inside], polynomial(places)[inside])


def test_interpolation_of_two_parts_gives_both_the_same() -> None:
    values = torch.randn(3, 24, dtype=torch.float64)
    once, twice = (interpolate(values, torch.from_numpy(interpolation_kernel(4, parts))) for parts in (1, 2))
    torch.testing.assert_close(twice, once.repeat_interleave(2, -1))
