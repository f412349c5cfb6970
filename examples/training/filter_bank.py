"""Train an aid with 16 parameters through the default loss, and compare it with NAL-R.

    python examples/training/filter_bank.py TRAIN_SPEECH VALID_SPEECH \
        [EAR] [STEPS] [CRITERION] [SIMULATOR]

It prints HASPI, HASQI and the output level for speech at 65 dB SPL, and the loudness error at 50,
65 and 80 dB SPL: the level that the ear perceives (exact MSBG) minus that of a normal ear. HASPI
rises with level, so NAL-R is also measured at the output level of the trained aid.
"""

import sys
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from compensators import NALR
from hlsim import MSBG, Audiogram, HearingLossLoss
from hlsim.calibration import level_spl, set_level
from hlsim.data.clips import Clips
from hlsim.dsp.stft import STFT
from hlsim.metrics import haspi, hasqi

SAMPLE_RATE = 16000
FFT = 256
HANN_POWER = 0.375
"""Mean square of a Hann window."""

CENTRES = (250.0, 500.0, 1000.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)
"""Frequencies of the bands in Hz."""

Aid = Callable[[Tensor], Tensor]


class FilterBank(nn.Module):
    """Eight bands, each with a gain at 50 dB SPL and a slope of the gain over level.

    Both are in units of 10 dB, and 0 before training.
    """

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.zeros(8))
        self.slope = nn.Parameter(torch.zeros(8))
        self.stft = STFT(FFT, FFT, FFT // 4)
        bins = FFT // 2 + 1
        octaves = (torch.arange(bins) * SAMPLE_RATE / FFT).clamp(CENTRES[0], CENTRES[-1]).log2()
        centres = torch.tensor(CENTRES).log2()
        lower = (torch.bucketize(octaves, centres) - 1).clamp(0, 6)
        upper_share = (octaves - centres[lower]) / (centres[lower + 1] - centres[lower])
        shares = torch.zeros(bins, 8).scatter_(1, lower[:, None], 1.0 - upper_share[:, None])
        shares.scatter_add_(1, lower[:, None] + 1, upper_share[:, None])
        self.register_buffer("shares", shares)

    def forward(self, waveform: Tensor) -> Tensor:
        """Amplify each band. Shape: (items, time) in pascals -> (items, time)."""
        spectrum = self.stft.analyse(waveform)
        powers = (spectrum.abs().square() * (2.0 / (FFT * HANN_POWER * FFT))) @ self.shares
        padded = functional.pad(powers.mT, (8, 8), mode="replicate")
        smoothed = functional.avg_pool1d(padded, 17, 1).mT
        levels = 10.0 * torch.log10(smoothed + 1e-10) + 94.0
        gain_db = 10.0 * (self.gain + self.slope * (levels - 50.0) / 40.0)
        gains = 10.0 ** (gain_db.clamp(-30.0, 90.0) @ self.shares.T / 20.0)
        return self.stft.synthesise(spectrum * gains, waveform.shape[-1])


def train_filter_bank(
    folder: str, loss: nn.Module, steps: int, clips: int = 4, degrade: Aid | None = None
) -> FilterBank:
    """Train a filter bank on speech of 50 to 80 dB SPL.

    Args:
        folder: Folder of speech.
        loss: Function of output and clean speech.
        steps: Number of steps.
        clips: Number of clips per step.
        degrade: Function from clean speech to the aid's input; by default the input is clean.
    """
    aid = FilterBank()
    optimiser = torch.optim.Adam(aid.parameters(), lr=0.05)
    source = Clips(folder, sample_rate=SAMPLE_RATE, seconds=1.0)
    generator = torch.Generator().manual_seed(0)
    for step in range(steps):
        speech = source.draw(clips, generator)
        speech = set_level(speech, 50.0 + 30.0 * torch.rand(clips, generator=generator))
        aid_input = speech if degrade is None else degrade(speech)
        value = loss(aid(aid_input), speech)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        if step % 50 == 0 or step + 1 == steps:
            print(f"step {step}: {value.item():.3f}", file=sys.stderr, flush=True)
    return aid


@torch.no_grad()
def describe_aid(aid: Aid, ear: Audiogram, speech: Tensor) -> str:
    """Measure an aid's scores, its output level and its loudness errors.

    Args:
        aid: Function from input to output.
        ear: Ear that wears the aid.
        speech: Clean speech with shape (items, time).
    """
    msbg = MSBG(sample_rate=SAMPLE_RATE)
    normal_ear = Audiogram.standard("NH")
    loudness_errors = []
    for spl in (50.0, 65.0, 80.0):
        clean = set_level(speech, spl)
        output = aid(clean)
        error = level_spl(msbg(output, ear)) - level_spl(msbg(clean, normal_ear))
        loudness_errors.append(f"{float(error.mean()):+.1f}")
        if spl == 65.0:
            intelligibility = float(haspi(output, clean, ear).mean())
            quality = float(hasqi(output, clean, ear).mean())
            output_level = float(level_spl(output).mean())
    return (
        f"HASPI {intelligibility:.3f}, HASQI {quality:.3f}, output level {output_level:.1f} dB "
        f"SPL, loudness error at 50 / 65 / 80 dB SPL {' / '.join(loudness_errors)} dB"
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
    clips = Clips(valid, sample_rate=SAMPLE_RATE, seconds=2.0)
    speech = clips.draw(8, torch.Generator().manual_seed(0))
    loss = HearingLossLoss(ear, simulator=simulator, criterion=criterion)
    nalr = NALR(ear)
    aid = train_filter_bank(train, loss, int(steps))

    def nalr_at_equal_level(waveform: Tensor) -> Tensor:
        return set_level(nalr(waveform), level_spl(aid(waveform)))

    aids: dict[str, Aid] = {
        "unaided": nn.Identity(),
        "NAL-R": nalr,
        "NAL-R at the output level of the trained aid": nalr_at_equal_level,
        f"trained, {criterion}": aid,
    }
    for title, candidate in aids.items():
        print(f"{name}, {title}: {describe_aid(candidate, ear, speech)}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
