"""A criterion of your own on what is heard: here STOI's correlation of short-time envelopes, in plain torch.

``HearingLossLoss(ear, criterion=envelope_correlation)`` takes it as it is. One that gives a mean instead of a value for
each item, as those of auraloss and torch-stoi, goes on ``heard, reference = loss.heard(aided, clean)``:

    python examples/training/your_criterion.py [auraloss | torch-stoi]
"""

import sys
from collections.abc import Callable

import torch
from torch import Tensor, nn

from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.losses.band_levels import band_levels


def envelope_correlation(heard: Tensor, reference: Tensor) -> Tensor:
    """One minus the correlation of envelopes over 384 ms in each of 24 bands. Shape: (items, time) twice -> (items,)."""
    envelopes = (10.0 ** (band_levels(waveform, 16000) / 20.0) for waveform in (heard, reference))
    first, second = (envelope.unfold(-2, min(24, envelope.shape[-2]), 12) for envelope in envelopes)
    first, second = (part - part.mean(-1, keepdim=True) for part in (first, second))
    return 1.0 - nn.functional.cosine_similarity(first, second, dim=-1).mean((-2, -1))


def from_elsewhere(package: str) -> Callable[[Tensor, Tensor], Tensor]:
    """Someone else's mean over the items of what is heard and the reference, (items, time) in pascals."""
    if package == "auraloss":
        from auraloss.freq import MultiResolutionSTFTLoss

        spectra = MultiResolutionSTFTLoss()
        return lambda heard, reference: spectra(heard.unsqueeze(1), reference.unsqueeze(1))
    from torch_stoi import NegSTOILoss

    intelligibility = NegSTOILoss(sample_rate=16000)
    return lambda heard, reference: intelligibility(heard, reference).mean()


def main(package: str = "", steps: int = 20) -> None:
    torch.manual_seed(0)
    gains = nn.Parameter(torch.zeros(5))
    clean = set_level(torch.randn(2, 16000) * torch.linspace(0.0, 20.0, 16000).sin(), 65.0)
    loss = HearingLossLoss(Audiogram.standard("N3"), criterion=envelope_correlation)
    # or beside the default, whose levels it does not know, of one hearing each
    default = HearingLossLoss(Audiogram.standard("N3"), simulator=loss.simulator)
    measure = from_elsewhere(package) if package else None
    optimiser = torch.optim.Adam([gains], lr=0.1)
    for step in range(steps):
        aided = torch.fft.irfft(
            torch.fft.rfft(clean)
            * 10.0 ** nn.functional.interpolate(gains[None, None], 8001, mode="linear")[0],
            16000,
        )
        value = default(aided, clean)
        value = value + (measure(*loss.heard(aided, clean)) if measure else loss(aided, clean))
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        print(f"step {step}: {value.item():.3f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
