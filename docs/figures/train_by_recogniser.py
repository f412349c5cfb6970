"""Train a hearing aid by the words that a recogniser finds in its output.

The main term of the loss is the negative log likelihood of the spoken words. Whisper computes it
from what machine_listener.py gives it: the aid's output in noise through the exact MSBG, which
simulates the impaired ear, with the ear's internal noise. The output is first scaled to the level
of the untrained aid's, so that no words are won by amplification. Other terms compare levels in
frequency bands and loudness with a normal ear's, and contain HASPI (see `loss_terms`).

It needs `pip install faster-whisper` and a folder with a Whisper model for CTranslate2 in float16
or float32 (model.bin, config.json, tokenizer.json, vocabulary.txt):

    python docs/figures/train_by_recogniser.py speech/train noise/train --model TINY \\
        --audiograms audiograms/train.csv --device cuda --out trained

A step of 32 clips needs 6 GB of memory. On a CPU, take smaller steps, such as `--batch 4`.

An aid is not to be judged by the recogniser that trained it. Judge it by another one, on other
speakers:

    python examples/machine_listener.py compare speech/valid noise/valid --model BASE \\
        --audiograms audiograms/valid.csv --aids hearing-aid ./trained nalr --out judged
"""

from __future__ import annotations

import argparse
import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from whisper_likelihood import TextLikelihood, read_weights

from compensators import HearingAid, load_compensator
from examples.machine_listener import PEAK, RATE, Whisper, agreed_text, internal_noise
from hlsim import MSBG
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.checkpoint import read_record
from hlsim.cli.options import count
from hlsim.data.augment import draw_uniform
from hlsim.data.clips import Clips
from hlsim.data.ears import draw_thresholds
from hlsim.data.mixing import mix
from hlsim.losses.score_loss import score_loss
from hlsim.metrics.band_levels import band_level_loss

SECONDS = 3.0  # duration of the clips
PADDING_SECONDS = 1  # silence after them, as the machine listener's inputs have whole seconds
LEVELS = (58.0, 72.0)  # lowest and highest level of clean speech in dB SPL
SNRS = (-3.0, 10.0)  # lowest and highest signal-to-noise ratio in dB
MEASURED_SHARE = 0.6  # share of the ears that are measured ones; the others are random
LOWEST_CLIP_LIKELIHOOD = -0.35  # mean log likelihood of the tokens of a clip without noise
SOFTENING = 0.02  # added to the probabilities of tokens, so that hopeless ones have little gradient
WEIGHTS = {
    "words": 1.0,
    "bands": 0.02,
    "level": 0.03,
    "clean_bands": 0.02,
    "clean_loudness": 0.05,
    "haspi": 0.5,
}
LEARNING_RATE = 1e-3
LAST_RATE = 0.01  # learning rate at the end, relative to the highest one
WARM_UP_STEPS = 40
REPORT_STEPS = 50


class TextClip(NamedTuple):
    """A clip of speech at 16 kHz, (time,), and the tokens of its text, (tokens,)."""

    speech: Tensor
    tokens: Tensor


class Batch(NamedTuple):
    """Items of a training step.

    Attributes:
        clean: Speech in pascals. Shape: (items, time).
        noisy: Speech with noise in pascals. Shape: (items, time).
        ears: Hearing thresholds in dB HL. Shape: (items, 8).
        tokens: Texts; padding is -1. Shape: (items, tokens).
        internal_noise: Internal noise of a normal ear in pascals. Shape: (items, time).
    """

    clean: Tensor
    noisy: Tensor
    ears: Tensor
    tokens: Tensor
    internal_noise: Tensor


def as_recogniser_input(waveform: Tensor) -> Tensor:
    """Scale sounds to a peak of 0.5, and add a second of silence. Shape: (items, time)."""
    scaled = waveform * (PEAK / waveform.detach().abs().amax(-1, keepdim=True))
    return functional.pad(scaled, (0, PADDING_SECONDS * RATE))


def draw_text_clips(
    speech: Clips,
    recogniser: Whisper,
    likelihood: TextLikelihood,
    count: int,
    generator: torch.Generator,
) -> list[TextClip]:
    """Draw clips in which the recogniser finds three or more words without noise.

    Clips of whose words it is not sure, by the mean log likelihood of their tokens, are left out.
    """
    clips: list[TextClip] = []
    while len(clips) < count:
        clip = speech.draw(1, generator)
        text = agreed_text(clip[0].numpy(), [recogniser])
        if text is not None:
            tokens = torch.tensor([recogniser.encode(f" {text}")])
            sound = as_recogniser_input(clip).to(likelihood.device)
            if likelihood(sound, tokens.to(likelihood.device)).mean() > LOWEST_CLIP_LIKELIHOOD:
                clips.append(TextClip(clip[0], tokens[0]))
    return clips


def draw_batches(
    clips: Sequence[TextClip],
    noise: Clips,
    measured_ears: Tensor,
    items: int,
    generator: torch.Generator,
) -> Iterator[Batch]:
    """Yield batches of random clips, levels, noise, ears and internal noise without end.

    Args:
        clips: Speech and its texts.
        noise: Noise, as long as the speech.
        measured_ears: Hearing thresholds in dB HL. Shape: (ears, 8).
        items: Number of items per batch.
        generator: Source of the random numbers.
    """
    while True:
        chosen = [clips[i] for i in torch.randint(len(clips), (items,), generator=generator)]
        levels = draw_uniform(*LEVELS, (items,), generator)
        clean = set_level(torch.stack([clip.speech for clip in chosen]), levels)
        snrs = draw_uniform(*SNRS, (items,), generator)
        noisy = mix(clean, noise.draw(items, generator), snrs, RATE)
        rows = torch.randint(len(measured_ears), (items,), generator=generator)
        is_measured = torch.rand(items, 1, generator=generator) < MEASURED_SHARE
        ears = torch.where(is_measured, measured_ears[rows], draw_thresholds(items, generator))
        tokens = [clip.tokens for clip in chosen]
        padded_tokens = nn.utils.rnn.pad_sequence(tokens, batch_first=True, padding_value=-1)
        seeds = torch.randint(1 << 30, (items,), generator=generator).tolist()
        internal = np.stack([internal_noise(clean.shape[-1], seed) for seed in seeds])
        yield Batch(clean, noisy, ears, padded_tokens, torch.from_numpy(internal))


def loss_terms(
    aid: HearingAid,
    untrained: HearingAid,
    batch: Batch,
    likelihood: TextLikelihood,
    simulator: MSBG,
) -> dict[str, Tensor]:
    """Return the terms of the loss by name, each for all or for some of the items.

    The first three are those of noisy speech, for all items. What the ear perceives is simulated
    for an output that is scaled to the level of the untrained aid's.

    - ``words``: negative log likelihood per token.
    - ``bands``: by how many dB the levels in bands of what the ear perceives differ from those of
      clean speech for a normal ear.
    - ``level``: by how many dB the level of the output differs from that of the untrained aid's.

    The others are those of outputs at the aid's own level.

    - ``clean_bands``: as ``bands``, of clean speech, for the first half of the items.
    - ``clean_loudness``: by how many dB the RMS level of what the ear perceives of clean speech
      differs from that for a normal ear, for the same items.
    - ``haspi``: 1 minus HASPI of the output in noise, for the last quarter of the items.
    """
    clean, noisy, ears, tokens, noise = batch
    output = aid(noisy, ears)
    with torch.no_grad():
        untrained_level = level_spl(untrained(noisy, ears))
        normal = simulator(clean, torch.zeros_like(ears))
    perceived = simulator(set_level(output, untrained_level), ears)
    likelihoods = likelihood(as_recogniser_input(perceived + noise), tokens).exp()
    logs = (likelihoods + SOFTENING).log()
    is_token = tokens >= 0

    half = slice(math.ceil(len(clean) / 2))
    perceived_clean = simulator(aid(clean[half], ears[half]), ears[half])
    quarter = slice(-math.ceil(len(clean) / 4), None)
    scored = output[quarter], clean[quarter], ears[quarter]
    ends = [clean.shape[-1]] * len(scored[0])
    return {
        "words": -(logs * is_token).sum(-1) / is_token.sum(-1),
        "bands": band_level_loss(perceived, normal, RATE),
        "level": (level_spl(output) - untrained_level).abs(),
        "clean_bands": band_level_loss(perceived_clean, normal[half], RATE),
        "clean_loudness": (level_spl(perceived_clean) - level_spl(normal[half])).abs(),
        "haspi": score_loss("haspi", *scored, ends, RATE),
    }


def relative_rate(step: int, steps: int) -> float:
    """Return a step's learning rate relative to the highest one: a warm-up, then half a cosine.

    >>> relative_rate(0, steps=100), relative_rate(50, steps=100)
    (0.025, 0.5)
    """
    cosine = 0.5 + 0.5 * math.cos(math.pi * step / steps)
    return min(1.0, (step + 1) / WARM_UP_STEPS) * max(LAST_RATE, cosine)


def train(
    aid: HearingAid, batches: Iterator[Batch], likelihood: TextLikelihood, steps: int
) -> None:
    """Train the amplification of an aid, and its noise reduction at the default slider.

    Training runs on the device of the likelihood, and prints the means of the loss's terms.
    """
    device = likelihood.device
    aid.to(device)
    untrained = copy.deepcopy(aid).eval().requires_grad_(False)
    simulator = MSBG(sample_rate=RATE).to(device)

    def draw_terms() -> dict[str, Tensor]:
        batch = Batch(*(tensor.to(device) for tensor in next(batches)))
        return loss_terms(aid, untrained, batch, likelihood, simulator)

    minimise(aid, draw_terms, WEIGHTS, LEARNING_RATE, steps, REPORT_STEPS)


def minimise(
    aid: HearingAid,
    draw_terms: Callable[[], dict[str, Tensor]],
    weights: dict[str, float],
    learning_rate: float,
    steps: int,
    report_steps: int,
) -> None:
    """Train all weights of an aid, and print the means of the loss's terms.

    Args:
        aid: Aid to train. Afterwards it is on the CPU and needs no gradient.
        draw_terms: Function that returns the terms of the loss for a new batch, by name, each of
            which is averaged.
        weights: Weight of each term.
        learning_rate: Highest learning rate, see ``relative_rate``.
        steps: Number of steps.
        report_steps: Number of steps after which the means are printed.
    """
    aid.train().requires_grad_(True)
    optimiser = torch.optim.AdamW(
        aid.parameters(), learning_rate, betas=(0.9, 0.98), weight_decay=0.0
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: relative_rate(step, steps))
    recent = []
    for step in range(1, steps + 1):
        means = {name: term.mean() for name, term in draw_terms().items()}
        loss: Tensor = sum(weight * means[name] for name, weight in weights.items())
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(aid.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        recent.append(torch.stack([*means.values()]).detach())
        if step % report_steps == 0 or step == steps:
            values = zip(means, torch.stack(recent).mean(0).tolist(), strict=True)
            report = ", ".join(f"{name} {value:.3f}" for name, value in values)
            print(f"step {step}: {report}", flush=True)
            recent.clear()
    aid.cpu().eval().requires_grad_(False)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("speech", help="folder of training speech in English")
    parser.add_argument("noise", help="folder of training noise")
    parser.add_argument("--audiograms", required=True, help="CSV file of measured ears")
    parser.add_argument("--model", required=True, help="folder of a Whisper model")
    parser.add_argument("--start", default="hearing-aid", help="checkpoint that is trained further")
    parser.add_argument("--clips", type=int, default=1500, help="number of clips of 3 s")
    parser.add_argument("--steps", type=count, default=950, help="number of training steps")
    parser.add_argument("--batch", type=int, default=32, help="number of items per step")
    parser.add_argument("--seed", type=int, default=3, help="seed of all random numbers")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--out", required=True, help="folder of the checkpoint that is written")
    options = parser.parse_args(arguments)
    start_time = time.monotonic()
    aid, start = load_compensator(options.start), read_record(options.start)
    recogniser = Whisper(options.model)
    weights = read_weights(recogniser.folder / "model.bin", options.device)
    mel_filters = recogniser.mel_filters.to(options.device)
    likelihood = TextLikelihood(weights, mel_filters, recogniser.prompt)
    speech = Clips(options.speech, sample_rate=RATE, seconds=SECONDS)
    noise = Clips(options.noise, sample_rate=RATE, seconds=SECONDS, repeat=True)
    ears = read_audiograms(options.audiograms, simulated=True)
    measured_ears = torch.tensor([ear.thresholds for _, ear in ears])
    generator = torch.Generator().manual_seed(options.seed)
    clips = draw_text_clips(speech, recogniser, likelihood, options.clips, generator)
    batches = draw_batches(clips, noise, measured_ears, options.batch, generator)
    train(aid, batches, likelihood, options.steps)
    about = {
        "start_sha256": start["sha256"],
        "audiogram": None,
        "simulator": "msbg",
        "recogniser": options.model,
        "recipe": {
            "speech": options.speech,
            "noise": options.noise,
            "audiograms": options.audiograms,
            "weights": WEIGHTS,
            "batch": options.batch,
            "seconds": SECONDS,
            "levels": LEVELS,
            "snr": SNRS,
            "learning_rate": LEARNING_RATE,
            "clips": options.clips,
            "seed": options.seed,
        },
        "steps": options.steps,
        "minutes": round((time.monotonic() - start_time) / 60.0, 1),
        "device": options.device,
        "before": start["about"],
    }
    aid.save_pretrained(options.out, about=about)


if __name__ == "__main__":
    main()
