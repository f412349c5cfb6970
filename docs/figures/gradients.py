"""Compare gradients through the networks with those through the exact MSBG.

    python docs/figures/gradients.py SPEECH_DIR NOISE_DIR AUDIOGRAMS.csv [ITEMS]

It prints the cosine between the gradients of ``HearingLossLoss`` with respect to the output of an
aid, through a network and through the exact MSBG, as the median over the items. The last row of a
criterion compares the exact MSBG with itself, for the same signals shifted by half a hop of its
frames (0.7 ms). A simulator on other frames can hardly be closer.
"""

import sys

import torch
from torch import Tensor
from torch.nn import functional

from compensators import NALR
from hlsim import Audiogram, HearingLossLoss
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import set_level
from hlsim.data.clips import Clips
from hlsim.data.mixing import mix

RATE = 16000
HALF_HOP = 12  # samples


def compute_gradients(
    loss: HearingLossLoss, signals: Tensor, clean: Tensor, ears: list[Audiogram], shift: int = 0
) -> Tensor:
    """Compute the gradient of the loss for each item.

    Args:
        loss: Loss with a value per item.
        signals: Outputs of an aid with shape (items, time).
        clean: Clean speech with shape (items, time).
        ears: Ear of each item.
        shift: Number of samples of silence before all signals.

    Returns:
        Gradients with shape (items, time).
    """
    signals = signals.clone().requires_grad_()
    shifted = functional.pad(signals, (shift, 0))
    loss(shifted, functional.pad(clean, (shift, 0)), ears).sum().backward()
    assert signals.grad is not None
    return signals.grad


def main() -> None:
    speech, noise, table = sys.argv[1:4]
    items = int(sys.argv[4]) if len(sys.argv) > 4 else 24
    generator = torch.Generator().manual_seed(0)
    measured = read_audiograms(table, simulated=True)
    ears = [measured[item % len(measured)][1] for item in range(items)]
    clean = set_level(Clips(speech, sample_rate=RATE, seconds=2.0).draw(items, generator), 65.0)
    noise_clips = Clips(noise, sample_rate=RATE, seconds=2.0, repeat=True).draw(items, generator)
    noisy = mix(clean, noise_clips, 2.5 + 15.0 * torch.rand(items, generator=generator), None)
    nalr = NALR(sample_rate=RATE)
    scenes = (clean, nalr(clean, ears), noisy, nalr(noisy, ears))
    print("| criterion | through | clean | clean, NAL-R | noisy | noisy, NAL-R |")
    print("|---|---|---|---|---|---|")
    for criterion in ("coherent-bands", "bands"):
        losses = {
            name: HearingLossLoss(simulator=name, criterion=criterion, reduction="none")
            for name in ("msbg", "neuro-msbg", "neuro-msbg-cnn-narrow")
        }
        exact = [compute_gradients(losses["msbg"], scene, clean, ears) for scene in scenes]
        for name, shift in (("neuro-msbg", 0), ("neuro-msbg-cnn-narrow", 0), ("msbg", HALF_HOP)):
            cells = []
            for scene, expected in zip(scenes, exact, strict=True):
                gradients = compute_gradients(losses[name], scene, clean, ears, shift)
                cosine = functional.cosine_similarity(gradients, expected, dim=-1).median()
                cells.append(f"{float(cosine):.2f}")
            title = f"{name}, shifted" if shift else name
            print(f"| `{criterion}` | {title} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
