"""Ears whose measured uncomfortable level is exceeded by loud sounds through an aid.

    python docs/figures/discomfort.py people/thresholds_in_noise.csv [STRIDE]

The table has one row per person, see ``examples/people_recruitment.py``; every STRIDEth ear with an
uncomfortable level below 115 dB HL is used. The sounds are speech at 80 dB SPL, music (chords of
decaying harmonic tones) at 80 dB SPL and a slam, a decaying noise with a peak of 100 dB SPL. An
ear is exceeded if the 99th percentile of the levels of a third of an octave, over 125 ms, is above
its uncomfortable level at 500, 1000, 2000 or 4000 Hz. HASPI, HASQI and the output level of speech
at 65 dB SPL are means of the standard ears N2 to N5. An aid without measured levels stays a margin
below predicted ones; the table has its own margin, the first, and larger ones.

The words that such margins cost are those of a recogniser, with this file as a plug-in:

    F=docs/figures/discomfort.py
    python examples/machine_listener.py compare speech/valid noise/valid --model moonshine-tiny \\
        --audiograms audiograms/valid.csv --step 4 --own-levels --out words-limited \\
        --aids $F:margin_7 $F:margin_16 $F:margin_20 $F:margin_24 hearing-aid
"""

import sys
from functools import cache, partial

import numpy as np
import torch
from torch import Tensor, nn

import hlsim
from compensators import load_compensator
from examples.people_recruitment import NOT_REACHED, read_uncomfortable_levels
from hlsim import Audiogram
from hlsim.audiogram.discomfort import PREDICTION_MARGIN_DB
from hlsim.audiogram.prescription import FREE_FIELD_THRESHOLD_SPL
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.metrics import haspi, hasqi

RATE = 16000
WINDOW = RATE // 8
AIDS = ("hearing-aid", "wdrc")
PERCENTILE = 0.99
EARS_AT_ONCE = 16
MARGINS = (PREDICTION_MARGIN_DB, 12.0, 16.0, 20.0, 24.0, 28.0, 32.0)  # dB


def make_sounds() -> dict[str, Tensor]:
    """Return the loud sounds, at 16 kHz in pascals. Shape of each: (time,)."""
    random = np.random.default_rng(0)
    time = np.arange(3 * RATE) / RATE
    music = np.zeros_like(time)
    for onset in np.arange(0.0, 3.0, 0.375):
        since = np.maximum(time - onset, 0.0)
        for semitone in random.integers(0, 30, 3):
            pitch = 110.0 * 2.0 ** (semitone / 12.0)
            tones = [np.sin(2.0 * np.pi * k * pitch * since) / k for k in range(1, 13)]
            music += (time >= onset) * np.exp(-4.0 * since) * np.sum(tones, 0)
    since = np.maximum(time - 1.0, 0.0)
    slam = (time >= 1.0) * np.exp(-since / 0.05) * random.normal(size=len(time))
    slam *= 2.0 / np.abs(slam).max()
    return {
        "speech": set_level(hlsim.example_speech()[: 3 * RATE], 80.0),
        "music": set_level(torch.from_numpy(music).float(), 80.0),
        "slam": torch.from_numpy(slam).float(),
    }


def third_octave_levels(signal: Tensor, hertz: float) -> Tensor:
    """Return levels in dB SPL over windows of 125 ms. Shape: (..., time) -> (..., windows)."""
    window = torch.hann_window(WINDOW)
    frames = signal.unfold(-1, WINDOW, WINDOW // 4) * window
    powers = torch.fft.rfft(frames).abs().square() * 2.0 / (WINDOW * window.square().sum())
    frequencies = torch.arange(powers.shape[-1]) * RATE / WINDOW
    in_third = (frequencies - hertz).abs() < hertz * (2.0 ** (1.0 / 6.0) - 1.0)
    return 10.0 * powers[..., in_third].sum(-1).clamp_min(1e-20).log10() + PASCAL_SPL


def read_ears(path: str, stride: int) -> list[Audiogram]:
    """Return the ears of the table with the uncomfortable levels that they reached."""
    ears = []
    for _, rows in read_uncomfortable_levels(path).groupby(["person", "ear"]):
        reached = rows[rows["ucl"] < NOT_REACHED]
        if not reached.empty:
            ear = rows["audiogram"].iloc[0]
            levels = dict(zip(reached["hz"], reached["ucl"], strict=True))
            ears.append(Audiogram(ear.levels, ear.frequencies, ucl=levels))
    return ears[::stride]


def set_predicted_limits(ear: Audiogram, margin: float) -> Audiogram:
    """Return the ear with uncomfortable levels that are a margin in dB below predicted ones.

    One level is enough: its distance from the prediction holds at all frequencies.
    """
    predicted = Audiogram(ear.levels, ear.frequencies).uncomfortable_levels([1000.0])[0]
    return Audiogram(ear.levels, ear.frequencies, ucl={1000.0: predicted - margin})


@cache
def load_limited_aid() -> nn.Module:
    """Return ``hearing-aid`` with its limit by the ear."""
    return load_compensator("hearing-aid", limit_to_ear=True).eval()


def process_below_prediction(margin: float, waveform: Tensor, ear: Audiogram) -> Tensor:
    """Process a waveform by ``hearing-aid``, limited to a margin in dB below predicted levels."""
    output: Tensor = load_limited_aid()(waveform, set_predicted_limits(ear, margin))
    return output


margin_7, margin_16, margin_20, margin_24 = (
    partial(process_below_prediction, margin) for margin in (PREDICTION_MARGIN_DB, 16.0, 20.0, 24.0)
)


def exceeded(output: Tensor, ear: Audiogram) -> bool:
    """Return whether a measured uncomfortable level of an ear is exceeded."""
    for hertz, level in ear.ucl:
        highest = level + FREE_FIELD_THRESHOLD_SPL[int(hertz)]
        if float(third_octave_levels(output, hertz).quantile(PERCENTILE)) > highest:
            return True
    return False


@torch.no_grad()
def main(path: str, stride: str = "1") -> None:
    """Print a table of shares of ears, and scores of speech at 65 dB SPL."""
    ears, sounds = read_ears(path, int(stride)), make_sounds()
    standard = [Audiogram.standard(ear) for ear in ("N2", "N3", "N4", "N5")]
    speech = hlsim.example_speech()[: 3 * RATE].expand(len(standard), -1)
    print(f"{len(ears)} ears")
    rows = [("no limit", False, ears, standard), ("measured levels", True, ears, standard)]
    for margin in MARGINS:
        people, typical = (
            [set_predicted_limits(ear, margin) for ear in group] for group in (ears, standard)
        )
        rows.append((f"{margin:g} dB below predicted levels", True, people, typical))
    for name in AIDS:
        for label, limit, fitted, typical in rows:
            aid = load_compensator(name, limit_to_ear=limit)
            counts = []
            for sound in sounds.values():
                outputs = torch.cat(
                    [
                        aid(sound.expand(len(block), -1), block)
                        for block in (
                            fitted[start : start + EARS_AT_ONCE]
                            for start in range(0, len(fitted), EARS_AT_ONCE)
                        )
                    ]
                )
                counts.append(
                    np.mean([exceeded(*pair) for pair in zip(outputs, ears, strict=True)])
                )
            shares = ", ".join(f"{s} {c:.1%}" for s, c in zip(sounds, counts, strict=True))
            outputs = aid(speech, typical)
            scores = [score(outputs, speech, standard).mean() for score in (haspi, hasqi)]
            print(
                f"{name}, {label}: {shares}; HASPI {scores[0]:.4f}, HASQI {scores[1]:.4f}, "
                f"{level_spl(outputs).mean():.1f} dB SPL",
                flush=True,
            )


if __name__ == "__main__":
    main(*sys.argv[1:])
