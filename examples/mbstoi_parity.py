"""MBSTOI of hlsim against pyclarity's, and their speeds by turns on one thread:

    python examples/mbstoi_parity.py SPEECH NOISE [PAIRS [RATE]]

Pairs of 3 s of a spherical head: speech from one direction, noise from another, -10 to 10 dB SNR at both ears together.
"""

import sys
import time
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from hlsim.metrics import mbstoi
from hlsim.training.clips import Clips

HEAD_SECONDS = 0.0875 / 343.0  # a radius of 8.75 cm, in the time that sound takes


def at_ears(signal: Tensor, azimuth: float, sample_rate: int) -> Tensor:
    """A signal from a direction in degrees, 0 in front and 90 on the right: delay and shadow of a sphere.

    Brown and Duda 1998, "A structural model for binaural sound synthesis", IEEE Trans. Speech Audio Process. 6(5).

    Shape: (time,) -> (2, time).
    """
    points = len(signal) + sample_rate // 100
    spectrum = torch.fft.rfft(signal, points)
    w = 2j * np.pi * torch.arange(len(spectrum), dtype=torch.float64) * sample_rate / points
    ears = []
    for ear in (-90.0, 90.0):
        angle = abs((azimuth - ear + 180.0) % 360.0 - 180.0)
        turned = np.deg2rad(angle)
        delay = HEAD_SECONDS * (
            1.0 - np.cos(turned) if angle < 90.0 else 1.0 + turned - np.pi / 2.0
        )
        treble = 1.05 + 0.95 * np.cos(turned * 180.0 / 150.0)
        shadow = (1.0 + 0.5 * treble * w * HEAD_SECONDS) / (1.0 + 0.5 * w * HEAD_SECONDS)
        ears.append(
            torch.fft.irfft(spectrum * shadow * torch.exp(-w * delay), points)[: len(signal)]
        )
    return torch.stack(ears)


def mixed(
    speech: Tensor, noise: Tensor, azimuths: tuple[float, float], snr: float, rate: int
) -> Tensor:
    """Clean and noisy speech at the ears, the SNR in dB. Shape: (time,) twice -> (2, 2, time)."""
    clean, masker = (at_ears(*each, rate) for each in zip((speech, noise), azimuths, strict=True))
    masker = masker * (clean.norm() / masker.norm() * 10.0 ** (-snr / 20.0))
    return torch.stack([clean, clean + masker])


def pairs(speech: str, noise: str, count: int, rate: int) -> Iterator[Tensor]:
    generator = torch.Generator().manual_seed(0)
    talkers = Clips(speech, sample_rate=rate, seconds=3.0, repeat=True)
    maskers = Clips(noise, sample_rate=rate, seconds=3.0, repeat=True)
    for _ in range(count):
        talker, masker = (clips.draw(1, generator)[0].double() for clips in (talkers, maskers))
        front = float(180.0 * torch.rand((), generator=generator) - 90.0)
        # 30 degrees away or more
        around = front + float(30.0 + 300.0 * torch.rand((), generator=generator))
        snr = float(20.0 * torch.rand((), generator=generator) - 10.0)
        yield mixed(talker, masker, (front, around), snr, rate)


@torch.no_grad()
def main(speech: str, noise: str, count: str = "50", rate: str = "16000") -> None:
    from clarity.evaluator.mbstoi import mbstoi as theirs

    torch.set_num_threads(1)  # and OMP_NUM_THREADS=1 for numpy
    warm = torch.randn(2, 2, 2 * int(rate), dtype=torch.float64)
    mbstoi(warm[0], warm[1], sample_rate=int(rate))
    scores, errors, single, ratios = [], [], [], []
    for clean, noisy in pairs(speech, noise, int(count), int(rate)):
        start = time.process_time()
        expected = float(theirs(*clean.numpy(), *noisy.numpy(), int(rate)))
        between = time.process_time()
        found = float(mbstoi(noisy, clean, sample_rate=int(rate)))
        ratios.append((between - start) / (time.process_time() - between))
        scores.append(expected)
        errors.append(abs(found - expected))
        single.append(
            abs(float(mbstoi(noisy.float(), clean.float(), sample_rate=int(rate))) - expected)
        )
    print(f"{rate} Hz, {count} pairs, scores {min(scores):.2f} to {max(scores):.2f}")
    for name, each in (("float64", errors), ("float32", single)):
        print(f"{name} signals: error {np.median(each):.1e} median, {max(each):.1e} worst")
    print(
        f"{np.median(ratios):.1f} times pyclarity's speed, {min(ratios):.1f} to {max(ratios):.1f}"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
