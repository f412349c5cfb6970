"""Resampling against scipy, tones and finite differences."""

import math
import subprocess
import sys

import numpy as np
import pytest
import scipy.signal
import torch
from torch import Tensor

from hlsim.dsp.resample import _resampler, resample

RATES = [
    (16000, 44100),
    (44100, 16000),
    (48000, 16000),
    (16000, 48000),
    (22050, 44100),
    (32000, 44100),
]


def tone(hz: float, rate: int, seconds: float = 0.5) -> Tensor:
    time = torch.arange(round(rate * seconds), dtype=torch.float64) / rate
    return torch.sin(2 * math.pi * hz * time + 0.3)


@pytest.mark.parametrize(("source", "target"), RATES)
def test_tones_keep_their_phase_and_amplitude(source: int, target: int) -> None:
    for hz in (100.0, 1000.0, 0.45 * 0.88 * min(source, target)):
        ours = resample(tone(hz, source), source, target)
        middle = slice(len(ours) // 8, -len(ours) // 8)
        assert float((ours - tone(hz, target))[middle].abs().max()) < 2e-4


@pytest.mark.parametrize(("source", "target"), RATES)
def test_stops_what_the_lower_rate_cannot_hold(source: int, target: int) -> None:
    nyquist = min(source, target) / 2
    # a click holds all frequencies alike
    click = torch.zeros(source, dtype=torch.float64)
    click[source // 2] = 1.0
    response = torch.fft.rfft(resample(click, source, target)).abs() * max(source / target, 1.0)
    response = response / response[100]
    hz = torch.arange(len(response), dtype=torch.float64)
    gain_db = 20 * torch.log10(response + 1e-12)
    assert float(gain_db[hz < 0.9 * nyquist].abs().max()) < 0.1
    if target > source:
        assert float(gain_db[hz >= nyquist].max()) < -55.0
        assert float(gain_db[hz > 1.01 * nyquist].max()) < -80.0
    else:
        # what folds back is at most what leaks from just above
        above = resample(tone(1.01 * nyquist, source), source, target)
        assert float(20 * above[len(above) // 4 : -len(above) // 4].abs().max().log10()) < -80.0


@pytest.mark.parametrize(("source", "target"), RATES)
def test_equals_scipys_polyphase_filter_on_band_limited_noise(source: int, target: int) -> None:
    low = scipy.signal.firwin(1001, 0.35 * min(source, target), fs=source)
    noise = scipy.signal.lfilter(low, 1.0, np.random.default_rng(0).standard_normal(source // 2))
    common = math.gcd(source, target)
    up, down = target // common, source // common
    taps = scipy.signal.firwin(
        2 * 80 * max(up, down) + 1, 0.95 / max(up, down), window=("kaiser", 12.0)
    )
    theirs = scipy.signal.resample_poly(noise, up, down, window=taps)
    ours = resample(torch.from_numpy(noise), source, target).numpy()
    assert ours.shape == theirs.shape
    middle = slice(1000, -1000)
    error = np.sqrt(np.mean((ours - theirs)[middle] ** 2) / np.mean(theirs[middle] ** 2))
    assert error < 1e-4


@pytest.mark.parametrize(("source", "target"), RATES)
@pytest.mark.parametrize("time", [1, 2, 159, 1601])
def test_length_is_rounded_up_and_leading_dimensions_stay(
    source: int, target: int, time: int
) -> None:
    ours = resample(torch.randn(2, 3, time), source, target)
    assert ours.shape == (2, 3, math.ceil(time * target / source))


def test_one_of_a_stack_of_batches_is_resampled() -> None:
    batch = torch.randn(3, 2, 2, 1600)[:, 0]
    torch.testing.assert_close(
        resample(batch, 16000, 24000)[1, 1], resample(batch[1, 1], 16000, 24000)
    )


def test_there_and_back_is_the_same_up_to_the_band_edge() -> None:
    wave = tone(440.0, 16000) + tone(3000.0, 16000) + tone(6500.0, 16000)
    back = resample(resample(wave, 16000, 44100), 44100, 16000)
    assert float((back - wave)[500:-500].abs().max()) < 1e-4


def test_equal_rates_change_nothing_at_all() -> None:
    wave = torch.randn(7)
    assert resample(wave, 44100, 44100) is wave


def test_resampling_is_differentiable() -> None:
    wave = torch.randn(2, 40, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: resample(w, 16000, 24000), wave)
    assert torch.autograd.gradcheck(lambda w: resample(w, 48000, 16000), wave)


def test_a_kernel_made_in_inference_mode_serves_gradients_too() -> None:
    with torch.inference_mode():
        expected = resample(torch.ones(50), 17000, 16000)
    wave = torch.ones(50, requires_grad=True)
    resampled = resample(wave, 17000, 16000)
    resampled.sum().backward()
    assert wave.grad is not None and torch.equal(resampled.detach(), expected)


def test_a_kernel_made_in_a_transform_serves_others_too() -> None:
    def energy(wave: Tensor) -> Tensor:
        return resample(wave, 17000, 16000).square().sum()

    _resampler.cache_clear()
    wave = torch.randn(50)
    torch.func.grad(lambda w: torch.func.grad(energy)(w).sum())(wave)
    (expected,) = torch.autograd.grad(energy(wave.requires_grad_()), wave)
    torch.testing.assert_close(torch.func.grad(energy)(wave.detach()), expected)


def test_fake_tensors_leave_no_kernel_behind() -> None:
    from torch._subclasses.fake_tensor import FakeTensorMode

    _resampler.cache_clear()
    with FakeTensorMode(allow_non_fake_inputs=True):
        resample(torch.ones(50), 17000, 16000)
    assert type(resample(torch.ones(50), 17000, 16000)) is Tensor


def test_rates_without_a_common_factor_are_refused_before_a_kernel_of_gigabytes_is_made() -> None:
    with pytest.raises(
        ValueError, match="from 44101 to 16000 Hz, whose common factor is too small; allowed"
    ):
        resample(torch.ones(50), 44101, 16000)


def test_without_torchaudio_all_but_another_rate_works() -> None:
    """As beside a build of torch that it does not fit."""
    code = """
import sys
sys.modules["torchaudio"] = None
import torch
from hlsim import Audiogram, HearingLossLoss
ear, speech = Audiogram.standard("N3"), 0.01 * torch.randn(1, 4000)
for simulator in ("msbg", "neuro-msbg"):
    assert bool(HearingLossLoss(ear, simulator=simulator)(2.0 * speech, speech).isfinite())
try:
    HearingLossLoss(ear, sample_rate=44100)(2.0 * speech, speech)
except ImportError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "torchaudio is needed to change the sample rate and cannot be loaded" in done.stdout
    assert f"install torchaudio 2.11 from where torch {torch.__version__} came from" in done.stdout
