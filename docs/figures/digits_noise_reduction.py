"""Compare what noise reduction does to digits with what listeners understand of them.

    python docs/figures/digits_noise_reduction.py noise/valid [--listeners FOLDER ...]
        [--steady FOLDER]

The sounds are the digit triplets of ``hlsim srt`` in their steady noise, and in recorded noises
from the subfolders of a folder. The first table has the changes of the signal-to-noise ratio (SNR)
and of the digits' level by the noise reduction of ``hearing-aid``. Its gains are computed from the
mixture, and applied to the digits and to the noise alone. The second table has the share of digits
that listeners recognise without noise reduction behind the exact MSBG of four aided ears, and its
changes by noise reduction with 95 % intervals (bootstrap over triplets).

``--steady`` writes steady noise to a folder, from which examples/machine_listener.py can take it.
"""

import argparse
from pathlib import Path

import numpy as np
import soundfile
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from compensators import load_compensator
from compensators.filter_bank import DELAY, apply_gains
from hlsim import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.data.clips import Clips
from hlsim.evaluation.digits import load_listener
from hlsim.evaluation.digits.material import Triplets, draw_triplets, perceive, present
from hlsim.metrics.sii import SII_BANDS
from hlsim.simulators import load_simulator

Array = NDArray[np.float64]

RATE = 16000

NOISE_SPL = 65.0

EARS = ("N2", "N3", "N4", "S2")

SHARES = {"none": 0.0, "half": 0.5, "full": 1.0, "full, at equal level": 1.0}
"""Sliders of noise reduction. The last output has the level of that without noise reduction."""

SOUND_SNRS = (-8.0, 0.0, 5.0)
"""SNRs in dB at which sounds are measured."""

LISTENING_SNRS = (-10.0, -6.0)
"""SNRs in dB at which listeners are tested, around the thresholds of aided ears."""

AT_ONCE = 8
"""Number of triplets that are processed at once."""

DRAWS = 1000
"""Bootstrap samples of triplets."""


def draw_material(count: int, noise: Path) -> dict[str, Triplets]:
    """Draw triplets in steady noise, and the same ones in recorded noises, by name."""
    steady = draw_triplets(count, torch.Generator().manual_seed(0))
    kinds = sorted(path for path in noise.iterdir() if path.is_dir())
    generator = torch.Generator().manual_seed(1)
    seconds = steady.noise.shape[-1] / RATE
    pieces = [
        Clips(kind, sample_rate=RATE, seconds=seconds, repeat=True).draw(count, generator)
        for kind in kinds
    ]
    recorded = torch.stack([pieces[i % len(kinds)][i] for i in range(count)])
    recorded = recorded / recorded.square().mean(-1, keepdim=True).sqrt()
    return {"steady": steady, "recorded": steady._replace(noise=recorded)}


def write_steady_noise(folder: Path) -> None:
    """Write twelve pieces of steady noise to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    pieces = draw_triplets(12, torch.Generator().manual_seed(7)).noise
    for number, piece in enumerate(pieces.numpy()):
        soundfile.write(folder / f"{number:02d}.flac", 0.05 * piece, RATE)


def band_levels(signals: Tensor) -> Array:
    """Compute the levels of signals in third octaves in dB, (items, bands)."""
    powers = torch.fft.rfft(signals.double()).abs().square().numpy()
    hertz = np.fft.rfftfreq(signals.shape[-1], 1.0 / RATE)
    inside = [(hertz >= hz * 2.0 ** (-1 / 6)) & (hertz < hz * 2.0 ** (1 / 6)) for hz in SII_BANDS]
    return 10.0 * np.log10(powers @ np.stack(inside, -1))


def attenuate(signals: Tensor, attenuation: Tensor) -> Tensor:
    """Apply gains in dB of noise reduction to signals, whose output is 64 samples late.

    Shape: (items, time), (items, time / 64, bands) -> (items, time).
    """
    # As in the aid: two hops without a gain come first, and the last hop is not needed.
    gains = 10.0 ** (nn.functional.pad(attenuation, (0, 0, 2, -1)) / 20.0)
    return apply_gains(nn.functional.pad(signals, (2 * DELAY, 0)), gains - 1.0)


def measure_sounds(aid: nn.Module, triplets: Triplets, snr: float) -> list[str]:
    """Measure changes in dB by half and by full noise reduction, means over third octaves.

    Returns: Changes of the SNR by half and full noise reduction, and of the digits' level by both.
    """
    snrs = torch.full((len(triplets.digits),), snr)
    mixture = present(triplets, snrs, NOISE_SPL)
    silent = triplets._replace(speech=torch.zeros_like(triplets.speech))
    noise = present(silent, snrs, NOISE_SPL)
    parts = {"speech": mixture - noise, "noise": noise}
    attenuation = aid.attenuation(mixture)
    changes: dict[str, list[float]] = {"snr": [], "speech": []}
    for share in (0.5, 1.0):
        change = {}
        for name, part in parts.items():
            output = attenuate(part, share * attenuation)
            change[name] = float((band_levels(output) - band_levels(part)).mean())
        changes["snr"].append(change["speech"] - change["noise"])
        changes["speech"].append(change["speech"])
    return [f"{value:+.1f}" for values in changes.values() for value in values]


def count_right(
    aid: nn.Module, triplets: Triplets, snr: float, listeners: list[nn.Module]
) -> Array:
    """Return the share of right digits, mean over ears: (shares, listeners, triplets)."""
    simulator = load_simulator("msbg")
    signals = present(triplets, torch.full((len(triplets.digits),), snr), NOISE_SPL)
    right = np.zeros((len(SHARES), len(listeners), len(signals)))
    for name in EARS:
        ear = torch.tensor(Audiogram.standard(name).thresholds)
        for start in range(0, len(signals), AT_ONCE):
            part = slice(start, start + AT_ONCE)
            outputs = [aid(signals[part], ear, noise_reduction=x) for x in SHARES.values()]
            outputs[-1] = set_level(outputs[-1], level_spl(outputs[0]))
            for condition, output in enumerate(outputs):
                perceived = perceive(output, ear, simulator, triplets.internal[part])
                for number, listener in enumerate(listeners):
                    answers = listener(perceived).argmax(-1)
                    is_right = (answers == triplets.digits[part]).double().mean(-1)
                    right[condition, number, part] += is_right.numpy() / len(EARS)
    return right


def describe(values: Array) -> str:
    """Return a mean with its interval."""
    rng = np.random.default_rng(0)
    means = values[rng.integers(len(values), size=(DRAWS, len(values)))].mean(-1)
    low, high = np.quantile(means, [0.025, 0.975])
    return f"{values.mean():+.3f} [{low:+.3f}, {high:+.3f}]"


@torch.inference_mode()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("noise", type=Path, help="folder of noise with a subfolder for each kind")
    parser.add_argument("--listeners", nargs="+", default=["digit-listener"])
    parser.add_argument("--triplets", type=int, default=80)
    parser.add_argument("--steady", type=Path, help="folder to which steady noise is written")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.steady:
        write_steady_noise(options.steady)
    aid = load_compensator("hearing-aid")
    material = draw_material(options.triplets, options.noise)
    head = "noise | SNR (dB) | SNR, half | SNR, full | digits, half | digits, full"
    print(f"| {head} |\n|{'---|' * 6}")
    for noise, triplets in material.items():
        for snr in SOUND_SNRS:
            changes = measure_sounds(aid, triplets, snr)
            print(f"| {noise} | {snr:g} | {' | '.join(changes)} |", flush=True)

    listeners = [load_listener(name) for name in options.listeners]
    head = "noise | SNR (dB) | listener | " + " | ".join(SHARES)
    print(f"\n| {head} |\n|{'---|' * 7}")
    for noise, triplets in material.items():
        for snr in LISTENING_SNRS:
            right = count_right(aid, triplets, snr, listeners)
            for name, (none, *reduced) in zip(options.listeners, right.swapaxes(0, 1), strict=True):
                changes = [describe(share - none) for share in reduced]
                cells = [f"{none.mean():.3f}", *changes]
                print(f"| {noise} | {snr:g} | {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
