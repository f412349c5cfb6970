"""The 16-parameter aid of filter_bank.py from zero through HASPI: with a term for the level that is heard, and without.

    python examples/training/haspi_objective.py TRAIN_SPEECH VALID_SPEECH [EAR] [STEPS] [SNR] [AIDS...]

It is given the speech in white noise at SNR dB, by default in none: of clean speech HASPI soon has no more to give.
Of each aid it prints what filter_bank.py does, and the highest peak that the ear is given at 80 dB SPL.
"""

import math
import sys
from collections.abc import Callable
from functools import partial

import torch
from filter_bank import RATE, judged, trained
from torch import Tensor, nn

from compensators import NALR
from hlsim import Audiogram, HASPILoss, HearingLossLoss
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.training.clips import Clips

LOSSES: dict[str, Callable[[Audiogram], HearingLossLoss]] = {
    "default loss": HearingLossLoss,
    "HASPILoss": HASPILoss,
    "HASPI alone": lambda ear: HASPILoss(ear, level=0.0),
}


def in_noise(speech: Tensor, snr: float, generator: torch.Generator) -> Tensor:
    return speech + set_level(
        torch.randn(speech.shape, generator=generator), level_spl(speech) - snr
    )


@torch.no_grad()
def told(aid: nn.Module, ear: Audiogram, speech: Tensor, snr: float) -> str:
    """What filter_bank.py tells, and the highest peak at 80 dB SPL. Shape: (items, time)."""

    def given(clean: Tensor) -> Tensor:
        aided: Tensor = aid(in_noise(clean, snr, torch.Generator().manual_seed(0)))
        return aided

    peak = PASCAL_SPL + 20.0 * math.log10(float(given(set_level(speech, 80.0)).abs().max()))
    return f"{judged(given, ear, speech)}, peak {peak:.0f} dB SPL"


def main(
    train: str, valid: str, name: str = "N3", steps: str = "200", snr: str = "inf", *names: str
) -> None:
    ear = Audiogram.standard(name)
    speech = Clips(valid, sample_rate=RATE, seconds=2.0).draw(8, torch.Generator().manual_seed(0))
    for title, aid in (("unaided", nn.Identity()), ("NAL-R", NALR(ear))):
        print(f"{name}, {title}: {told(aid, ear, speech, float(snr))}", flush=True)
    for title in names or LOSSES:
        generator = torch.Generator().manual_seed(0)
        noisy = partial(in_noise, snr=float(snr), generator=generator)
        aid = trained(train, LOSSES[title](ear), int(steps), clips=2, given=noisy)
        print(f"{name}, {title}: {told(aid, ear, speech, float(snr))}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
