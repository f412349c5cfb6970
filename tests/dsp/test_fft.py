import pytest
import torch

from hlsim.dsp.fft import long_irfft, long_rfft

LENGTHS = (4096, 12346, 24696, 50400)  # the first goes as it is, the others as complex numbers


@pytest.mark.parametrize("points", LENGTHS)
@pytest.mark.parametrize("excess", [-100, 0, 100])
def test_rfft_is_torchs(points: int, excess: int) -> None:
    wave = torch.randn(1, points + excess, dtype=torch.float64, requires_grad=True)
    ours, theirs = long_rfft(wave, points), torch.fft.rfft(wave, points)
    torch.testing.assert_close(ours, theirs)
    weights = torch.randn_like(theirs)
    first, second = (torch.autograd.grad(out, wave, weights)[0] for out in (ours, theirs))
    torch.testing.assert_close(first, second)


@pytest.mark.parametrize("points", LENGTHS)
def test_irfft_is_torchs(points: int) -> None:
    # which takes no notice of the imaginary parts of the first and the last
    spectrum = torch.randn(1, points // 2 + 1, dtype=torch.complex128, requires_grad=True)
    ours, theirs = long_irfft(spectrum, points), torch.fft.irfft(spectrum, points)
    torch.testing.assert_close(ours, theirs)
    weights = torch.randn_like(theirs)
    first, second = (torch.autograd.grad(out, spectrum, weights)[0] for out in (ours, theirs))
    torch.testing.assert_close(first, second)


def test_there_and_back_in_single_precision() -> None:
    wave = torch.randn(1, 24696)
    torch.testing.assert_close(long_irfft(long_rfft(wave, 24696), 24696), wave, rtol=0.0, atol=3e-6)
