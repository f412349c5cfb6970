"""Draw docs/heard.png, speech as a normal ear and an N4 ear perceive it, without an aid and with
three, and docs/family.png, an N2 ear by simulator.

python docs/figures/heard.py
"""

from io import BytesIO
from pathlib import Path

import torch
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from compensators import load_compensator
from hlsim import MSBG, Audiogram, list_pretrained, load_pretrained
from hlsim.audio import read_audio
from hlsim.calibration import level_spl, set_level
from hlsim.data.bundled import EXAMPLE_FILE
from hlsim.dsp.resample import resample
from hlsim.report.players import spectrogram_levels

ROOT = Path(__file__).parents[2]
RATE = 16000
EXACT = "exact MSBG"
RANGE_DB = 75.0
AIDS = {
    "nalr": "NAL-R",
    "hearing-aid": "hearing-aid",
    "compensator-general": "compensator-general",
}
"""Titles of the aids by name."""


def read_speech() -> Tensor:
    """Read an utterance that ships with hlsim, at 65 dB SPL. Shape: -> (time,)."""
    waveform, rate = read_audio(EXAMPLE_FILE)
    return set_level(resample(waveform[0], rate, RATE), 65.0)


def draw(signals: dict[str, Tensor], path: Path, reference: str = "") -> None:
    """Draw the spectrogram of each signal, two in a row.

    Args:
        signals: Signals by name.
        path: File of the picture.
        reference: Name of a signal. The differences from it are drawn for all signals after it.
    """
    levels = {name: spectrogram_levels(signal, RATE) for name, signal in signals.items()}
    highest = 5.0 * round(
        max(float(image.quantile(0.999)) for image in levels.values()) / 5.0 + 0.5
    )
    lowest = highest - RANGE_DB
    panels = []
    for name, image in levels.items():
        title = f"{name}, {level_spl(signals[name]):.0f} dB SPL"
        panels.append((title, image, "dB SPL in a bin", "gist_heat_r", (lowest, highest)))
    names = [*signals]
    for name in names[names.index(reference) + 1 :] if reference else []:
        image = levels[name] - levels[reference]
        image[torch.maximum(levels[name], levels[reference]) < lowest] = torch.nan
        panels.append((f"{name} minus {reference}", image, "dB", "RdBu_r", (-15.0, 15.0)))

    rows = -(-len(panels) // 2)
    figure = Figure(figsize=(9.2, 2.1 * rows), layout="constrained")
    places = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes, (title, image, unit, colours, (low, high)) in zip(places, panels, strict=False):
        extent = (0.0, len(signals[names[0]]) / RATE, 0.0, 8.0)
        style = {"vmin": low, "vmax": high, "cmap": colours, "extent": extent}
        drawn = axes.imshow(image.numpy(), origin="lower", aspect="auto", **style)
        axes.set(xlabel="time (s)", ylabel="frequency (kHz)")
        axes.set_title(title, fontsize="medium")
        figure.colorbar(drawn, ax=axes, label=unit, aspect=15, pad=0.02)
    for axes in places[len(panels) :]:
        axes.set_axis_off()
    data = BytesIO()
    figure.savefig(data, dpi=130, format="png")
    # 48 colours need a third of the space
    picture = Image.open(data).convert("RGB").quantize(48, Image.Quantize.MAXCOVERAGE)
    picture.save(path, optimize=True)


@torch.no_grad()
def main(folder: Path = ROOT / "docs") -> None:
    clean, exact, ear = read_speech(), MSBG(sample_rate=RATE), Audiogram.standard("N4")
    perceived = {
        "clean speech": clean,
        "normal ear": exact(clean, Audiogram.standard("NH")),
        "N4 ear without an aid": exact(clean, ear),
    }
    for name, title in AIDS.items():
        output = load_compensator(name)(clean, ear)
        perceived[f"N4 ear with {title}"] = exact(output, ear)
    draw(perceived, folder / "heard.png")
    ear = Audiogram.standard("N2")
    family = [name for name, loader in list_pretrained().items() if loader == "load_pretrained"]
    perceived = {name: load_pretrained(name)(clean, ear) for name in family}
    draw(
        {"clean speech": clean, EXACT: exact(clean, ear)} | perceived, folder / "family.png", EXACT
    )


if __name__ == "__main__":
    main()
