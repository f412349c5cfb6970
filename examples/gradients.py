"""Gradients through networks and the exact MSBG: python examples/gradients.py SPEECH_DIR NOISE_DIR AUDIOGRAMS.csv [ITEMS]

Cosine of the gradient of HearingLossLoss at what is given with that through the exact MSBG: the median over the items.
Beside the networks stands the exact model itself, its frames half a hop (0.7 ms) later in the signal: a simulator that
knows nothing of where these frames lie can hardly be nearer.
"""

import sys

import torch
from torch import Tensor, nn
from torch.nn import functional

from compensators import NALR
from hlsim import MSBG, Audiogram, HearingLossLoss
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import set_level
from hlsim.data.augment import mix
from hlsim.data.clips import Clips

RATE = 16000
HALF_A_HOP = 12  # samples


class Later(nn.Module):
    """The exact model of a signal that begins later."""

    def __init__(self, samples: int) -> None:
        super().__init__()
        self.samples, self.exact = samples, MSBG(sample_rate=RATE)

    def forward(self, waveform: Tensor, ear: Audiogram | Tensor) -> Tensor:
        return self.exact(functional.pad(waveform, (self.samples, 0)), ear)[..., self.samples :]

    def normal(self, waveform: Tensor) -> Tensor:
        return self(waveform, Audiogram.standard("NH"))


def loss_through(simulator: str, criterion: str) -> HearingLossLoss:
    if simulator in ("neuro-msbg", "neuro-msbg-light"):
        return HearingLossLoss(simulator=simulator, criterion=criterion)
    exact = Later(HALF_A_HOP if simulator == "msbg, half a hop later" else 0)
    return HearingLossLoss(simulator=exact, normal=exact.normal, criterion=criterion)


def gradient(loss: HearingLossLoss, given: Tensor, clean: Tensor, ear: Audiogram) -> Tensor:
    given = given.clone().requires_grad_()
    loss(given, clean, ear).backward()
    assert given.grad is not None
    return given.grad


def main() -> None:
    speech, noise, table = sys.argv[1:4]
    items = int(sys.argv[4]) if len(sys.argv) > 4 else 24
    ears, generator = (
        [ear for _, ear in read_audiograms(table, simulated=True)],
        torch.Generator().manual_seed(0),
    )
    clean = set_level(Clips(speech, sample_rate=RATE, seconds=2.0).draw(items, generator), 65.0)
    others = Clips(noise, sample_rate=RATE, seconds=2.0, repeat=True).draw(items, generator)
    noisy, nalr = (
        mix(clean, others, 2.5 + 15.0 * torch.rand(items, generator=generator)),
        NALR(sample_rate=RATE),
    )
    print("| criterion | through | clean | clean, NAL-R | noisy | noisy, NAL-R |\n|---|---|---|---|---|---|")
    for criterion in ("coherent-bands", "bands"):
        exact = loss_through("msbg", criterion)
        for simulator in ("neuro-msbg", "neuro-msbg-light", "msbg, half a hop later"):
            other, cells = loss_through(simulator, criterion), []
            for signals, aided in ((clean, False), (clean, True), (noisy, False), (noisy, True)):
                cosines = []
                for item in range(items):
                    ear, reference = ears[item % len(ears)], clean[item : item + 1]
                    given = signals[item : item + 1]
                    given = nalr(given, ear) if aided else given
                    ours, theirs = (gradient(loss, given, reference, ear) for loss in (other, exact))
                    cosines.append(functional.cosine_similarity(ours, theirs, dim=-1))
                cells.append(f"{float(torch.cat(cosines).median()):.2f}")
            print(f"| `{criterion}` | {simulator} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
