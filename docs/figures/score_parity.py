"""HASPI, HASQI and HAAQI compared with those of pyclarity: errors with the same seed, and speed.

    python docs/figures/score_parity.py SPEECH [ITEMS]

The items are 3 s of speech at 16 kHz and 50 to 80 dB SPL, for the ears N1 to N6 and S1 to S3. The
output is clean, noisy (-5 to 20 dB SNR), amplified by NAL-R, clipped, low-passed, or noisy and
amplified. Times are those of one thread, without the preparation of the clean speech.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from clarity.evaluator.haaqi import haaqi_v1
from clarity.evaluator.haspi import haspi_v2
from clarity.evaluator.hasqi import hasqi_v2
from torch import Tensor

from compensators import NALR
from hlsim import Audiogram
from hlsim.calibration import set_level
from hlsim.data.clips import Clips
from hlsim.metrics import HaaqiReference, HaspiReference, HasqiReference

PYCLARITY = {"haspi": haspi_v2, "hasqi": hasqi_v2, "haaqi": partial(haaqi_v1, equalisation=1)}
RATE = 16000
EARS = ("N1", "N2", "N3", "N4", "N5", "N6", "S1", "S2", "S3")


def process(clean: Tensor, index: int, ear: Audiogram, generator: torch.Generator) -> Tensor:
    """Process speech in one of six ways. Shape: (time,) -> (time,)."""
    kind = ("clean", "noisy", "nalr", "clipped", "low-passed", "noisy nalr")[index % 6]
    noise = clean.norm() * torch.nn.functional.normalize(
        torch.randn(clean.shape, generator=generator), dim=-1
    )
    snr = 25.0 * torch.rand((), generator=generator) - 5.0
    output = clean + noise * 10.0 ** (-snr / 20.0) if "noisy" in kind else clean
    if kind == "clipped":
        limit = 0.25 * float(clean.abs().max())
        output = output.clamp(-limit, limit)
    if kind == "low-passed":
        spectrum = torch.fft.rfft(output)
        spectrum[..., 2000 * clean.shape[-1] // RATE :] = 0.0
        output = torch.fft.irfft(spectrum, clean.shape[-1])
    return NALR(ear, sample_rate=RATE)(output) if "nalr" in kind else output


def pyclarity_score(name: str, clean: Tensor, output: Tensor, ear: Audiogram, seed: int) -> float:
    """Compute pyclarity's score with a seed of NumPy's global generator, from which it draws
    noise."""
    score = PYCLARITY[name]
    signals = [signal.double().numpy() for signal in (clean, output)]
    np.random.seed(seed)
    return float(score(signals[0], RATE, signals[1], RATE, ear.to_clarity(), level1=94.0)[0])


def prepare_score(name: str, clean: Tensor, ear: Audiogram) -> Callable[..., Tensor]:
    """Prepare the clean speech, and return a function from an output (time,) to its score."""
    if name == "haspi":
        reference = HaspiReference(clean)
        return lambda output, **noise: reference.score(output, ear, **noise)
    reference_class = {"hasqi": HasqiReference, "haaqi": HaaqiReference}[name]
    return reference_class(clean, ear).score


def time_call(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a call, and its processor time in seconds."""
    start = time.process_time()
    return call(), time.process_time() - start


@torch.no_grad()
def main(folder: str, items: str = "24") -> None:
    torch.set_num_threads(1)
    clips, generator = (
        Clips(folder, sample_rate=RATE, seconds=3.0),
        torch.Generator().manual_seed(0),
    )
    for name in PYCLARITY:
        errors, ratios = {torch.float64: [], torch.float32: []}, []
        for index in range(int(items)):
            ear = Audiogram.standard(EARS[index % len(EARS)])
            clean = set_level(
                clips.draw(1, generator)[0], 50.0 + 30.0 * torch.rand((), generator=generator)
            )
            output = process(clean, index, ear, generator)
            expected, pyclarity_seconds = time_call(
                partial(pyclarity_score, name, clean, output, ear, index)
            )
            for dtype, values in errors.items():
                score = prepare_score(name, clean.to(dtype), ear)
                value, seeded_seconds = time_call(
                    partial(score, output.to(dtype), noise="seeded", seed=index)
                )
                values.append(abs(float(value) - expected))
            expected_seconds = time_call(partial(score, output))[1]  # in float32
            ratios.append(
                (pyclarity_seconds / seeded_seconds, pyclarity_seconds / expected_seconds)
            )
        for dtype, values in errors.items():
            print(
                f"{name}, {dtype}: error {np.median(values):.1e} median, {max(values):.1e} "
                f"worst of {len(values)}"
            )
        seeded, expected_noise = np.median(ratios, 0)
        print(
            f"{name}: {seeded:.1f} times pyclarity's speed seeded, {expected_noise:.1f} with "
            "expected noise (float32)"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
