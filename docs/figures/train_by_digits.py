"""Train a hearing aid by the digits that a recogniser finds behind one or two simulated ears.

    python docs/figures/train_by_digits.py speech/train noise/train \\
        --audiograms audiograms/train.csv --simulators attenuation --seed 1 --out trained

It shows whether `hearing-aid` gives more words behind an ear that only attenuates, when it is
trained for such an ear. The loss is the cross entropy of the shipped `digit-listener`, mean of the
simulators, at the level of the untrained aid's output, so that no digits are won by amplification.
For speech in quiet, the levels in bands stay near those of the untrained aid. Half an hour on one
CPU thread. `machine_listener.py compare` judges the aid by words.
"""

import argparse
import copy
import time
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional
from train_by_recogniser import minimise

from compensators import HearingAid, load_compensator
from hlsim.audiogram.table import read_audiograms
from hlsim.audiogram.thresholds import as_thresholds
from hlsim.calibration import NEURO_RATE, level_spl, set_level
from hlsim.checkpoint import read_record
from hlsim.cli.options import count, seed
from hlsim.data.augment import draw_uniform
from hlsim.data.clips import Clips
from hlsim.data.ears import draw_thresholds
from hlsim.evaluation.digits.material import TRIPLET_SAMPLES, draw_triplets, perceive, present
from hlsim.evaluation.digits.recogniser import load_listener
from hlsim.metrics.band_levels import band_level_loss
from hlsim.simulators import load_simulator

BATCH = 8  # triplets per step
CLEAN_ITEMS = 4  # items of speech in quiet per step
SPEECH_SECONDS = 2.0
MEASURED_SHARE = 0.6  # share of the ears that are measured ones; the others are random
REAL_NOISE_SHARE = 0.5  # share of the triplets in recorded noise; the others have that of the test
SNRS = (-19.0, -5.0)  # dB, for an ear of 20 dB HL
SNR_PER_DB = 0.2  # rise of these ratios per dB of hearing loss
LEVELS = (55.0, 75.0)  # dB SPL
WEIGHTS = {"digits": 1.0, "level": 0.03, "clean_bands": 0.01}
LEARNING_RATE = 7e-4
REPORT_STEPS = 25


class Lessons:
    """Terms of the loss for random triplets, noises, levels and ears.

    Args:
        speech: Speech in quiet.
        noise: Recorded noise, as long as a triplet.
        measured_ears: Hearing thresholds in dB HL. Shape: (ears, 8).
        simulators: Names of simulators.
        untrained: The aid before the training.
    """

    def __init__(
        self,
        speech: Clips,
        noise: Clips,
        measured_ears: Tensor,
        simulators: Sequence[str],
        untrained: HearingAid,
    ) -> None:
        self.speech = speech
        self.noise = noise
        self.measured_ears = measured_ears
        self.simulators = [load_simulator(name) for name in simulators]
        self.untrained = untrained
        self.listener = load_listener()

    def loss_terms(self, aid: HearingAid, generator: torch.Generator) -> dict[str, Tensor]:
        """Return the terms of the loss of a step by name, each the mean of its items.

        - ``digits``: cross entropy of the digits in noise.
        - ``level``: by how many dB the level of the output differs from the untrained aid's.
        - ``clean_bands``: the same for levels in bands, of speech in quiet.
        """
        ears = self._draw_ears(generator)
        triplets = draw_triplets(BATCH, generator)
        recorded = self.noise.draw(BATCH, generator)
        recorded = recorded / recorded.square().mean(-1, keepdim=True).sqrt().clamp_min(1e-9)
        is_recorded = torch.rand(BATCH, 1, generator=generator) < REAL_NOISE_SHARE
        triplets = triplets._replace(noise=torch.where(is_recorded, recorded, triplets.noise))
        loss_db = (ears[:, 1:6].mean(-1) - 20.0).clamp(0.0, 125.0)
        snrs = draw_uniform(*SNRS, (BATCH,), generator) + SNR_PER_DB * loss_db
        sound = present(triplets, snrs, draw_uniform(*LEVELS, (BATCH,), generator))
        output = aid(sound, ears)
        clean_levels = draw_uniform(*LEVELS, (CLEAN_ITEMS,), generator)
        clean = set_level(self.speech.draw(CLEAN_ITEMS, generator), clean_levels)
        clean_ears = ears[:CLEAN_ITEMS]
        with torch.no_grad():
            untrained_level = level_spl(self.untrained(sound, ears))
            untrained_clean = self.untrained(clean, clean_ears)
        at_level = set_level(output, untrained_level)
        entropies = []
        for simulator in self.simulators:
            scores = self.listener(perceive(at_level, ears, simulator, triplets.internal))
            entropies.append(
                functional.cross_entropy(scores.flatten(0, 1), triplets.digits.flatten())
            )
        return {
            "digits": torch.stack(entropies).mean(),
            "level": (level_spl(output) - untrained_level).abs().mean(),
            "clean_bands": band_level_loss(
                aid(clean, clean_ears), untrained_clean, NEURO_RATE
            ).mean(),
        }

    def _draw_ears(self, generator: torch.Generator) -> Tensor:
        """Return thresholds of random and measured ears in dB HL. Shape: (BATCH, 8)."""
        rows = torch.randint(len(self.measured_ears), (BATCH,), generator=generator)
        is_measured = torch.rand(BATCH, 1, generator=generator) < MEASURED_SHARE
        random_ears = draw_thresholds(BATCH, generator)
        return torch.where(is_measured, self.measured_ears[rows], random_ears)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("speech", help="folder of training speech")
    parser.add_argument("noise", help="folder of training noise")
    parser.add_argument("--audiograms", required=True, help="CSV file of measured ears")
    parser.add_argument("--simulators", nargs="+", default=["msbg", "attenuation"])
    parser.add_argument("--start", default="hearing-aid", help="checkpoint that is trained further")
    parser.add_argument("--steps", type=count, default=450, help="number of training steps")
    parser.add_argument("--seed", type=seed, default=0, help="seed of all random numbers")
    parser.add_argument("--out", required=True, help="folder of the checkpoint that is written")
    options = parser.parse_args(arguments)
    start_time = time.monotonic()
    try:
        aid, start = load_compensator(options.start), read_record(options.start)
        table = read_audiograms(options.audiograms, simulated=True)
        speech = Clips(options.speech, sample_rate=NEURO_RATE, seconds=SPEECH_SECONDS)
        triplet_seconds = TRIPLET_SAMPLES / NEURO_RATE
        noise = Clips(options.noise, sample_rate=NEURO_RATE, seconds=triplet_seconds, repeat=True)
        ears = as_thresholds([ear for _, ear in table])
        untrained = copy.deepcopy(aid).eval().requires_grad_(False)
        lessons = Lessons(speech, noise, ears, options.simulators, untrained)
    except ValueError as error:
        parser.error(str(error))
    generator = torch.Generator().manual_seed(options.seed)
    draw_terms = partial(lessons.loss_terms, aid, generator)
    minimise(aid, draw_terms, WEIGHTS, LEARNING_RATE, options.steps, REPORT_STEPS)
    about = {
        "start_sha256": start["sha256"],
        "audiogram": None,
        "simulator": options.simulators,
        "recipe": {
            "speech": options.speech,
            "noise": options.noise,
            "audiograms": options.audiograms,
            "weights": WEIGHTS,
            "learning_rate": LEARNING_RATE,
            "seed": options.seed,
        },
        "steps": options.steps,
        "minutes": round((time.monotonic() - start_time) / 60.0, 1),
        "before": start["about"],
    }
    aid.save_pretrained(options.out, about=about)


if __name__ == "__main__":
    main()
