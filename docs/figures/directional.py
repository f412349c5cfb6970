"""Benefit of directional microphones in the digit test, behind a simulated ear.

    python docs/figures/directional.py [TRIPLETS [CHECKPOINT]]

Digits come from the front, and noise with their spectrum at 65 dB SPL from one direction on the
left or from all directions (64), to a rigid sphere with two microphones a side. The left ear is
tested with `hearing-aid` without noise reduction, behind each front end. A signal-to-noise ratio is
that at the centre of the head without the head. The table has the speech reception threshold with
the front microphone alone, and how far each front end lowers it, in dB with 95 % intervals. The
front end of a trained checkpoint is one of them, if there is one.
"""

import sys
from functools import partial

import torch
from torch import Tensor, nn

from compensators import load_compensator
from compensators.beamformer import AdaptiveBeamformer, BeamformingAid
from compensators.directional import (
    AdaptiveDifferentialMicrophone,
    BinauralMVDR,
    DifferentialMicrophone,
)
from hlsim import Audiogram
from hlsim.data.scenes import DIFFUSE_DIRECTIONS, sound_at_microphones
from hlsim.dsp.sphere import evenly_spread_directions, unit_vectors
from hlsim.evaluation.digits.material import Triplets
from hlsim.evaluation.digits.psychometric import subtract
from hlsim.evaluation.digits.speech_reception import DigitTest

EARS = ("N2", "N4")
AZIMUTHS: dict[str, float | None] = {"90": 90.0, "135": 135.0, "180": 180.0, "all": None}


class FrontMicrophone(nn.Module):
    """The signal of the front microphone of each ear."""

    def forward(self, waveform: Tensor) -> Tensor:
        return waveform[..., 0, :, :]


FRONT_ENDS: dict[str, nn.Module] = {
    "front microphone": FrontMicrophone(),
    "hypercardioid": DifferentialMicrophone("hypercardioid"),
    "adaptive": AdaptiveDifferentialMicrophone(),
    "binaural MVDR": BinauralMVDR(),
    "untrained beamformer": AdaptiveBeamformer().requires_grad_(False),
}


def place(triplets: Triplets, azimuth: float | None) -> Triplets:
    """Return the triplets at the microphones, (triplets, microphones, ears, time)."""
    speech = sound_at_microphones(triplets.speech[:, None], unit_vectors([0.0]))
    if azimuth is not None:
        noise = sound_at_microphones(triplets.noise[:, None], unit_vectors([azimuth]))
        return triplets._replace(speech=speech, noise=noise)
    generator = torch.Generator().manual_seed(1)
    directions = evenly_spread_directions(DIFFUSE_DIRECTIONS)
    noises = []
    for sound in triplets.noise:  # one by one, which limits memory
        shifts = torch.randint(len(sound), (DIFFUSE_DIRECTIONS,), generator=generator)
        parts = torch.stack([sound.roll(int(shift)) for shift in shifts])
        noises.append(sound_at_microphones(parts, directions) * DIFFUSE_DIRECTIONS**-0.5)
    return triplets._replace(speech=speech, noise=torch.stack(noises))


def main(triplets: str = "120", checkpoint: str | None = None) -> None:
    front_ends = dict(FRONT_ENDS)
    if checkpoint is not None:
        front_ends["trained beamformer"] = BeamformingAid.from_pretrained(checkpoint).front_end
    test = DigitTest.draw(int(triplets))
    aid = load_compensator("hearing-aid")

    def aided(front_end: nn.Module, signals: Tensor, ear: Tensor) -> Tensor:
        output: Tensor = aid(front_end(signals)[..., 0, :], ear, noise_reduction=0.0)
        return output

    print(f"| ear, noise from (degrees) | {' | '.join(front_ends)} |")
    print("|---" * (1 + len(front_ends)) + "|")
    for name, azimuth in AZIMUTHS.items():
        placed = DigitTest(
            place(test.material, azimuth), test.simulator, test.listener, test.noise_spl
        )
        for label in EARS:
            ear = torch.tensor(Audiogram.standard(label).thresholds)
            front, *directional = [
                placed.measure(ear, partial(aided, front_end)) for front_end in front_ends.values()
            ]
            cells = [f"{front.value:.1f} [{front.low:.1f}, {front.high:.1f}]"]
            for threshold in directional:
                benefit = subtract(front, threshold)
                cells.append(f"{benefit.value:.1f} [{benefit.low:.1f}, {benefit.high:.1f}]")
            print(f"| {label}, {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
