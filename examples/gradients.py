"""Gradients through networks and the exact MSBG: python examples/gradients.py SPEECH_DIR NOISE_DIR AUDIOGRAMS.csv [ITEMS]

Cosine of the gradient of HearingLossLoss at what is given with that through the exact MSBG: the median over the items.
Beside the networks stands the exact model itself, for the same signals begun half a hop of its frames (0.7 ms) later: a
simulator that knows nothing of where these frames lie can hardly be nearer.
"""

import sys

import torch
from torch import Tensor
from torch.nn import functional

from compensators import NALR
from hlsim import Audiogram, HearingLossLoss
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import set_level
from hlsim.training.augment import mix
from hlsim.training.clips import Clips

RATE = 16000
HALF_A_HOP = 12  # samples


def gradients(
    loss: HearingLossLoss, signals: Tensor, clean: Tensor, ears: list[Audiogram], later: int = 0
) -> Tensor:
    """Compute the gradient of each item for its ear, with speech shifted by some samples.

    Shape: (items, time) twice -> (items, time).
    """
    signals = signals.clone().requires_grad_()
    begun, reference = (functional.pad(one, (later, 0)) for one in (signals, clean))
    loss(begun, reference, ears).sum().backward()
    assert signals.grad is not None
    return signals.grad


def main() -> None:
    speech, noise, table = sys.argv[1:4]
    items = int(sys.argv[4]) if len(sys.argv) > 4 else 24
    generator, measured = torch.Generator().manual_seed(0), read_audiograms(table, simulated=True)
    ears = [measured[item % len(measured)][1] for item in range(items)]
    clean = set_level(Clips(speech, sample_rate=RATE, seconds=2.0).draw(items, generator), 65.0)
    others = Clips(noise, sample_rate=RATE, seconds=2.0, repeat=True).draw(items, generator)
    noisy, nalr = (
        mix(clean, others, 2.5 + 15.0 * torch.rand(items, generator=generator)),
        NALR(sample_rate=RATE),
    )
    scenes = clean, nalr(clean, ears), noisy, nalr(noisy, ears)
    print(
        "| criterion | through | clean | clean, NAL-R | noisy | noisy, NAL-R |\n|---|---|---|---|---|---|"
    )
    for criterion in ("coherent-bands", "bands"):
        losses = {
            name: HearingLossLoss(simulator=name, criterion=criterion, reduction="none")
            for name in ("msbg", "neuro-msbg", "neuro-msbg-light")
        }
        true = [gradients(losses["msbg"], scene, clean, ears) for scene in scenes]
        for name, later in (("neuro-msbg", 0), ("neuro-msbg-light", 0), ("msbg", HALF_A_HOP)):
            found = [gradients(losses[name], scene, clean, ears, later) for scene in scenes]
            cosines = [
                functional.cosine_similarity(*pair, dim=-1).median()
                for pair in zip(found, true, strict=True)
            ]
            cells = " | ".join(f"{float(cosine):.2f}" for cosine in cosines)
            print(
                f"| `{criterion}` | {name}{', begun later' if later else ''} | {cells} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
