"""MBSTOI of hlsim compared with that of pyclarity: errors, and speed on one thread.

    python docs/figures/mbstoi_parity.py SPEECH NOISE [PAIRS [RATE]]

The signals are 3 s of speech from one direction and noise from another, at the ears of a spherical
head, with -10 to 10 dB SNR over both ears.
"""

import sys
import time
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from hlsim.data.clips import Clips
from hlsim.metrics import mbstoi

HEAD_SECONDS = 0.0875 / 343.0  # time in which sound travels the radius of the head, 8.75 cm


def simulate_head(signal: Tensor, azimuth: float, sample_rate: int) -> Tensor:
    """Simulate the delay and the shadow of a spherical head.

    Args:
        signal: Sound with shape (time,).
        azimuth: Direction of the sound in degrees, 0 in front and 90 on the right.
        sample_rate: Sample rate in Hz.

    Returns:
        Sounds at the left and right ear with shape (2, time).

    Source: Brown and Duda 1998, "A structural model for binaural sound synthesis", IEEE Trans.
        Speech Audio Process. 6(5).
    """
    points = len(signal) + sample_rate // 100
    spectrum = torch.fft.rfft(signal, points)
    w = 2j * np.pi * torch.arange(len(spectrum), dtype=torch.float64) * sample_rate / points
    ears = []
    for ear in (-90.0, 90.0):
        angle = abs((azimuth - ear + 180.0) % 360.0 - 180.0)
        radians = np.deg2rad(angle)
        delay = HEAD_SECONDS * (
            1.0 - np.cos(radians) if angle < 90.0 else 1.0 + radians - np.pi / 2.0
        )
        treble = 1.05 + 0.95 * np.cos(radians * 180.0 / 150.0)
        shadow = (1.0 + 0.5 * treble * w * HEAD_SECONDS) / (1.0 + 0.5 * w * HEAD_SECONDS)
        ears.append(
            torch.fft.irfft(spectrum * shadow * torch.exp(-w * delay), points)[: len(signal)]
        )
    return torch.stack(ears)


def mix_at_ears(
    speech: Tensor, noise: Tensor, azimuths: tuple[float, float], snr: float, rate: int
) -> Tensor:
    """Return clean and noisy speech at both ears. Shape: (time,), (time,) -> (2, 2, time)."""
    clean = simulate_head(speech, azimuths[0], rate)
    masker = simulate_head(noise, azimuths[1], rate)
    masker = masker * (clean.norm() / masker.norm() * 10.0 ** (-snr / 20.0))
    return torch.stack([clean, clean + masker])


def draw_pairs(speech: str, noise: str, count: int, rate: int) -> Iterator[Tensor]:
    """Yield clean and noisy speech at both ears. Shape: -> (2, 2, time)."""
    generator = torch.Generator().manual_seed(0)
    talkers = Clips(speech, sample_rate=rate, seconds=3.0, repeat=True)
    maskers = Clips(noise, sample_rate=rate, seconds=3.0, repeat=True)
    for _ in range(count):
        talker, masker = (clips.draw(1, generator)[0].double() for clips in (talkers, maskers))
        speech_azimuth = float(180.0 * torch.rand((), generator=generator) - 90.0)
        # The noise is at least 30 degrees away from the speech.
        noise_azimuth = speech_azimuth + float(30.0 + 300.0 * torch.rand((), generator=generator))
        snr = float(20.0 * torch.rand((), generator=generator) - 10.0)
        yield mix_at_ears(talker, masker, (speech_azimuth, noise_azimuth), snr, rate)


@torch.no_grad()
def main(speech: str, noise: str, count: str = "50", rate: str = "16000") -> None:
    from clarity.evaluator.mbstoi import mbstoi as pyclarity_mbstoi

    torch.set_num_threads(1)  # NumPy requires OMP_NUM_THREADS=1 as well.
    warm_up = torch.randn(2, 2, 2 * int(rate), dtype=torch.float64)
    mbstoi(warm_up[0], warm_up[1], sample_rate=int(rate))
    scores, errors, single, ratios = [], [], [], []
    for clean, noisy in draw_pairs(speech, noise, int(count), int(rate)):
        start = time.process_time()
        expected = float(pyclarity_mbstoi(*clean.numpy(), *noisy.numpy(), int(rate)))
        middle = time.process_time()
        score = float(mbstoi(noisy, clean, sample_rate=int(rate)))
        ratios.append((middle - start) / (time.process_time() - middle))
        scores.append(expected)
        errors.append(abs(score - expected))
        single.append(
            abs(float(mbstoi(noisy.float(), clean.float(), sample_rate=int(rate))) - expected)
        )
    print(f"{rate} Hz, {count} pairs, scores {min(scores):.2f} to {max(scores):.2f}")
    for name, values in (("float64", errors), ("float32", single)):
        print(f"{name} signals: error {np.median(values):.1e} median, {max(values):.1e} worst")
    print(
        f"{np.median(ratios):.1f} times pyclarity's speed, {min(ratios):.1f} to {max(ratios):.1f}"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
