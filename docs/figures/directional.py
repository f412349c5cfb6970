"""Benefit of directional microphones in the digit test, behind a simulated ear.

    python docs/figures/directional.py [TRIPLETS [CHECKPOINT]]

Digits come from the front, and noise with their spectrum at 65 dB SPL from one direction on the
left or from all directions (64), to a rigid sphere with two microphones a side. The left ear is
tested with `hearing-aid` without noise reduction, behind each front end. A signal-to-noise ratio is
that at the centre of the head without the head. The table has the speech reception threshold with
the front microphone alone, and how far each front end lowers it, in dB with 95 % intervals.

With the name or folder of a trained checkpoint, the table compares its front end with the adaptive
microphone, for the ear N2. Noise from one direction has 75 dB SPL, and the digits are 12 dB softer
than stated by the test, whose lowest ratios are otherwise too high for these front ends.
"""

import sys
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from compensators import load_compensator
from compensators.directional import (
    AdaptiveDifferentialMicrophone,
    BinauralMVDR,
    DifferentialMicrophone,
)
from hlsim import Audiogram
from hlsim.data.scenes import DIFFUSE_DIRECTIONS, sound_at_microphones
from hlsim.dsp.sphere import evenly_spread_directions, unit_vectors
from hlsim.evaluation.digits.material import Triplets
from hlsim.evaluation.digits.psychometric import Estimate, subtract
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


def aided(front_end: nn.Module, signals: Tensor, ear: Tensor) -> Tensor:
    """Return the output of the hearing aid for the left ear."""
    aid: Any = load_compensator("hearing-aid")
    output: Tensor = aid(front_end(signals)[..., 0, :], ear, noise_reduction=0.0)
    return output


def format_estimate(estimate: Estimate, offset: float = 0.0) -> str:
    """Format an estimate minus an offset, with its interval."""
    value, low, high = (number - offset for number in estimate)
    return f"{value:.1f} [{low:.1f}, {high:.1f}]"


def compare_with_adaptive(test: DigitTest, checkpoint: str) -> None:
    """Print the thresholds with the adaptive microphone and a trained front end."""
    ear = torch.tensor(Audiogram.standard("N2").thresholds)
    trained: Any = load_compensator(checkpoint)
    print("| noise from (degrees) | adaptive | trained | trained is lower by |")
    print("|---|---|---|---|")
    for name, azimuth in AZIMUTHS.items():
        softer_db = 0.0 if azimuth is None else 12.0
        noise_spl = test.noise_spl if azimuth is None else 75.0
        triplets = place(test.material, azimuth)
        triplets = triplets._replace(speech=triplets.speech * 10.0 ** (-softer_db / 20.0))
        placed = DigitTest(triplets, test.simulator, test.listener, noise_spl)
        thresholds = [
            placed.measure(ear, partial(aided, front_end))
            for front_end in (FRONT_ENDS["adaptive"], trained.front_end)
        ]
        cells = [format_estimate(threshold, softer_db) for threshold in thresholds]
        print(f"| {name} | {' | '.join(cells)} | {format_estimate(subtract(*thresholds))} |")


def main(triplets: str = "120", checkpoint: str | None = None) -> None:
    test = DigitTest.draw(int(triplets))
    if checkpoint is not None:
        compare_with_adaptive(test, checkpoint)
        return
    print(f"| ear, noise from (degrees) | {' | '.join(FRONT_ENDS)} |")
    print("|---" * (1 + len(FRONT_ENDS)) + "|")
    for name, azimuth in AZIMUTHS.items():
        placed = DigitTest(
            place(test.material, azimuth), test.simulator, test.listener, test.noise_spl
        )
        for label in EARS:
            ear = torch.tensor(Audiogram.standard(label).thresholds)
            front, *directional = [
                placed.measure(ear, partial(aided, front_end)) for front_end in FRONT_ENDS.values()
            ]
            benefits = [subtract(front, threshold) for threshold in directional]
            cells = [format_estimate(estimate) for estimate in (front, *benefits)]
            print(f"| {label}, {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
