"""A 16-parameter aid from zero through the default loss, judged beside no aid and NAL-R:

    python examples/training/filter_bank.py TRAIN_SPEECH VALID_SPEECH [EAR] [STEPS] [CRITERION] [SIMULATOR]

It prints HASPI and HASQI and the level given (all at 65 dB SPL), and the level that the exact MSBG hears against a normal
ear at 50, 65 and 80 dB SPL. HASPI rises with level: NAL-R is judged once more at the level that the trained aid gives.
"""

import sys
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from compensators import NALR
from hlsim import MSBG, Audiogram, HearingLossLoss
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.stft import STFT
from hlsim.metrics import haspi, hasqi
from hlsim.training.clips import Clips

RATE = 16000
CENTRES = (250.0, 500.0, 1000.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)


class FilterBank(nn.Module):
    """Eight bands, each with a gain at 50 dB SPL and a slope of it over level; zero is no gain."""

    def __init__(self) -> None:
        super().__init__()
        self.gain, self.slope = (
            nn.Parameter(torch.zeros(8)),
            nn.Parameter(torch.zeros(8)),
        )  # in 10 dB
        self.stft = STFT(256, 256, 64)
        octaves = (torch.arange(129) * RATE / 256).clamp(CENTRES[0], CENTRES[-1]).log2()
        centres = torch.tensor(CENTRES).log2()
        low = (torch.bucketize(octaves, centres) - 1).clamp(0, 6)
        high_share = (octaves - centres[low]) / (centres[low + 1] - centres[low])
        shares = torch.zeros(129, 8).scatter_(1, low[:, None], 1.0 - high_share[:, None])
        self.register_buffer(
            "shares", shares.scatter_add_(1, low[:, None] + 1, high_share[:, None])
        )

    def forward(self, waveform: Tensor) -> Tensor:
        """Shape: (items, time) in pascals -> (items, time)."""
        spectrum = self.stft.analyse(waveform)
        powers = (spectrum.abs().square() * (2.0 / (256 * 0.375 * 256))) @ self.shares
        smooth = functional.avg_pool1d(
            functional.pad(powers.mT, (8, 8), mode="replicate"), 17, 1
        ).mT
        levels = 10.0 * torch.log10(smooth + 1e-10) + 94.0
        gain_db = 10.0 * (self.gain + self.slope * (levels - 50.0) / 40.0)
        gains = 10.0 ** (gain_db.clamp(-30.0, 90.0) @ self.shares.T / 20.0)
        return self.stft.synthesise(spectrum * gains, waveform.shape[-1])


def trained(
    folder: str,
    loss: nn.Module,
    steps: int,
    clips: int = 4,
    given: Callable[[Tensor], Tensor] | None = None,
) -> FilterBank:
    """From zero, on speech of 50 to 80 dB SPL, ``clips`` at a time; ``given`` makes of it what the aid is given."""
    aid = FilterBank()
    optimiser = torch.optim.Adam(aid.parameters(), lr=0.05)
    source, generator = (
        Clips(folder, sample_rate=RATE, seconds=1.0),
        torch.Generator().manual_seed(0),
    )
    for step in range(steps):
        speech = source.draw(clips, generator)
        speech = set_level(speech, 50.0 + 30.0 * torch.rand(clips, generator=generator))
        value = loss(aid(given(speech) if given else speech), speech)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        if step % 50 == 0 or step + 1 == steps:
            print(f"step {step}: {value.item():.3f}", file=sys.stderr, flush=True)
    return aid


@torch.no_grad()
def judged(aid: Callable[[Tensor], Tensor], ear: Audiogram, speech: Tensor) -> str:
    """Scores, and the levels given and heard. Shape: (items, time)."""
    exact, differences = MSBG(sample_rate=RATE), []
    for spl in (50.0, 65.0, 80.0):
        clean = set_level(speech, spl)
        aided = aid(clean)
        heard, normal = (
            level_spl(exact(w, e)) for w, e in ((aided, ear), (clean, Audiogram.standard("NH")))
        )
        differences.append(f"{float((heard - normal).mean()):+.1f}")
        if spl == 65.0:
            scores = [float(score(aided, clean, ear).mean()) for score in (haspi, hasqi)]
            given = float(level_spl(aided).mean())
    return (
        f"HASPI {scores[0]:.3f}, HASQI {scores[1]:.3f}, gives {given:.1f} dB SPL, "
        f"heard at 50 / 65 / 80 dB SPL {' / '.join(differences)} dB"
    )


def main(
    train: str,
    valid: str,
    name: str = "N3",
    steps: str = "350",
    criterion: str = "coherent-bands",
    simulator: str = "neuro-msbg",
) -> None:
    ear = Audiogram.standard(name)
    speech = Clips(valid, sample_rate=RATE, seconds=2.0).draw(8, torch.Generator().manual_seed(0))
    loss = HearingLossLoss(ear, simulator=simulator, criterion=criterion)
    nalr, aid = NALR(ear), trained(train, loss, int(steps))

    def as_loud(waveform: Tensor) -> Tensor:
        return set_level(nalr(waveform), level_spl(aid(waveform)))

    aids: dict[str, Callable[[Tensor], Tensor]] = {
        "unaided": nn.Identity(),
        "NAL-R": nalr,
        "NAL-R at the level of the trained": as_loud,
        f"trained, {criterion}": aid,
    }
    for title, candidate in aids.items():
        print(f"{name}, {title}: {judged(candidate, ear, speech)}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
