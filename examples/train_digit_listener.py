"""Train the listener of the digits-in-noise test, ``checkpoints/digit-listener``.

    OMP_NUM_THREADS=1 python examples/train_digit_listener.py --ears audiograms/train.csv \
        --out runs/digit-listener

It takes about half an hour on one CPU thread. ``--ears`` is a table of measured ears. The listener
hears triplets of digits in noise through simulated ears, without an aid, with prescriptions that
are fitted to a slightly different ear, and with a noise reduction that knows the noise, with
errors. It gets no score, no shipped checkpoint of an aid and no result of a person.

``--aid hearing-aid --start FOLDER`` continues with a listener for whom half of the aided sounds
come from this aid, as somebody who has worn it for some time.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from compensators import load_compensator
from hlsim import read_audiograms
from hlsim.audiogram import HIGHEST_SIMULATED, LOWEST_LEVEL
from hlsim.audiogram.thresholds import as_thresholds
from hlsim.checkpoint import DIGIT_LISTENER, save_checkpoint
from hlsim.data.ears import draw_thresholds
from hlsim.dsp.stft import STFT
from hlsim.evaluation.digits.material import Triplets, draw_triplets, perceive, present
from hlsim.evaluation.digits.recogniser import DigitListener, load_listener
from hlsim.simulators import load_simulator
from hlsim.version import __version__

BATCH = 16
"""Triplets per step."""

SIMULATORS = {"msbg": 0.45, "msbg-unsmeared": 0.2, "attenuation": 0.35}
"""Share of the steps with each simulator."""

LEARNING_RATE = 2e-3

TEST_SPL = 65.0
"""Level of the noise in dB SPL in the test."""

WARM_UP = 100
"""Steps in which the signal-to-noise ratio falls from an easy one."""


class NoiseReduction:
    """Wiener filter that knows speech and noise, with errors, in frames of 16 ms.

    It stands for any noise reduction. Its largest attenuation, 4 to 16 dB, and the size of its
    errors, up to 10 dB, are drawn per triplet.
    """

    def __init__(self) -> None:
        self.stft = STFT(fft=256, window=256, hop=64)

    def __call__(self, signals: Tensor, noise: Tensor, generator: torch.Generator) -> Tensor:
        spectrum, noise_spectrum = self.stft.analyse(signals), self.stft.analyse(noise)
        speech_power = (spectrum - noise_spectrum).abs().square() + 1e-12
        noise_power = noise_spectrum.abs().square().mean(1, keepdim=True) + 1e-12
        strength = torch.rand(2, len(signals), 1, 1, generator=generator)
        errors_db = 10.0 * strength[0] * torch.randn(speech_power.shape, generator=generator)
        snr = speech_power / noise_power * 10.0 ** (errors_db / 10.0)
        lowest_gain = 10.0 ** (-(4.0 + 12.0 * strength[1]) / 20.0)
        gain = (snr / (1.0 + snr)).clamp_min(lowest_gain)
        return self.stft.synthesise(spectrum * gain, signals.shape[-1])


class Lessons:
    """Perceived triplets for training, from ears, simulators and aids that are drawn at random.

    Args:
        measured: Measured ears in dB HL, (ears, 8).
        aid: Name of an aid from which half of the aided sounds come; None for none.
    """

    def __init__(self, measured: Tensor, aid: str | None) -> None:
        self.measured = measured
        self.simulators = [load_simulator(name) for name in SIMULATORS]
        self.prescriptions = [load_compensator(name) for name in ("nalr", "wdrc")]
        self.aid = load_compensator(aid) if aid else None
        self.reduce_noise = NoiseReduction()

    @torch.no_grad()
    def draw(self, easier_db: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw a batch of perceived triplets, (items, time), and their digits, (items, 3).

        Args:
            easier_db: Increase of all signal-to-noise ratios in dB.
            generator: Source of the random numbers.
        """
        ears = self._draw_ears(generator)
        triplets = draw_triplets(BATCH, generator)
        chance = torch.rand(4, generator=generator).tolist()
        is_aided = chance[0] < 0.5
        # An aid restores a part of what the loss takes.
        per_db = 0.2 if is_aided else 0.35
        loss_db = (per_db * (ears[:, 1:6].mean(-1) - 20.0)).clamp(0.0, 25.0)
        span = torch.rand(BATCH, generator=generator)
        snr = -17.0 + 20.0 * span + loss_db + easier_db
        is_test_level = torch.rand(BATCH, generator=generator) < 0.5
        levels = 50.0 + 30.0 * torch.rand(BATCH, generator=generator)
        noise_spl = torch.where(is_test_level, torch.tensor(TEST_SPL), levels)
        signals = present(triplets, snr, noise_spl)
        if is_aided:
            signals = self._process(signals, triplets, noise_spl, ears, chance[1:], generator)
        weights = torch.tensor([*SIMULATORS.values()])
        simulator = self.simulators[int(torch.multinomial(weights, 1, generator=generator))]
        return perceive(signals, ears, simulator, triplets.internal), triplets.digits

    def _draw_ears(self, generator: torch.Generator) -> Tensor:
        """Draw ears: half are measured, a fifth have no loss, and the others are random."""
        index = torch.randint(len(self.measured), (BATCH,), generator=generator)
        kind = torch.rand(BATCH, 1, generator=generator)
        drawn = draw_thresholds(BATCH, generator)
        ears = torch.where(kind < 0.5, self.measured[index], drawn)
        return torch.where(kind > 0.8, 0.0, ears)

    def _process(
        self,
        signals: Tensor,
        triplets: Triplets,
        noise_spl: Tensor,
        ears: Tensor,
        chance: Sequence[float],
        generator: torch.Generator,
    ) -> Tensor:
        """Process noisy triplets by a random aid.

        Args:
            signals: Noisy triplets in pascals.
            triplets: Their digits and noises.
            noise_spl: Level of the noise in dB SPL per triplet.
            ears: Ears in dB HL.
            chance: Three random numbers from 0 to 1 that choose the aid.
            generator: Source of further random numbers.
        """
        if self.aid is not None and chance[0] < 0.5:
            return self.aid(signals, ears, noise_reduction=chance[1])
        if chance[1] < 0.5:
            silent = triplets._replace(speech=torch.zeros_like(triplets.speech))
            noise = present(silent, torch.zeros(BATCH), noise_spl)
            signals = self.reduce_noise(signals, noise, generator)
        tilt = 6.0 * torch.randn(BATCH, 2, generator=generator)
        fitted_for = ears + tilt[:, :1] + tilt[:, 1:] * torch.linspace(-1.0, 1.0, 8)
        prescription = self.prescriptions[int(chance[2] < 0.5)]
        return prescription(signals, fitted_for.clamp(LOWEST_LEVEL, HIGHEST_SIMULATED))


def train(
    listener: DigitListener, lessons: Lessons, steps: int, seed: int, learning_rate: float
) -> float:
    """Train a listener, and return the share of digits that it recognised in the last steps."""
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.AdamW(listener.parameters(), learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, learning_rate, total_steps=steps)
    start, shares = time.time(), []
    listener.train()
    for step in range(steps):
        perceived, digits = lessons.draw(12.0 * max(0.0, 1.0 - step / WARM_UP), generator)
        scores = listener(perceived).flatten(0, 1)
        loss = nn.functional.cross_entropy(scores, digits.flatten())
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(listener.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        shares.append(float((scores.argmax(-1) == digits.flatten()).float().mean()))
        if step % 25 == 0:
            recent = sum(shares[-25:]) / len(shares[-25:])
            minutes = (time.time() - start) / 60.0
            print(f"step {step}: {recent:.3f} of the digits, {minutes:.1f} min", flush=True)
    return sum(shares[-100:]) / len(shares[-100:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ears", required=True, help="table of measured ears")
    parser.add_argument("--out", type=Path, required=True, help="folder of the checkpoint")
    parser.add_argument("--steps", type=int, default=700)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", help="checkpoint of the listener that is trained further")
    parser.add_argument("--aid", help="aid from which half of the aided sounds come")
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    measured = as_thresholds([ear for _, ear in read_audiograms(options.ears, simulated=True)])
    if options.start:
        listener = load_listener(options.start).requires_grad_(True)
    else:
        listener = DigitListener()
    learning_rate = LEARNING_RATE / (10.0 if options.start else 1.0)
    start = time.time()
    lessons = Lessons(measured, options.aid)
    share = train(listener, lessons, options.steps, options.seed, learning_rate)
    about = {
        "hlsim": __version__,
        "ears": f"{len(measured)} measured ears, ears without a loss, and random ears",
        "simulators": SIMULATORS,
        "aid": options.aid,
        "start": options.start,
        "steps": options.steps,
        "triplets_per_step": BATCH,
        "seed": options.seed,
        "minutes": round((time.time() - start) / 60.0, 1),
        "digits_recognised_at_the_end_of_training": round(share, 3),
    }
    save_checkpoint(options.out, DIGIT_LISTENER, listener.eval(), listener.config.to_dict(), about)


if __name__ == "__main__":
    main()
