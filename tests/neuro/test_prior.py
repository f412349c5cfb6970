"""The prior agrees with MSBG, and the network on bands corrects it."""

from pathlib import Path

import pytest
import torch
from torch.nn import functional

from hlsim import MSBG, Audiogram
from hlsim.dsp.fft import power
from hlsim.neuro import NeuroConfig, NeuroMSBG
from hlsim.neuro.frame_grid import (
    analyse_frames,
    from_frame_rate,
    synthesise_frames,
    to_frame_rate,
)
from hlsim.neuro.prior import Prior

EARS = torch.tensor([Audiogram.standard(name).thresholds for name in ("NH", "N1", "N3", "N5")])


def test_fixed_response_equals_msbg_without_a_loss() -> None:
    # The exact model removes 8 kHz from signals at 16 kHz, so this signal does not contain it.
    signal = torch.zeros(1, 8000)
    signal[0, 3999:4002] = torch.tensor([0.25, 0.5, 0.25])
    expected = MSBG("NH", sample_rate=16000)(signal)
    output = Prior(NeuroConfig().stft).filter(signal, torch.tensor([0]))
    assert float((output - expected).norm() / expected.norm()) < 2e-3


def test_without_a_loss_the_factor_is_one() -> None:
    stft = NeuroConfig().stft
    spectrum = torch.randn(2, 50, stft.frequencies, dtype=torch.complex64)
    factor = Prior(stft)(power(spectrum), torch.zeros(2, 8), torch.zeros(2, dtype=torch.long))
    torch.testing.assert_close(factor, torch.ones_like(factor), atol=1e-4, rtol=0.0)


def network_on_bands(step: int) -> NeuroMSBG:
    return NeuroMSBG(NeuroConfig(channels=8, blocks=1, kernel=(3, 1), stride=(step, 1)))


def test_frames_are_filtered_and_converted_as_msbg_does_without_a_loss() -> None:
    signal = torch.zeros(1, 8000)
    signal[0, 3999:4002] = torch.tensor([0.25, 0.5, 0.25])
    expected = MSBG("NH", sample_rate=16000)(signal)
    output = from_frame_rate(to_frame_rate(signal), torch.tensor([0]), 8000)
    assert float((output - expected).norm() / expected.norm()) < 2e-3


def test_spectra_of_frames_are_fourier_transforms_and_invertible() -> None:
    generator = torch.Generator().manual_seed(0)
    waveform = torch.randn(2, 250, generator=generator, dtype=torch.float64).requires_grad_()
    real, imaginary = analyse_frames(waveform)
    # The third frame begins one hop before the signal, half a sample before its first sample.
    times = torch.arange(96, dtype=torch.float64) + 0.5
    window = torch.sin(torch.pi * times / 96).square()
    frame = functional.pad(waveform, (24, 0))[:, :96] * window
    angles = 2.0 * torch.pi / 192 * torch.outer(times - 48.0, torch.arange(97))
    torch.testing.assert_close(real[:, 2], frame @ angles.cos())
    torch.testing.assert_close(imaginary[:, 2], -frame @ angles.sin())
    torch.testing.assert_close(synthesise_frames(real, imaginary, 250), waveform)

    def double(signals: torch.Tensor) -> torch.Tensor:
        parts = analyse_frames(signals)
        return synthesise_frames(2.0 * parts[0], parts[1].square(), 250)

    assert torch.autograd.gradcheck(double, waveform, fast_mode=True)
    assert torch.autograd.gradgradcheck(double, waveform, fast_mode=True)


def test_smearing_equals_that_of_msbg_on_the_same_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_recruitment(thresholds: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        return torch.ones(len(thresholds), weights.shape[-1])

    generator = torch.Generator().manual_seed(0)
    waveform = 0.05 * torch.randn(4, 8000, generator=generator, dtype=torch.float64).float()
    for module in ("hlsim.msbg.model", "hlsim.neuro.prior"):
        monkeypatch.setattr(f"{module}.expansion_ratios", no_recruitment)
    expected = MSBG()(waveform, EARS)
    output = NeuroMSBG()(waveform, EARS).detach()
    shifted = NeuroMSBG()(functional.pad(waveform, (12, 0)), EARS).detach()[:, 12:]
    # Edges, where MSBG's first frames repeat samples, are left out.
    expected, output, shifted = (signals[:, 1000:-1000] for signals in (expected, output, shifted))
    magnitude = expected.norm(dim=-1)
    assert float(((output - expected).norm(dim=-1) / magnitude).max()) < 0.01
    # Without a loss, nothing is smeared.
    assert float(((shifted - expected).norm(dim=-1) / magnitude)[1:].min()) > 0.05


def test_gradients_through_bands_are_exact() -> None:
    model = network_on_bands(step=2).double()
    for parameter in model.parameters():
        parameter.data.add_(0.01 * torch.randn_like(parameter))
    waveform = (0.05 * torch.randn(2, 200, dtype=torch.float64)).requires_grad_()

    def simulate(signals: torch.Tensor) -> torch.Tensor:
        return model(signals, EARS[1:3].double())

    assert torch.autograd.gradcheck(simulate, waveform, fast_mode=True, atol=1e-6)
    assert torch.autograd.gradgradcheck(simulate, waveform, fast_mode=True, atol=1e-6)


def test_constants_that_are_not_computed_cannot_be_saved(tmp_path: Path) -> None:
    network = NeuroMSBG(compute_prior=False)
    assert network(torch.randn(1600), "N3").isnan().all()
    with pytest.raises(ValueError, match="NaN"):
        network.save_pretrained(tmp_path)
