"""Processor time of the parts of HASPI, HASQI and HAAQI, on one thread.

    python docs/figures/score_parts.py [ROUNDS]

Each round scores one output of 3 s for the ear N3, with the clean speech prepared and with noise of
a new seed, which both scores share. The second table has the shares of one pair of signals with
nothing prepared, and the third table the ratio of pyclarity's processor time for such a pair to
that of hlsim, both in this process.
"""

import cProfile
import pstats
import statistics
import sys
import time
from functools import partial

import torch
from score_parity import pyclarity_score, time_call
from torch import Tensor

from hlsim import Audiogram, example_speech
from hlsim.metrics import HaspiReference, HasqiReference, haaqi, haspi, hasqi

PARTS = {
    "_prepare": "preparation of the clean speech, HASPI and HASQI together",
    "score": "both scores",
    "simulate_cochlea": "cochlea of the output, twice",
    "state_after_motion_noise": "counting of the noise, HASPI",
    "_threshold_noise": "drawing of the noise, HASQI",
    "align_channels": "alignment of channels",
    "segment_spectra": "spectra of segments",
    "nerve_levels": "adaptation of hair cells",
    "coherence": "coherence of segments",
    "align": "resampling and alignment of the output as a whole, twice",
}

PAIR_PARTS = {
    "simulate_cochlea": "cochlea of both signals",
    "nerve_levels": "adaptation of hair cells",
    "lag_spectrum": "spectra of the clean channels for their alignment",
    "align_channels": "alignment of channels",
    "smooth_frames": "frames of levels (HASPI)",
    "correlation": "correlation by rate of modulation (HASPI)",
    "segment_spectra": "spectra of segments (HASQI, HAAQI)",
    "coherence": "coherence of segments (HASQI, HAAQI)",
    "_draw_noise": "noise (HASPI)",
    "_threshold_noise": "noise (HASQI, HAAQI)",
}

NOISE_PARTS = ("_draw_noise", "_threshold_noise")
SCORES = {"haspi": haspi, "hasqi": hasqi, "haaqi": haaqi}
PAIR_SECONDS = (1.5, 3.0)
PAIR_ROUNDS = 5
EAR = "N3"


def make_pair(seconds: float) -> tuple[Tensor, Tensor]:
    """Return clean speech at 16 kHz and the same with faint noise. Shape: -> (time,) twice."""
    clean = example_speech()[8000 : 8000 + round(16000 * seconds)]
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    return clean, clean + 0.01 * noise


def profile(rounds: int) -> dict[str, float]:
    """Return the seconds per round of each function of ``PARTS``."""
    clean, output = make_pair(3.0)
    haspi_reference, hasqi_reference = HaspiReference(clean), HasqiReference(clean, EAR)

    def score_both(seed: int) -> None:
        haspi_reference.score(output, EAR, noise="seeded", seed=seed)
        hasqi_reference.score(output, noise="seeded", seed=seed)

    score_both(0)  # designs the filters
    preparation = cProfile.Profile(time.process_time)
    scores = cProfile.Profile(time.process_time)
    for seed in range(1, rounds + 1):
        preparation.runcall(lambda: (HaspiReference(clean), HasqiReference(clean, EAR)))
        scores.runcall(score_both, seed)
    seconds = dict.fromkeys(PARTS, 0.0)
    for run, names in ((preparation, {"_prepare"}), (scores, PARTS.keys() - {"_prepare"})):
        for (path, _, name), (_, _, _, cumulative, _) in pstats.Stats(run).stats.items():
            if name in names and "hlsim/metrics" in path:
                seconds[name] += cumulative / rounds
    return seconds


def profile_pairs(rounds: int) -> list[dict[str, float]]:
    """Return the shares of ``PAIR_PARTS`` in HASPI, HASQI and HAAQI of a pair."""
    clean, output = make_pair(3.0)
    shares = []
    # Noise that is drawn once comes from a store, so no seed is used twice.
    for first_seed, score in zip((1000, 2000, 3000), SCORES.values(), strict=True):
        score(output, clean, EAR, noise="seeded", seed=first_seed)  # designs the filters
        run = cProfile.Profile(time.process_time)
        for seed in range(first_seed + 1, first_seed + rounds + 1):
            run.runcall(score, output, clean, EAR, noise="seeded", seed=seed)
        calls = pstats.Stats(run).stats.items()
        seconds = {name: cumulative for (_, _, name), (_, _, _, cumulative, _) in calls}
        total = max(seconds.values())
        shares.append({name: seconds.get(name, 0.0) / total for name in PAIR_PARTS})
    return shares


def compare_pairs(name: str, seconds: float) -> list[float]:
    """Return the ratios of pyclarity's time to that of hlsim for a pair, one for each round.

    The time of hlsim is the median of three calls, each with noise of a new seed.
    """
    clean, output = make_pair(seconds)
    ear = Audiogram.standard(EAR)
    first_seed = round(1e5 * seconds)  # no seed of another table
    score = partial(SCORES[name], output, clean, ear, noise="seeded")
    score(seed=first_seed)  # designs the filters
    ratios = []
    for count in range(PAIR_ROUNDS):
        pyclarity = time_call(partial(pyclarity_score, name, clean, output, ear, count))[1]
        seeds = range(first_seed + 3 * count + 1, first_seed + 3 * count + 4)
        times = [time_call(partial(score, seed=seed))[1] for seed in seeds]
        ratios.append(pyclarity / statistics.median(times))
    return ratios


@torch.no_grad()
def main(rounds: str = "10") -> None:
    torch.set_num_threads(1)
    print("| part | processor time (ms) |\n|---|---|")
    for name, seconds in profile(int(rounds)).items():
        print(f"| {PARTS[name]} | {1000.0 * seconds:.0f} |")
    print("\n| share of the time (%) | HASPI | HASQI | HAAQI |\n|---|---|---|---|")
    scores = profile_pairs(int(rounds))
    for name, part in PAIR_PARTS.items():
        print("|", part, "|", " | ".join(f"{100.0 * shares[name]:.0f}" for shares in scores), "|")
    print("\n| times pyclarity's speed | 1.5 s | 3 s | 3 s, if noise took no time |")
    print("|---|---|---|---|")
    for name, shares in zip(SCORES, scores, strict=True):
        columns = []
        for seconds in PAIR_SECONDS:
            ratios = compare_pairs(name, seconds)
            median = statistics.median(ratios)
            columns.append(f"{median:.1f} ({min(ratios):.1f} to {max(ratios):.1f})")
        rest = 1.0 - sum(shares[part] for part in NOISE_PARTS)
        columns.append(f"{median / rest:.1f}")
        print(f"| {name.upper()} | {' | '.join(columns)} |")


if __name__ == "__main__":
    main(*sys.argv[1:])
