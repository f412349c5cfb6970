"""Relative error of the exact MSBG with respect to pyclarity's.

    python docs/figures/parity.py SPEECH_DIR AUDIOGRAMS.csv [CASES]

At 44.1 kHz, outputs are compared sample by sample, with the delay and the rescaling of the
reference. At 16 kHz, the reference processes the resampled input, its output is aligned and
resampled, and both are compared below 7 kHz. Both are measured at the levels of speech, and at the
levels that compensators produce for ears with a severe loss.
"""

import statistics
import sys

import numpy as np
import torch
from clarity.evaluator.msbg.msbg import Ear
from pyclarity_teacher import pyclarity_msbg

from hlsim import MSBG, Audiogram
from hlsim.audiogram import HIGHEST_SIMULATED, LOWEST_LEVEL, STANDARD
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import set_level
from hlsim.data.clips import Clips
from hlsim.data.ears import draw_thresholds


def error_at_44100_hz(signal: torch.Tensor, ear: Audiogram) -> float:
    """Compute the relative error at 44.1 kHz and at pyclarity's full scale of 120 dB SPL."""
    reference = Ear()
    reference.set_audiogram(ear.to_clarity())
    expected = reference.process(signal.double().numpy())[0]
    model = MSBG(ear, sample_rate=44100, full_scale_spl=120.0, aligned=False, rescale_active=True)
    perceived = model(signal).numpy()
    return float(np.linalg.norm(perceived - expected) / np.linalg.norm(expected))


def error_at_16000_hz(signal: torch.Tensor, ear: Audiogram) -> float:
    """Compute the relative error at 16 kHz, below 7 kHz."""
    expected = np.fft.rfft(pyclarity_msbg(signal, ear, 16000).numpy())
    perceived = np.fft.rfft(MSBG(ear, sample_rate=16000)(signal).numpy())
    bins = len(expected) * 7 // 8
    error = np.linalg.norm(perceived[:bins] - expected[:bins])
    return float(error / np.linalg.norm(expected[:bins]))


def draw_speech_case(
    number: int, measured: list[Audiogram], generator: torch.Generator
) -> tuple[Audiogram, float]:
    """Draw a measured ear or a random ear by turns, and a level of 50 to 80 dB SPL."""
    ear = Audiogram(tuple(draw_thresholds(1, generator)[0].tolist()))
    if number % 2 == 0:
        ear = measured[int(torch.randint(len(measured), (), generator=generator))]
    return ear, 50.0 + 30.0 * float(torch.rand((), generator=generator))


def draw_amplified_case(
    number: int, measured: list[Audiogram], generator: torch.Generator
) -> tuple[Audiogram, float]:
    """Draw an ear near N4, N5, N6 or S3 by turns, and an output level of 80 to 115 dB SPL."""
    standard = torch.tensor(STANDARD[("N4", "N5", "N6", "S3")[number % 4]])
    thresholds = standard + 5.0 * torch.randn(8, generator=generator)
    ear = Audiogram(tuple(thresholds.clamp(LOWEST_LEVEL, HIGHEST_SIMULATED).tolist()))
    return ear, 80.0 + 35.0 * float(torch.rand((), generator=generator))


DRAWS = {
    "50 to 80 dB SPL": draw_speech_case,
    "near N4, N5, N6 and S3, 80 to 115 dB SPL": draw_amplified_case,
}

COMPARISONS = (
    ("44.1 kHz, sample by sample", 44100, 120.0, error_at_44100_hz),
    ("16 kHz, below 7 kHz", 16000, 94.0, error_at_16000_hz),
)


def main() -> None:
    speech, table = sys.argv[1:3]
    cases = int(sys.argv[3]) if len(sys.argv) > 3 else 40
    measured = [ear for _, ear in read_audiograms(table)]
    for levels, draw in DRAWS.items():
        for name, rate, full_scale_spl, compute_error in COMPARISONS:
            generator = torch.Generator().manual_seed(0)
            clips = Clips(speech, sample_rate=rate, seconds=1.5)
            errors = []
            for number in range(cases):
                ear, level = draw(number, measured, generator)
                signal = set_level(clips.draw(1, generator)[0], level, full_scale_spl)
                errors.append(compute_error(signal, ear))
            print(
                f"{name}, {levels}: median {statistics.median(errors):.1e}, "
                f"worst {max(errors):.1e} of {cases} cases, seed 0"
            )


if __name__ == "__main__":
    main()
