"""The hearing aid's noise reduction in noise, in babble, with a second talker and in a room.

    python docs/figures/noise_reduction.py speech/valid noise/valid audiograms/valid.csv [ITEMS]

For each scene, it prints wide-band PESQ and STOI for a normal ear without amplification, and HASPI
of the aid for measured ears with noise reduction on and off, at the output level of clean speech.
If RNNoise, DeepFilterNet3 and GTCRN are installed (examples/enhancers.py), they are compared with
the aid. Their look-ahead is 20 ms or more, that of the aid 4 ms.
"""

import math
import statistics
import sys
from collections.abc import Callable
from functools import partial

import torch
from pesq import PesqError, pesq
from pystoi import stoi
from scipy.signal import fftconvolve
from torch import Tensor

from compensators import load_compensator
from examples.enhancers import GTCRN, DeepFilterNet3, RNNoise
from hlsim import Audiogram
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.data.clips import Clips
from hlsim.data.mixing import mix
from hlsim.metrics import haspi

RATE, SECONDS, LEVEL = 16000, 3.0, 65.0


def room_response(generator: torch.Generator, reverberation: float = 0.5) -> Tensor:
    """Make an impulse response: the direct sound, and noise of equal energy that decays after 10
    ms.

    Args:
        generator: Source of the random numbers.
        reverberation: Time in seconds in which the noise decays by 60 dB.
    """
    time = torch.arange(round(reverberation * RATE)) / RATE
    tail = torch.randn(len(time), generator=generator) * 10.0 ** (-3.0 * time / reverberation)
    tail[: RATE // 100] = 0.0
    tail = tail / tail.square().sum().sqrt()
    tail[0] = 1.0
    return tail


def make_scenes(speech: str, noise: str, items: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Return the input and the clean speech of each scene by name, with shape (items, time)."""
    generator = torch.Generator().manual_seed(0)
    voices = Clips(speech, sample_rate=RATE, seconds=SECONDS)
    clean = set_level(voices.draw(items, generator), LEVEL)
    noises = Clips(noise, sample_rate=RATE, seconds=SECONDS, repeat=True).draw(items, generator)
    talkers = [set_level(voices.draw(items, generator), LEVEL) for _ in range(6)]
    snr = torch.tensor([2.5, 7.5, 12.5, 17.5])[torch.arange(items) % 4]
    reverberant = torch.from_numpy(
        fftconvolve(clean.numpy(), room_response(generator).numpy()[None], axes=-1)
    )
    return {
        "noise, 2.5 to 17.5 dB": (mix(clean, noises, snr, None), clean),
        "babble of six, 0 dB": (mix(clean, torch.stack(talkers).sum(0), 0.0, None), clean),
        "a second talker, 0 dB": (clean + talkers[0], clean),
        "a room of 0.5 s": (set_level(reverberant[:, : clean.shape[-1]], LEVEL), clean),
        "quiet": (clean, clean),
    }


def main() -> None:
    speech, noise, audiograms, *rest = sys.argv[1:]
    items = int(rest[0]) if rest else 40
    aid, normal = load_compensator("hearing-aid"), Audiogram.standard("NH")
    measured = [ear.thresholds for _, ear in read_audiograms(audiograms, simulated=True)]
    ears = torch.tensor([measured[i % len(measured)] for i in range(items)])
    enhancers: dict[str, Callable[[Tensor], Tensor]] = {
        "none": lambda signal: signal,
        "hearing-aid": lambda signal: aid(signal, normal, 1.0, 0.0),
    }
    for enhancer in (RNNoise, DeepFilterNet3, GTCRN):
        enhance = enhancer()
        try:
            enhance(torch.zeros(1, RATE), RATE)
        except ImportError as error:
            print(error, file=sys.stderr)
        else:
            enhancers[enhancer.__name__] = partial(enhance, sample_rate=RATE)
    print(
        "| scene | noise reduction | PESQ | STOI | HASPI | interval of the change "
        "|\n|---|---|---|---|---|---|"
    )
    for scene, (signal, clean) in make_scenes(speech, noise, items).items():
        level = level_spl(aid(clean, ears, 0.0))
        unenhanced_scores = None
        for name, reduce in enhancers.items():
            reduced = reduce(signal)
            pairs = list(zip(clean.numpy(), reduced.numpy(), strict=True))
            # PESQ is negative if it finds no utterance in the clip.
            ratings = [pesq(RATE, *pair, "wb", on_error=PesqError.RETURN_VALUES) for pair in pairs]
            quality = statistics.mean(value for value in ratings if value > 0.0)
            intelligible = sum(stoi(*pair, RATE) for pair in pairs) / items
            output = aid(signal, ears, 1.0) if name == "hearing-aid" else aid(reduced, ears, 0.0)
            scores = haspi(set_level(output, level), clean, ears)
            if unenhanced_scores is None:
                unenhanced_scores = scores
            change = scores - unenhanced_scores
            half_width = 1.96 * float(change.std()) / math.sqrt(items)
            interval = f"{float(change.mean()):+.3f} ± {half_width:.3f}" if name != "none" else ""
            print(
                f"| {scene} | {name} | {quality:.2f} | {intelligible:.3f} | "
                f"{float(scores.mean()):.3f} | {interval} |"
            )


if __name__ == "__main__":
    with torch.no_grad():
        main()
