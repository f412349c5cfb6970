"""Train the aid of ``filter_bank.py`` through HASPI, with and without a term for the loudness.

    python examples/training/haspi_objective.py TRAIN_SPEECH VALID_SPEECH \
        [EAR] [STEPS] [SNR] [LOSSES...]

The input is speech in white noise at SNR dB, or clean speech by default, whose HASPI soon reaches
its maximum. Of each aid it prints what ``filter_bank.py`` prints, and the highest peak of the
output at 80 dB SPL.
"""

import math
import sys
from collections.abc import Callable
from functools import partial

import torch
from filter_bank import SAMPLE_RATE, Aid, describe_aid, train_filter_bank
from torch import Tensor, nn

from compensators import NALR
from hlsim import Audiogram, HASPILoss, HearingLossLoss
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.data.clips import Clips

LOSSES: dict[str, Callable[[Audiogram], HearingLossLoss]] = {
    "default loss": HearingLossLoss,
    "HASPILoss": HASPILoss,
    "HASPI alone": lambda ear: HASPILoss(ear, level=0.0),
}


def add_noise(speech: Tensor, snr: float, generator: torch.Generator) -> Tensor:
    """Add white noise at a signal-to-noise ratio in dB. Shape: (items, time) -> (items, time)."""
    noise = torch.randn(speech.shape, generator=generator)
    return speech + set_level(noise, level_spl(speech) - snr)


@torch.no_grad()
def describe_aid_in_noise(aid: Aid, ear: Audiogram, speech: Tensor, snr: float) -> str:
    """Measure an aid as ``describe_aid`` does, and the highest peak of its output at 80 dB SPL."""

    def process_noisy(clean: Tensor) -> Tensor:
        return aid(add_noise(clean, snr, torch.Generator().manual_seed(0)))

    peak = float(process_noisy(set_level(speech, 80.0)).abs().max())
    peak_spl = PASCAL_SPL + 20.0 * math.log10(peak)
    return f"{describe_aid(process_noisy, ear, speech)}, peak {peak_spl:.0f} dB SPL"


def main(
    train: str, valid: str, name: str = "N3", steps: str = "200", snr: str = "inf", *names: str
) -> None:
    ear = Audiogram.standard(name)
    clips = Clips(valid, sample_rate=SAMPLE_RATE, seconds=2.0)
    speech = clips.draw(8, torch.Generator().manual_seed(0))
    for title, aid in (("unaided", nn.Identity()), ("NAL-R", NALR(ear))):
        print(f"{name}, {title}: {describe_aid_in_noise(aid, ear, speech, float(snr))}", flush=True)
    for title in names or LOSSES:
        generator = torch.Generator().manual_seed(0)
        degrade = partial(add_noise, snr=float(snr), generator=generator)
        aid = train_filter_bank(train, LOSSES[title](ear), int(steps), clips=2, degrade=degrade)
        print(f"{name}, {title}: {describe_aid_in_noise(aid, ear, speech, float(snr))}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
