"""Draws examples/delay.png: the paper's impulse method against the structural delay, by ear and level."""

from pathlib import Path

from matplotlib import pyplot

from hlsim import MSBG, Audiogram
from hlsim.msbg import estimate_delay

EARS = ("NH", "N1", "N2", "N3", "N4", "S1", "S2", "S3")
LEVELS = (100.0, 110.0, 120.0)

figure, axes = pyplot.subplots(figsize=(8.0, 3.6), layout="constrained")
for level in LEVELS:
    delays = [estimate_delay(MSBG(Audiogram.standard(ear), aligned=False), level=level) for ear in EARS]
    axes.plot(EARS, delays, "o", label=f"impulse method, {level:g} dB SPL")
structural = [MSBG(aligned=False).delay(Audiogram.standard(ear).severity) for ear in EARS]
axes.plot(EARS, structural, "k_", markersize=24, label="structural delay")
axes.set(xlabel="ear", ylabel="samples at 44.1 kHz", title="Delay of MSBG")
axes.legend(fontsize="small")
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
