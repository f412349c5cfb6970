"""The 16-parameter aid of filter_bank.py from zero through HASPI: with a term for the level that is heard, and without.

    python examples/training/haspi_objective.py TRAIN_SPEECH VALID_SPEECH [EAR] [STEPS] [SNR] [AIDS...]

It is given the speech in white noise at SNR dB, by default in none: of clean speech HASPI soon has no more to give.
Of each aid it prints HASPI and HASQI at 65 dB SPL, the level that the exact MSBG hears against a normal ear at 50, 65
and 80 dB SPL, and the highest peak that the ear is given at 80 dB SPL.
"""

import math
import sys
from collections.abc import Callable

import torch
from filter_bank import RATE, FilterBank
from torch import Tensor, nn

from compensators import NALR
from hlsim import MSBG, Audiogram, HASPILoss, HearingLossLoss
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.data.clips import Clips
from hlsim.metrics import haspi, hasqi

LOSSES: dict[str, Callable[[Audiogram], HearingLossLoss]] = {
    "default loss": HearingLossLoss,
    "HASPILoss": HASPILoss,
    "HASPI alone": lambda ear: HASPILoss(ear, level=0.0),
}


def in_noise(speech: Tensor, snr: float, generator: torch.Generator) -> Tensor:
    return speech + set_level(torch.randn(speech.shape, generator=generator), level_spl(speech) - snr)


def trained(folder: str, ear: Audiogram, steps: int, snr: float, name: str) -> FilterBank:
    aid, loss = FilterBank(), LOSSES[name](ear)
    optimiser = torch.optim.Adam(aid.parameters(), lr=0.05)
    clips, generator = Clips(folder, sample_rate=RATE, seconds=1.0), torch.Generator().manual_seed(0)
    for step in range(steps):
        speech = set_level(clips.draw(2, generator), 50.0 + 30.0 * torch.rand(2, generator=generator))
        value = loss(aid(in_noise(speech, snr, generator)), speech)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        if step % 50 == 0 or step + 1 == steps:
            print(f"{name}, step {step}: {value.item():.3f}", file=sys.stderr, flush=True)
    return aid


@torch.no_grad()
def judged(aid: nn.Module, ear: Audiogram, speech: Tensor, snr: float) -> str:
    """HASPI, HASQI, the levels heard, and the peak. Shape: (items, time)."""
    exact, differences = MSBG(sample_rate=RATE), []
    for spl in (50.0, 65.0, 80.0):
        clean = set_level(speech, spl)
        aided = aid(in_noise(clean, snr, torch.Generator().manual_seed(0)))
        heard, normal = (level_spl(exact(w, e)) for w, e in ((aided, ear), (clean, Audiogram.standard("NH"))))
        differences.append(f"{float((heard - normal).mean()):+.1f}")
        if spl == 65.0:
            scores = [float(score(aided, clean, ear).mean()) for score in (haspi, hasqi)]
    peak = PASCAL_SPL + 20.0 * math.log10(float(aided.abs().max()))
    return (
        f"HASPI {scores[0]:.3f}, HASQI {scores[1]:.3f}, heard at 50 / 65 / 80 dB SPL {' / '.join(differences)} dB, "
        f"peak {peak:.0f} dB SPL"
    )


def main(train: str, valid: str, name: str = "N3", steps: str = "200", snr: str = "inf", *names: str) -> None:
    ear = Audiogram.standard(name)
    speech = Clips(valid, sample_rate=RATE, seconds=2.0).draw(8, torch.Generator().manual_seed(0))
    for title, aid in (("unaided", nn.Identity()), ("NAL-R", NALR(ear))):
        print(f"{name}, {title}: {judged(aid, ear, speech, float(snr))}", flush=True)
    for title in names or LOSSES:
        aid = trained(train, ear, int(steps), float(snr), title)
        print(f"{name}, {title}: {judged(aid, ear, speech, float(snr))}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
