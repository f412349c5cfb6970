"""Processor time of the parts of HASPI and HASQI, for one output of 3 s on one thread.

    python docs/figures/score_parts.py [ROUNDS]

Each round scores one output for the ear N3, with the clean speech prepared and with noise of a new
seed, which both scores share. The second table has the shares of one pair of signals with nothing
prepared. The profile counts processor time.
"""

import cProfile
import pstats
import sys
import time

import torch

from hlsim import example_speech
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


def profile(rounds: int) -> dict[str, float]:
    """Return the seconds per round of each function of ``PARTS``."""
    clean = example_speech()[:48000]
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    output = clean + 0.01 * noise
    references = HaspiReference(clean), HasqiReference(clean, "N3")
    haspi, hasqi = references

    def score_both(seed: int) -> None:
        haspi.score(output, "N3", noise="seeded", seed=seed)
        hasqi.score(output, noise="seeded", seed=seed)

    score_both(0)  # designs the filters
    preparation = cProfile.Profile(time.process_time)
    scores = cProfile.Profile(time.process_time)
    for seed in range(1, rounds + 1):
        preparation.runcall(lambda: (HaspiReference(clean), HasqiReference(clean, "N3")))
        scores.runcall(score_both, seed)
    seconds = dict.fromkeys(PARTS, 0.0)
    for run, names in ((preparation, {"_prepare"}), (scores, PARTS.keys() - {"_prepare"})):
        for (path, _, name), (_, _, _, cumulative, _) in pstats.Stats(run).stats.items():
            if name in names and "hlsim/metrics" in path:
                seconds[name] += cumulative / rounds
    return seconds


def profile_pairs(rounds: int) -> list[dict[str, float]]:
    """Return the shares of ``PAIR_PARTS`` in HASPI, HASQI and HAAQI of a pair."""
    clean = example_speech()[:48000]
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    output = clean + 0.01 * noise
    shares = []
    # Noise that is drawn once comes from a store, so no seed is used twice.
    for first_seed, score in ((1000, haspi), (2000, hasqi), (3000, haaqi)):
        score(output, clean, "N3", noise="seeded", seed=first_seed)  # designs the filters
        run = cProfile.Profile(time.process_time)
        for seed in range(first_seed + 1, first_seed + rounds + 1):
            run.runcall(score, output, clean, "N3", noise="seeded", seed=seed)
        calls = pstats.Stats(run).stats.items()
        seconds = {name: cumulative for (_, _, name), (_, _, _, cumulative, _) in calls}
        total = max(seconds.values())
        shares.append({name: seconds.get(name, 0.0) / total for name in PAIR_PARTS})
    return shares


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


if __name__ == "__main__":
    main(*sys.argv[1:])
