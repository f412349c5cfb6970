"""Draws docs/delay.png, the paper's impulse method against the structural delay, and prints the delay by frequency.

Each figure of the table is what is left of the delay in aligned output, in samples at 44.1 kHz (negative: it comes
early), by the cross-correlation of a tone burst of 65 dB SPL with what is heard of it.
"""

from pathlib import Path

import torch
from matplotlib import pyplot
from torch import Tensor

from hlsim import MSBG, Audiogram
from hlsim.calibration import set_level
from hlsim.msbg import estimate_delay
from hlsim.msbg.ear import MSBG_RATE

EARS = ("NH", "N1", "N2", "N3", "N4", "S1", "S2", "S3")
TABLED = EARS[:5]
LEVELS = (100.0, 110.0, 120.0)
HERTZ = (200, 300, 400, 500, 750, 1000, 2000, 4000, 8000)


def bursts() -> Tensor:
    """Gaussian tone bursts, half a second each, about a third of an octave wide. Shape: -> (HERTZ, time)."""
    cycles = torch.tensor(HERTZ).unsqueeze(-1) * torch.linspace(-0.25, 0.25, MSBG_RATE // 2 + 1)
    return set_level((2.0 * torch.pi * cycles).cos() * (-0.5 * cycles.square()).exp(), 65.0)


def left_of_the_delay(heard: Tensor, given: Tensor) -> list[int]:
    """Where the envelope of the cross-correlation is greatest. Shape: (HERTZ, time) twice -> samples."""
    points = 2 * given.shape[-1]
    product = torch.fft.fft(heard, points) * torch.fft.fft(given, points).conj()
    product[:, points // 2 :] = 0.0
    lags = torch.fft.ifft(product).abs().argmax(-1)
    return [lag - points if lag > points // 2 else lag for lag in lags.tolist()]


def draw(to: Path) -> None:
    figure, axes = pyplot.subplots(figsize=(8.0, 3.6), layout="constrained")
    for level in LEVELS:
        delays = [
            estimate_delay(MSBG(Audiogram.standard(ear), aligned=False), level=level)
            for ear in EARS
        ]
        axes.plot(EARS, delays, "o", label=f"impulse method, {level:g} dB SPL")
    structural = [MSBG(aligned=False).delay(Audiogram.standard(ear).severity) for ear in EARS]
    axes.plot(EARS, structural, "k_", markersize=24, label="structural delay")
    axes.set(xlabel="ear", ylabel="samples at 44.1 kHz", title="Delay of MSBG")
    axes.legend(fontsize="small")
    figure.savefig(to, dpi=110)
    pyplot.close(figure)


def main() -> None:
    print("| Ear | MSBG's severity |" + "".join(f" {hertz} Hz |" for hertz in HERTZ))
    print("|---|---|" + "---|" * len(HERTZ))
    for name in TABLED:
        ear = Audiogram.standard(name)
        left = left_of_the_delay(MSBG(ear)(bursts()), bursts())
        print(f"| {name} | {ear.severity} |" + "".join(f" {samples:+d} |" for samples in left))
    draw(Path(__file__).parents[1] / "docs" / "delay.png")


if __name__ == "__main__":
    main()
