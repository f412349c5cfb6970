"""The short-time Fourier transform equals scipy's, and its inverse returns the waveform."""

import pytest
import torch
from scipy.signal import ShortTimeFFT
from scipy.signal.windows import hann

from hlsim.dsp.stft import STFT

SIZES = [(400, 400, 100), (256, 96, 24), (256, 256, 128)]


@pytest.mark.parametrize(("fft", "window", "hop"), SIZES)
def test_equals_scipys_transform(fft: int, window: int, hop: int) -> None:
    wave = torch.randn(2, 1999, dtype=torch.float64)
    ours = STFT(fft, window, hop).analyse(wave)
    theirs = ShortTimeFFT(hann(window, sym=False), hop, 16000, mfft=fft, phase_shift=None)
    expected = torch.from_numpy(theirs.stft(wave.numpy(), p0=0, p1=ours.shape[1])).mT
    # The window lies in the middle of our frames and at the beginning of scipy's frames. A shift in
    # time is a linear phase.
    shift = (fft - window) // 2
    bins = torch.arange(fft // 2 + 1, dtype=torch.float64)
    linear_phase = torch.exp(-2j * torch.pi * shift / fft * bins)
    assert ours.shape == (2, 1999 // hop + 1, fft // 2 + 1) == expected.shape
    torch.testing.assert_close(ours, expected * linear_phase, atol=1e-10, rtol=0)


@pytest.mark.parametrize(("fft", "window", "hop"), SIZES)
def test_inverse_returns_the_waveform_at_its_length(fft: int, window: int, hop: int) -> None:
    stft = STFT(fft, window, hop)
    for time in (1, 399, 1601):
        wave = torch.randn(3, time)
        back = stft.synthesise(stft.analyse(wave), time)
        torch.testing.assert_close(back, wave, atol=1e-5, rtol=0)


def test_both_ways_are_differentiable() -> None:
    stft = STFT(32, 16, 8)
    wave = torch.randn(1, 60, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: stft.synthesise(stft.analyse(w) * 2.0, 60), wave)


def test_lengths_that_do_not_fit_together_are_rejected() -> None:
    for sizes in ((400, 400, 201), (400, 401, 100), (401, 400, 100), (400, 400, 0)):
        with pytest.raises(ValueError):
            STFT(*sizes)
