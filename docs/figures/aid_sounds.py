"""Measure tones, everyday sounds and music through `hearing-aid`.

    python docs/figures/aid_sounds.py [--loudness -10]

- Steady tones of 0.25 to 4 kHz at 50, 65 and 80 dB SPL: the level that the ear perceives, minus
  that which a normal ear perceives. In parentheses, the same as a difference of the output in dB:
  in an ear with recruitment, the perceived level changes by several dB for one dB of output.
- Ten everyday sounds and music at natural levels, all of them synthetic: in how many of its main
  third octaves the ear hears the sound. They are those within 20 dB of the loudest that a normal
  ear hears, and in which the loss is below 80 dB HL. A third octave is heard if its level, the 95th
  percentile over 125 ms, exceeds the internal noise (ANSI S3.5-1997) plus the hearing loss.
- Music, chords of decaying harmonic tones: HAAQI, but for N5.
"""

import argparse

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from compensators import load_compensator
from docs.figures.discomfort import RATE, make_sounds, third_octave_levels
from hlsim import Audiogram
from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import set_level
from hlsim.dsp.interpolation import interpolate
from hlsim.evaluation.aid_properties import measure_steady_tones
from hlsim.metrics import haaqi
from hlsim.metrics.sii import INTERNAL_NOISE, SII_BANDS

EARS = ("N2", "N3", "N4", "N5")
LEVELS = (50.0, 65.0, 80.0)
HIGHEST_LOSS = 80.0
MAIN_DB = 20.0
PERCENTILE = 0.95
LOUDER_DB = 0.5
LOUDER = 10.0 ** (LOUDER_DB / 20.0)
BANDS = SII_BANDS[:-1]  # the last one ends above 8 kHz


def make_everyday_sounds() -> dict[str, Tensor]:
    """Return sounds of 3 s at their natural level, in pascals. Shape of each: (time,)."""
    random = np.random.default_rng(0)
    time = np.arange(3 * RATE) / RATE
    noise = random.normal(size=len(time))

    def sweep(hertz: float | NDArray[np.float64]) -> NDArray[np.float64]:
        phase = np.cumsum(np.broadcast_to(hertz, time.shape)) / RATE
        return np.sin(2.0 * np.pi * phase)

    def filtered(low: float, high: float) -> NDArray[np.float64]:
        spectrum = np.fft.rfft(noise)
        hertz = np.fft.rfftfreq(len(time), 1.0 / RATE)
        return np.fft.irfft(spectrum * ((hertz > low) & (hertz < high)), len(time))

    def gated(on: float, period: float) -> NDArray[np.bool_]:
        return time % period < on

    chirp = 4000.0 + 1500.0 * np.sin(2.0 * np.pi * 12.0 * time)
    cry = 450.0 * (1.0 + 0.15 * np.sin(np.pi * time % np.pi))
    alarm_beeps = gated(0.5, 1.0)
    claps = filtered(500.0, 6000.0) * np.exp(-(time % 0.05) / 0.01)
    waves = {
        "doorbell": (sweep(660.0) * np.exp(-4.0 * time), 70.0),
        "phone": (sweep(np.where(gated(0.05, 0.1), 1000.0, 1300.0)) * gated(1.0, 1.5), 70.0),
        "smoke alarm, 3.1 kHz": (sweep(3100.0) * alarm_beeps, 80.0),
        "smoke alarm, 0.52 kHz": (np.sign(sweep(520.0)) * alarm_beeps, 80.0),
        "kettle": (sweep(2500.0) + 0.3 * filtered(1500.0, 6000.0), 65.0),
        "birds": (sweep(chirp) * gated(0.15, 0.4), 50.0),
        "siren": (sweep(900.0 + 500.0 * np.sin(np.pi * time)), 75.0),
        "applause": (claps, 70.0),
        "traffic": (filtered(50.0, 1000.0), 65.0),
        "crying": (sum(sweep(k * cry) / k for k in range(1, 9)) * gated(0.8, 1.0), 75.0),
    }
    sounds = {
        name: set_level(torch.from_numpy(np.asarray(wave, np.float32)), level)
        for name, (wave, level) in waves.items()
    }
    return {**sounds, "music": set_level(make_sounds()["music"], 65.0)}


def measure_levels(sound: Tensor) -> NDArray[np.float64]:
    """Return the levels of third octaves in dB SPL. Shape: (time,) -> (bands,)."""
    levels = [float(third_octave_levels(sound, hertz).quantile(PERCENTILE)) for hertz in BANDS]
    return np.array(levels)


def compute_threshold(ear: Audiogram) -> NDArray[np.float64]:
    """Return the level in dB SPL from which an ear hears a third octave. Shape: (bands,)."""
    losses = interpolate(torch.tensor([ear.thresholds]), FREQUENCIES, BANDS)[0]
    widths = 10.0 * np.log10(np.array(BANDS) * (2.0 ** (1.0 / 6.0) - 2.0 ** (-1.0 / 6.0)))
    return np.array(INTERNAL_NOISE)[: len(BANDS)] + widths + losses.clamp_min(0.0).numpy()


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--loudness", type=float, default=0.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    aid = load_compensator("hearing-aid", loudness=options.loudness)
    nalr = load_compensator("nalr")
    sounds = make_everyday_sounds()
    normal_threshold = compute_threshold(Audiogram.standard("NH"))
    for name in EARS:
        ear = Audiogram.standard(name)
        tones = measure_steady_tones(aid, ear, LEVELS)
        louder = measure_steady_tones(lambda x, ear: LOUDER * aid(x, ear), ear, LEVELS)
        print(f"{name}: tones of {tones['frequencies']} Hz")
        rows = zip(LEVELS, tones["loudness_error_db"], louder["loudness_error_db"], strict=True)
        for level, errors, louder_errors in rows:
            cells = [
                f"{error:+.1f} ({error * LOUDER_DB / (louder_error - error):+.1f})"
                for error, louder_error in zip(errors, louder_errors, strict=True)
            ]
            print(f"  {level:g} dB SPL: {', '.join(cells)}")
        threshold = compute_threshold(ear)
        for sound_name, sound in sounds.items():
            levels = measure_levels(sound)
            is_main = (levels > levels.max() - MAIN_DB) & (levels > normal_threshold)
            is_main &= threshold - normal_threshold < HIGHEST_LOSS
            counts = [
                (is_main & (measure_levels(output) > threshold)).sum()
                for output in (sound, nalr(sound, ear), aid(sound, ear))
            ]
            cells = "unaided {}, NAL-R {}, aid {}".format(*counts)
            print(f"  {sound_name}, {is_main.sum()} third octaves: {cells}", flush=True)
        if name == "N5":
            continue
        clean = sounds["music"]
        scores = [float(haaqi(process(clean, ear), clean, ear)) for process in (nalr, aid)]
        print("  HAAQI of music: NAL-R {:.3f}, aid {:.3f}".format(*scores), flush=True)


if __name__ == "__main__":
    main()
