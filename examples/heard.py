"""Draw docs/heard.png, speech as an N4 ear perceives it with and without an aid, and
docs/family.png, an N2 ear by simulator.

python examples/heard.py
"""

from io import BytesIO
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from compensators import load_compensator
from hlsim import MSBG, Audiogram, list_pretrained, load_pretrained
from hlsim.audio import read_audio
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.resample import resample
from hlsim.report.plots import new_figure
from hlsim.report.spectrograms import PANEL_INCHES, Panels, panels

ROOT = Path(__file__).parents[1]
RATE = 16000
EXACT = "exact MSBG"


def read_speech() -> Tensor:
    """Read an utterance that ships with hlsim, at 65 dB SPL. Shape: -> (time,)."""
    waveform, rate = read_audio(ROOT / "hlsim" / "data" / "speech" / "valid" / "flite-rms-01.flac")
    return set_level(resample(waveform[0], rate, RATE), 65.0)


def draw(signals: dict[str, Tensor], path: Path, reference: str = "") -> None:
    """Draw the spectrogram of each signal.

    Args:
        signals: Signals by name.
        path: File of the picture.
        reference: Name of a signal. The differences from it are drawn for all signals after it.
    """
    titles = {name: f"{name}, {level_spl(signal):.0f} dB SPL" for name, signal in signals.items()}
    names = [*signals]
    later = names[names.index(reference) + 1 :] if reference else []
    differences = {f"{name} minus {reference}": (titles[name], titles[reference]) for name in later}
    spectrograms = {titles[name]: signal for name, signal in signals.items()}
    pictures = panels(spectrograms, RATE, differences)
    image = Image.open(BytesIO(composite(pictures))).convert("RGB")
    image.quantize(96, Image.Quantize.MAXCOVERAGE).save(
        path, optimize=True
    )  # 96 colours need less than half of the space.


def composite(panels: Panels) -> bytes:
    """Return all panels as one PNG, in two columns."""
    rows = -(-len(panels) // 2)
    figure = new_figure((2.0 * PANEL_INCHES[0], rows * PANEL_INCHES[1]))
    places = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes, draw in zip(places, panels.values(), strict=False):
        draw(figure, axes)
    for axes in places[len(panels) :]:
        axes.set_axis_off()
    data = BytesIO()
    figure.savefig(data, dpi=160, format="png")
    return data.getvalue()


@torch.no_grad()
def main(folder: Path = ROOT / "docs") -> None:
    clean, exact, ear = read_speech(), MSBG(sample_rate=RATE), Audiogram.standard("N4")
    perceived = {"clean speech": clean, "perceived without an aid": exact(clean, ear)}
    for name in ("nalr", "compensator-general"):
        perceived[f"perceived with {name}"] = exact(load_compensator(name)(clean, ear), ear)
    draw(perceived, folder / "heard.png")
    ear = Audiogram.standard("N2")
    family = [name for name, loader in list_pretrained().items() if loader == "load_pretrained"]
    perceived = {name: load_pretrained(name)(clean, ear) for name in family}
    draw(
        {"clean speech": clean, EXACT: exact(clean, ear)} | perceived, folder / "family.png", EXACT
    )


if __name__ == "__main__":
    main()
