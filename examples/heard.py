"""Draws docs/heard.png: an utterance, what an N4 ear hears of it without an aid, and with compensator-general."""

from pathlib import Path

import numpy as np
import torch
from matplotlib import pyplot
from PIL import Image
from torch import Tensor

from compensators import load_compensator
from hlsim import MSBG, Audiogram
from hlsim.audio import read_audio
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.dsp.resample import resample

ROOT = Path(__file__).parents[1]
RATE = 16000


def speech() -> Tensor:
    """An utterance that comes with hlsim, at 65 dB SPL. Shape: -> (time,)."""
    waveform, rate = read_audio(ROOT / "hlsim" / "data" / "speech" / "valid" / "flite-rms-01.flac")
    return set_level(resample(waveform[0], rate, RATE), 65.0)


def level(waveform: Tensor) -> Tensor:
    """Levels in dB SPL of bins of 20 ms. Shape: (time,) -> (frequency, frames)."""
    points = RATE // 50
    window = torch.hann_window(points)
    spectrum = torch.stft(waveform, points, points // 4, window=window, return_complex=True)
    return 20.0 * torch.log10(spectrum.abs() * 2.0**0.5 / window.sum() + 1e-9) + PASCAL_SPL


def draw(signals: dict[str, Tensor], to: Path) -> None:
    figure, panels = pyplot.subplots(
        1, len(signals), figsize=(10.0, 2.9), dpi=100, sharey=True, layout="constrained"
    )
    for axes, (name, signal) in zip(panels, signals.items(), strict=True):
        seconds = len(signal) / RATE
        image = axes.imshow(
            level(signal).numpy(), origin="lower", aspect="auto", extent=(0.0, seconds, 0.0, RATE / 2000.0),
            vmin=-20.0, vmax=60.0, cmap="magma",
        )  # fmt: skip
        axes.set(title=f"{name}\n{level_spl(signal):.0f} dB SPL", xlabel="time (s)")
    panels[0].set(ylabel="frequency (kHz)")
    figure.colorbar(image, ax=list(panels), label="dB SPL in a bin", pad=0.01)
    figure.canvas.draw()
    # 64 colours: a third of the size
    Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3]).quantize(64).save(to, optimize=True)
    pyplot.close(figure)


def main() -> None:
    ear, clean = Audiogram.standard("N4"), speech()
    listen, aid = MSBG(ear, sample_rate=RATE), load_compensator("compensator-general")
    with torch.no_grad():
        signals = {
            "clean speech": clean,
            "heard by an N4 ear, no aid": listen(clean),
            "heard by an N4 ear, with an aid": listen(aid(clean, ear)),
        }
    draw(signals, ROOT / "docs" / "heard.png")


if __name__ == "__main__":
    main()
