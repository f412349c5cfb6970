"""HASPI and HASQI of hlsim against pyclarity's, under the same seed, and their speeds by turns on one thread:

    python examples/score_parity.py SPEECH [ITEMS]

Items of 3 s at 16 kHz, ears N1 to N6 and S1 to S3 in turn, 50 to 80 dB SPL; processed speech is clean, noisy (-5 to
20 dB), NAL-R, clipped, low-passed, or noisy with NAL-R. The clean speech is prepared beforehand.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from clarity.evaluator.haspi import haspi_v2
from clarity.evaluator.hasqi import hasqi_v2
from torch import Tensor

from compensators import NALR
from hlsim import Audiogram
from hlsim.calibration import set_level
from hlsim.metrics import HaspiReference, HasqiReference
from hlsim.training.clips import Clips

RATE = 16000
EARS = ("N1", "N2", "N3", "N4", "N5", "N6", "S1", "S2", "S3")


def processed(clean: Tensor, index: int, ear: Audiogram, generator: torch.Generator) -> Tensor:
    kind = ("clean", "noisy", "nal-r", "clipped", "low-passed", "noisy nal-r")[index % 6]
    noise = clean.norm() * torch.nn.functional.normalize(
        torch.randn(clean.shape, generator=generator), dim=-1
    )
    snr = 25.0 * torch.rand((), generator=generator) - 5.0
    given = clean + noise * 10.0 ** (-snr / 20.0) if "noisy" in kind else clean
    if kind == "clipped":
        limit = 0.25 * float(clean.abs().max())
        given = given.clamp(-limit, limit)
    if kind == "low-passed":
        spectrum = torch.fft.rfft(given)
        spectrum[..., 2000 * clean.shape[-1] // RATE :] = 0.0
        given = torch.fft.irfft(spectrum, clean.shape[-1])
    return NALR(ear, sample_rate=RATE)(given) if "nal-r" in kind else given


def pyclarity_score(name: str, clean: Tensor, output: Tensor, ear: Audiogram, seed: int) -> float:
    """pyclarity's score, with the seed of the noise that it draws from numpy's global generator."""
    score = {"haspi": haspi_v2, "hasqi": hasqi_v2}[name]
    signals = [signal.double().numpy() for signal in (clean, output)]
    np.random.seed(seed)
    return float(score(signals[0], RATE, signals[1], RATE, ear.to_clarity(), level1=94.0)[0])


def prepared(name: str, clean: Tensor, ear: Audiogram) -> Callable[..., Tensor]:
    """The score of processed speech, (time,) -> ()."""
    if name == "haspi":
        reference = HaspiReference(clean)
        return lambda given, **noise: reference.score(given, ear, **noise)
    return HasqiReference(clean, ear).score


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    return call(), time.process_time() - start


@torch.no_grad()
def main(folder: str, items: str = "24") -> None:
    torch.set_num_threads(1)
    clips, generator = (
        Clips(folder, sample_rate=RATE, seconds=3.0),
        torch.Generator().manual_seed(0),
    )
    for name in ("haspi", "hasqi"):
        errors, ratios = {torch.float64: [], torch.float32: []}, []
        for index in range(int(items)):
            ear = Audiogram.standard(EARS[index % len(EARS)])
            clean = set_level(
                clips.draw(1, generator)[0], 50.0 + 30.0 * torch.rand((), generator=generator)
            )
            given = processed(clean, index, ear, generator)
            expected, theirs = timed(partial(pyclarity_score, name, clean, given, ear, index))
            for dtype, found in errors.items():
                score = prepared(name, clean.to(dtype), ear)
                value, seeded = timed(partial(score, given.to(dtype), noise="seeded", seed=index))
                found.append(abs(float(value) - expected))
            ratios.append((theirs / seeded, theirs / timed(partial(score, given))[1]))  # float32
        for dtype, found in errors.items():
            print(
                f"{name}, {dtype}: error {np.median(found):.1e} median, {max(found):.1e} worst of {len(found)}"
            )
        seeded, expected_noise = np.median(ratios, 0)
        print(
            f"{name}: {seeded:.1f} times pyclarity's speed seeded, {expected_noise:.1f} with expected noise (float32)"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
