"""Train the amplification of a hearing aid for steady tones, and keep it for speech and noise.

    python docs/figures/train_tones.py speech/train noise/train \\
        --audiograms audiograms/train.csv --start FOURTH --out FIFTH
    python docs/figures/train_tones.py speech/train noise/train \\
        --audiograms audiograms/train.csv --start FIFTH --seed 9 --tones 6000 --steps 2500 \\
        --out SIXTH

First, the exact MSBG finds the level of the output at which each of many random ears perceives a
tone as loud as a normal ear does. Then the correction of the aid's gains is trained towards these
levels. For speech, noise and clicks it is trained towards the gains that the aid had before.
"""

import argparse
import copy
import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from compensators import HearingAid, load_compensator
from compensators.filter_bank import HISTORY, frame_power
from hlsim import MSBG
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import NEURO_RATE, level_spl, set_level
from hlsim.checkpoint import read_record
from hlsim.data.augment import draw_uniform
from hlsim.data.clips import Clips
from hlsim.data.ears import draw_thresholds
from hlsim.data.mixing import mix
from hlsim.data.tones_and_clicks import draw_sounds

TONE_SAMPLES = NEURO_RATE // 4
TONE_LEVELS = (45.0, 85.0)  # dB SPL
TONE_HERTZ = (200.0, 7000.0)
HIGHEST_RMS_SPL = 106.0  # the limiter of the aid leaves peaks of 109 dB SPL nearly unchanged
SEARCH_STEPS = 8
STEEPEST_SLOPE = 6.0  # steeper growth of the perceived level counts as this, in dB per dB
TONES_AT_ONCE = 50
SECONDS = 1.0  # duration of the sounds for which the gains are kept
LEVELS = (35.0, 95.0)  # dB SPL of these sounds
SNRS = (-10.0, 30.0)  # dB
MEASURED_SHARE = 0.4  # share of the ears that are measured ones; the others are random
TONES_PER_STEP = 48
OTHERS_PER_STEP = 16
OTHER_GAIN_WEIGHT = 1.0  # of the mean square of changed gains in dB^2
TONE_GAIN_WEIGHT = 0.02  # the same for tones: it keeps the bands in which a tone has no power
LEARNING_RATE = 1e-3
REPORT_STEPS = 100


class Tones(NamedTuple):
    """Steady tones, ears, and the levels that the output should have.

    Attributes:
        sound: Tones in pascals at 16 kHz. Shape: (tones, TONE_SAMPLES).
        ears: Hearing thresholds in dB HL. Shape: (tones, 8).
        levels: Levels of the output in dB SPL. Shape: (tones,).
        slopes: Change of the perceived level in dB per dB of the output. Shape: (tones,).
    """

    sound: Tensor
    ears: Tensor
    levels: Tensor
    slopes: Tensor


def steady_level(sound: Tensor) -> Tensor:
    """Return the level of the second half in dB SPL. Shape: (items, time) -> (items,)."""
    return level_spl(sound[:, sound.shape[-1] // 2 :])


def draw_ears(measured: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw measured and random ears. Shape: (ears, 8) -> (count, 8)."""
    rows = torch.randint(len(measured), (count,), generator=generator)
    is_measured = torch.rand(count, 1, generator=generator) < MEASURED_SHARE
    return torch.where(is_measured, measured[rows], draw_thresholds(count, generator))


def draw_tones(count: int, generator: torch.Generator) -> Tensor:
    """Draw tones of random frequencies, phases and levels. Shape: () -> (count, TONE_SAMPLES)."""
    octaves = draw_uniform(*map(math.log2, TONE_HERTZ), (count, 1), generator)
    phases = draw_uniform(0.0, 2.0 * math.pi, (count, 1), generator)
    radians = 2.0 * math.pi * 2.0**octaves * torch.arange(TONE_SAMPLES) / NEURO_RATE
    return set_level(torch.sin(radians + phases), draw_uniform(*TONE_LEVELS, (count,), generator))


@torch.no_grad()
def find_levels(sound: Tensor, ears: Tensor, highest: Tensor) -> Tones:
    """Find the levels at which ears perceive tones as loud as a normal ear, by bisection.

    Args:
        sound: Tones in pascals at 16 kHz.
        ears: Hearing thresholds in dB HL.
        highest: Highest levels in dB SPL.

    Shape: (tones, TONE_SAMPLES), (tones, 8), (tones,).
    """
    simulator = MSBG(sample_rate=NEURO_RATE)
    normal = steady_level(simulator(sound, torch.zeros_like(ears)))
    lower, upper = steady_level(sound), highest
    for _ in range(SEARCH_STEPS):
        middle = (lower + upper) / 2.0
        perceived = steady_level(simulator(set_level(sound, middle), ears))
        is_soft = perceived < normal
        lower = torch.where(is_soft, middle, lower)
        upper = torch.where(is_soft, upper, middle)
    softer = steady_level(simulator(set_level(sound, lower - 1.0), ears))
    louder = steady_level(simulator(set_level(sound, upper + 1.0), ears))
    slopes = (louder - softer) / (upper - lower + 2.0)
    return Tones(sound, ears, (lower + upper) / 2.0, slopes.clamp(0.0, STEEPEST_SLOPE))


def draw_other_sounds(
    speech: Clips, noise: Clips, items: int, generator: torch.Generator
) -> Tensor:
    """Draw sounds for which the gains are kept. Shape: () -> (items, time).

    Three in eight are speech, as many are speech in noise, one is noise and one clicks.
    """
    part = items // 8
    clean, mixed = speech.draw(6 * part, generator).chunk(2)
    noises = noise.draw(4 * part, generator)
    snrs = draw_uniform(*SNRS, (3 * part,), generator)
    noisy = mix(mixed, noises[: 3 * part], snrs, NEURO_RATE)
    clicks = draw_sounds(2 * part, clean.shape[-1], generator)[1::2]
    sounds = torch.cat((clean, noisy, noises[3 * part :], clicks))
    return set_level(sounds, draw_uniform(*LEVELS, (items,), generator))


def compute_gains(aid: HearingAid, sound: Tensor, ears: Tensor) -> Tensor:
    """Return the gains of the amplification in dB. Shape: (items, time) -> (items, hops, bands)."""
    levels = aid._levels(frame_power(functional.pad(sound, (HISTORY, 0))))
    state = aid.initial_state(sound.new_zeros(len(sound), len(aid.SLIDERS)))
    return aid._amplification(levels[..., : aid.bands + 1], aid.fit(ears), state)[0]


def mean_square_change(aid: HearingAid, start: HearingAid, sound: Tensor, ears: Tensor) -> Tensor:
    """Return the mean square in dB^2 by which the gains of two aids differ."""
    with torch.no_grad():
        start_gains = compute_gains(start, sound, ears)
    return functional.mse_loss(compute_gains(aid, sound, ears), start_gains)


def train(
    aid: HearingAid,
    tones: Tones,
    speech: Clips,
    noise: Clips,
    measured: Tensor,
    steps: int,
    generator: torch.Generator,
) -> None:
    """Train the correction of an aid's gains, and print the means of the loss's terms."""
    start = copy.deepcopy(aid)
    aid.requires_grad_(False)
    aid.correct.requires_grad_(True)
    optimiser = torch.optim.AdamW(aid.correct.parameters(), LEARNING_RATE, weight_decay=0.0)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    recent = []
    for step in range(1, steps + 1):
        rows = torch.randint(len(tones.levels), (TONES_PER_STEP,), generator=generator)
        sound, ears, levels, slopes = (values[rows] for values in tones)
        errors = slopes * (steady_level(aid(sound, ears)) - levels)
        other_sounds = draw_other_sounds(speech, noise, OTHERS_PER_STEP, generator)
        other_ears = draw_ears(measured, OTHERS_PER_STEP, generator)
        terms = {
            "tones": functional.smooth_l1_loss(errors, torch.zeros_like(errors)),
            "other gains": mean_square_change(aid, start, other_sounds, other_ears),
            "tone gains": mean_square_change(aid, start, sound, ears),
        }
        loss = (
            terms["tones"]
            + OTHER_GAIN_WEIGHT * terms["other gains"]
            + TONE_GAIN_WEIGHT * terms["tone gains"]
        )
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(aid.correct.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        recent.append(torch.stack([*terms.values()]).detach())
        if step % REPORT_STEPS == 0 or step == steps:
            means = zip(terms, torch.stack(recent).mean(0).tolist(), strict=True)
            print(f"step {step}: {', '.join(f'{n} {v:.3f}' for n, v in means)}", flush=True)
            recent.clear()
    aid.requires_grad_(False)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("speech", help="folder of training speech")
    parser.add_argument("noise", help="folder of training noise")
    parser.add_argument("--audiograms", required=True, help="CSV file of measured ears")
    parser.add_argument("--start", default="hearing-aid", help="checkpoint that is trained further")
    parser.add_argument("--tones", type=int, default=4000, help="number of tones")
    parser.add_argument("--steps", type=int, default=2000, help="number of training steps")
    parser.add_argument("--seed", type=int, default=8, help="seed of all random numbers")
    parser.add_argument("--out", required=True, help="folder of the checkpoint that is written")
    options = parser.parse_args(arguments)
    start_time = time.monotonic()
    aid, start = load_compensator(options.start), read_record(options.start)
    settings = {"sample_rate": NEURO_RATE, "seconds": SECONDS}
    speech = Clips(options.speech, **settings)
    noise = Clips(options.noise, **settings, repeat=True)
    table = read_audiograms(options.audiograms, simulated=True)
    measured = torch.tensor([ear.thresholds for _, ear in table])
    generator = torch.Generator().manual_seed(options.seed)
    parts = []
    for done in range(0, options.tones, TONES_AT_ONCE):
        count = min(TONES_AT_ONCE, options.tones - done)
        sound = draw_tones(count, generator)
        ears = draw_ears(measured, count, generator)
        highest = (steady_level(sound) + aid.config.cap_db).clamp_max(HIGHEST_RMS_SPL)
        parts.append(find_levels(sound, ears, highest))
    tones = Tones(*map(torch.cat, zip(*parts, strict=True)))
    train(aid, tones, speech, noise, measured, options.steps, generator)
    about = {
        "start_sha256": start["sha256"],
        "audiogram": None,
        "simulator": "msbg",
        "trained": "correction of the gains, towards normal loudness of steady tones, and towards "
        "the gains of the start for speech, noise and clicks",
        "recipe": {
            "speech": options.speech,
            "noise": options.noise,
            "audiograms": options.audiograms,
            "tones": options.tones,
            "tones_per_step": TONES_PER_STEP,
            "others_per_step": OTHERS_PER_STEP,
            "learning_rate": LEARNING_RATE,
            "seed": options.seed,
        },
        "steps": options.steps,
        "minutes": round((time.monotonic() - start_time) / 60.0, 1),
        "device": "CPU",
        "before": start["about"],
    }
    aid.save_pretrained(options.out, about=about)


if __name__ == "__main__":
    main()
