"""How far a waveform is from the truth."""

from itertools import pairwise

import torch

from hlsim.criteria.waveform import compressed_spectrum_error


def test_compressed_spectrum_error_of_nothing_of_noise_and_of_the_truth() -> None:
    truth = torch.randn(3, 8000) * torch.linspace(0.1, 1.0, 8000)
    noise = torch.randn(3, 8000)
    errors = [compressed_spectrum_error(truth + share * noise, truth) for share in (0.0, 0.1, 0.3, 1.0)]
    assert float(errors[0].max()) < 1e-9 and all((b > a).all() for a, b in pairwise(errors))
    # the same at any level, and nearly 1 for silence
    assert torch.allclose(
        compressed_spectrum_error(1e-3 * (truth + noise), 1e-3 * truth), errors[3], rtol=1e-3
    )
    silence = torch.zeros(3, 8000, requires_grad=True)
    error = compressed_spectrum_error(silence, truth)
    assert (error > 0.7).all() and (error < 1.0).all()
    error.sum().backward()
    assert silence.grad is not None and silence.grad.isfinite().all()
    assert compressed_spectrum_error(truth, 0.0 * truth).isfinite().all()
