"""Train with a criterion of your own on perceived speech.

    python examples/training/your_criterion.py [auraloss | torch-stoi]

The criterion here is the correlation of short-time envelopes, as in STOI. ``HearingLossLoss``
accepts it as its ``criterion``, because it returns a value for each item. A criterion that returns
a mean instead, such as those of auraloss and torch-stoi, is applied to the two signals that
``loss.heard`` returns.
"""

import sys
from collections.abc import Callable

import torch
from torch import Tensor, nn

from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.metrics.band_levels import band_levels

SAMPLE_RATE = 16000


def envelope_correlation(perceived: Tensor, reference: Tensor) -> Tensor:
    """Compute 1 - the mean correlation of the envelopes in 24 bands, over segments of 384 ms.

    Shape: (items, time), (items, time) -> (items,).
    """
    centred = []
    for waveform in (perceived, reference):
        envelopes = 10.0 ** (band_levels(waveform, SAMPLE_RATE) / 20.0)
        segments = envelopes.unfold(-2, min(24, envelopes.shape[-2]), 12)
        centred.append(segments - segments.mean(-1, keepdim=True))
    return 1.0 - nn.functional.cosine_similarity(*centred, dim=-1).mean((-2, -1))


def import_criterion(package: str) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a criterion of another package, which computes a mean over items of shape (time,)."""
    if package == "auraloss":
        from auraloss.freq import MultiResolutionSTFTLoss

        spectral_loss = MultiResolutionSTFTLoss()
        return lambda perceived, reference: spectral_loss(
            perceived.unsqueeze(1), reference.unsqueeze(1)
        )
    from torch_stoi import NegSTOILoss

    stoi_loss = NegSTOILoss(sample_rate=SAMPLE_RATE)
    return lambda perceived, reference: stoi_loss(perceived, reference).mean()


def main(package: str = "", steps: int = 20) -> None:
    torch.manual_seed(0)
    ear = Audiogram.standard("N3")
    log_gains = nn.Parameter(torch.zeros(5))
    clean = set_level(torch.randn(2, 16000) * torch.linspace(0.0, 20.0, 16000).sin(), 65.0)
    loss = HearingLossLoss(ear, criterion=envelope_correlation)
    # Correlations ignore the level, so the default criterion is added. Both share one simulator.
    default_loss = HearingLossLoss(ear, simulator=loss.simulator)
    imported_criterion = import_criterion(package) if package else None
    optimiser = torch.optim.Adam([log_gains], lr=0.1)
    for step in range(steps):
        gains = 10.0 ** nn.functional.interpolate(log_gains[None, None], 8001, mode="linear")[0]
        output = torch.fft.irfft(torch.fft.rfft(clean) * gains, 16000)
        value = default_loss(output, clean)
        if imported_criterion is None:
            value = value + loss(output, clean)
        else:
            value = value + imported_criterion(*loss.heard(output, clean))
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        print(f"step {step}: {value.item():.3f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
