"""Aids compared by a model of the auditory nerve: is the response closer to that of a normal ear?

    pip install brucezilany
    python docs/figures/auditory_nerve.py speech/valid noise/valid audiograms/valid.csv [EARS]

The model by Bruce, Erfani and Zilany (2018, Hearing Research 360) is independent of MSBG and HASPI.
Two thirds of each loss are assigned to outer hair cells, or as much as they can cause, and the rest
to inner hair cells (Bruce et al. 2003, JASA 113). For each ear, every aid processes 3 s of speech
at 65 dB SPL, clean and with 7.5 dB SNR. For the second in the middle, the mean firing rates of 16
places from 200 to 7000 Hz are compared with the response of a normal, unaided ear to the clean
speech. The measures are NSIM (Hines and Harte 2012, Speech Communication 54), where 1 means
equality, and the mean difference in spikes per second.
"""

import sys
from functools import cache

import brucezilany
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.signal import resample_poly
from scipy.stats import binomtest
from torch import nn

from compensators import NALR, WDRC, load_compensator
from hlsim import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.data.clips import Clips
from hlsim.data.mixing import mix
from hlsim.evaluation.items import read_ears

RATE = 16000  # Hz
MODEL_RATE = 100_000  # Hz
PLACES = np.geomspace(200.0, 7000.0, 16)  # Hz
FIBRES = {
    100.0: 0.61,
    4.0: 0.23,
    0.1: 0.16,
}  # shares of fibres by spontaneous rate (Liberman 1978, JASA 63)
COHC = np.linspace(1.0, 0.0, 21)
NORMAL_EAR = Audiogram.standard("NH")
Array = NDArray[np.float64]


def potential(sound: Array, place: float, cohc: float = 1.0, cihc: float = 1.0) -> Array:
    """Compute the potential of inner hair cells for a sound in pascals at 100 kHz."""
    stimulus = brucezilany.stimulus.Stimulus(
        sound.tolist(), MODEL_RATE, len(sound) / MODEL_RATE + 0.1
    )
    return np.array(brucezilany.inner_hair_cell(stimulus, cf=place, cohc=cohc, cihc=cihc))[
        : len(sound)
    ]


@cache
def outer_hair_cells_db(place: float) -> Array:
    """Compute the loss that each value of ``COHC`` causes at a place, for a soft tone.

    The response to such a tone is linear.
    """
    time = np.arange(MODEL_RATE // 4) / MODEL_RATE
    tone = 2e-5 * np.sqrt(2.0) * np.sin(2.0 * np.pi * place * time)
    potentials = np.array([potential(tone, place, cohc)[len(tone) // 2 :].std() for cohc in COHC])
    return np.maximum.accumulate(20.0 * np.log10(potentials[0] / potentials))


def neurogram(sound: Array, ear: Audiogram) -> Array:
    """Compute mean firing rates in windows of 12.8 ms.

    Shape: (time,) in pascals at 16 kHz -> (places, windows).
    """
    fast, window, rows = (
        resample_poly(sound, MODEL_RATE // 4000, RATE // 4000),
        np.hamming(1280),
        [],
    )
    losses = np.interp(np.log(PLACES), np.log(ear.frequencies), ear.levels).clip(0.0)
    for place, loss in zip(PLACES, losses, strict=True):
        outer = outer_hair_cells_db(place)
        cohc = float(np.interp(2.0 / 3.0 * loss, outer, COHC))
        cihc = 10.0 ** (-(loss - min(2.0 / 3.0 * loss, outer[-1])) / 20.0)
        voltage, rate = potential(fast, place, cohc, cihc).tolist(), np.zeros(len(fast))
        for spontaneous, share in FIBRES.items():
            driven = brucezilany.map_to_synapse(voltage, spontaneous, place, 1.0 / MODEL_RATE)
            settings = {"spontaneous_firing_rate": spontaneous, "noise": brucezilany.ONES}
            response = brucezilany.synapse(driven, place, 1, len(voltage), **settings)
            rate += share * response.mean_firing_rate
        rows.append(np.convolve(rate, window / window.sum(), "valid")[::640])
    return np.stack(rows)


def nsim(response: Array, normal: Array) -> float:
    """Compute NSIM: the similarity of levels and structure in windows of about three by three."""

    def blurred(values: Array) -> Array:
        return gaussian_filter(values, 0.5, truncate=2.0)

    level, shape = (0.01 * normal.max()) ** 2, 0.5 * (0.03 * normal.max()) ** 2
    a, b = blurred(response), blurred(normal)
    across = blurred(response * normal) - a * b
    spreads = np.sqrt(
        (blurred(response**2) - a**2).clip(0.0) * (blurred(normal**2) - b**2).clip(0.0)
    )
    similarity = (
        (2.0 * a * b + level) / (a**2 + b**2 + level) * (across + shape) / (spreads + shape)
    )
    return float(similarity.mean())


def main(speech: str, noise: str, audiograms: str, count: str = "32") -> None:
    ears, generator = read_ears(audiograms)[: int(count)], torch.Generator().manual_seed(0)
    aids: dict[str, nn.Module] = {"NAL-R": NALR(sample_rate=RATE), "WDRC": WDRC(sample_rate=RATE)}
    aids |= {name: load_compensator(name) for name in ("hearing-aid", "compensator-general")}
    clips = set_level(Clips(speech, sample_rate=RATE, seconds=3.0).draw(len(ears), generator), 65.0)
    noises = Clips(noise, sample_rate=RATE, seconds=3.0, repeat=True).draw(len(ears), generator)
    middle = slice(RATE, 2 * RATE)
    measures: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for number, (clean, masker, (name, ear)) in enumerate(
        zip(clips, noises, ears, strict=True), start=1
    ):
        normal = neurogram(clean[middle].double().numpy(), NORMAL_EAR)
        for scene, signal in (
            ("clean", clean),
            ("noisy", mix(clean, masker, 7.5, None)),
        ):
            outputs = {"unaided": signal} | {
                aid: module(signal, ear) for aid, module in aids.items()
            }
            outputs["NAL-R at the level of hearing-aid"] = set_level(
                outputs["NAL-R"], level_spl(outputs["hearing-aid"])
            )
            for aid, sound in outputs.items():
                response = neurogram(sound[middle].double().numpy(), ear)
                values = nsim(response, normal), float(np.abs(response - normal).mean())
                measures.setdefault((scene, aid), []).append(values)
        print(f"{number} of {len(ears)} ears: {name}", file=sys.stderr, flush=True)
    print(
        "| scene | aid | NSIM | closer than NAL-R | p (sign test) | difference (spikes/s) | "
        "closer than NAL-R | p (sign test) |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for (scene, aid), rows in measures.items():
        columns = []
        for column, sign in ((0, 1.0), (1, -1.0)):
            scores = np.array(rows)[:, column]
            nal_r_scores = np.array(measures[scene, "NAL-R"])[:, column]
            closer = int((sign * (scores - nal_r_scores) > 0.0).sum())
            p = f"{binomtest(closer, len(scores)).pvalue:.1g}"
            comparison = " | " if aid == "NAL-R" else f"{closer} of {len(scores)} | {p}"
            columns.append(f"{scores.mean():.3g} | {comparison}")
        print(f"| {scene} | {aid} | {' | '.join(columns)} |")


if __name__ == "__main__":
    with torch.no_grad():
        main(*sys.argv[1:])
