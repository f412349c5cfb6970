"""Draw docs/delay.png, the delay by the impulse method and by MSBG's structure, and print it by
frequency.

The table shows the remaining delay of the aligned output in samples at 44.1 kHz; negative values
mean that it is early. The delay is measured by cross-correlation of a tone burst at 65 dB SPL with
the output.
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
TABLE_EARS = EARS[:5]
LEVELS = (100.0, 110.0, 120.0)
HERTZ = (200, 300, 400, 500, 750, 1000, 2000, 4000, 8000)


def make_bursts() -> Tensor:
    """Make Gaussian tone bursts of half a second, with a bandwidth of about a third of an octave.

    Shape: -> (HERTZ, time).
    """
    cycles = torch.tensor(HERTZ).unsqueeze(-1) * torch.linspace(-0.25, 0.25, MSBG_RATE // 2 + 1)
    return set_level((2.0 * torch.pi * cycles).cos() * (-0.5 * cycles.square()).exp(), 65.0)


def measure_delays(outputs: Tensor, inputs: Tensor) -> list[int]:
    """Return the lags in samples at which the envelopes of the cross-correlations are highest.

    Shape: (HERTZ, time), (HERTZ, time).
    """
    points = 2 * inputs.shape[-1]
    product = torch.fft.fft(outputs, points) * torch.fft.fft(inputs, points).conj()
    product[:, points // 2 :] = 0.0
    lags = torch.fft.ifft(product).abs().argmax(-1)
    return [lag - points if lag > points // 2 else lag for lag in lags.tolist()]


def draw(path: Path) -> None:
    """Draw the delays of all ears."""
    figure, axes = pyplot.subplots(figsize=(8.0, 3.6), layout="constrained")
    for level in LEVELS:
        delays = [
            estimate_delay(
                MSBG(Audiogram.standard(ear), sample_rate=MSBG_RATE, aligned=False), level=level
            )
            for ear in EARS
        ]
        axes.plot(EARS, delays, "o", label=f"impulse method, {level:g} dB SPL")
    unaligned = MSBG(sample_rate=MSBG_RATE, aligned=False)
    structural = [unaligned.delay(Audiogram.standard(ear).severity) for ear in EARS]
    axes.plot(EARS, structural, "k_", markersize=24, label="structural delay")
    axes.set(xlabel="ear", ylabel="samples at 44.1 kHz", title="Delay of MSBG")
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def main() -> None:
    print("| Ear | MSBG's severity |" + "".join(f" {hertz} Hz |" for hertz in HERTZ))
    print("|---|---|" + "---|" * len(HERTZ))
    for name in TABLE_EARS:
        ear = Audiogram.standard(name)
        delays = measure_delays(MSBG(ear, sample_rate=MSBG_RATE)(make_bursts()), make_bursts())
        print(f"| {name} | {ear.severity} |" + "".join(f" {samples:+d} |" for samples in delays))
    draw(Path(__file__).parents[1] / "delay.png")


if __name__ == "__main__":
    main()
