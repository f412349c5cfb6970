"""The paper's Figure 2 for any utterance: MSBG's output over its input, before and after alignment.

    python examples/draw_alignment.py speech.wav alignment.png [EAR [FULL_SCALE_SPL]]

Draws the 120 ms around the loudest sample of the first channel, with outputs raised to the level of
the input, and prints the delay by MSBG's structure and by the paper's impulse method.
"""

import sys

import torch
from matplotlib.figure import Figure
from torch import Tensor

from hlsim import MSBG, Audiogram, estimate_delay
from hlsim.audio import read_audio
from hlsim.calibration import gain_to_pascals, level_spl
from hlsim.msbg.ear import MSBG_RATE

PLOT_SECONDS = 0.12


def draw(path: str, signal: Tensor, outputs: dict[str, Tensor], sample_rate: int) -> None:
    """Draw each output over the signal, in a panel of its own."""
    samples = min(round(PLOT_SECONDS * sample_rate), len(signal))
    start = int(signal.abs().argmax()) - samples // 2
    start = min(max(0, start), len(signal) - samples)
    window = slice(start, start + samples)
    times = torch.arange(start, start + samples) / sample_rate
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    panels = figure.subplots(len(outputs), 1, sharex=True)
    for axes, (title, output) in zip(panels, outputs.items(), strict=True):
        gain_db = float(level_spl(signal) - level_spl(output))
        raised = output * 10.0 ** (gain_db / 20.0)
        axes.plot(times, signal[window], label="input")
        axes.plot(times, raised[window], label=f"MSBG, raised by {gain_db:.0f} dB", alpha=0.8)
        axes.set(title=title, ylabel="pressure (Pa)")
        axes.legend(fontsize="small", loc="upper right")
    panels[-1].set(xlabel="time (s)")
    figure.savefig(path, dpi=110)


@torch.no_grad()
def main(
    source: str, target: str, ear: str = "N3", full_scale_spl: str = "94"
) -> tuple[float, float]:
    """Draw the figure, and return the delay in ms by MSBG's structure and by the impulse method."""
    audiogram = Audiogram.standard(ear)
    waveform, sample_rate = read_audio(source)
    signal = waveform[0] * gain_to_pascals(float(full_scale_spl))
    delayed = MSBG(audiogram, sample_rate=sample_rate, aligned=False)
    aligned = MSBG(audiogram, sample_rate=sample_rate)
    structural_ms = 1000.0 * delayed.delay(audiogram.severity) / MSBG_RATE
    impulse_ms = 1000.0 * estimate_delay(delayed) / sample_rate
    outputs = {
        f"A. MSBG, delayed by {impulse_ms:.1f} ms": delayed(signal)[: len(signal)],
        "B. MSBG, aligned": aligned(signal),
    }
    draw(target, signal, outputs, sample_rate)
    print(f"delay: {structural_ms:.2f} ms (structure), {impulse_ms:.2f} ms (impulse)")
    return structural_ms, impulse_ms


if __name__ == "__main__":
    main(*sys.argv[1:])
