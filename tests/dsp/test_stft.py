"""The short-time transform against scipy's, its inverse, and its lengths."""

import pytest
import torch
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import hann

from hlsim.dsp.fft import power, rfft
from hlsim.dsp.stft import STFT

SIZES = [(400, 400, 100), (256, 96, 24), (256, 256, 128)]


@pytest.mark.parametrize(("fft", "window", "hop"), SIZES)
def test_equals_scipys_transform(fft: int, window: int, hop: int) -> None:
    wave = torch.randn(2, 1999, dtype=torch.float64)
    ours = STFT(fft, window, hop).analyse(wave)
    theirs = ShortTimeFFT(hann(window, sym=False), hop, 16000, mfft=fft, phase_shift=None)
    expected = torch.from_numpy(theirs.stft(wave.numpy(), p0=0, p1=ours.shape[1])).mT
    # torch lays the window in the middle of the frame, scipy at its beginning: a linear phase
    early = (fft - window) // 2
    turn = torch.exp(-2j * torch.pi * early / fft * torch.arange(fft // 2 + 1, dtype=torch.float64))
    assert ours.shape == (2, 1999 // hop + 1, fft // 2 + 1) == expected.shape
    torch.testing.assert_close(ours, expected * turn, atol=1e-10, rtol=0)


@pytest.mark.parametrize(("fft", "window", "hop"), SIZES)
@pytest.mark.parametrize("time", [1, 100, 399, 1600, 1601])
def test_inverse_returns_the_waveform_at_its_length(
    fft: int, window: int, hop: int, time: int
) -> None:
    stft = STFT(fft, window, hop)
    wave = torch.randn(3, time)
    spectrum = stft.analyse(wave)
    assert spectrum.shape[-1] == stft.frequencies
    back = stft.synthesise(spectrum, time)
    assert back.shape == wave.shape
    torch.testing.assert_close(back, wave, atol=1e-5, rtol=0)


def test_a_tone_lies_in_its_bin() -> None:
    time = torch.arange(16000, dtype=torch.float64)
    tone = torch.cos(2 * torch.pi * 1000 * time / 16000).unsqueeze(0)
    spectrum = STFT(400, 400, 100).analyse(tone).abs()
    middle = spectrum[0, 10:-10]
    assert bool((middle.argmax(-1) == 25).all())  # bins of 40 Hz
    torch.testing.assert_close(
        middle[:, 25], torch.full_like(middle[:, 25], 100.0)
    )  # half the window's sum


def test_both_ways_are_differentiable() -> None:
    stft = STFT(32, 16, 8)
    wave = torch.randn(1, 60, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: stft.synthesise(stft.analyse(w) * 2.0, 60), wave)


@pytest.mark.parametrize(
    "sizes", [(400, 400, 201), (400, 401, 100), (401, 400, 100), (400, 400, 0), (0, 0, 0)]
)
def test_lengths_that_do_not_fit(sizes: tuple[int, int, int]) -> None:
    with pytest.raises(
        ValueError, match=r"STFT of fft .*; allowed: 2 hop <= window <= fft, fft even"
    ):
        STFT(*sizes)


@pytest.mark.parametrize("time", [1, 2, 7, 8])
def test_rfft_and_its_gradients_are_torchs(time: int) -> None:
    signals = torch.randn(3, time, dtype=torch.float64, requires_grad=True)
    ours, theirs = rfft(signals), torch.fft.rfft(signals)
    assert torch.equal(ours, theirs) and torch.equal(rfft(signals.detach()), theirs)
    weights = torch.randn_like(theirs)
    torch.testing.assert_close(
        *(torch.autograd.grad(spectrum, signals, weights)[0] for spectrum in (ours, theirs))
    )
    assert torch.autograd.gradgradcheck(rfft, signals)


def test_power_is_the_squared_modulus() -> None:
    spectrum = torch.randn(3, 5, dtype=torch.complex128)
    torch.testing.assert_close(power(spectrum), spectrum.abs().square())
    spectrum.requires_grad_()
    torch.testing.assert_close(power(spectrum), spectrum.abs().square())
    assert torch.autograd.gradcheck(power, (spectrum,))
    assert torch.autograd.gradgradcheck(power, (spectrum,))
    (gradient,) = torch.autograd.grad(power(spectrum * 0.0).sum(), spectrum)
    assert torch.equal(gradient, torch.zeros_like(gradient))
