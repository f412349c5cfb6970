"""Relative error of the exact MSBG to pyclarity's: python examples/parity.py SPEECH_DIR AUDIOGRAMS.csv [CASES]

At 44.1 kHz sample for sample, as the reference comes: with its delay and rescaling. At 16 kHz against the reference run
on the resampled input, aligned and resampled back, below 7 kHz. Each for speech as it is, and as loud as compensators
give it to ears with a severe loss.
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
from hlsim.training.clips import Clips
from hlsim.training.ears import draw_thresholds


def sample_for_sample(signal: torch.Tensor, ear: Audiogram) -> float:
    """At 44.1 kHz and pyclarity's full scale of 120 dB SPL."""
    reference = Ear()
    reference.set_audiogram(ear.to_clarity())
    expected = reference.process(signal.double().numpy())[0]
    model = MSBG(ear, sample_rate=44100, full_scale_spl=120.0, aligned=False, rescale_active=True)
    heard = model(signal).numpy()
    return float(np.linalg.norm(heard - expected) / np.linalg.norm(expected))


def below_7_khz(signal: torch.Tensor, ear: Audiogram) -> float:
    """At 16 kHz."""
    spectra = [
        np.fft.rfft(x.numpy())
        for x in (pyclarity_msbg(signal, ear, 16000), MSBG(ear, sample_rate=16000)(signal))
    ]
    expected, heard = (spectrum[: len(spectrum) * 7 // 8] for spectrum in spectra)
    return float(np.linalg.norm(heard - expected) / np.linalg.norm(expected))


def everyday(
    number: int, measured: list[Audiogram], generator: torch.Generator
) -> tuple[Audiogram, float]:
    """An ear, measured or drawn in turn, and a level of 50 to 80 dB SPL."""
    drawn = Audiogram(tuple(draw_thresholds(1, generator)[0].tolist()))
    ear = (
        drawn
        if number % 2
        else measured[int(torch.randint(len(measured), (), generator=generator))]
    )
    return ear, 50.0 + 30.0 * float(torch.rand((), generator=generator))


def amplified(
    number: int, measured: list[Audiogram], generator: torch.Generator
) -> tuple[Audiogram, float]:
    """An ear within some 5 dB of N4, N5, N6 or S3 in turn, and the 80 to 115 dB SPL that compensators give those."""
    standard = torch.tensor(STANDARD[("N4", "N5", "N6", "S3")[number % 4]])
    near = standard + 5.0 * torch.randn(8, generator=generator)
    ear = Audiogram(tuple(near.clamp(LOWEST_LEVEL, HIGHEST_SIMULATED).tolist()))
    return ear, 80.0 + 35.0 * float(torch.rand((), generator=generator))


def main() -> None:
    speech, table = sys.argv[1:3]
    cases = int(sys.argv[3]) if len(sys.argv) > 3 else 40
    measured = [ear for _, ear in read_audiograms(table)]
    for what, draw in (
        ("50 to 80 dB SPL", everyday),
        ("near N4, N5, N6 and S3, 80 to 115 dB SPL", amplified),
    ):
        for name, rate, full_scale, error in (
            ("44.1 kHz, sample for sample", 44100, 120.0, sample_for_sample),
            ("16 kHz, below 7 kHz", 16000, 94.0, below_7_khz),
        ):
            generator = torch.Generator().manual_seed(0)
            clips = Clips(speech, sample_rate=rate, seconds=1.5)
            errors = []
            for number in range(cases):
                ear, level = draw(number, measured, generator)
                errors.append(error(set_level(clips.draw(1, generator)[0], level, full_scale), ear))
            print(
                f"{name}, {what}: median {statistics.median(errors):.1e}, worst {max(errors):.1e} of {cases} cases, "
                "seed 0"
            )


if __name__ == "__main__":
    main()
