"""Training a Neuro-MSBG on targets that the exact MSBG makes as it goes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hlsim.audiogram import MILDER, Audiogram, draw_thresholds
from hlsim.calibration import set_level
from hlsim.checks import refuse_other_kinds, refuse_seed, refuse_unknown, refuse_weights
from hlsim.criteria.paper import paper_parts, weighted_sum
from hlsim.criteria.waveform import log_spectral_distance_db, noise_to_signal_db
from hlsim.data.augment import mix, vary
from hlsim.data.clips import Clips
from hlsim.data.sounds import draw_sounds
from hlsim.msbg import MSBG
from hlsim.neuro import NeuroConfig, NeuroMSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.pretrained import SIMULATOR, load_pretrained, save_checkpoint
from hlsim.training.averaging import average_of
from hlsim.training.beginning import start_identity, started
from hlsim.training.loop import TimedModule, run
from hlsim.training.sources import TrainingData, read_thresholds
from hlsim.training.state import CHECKPOINT

PRECISIONS = {"float32": None, "bfloat16": torch.bfloat16}

CRITERIA = ("complex", "log_spectrum", "magnitude", "phase", "snr", "time")


@dataclass(frozen=True)
class SimulatorRecipe:
    """What a training of a simulator is made of; a YAML file holds the same names.

    Attributes:
        model: settings of ``NeuroConfig``.
        start: checkpoint whose weights to start from, a name or a folder; its settings are the model's. It is
            also what is kept until the training gives a better one. Without it they are random.
        batch: clips a step.
        seconds: length of a clip.
        learning_rate: of AdamW at its highest.
        weights: of the criteria: ``snr`` (dB / 10), ``log_spectrum`` (dB / 10) and the paper's ``magnitude``, ``phase``,
            ``complex``, ``time``.
        unit_power: the signal that is scaled to unit power before the criteria, and all others with it: ``truth``, so
            that quiet items count as much as loud ones, or ``input``, as in MP-SENet. The paper's criteria on a network
            without a prior want the latter: a severe ear's first errors are 50 dB above its truth, and the network learns
            to be silent.
        levels: lowest and highest level in dB SPL, before amplification.
        sounds: share of clips that are tones or clicks instead of speech, 0 to 1; 0 with a manifest.
        treated: whether clips are equalised, amplified and compressed at random, as compensators do.
        precision: ``float32``, or ``bfloat16`` for the network's own layers: several times faster where the hardware has
            matrix units for it. Transforms, physics, scans and criteria stay in float32.
        average: weight of the past in the running average of the weights; the average is validated and kept. 0 for none.
        validate_every: steps.
        validation_items: how many.
        seed: of every random draw.
    """

    model: dict[str, Any] = field(default_factory=dict)
    start: str = ""
    batch: int = 6
    seconds: float = 1.3
    learning_rate: float = 1e-3
    weights: dict[str, float] = field(default_factory=lambda: {"snr": 1.0, "log_spectrum": 0.5})
    unit_power: str = "truth"
    levels: tuple[float, float] = (40.0, 95.0)
    sounds: float = 0.0
    treated: bool = True
    precision: str = "float32"
    average: float = 0.99
    validate_every: int = 200
    validation_items: int = 48
    seed: int = 0

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> SimulatorRecipe:
        """Raises ValueError where a name is unknown or a value is not allowed."""
        refuse_unknown(data, (entry.name for entry in fields(cls)), "settings", "in the recipe")
        return cls(**data)

    def __post_init__(self) -> None:
        refuse_other_kinds(self, "in the recipe")
        refuse_weights(self.weights, CRITERIA, "in the recipe")
        object.__setattr__(self, "levels", tuple(self.levels))
        counts = (self.batch, self.validate_every, self.validation_items)
        if min(counts) < 1 or self.seconds <= 0.0 or self.learning_rate <= 0.0:
            raise ValueError(
                f"batch {self.batch}, validate_every {self.validate_every}, validation_items {self.validation_items}, "
                f"seconds {self.seconds}, learning_rate {self.learning_rate} in the recipe; allowed: counts from 1 up, "
                "seconds and learning_rate above 0"
            )
        refuse_seed(self.seed, "in the recipe")
        if self.unit_power not in ("truth", "input"):
            raise ValueError(f"unit_power {self.unit_power!r} in the recipe; allowed: truth or input")
        if not 0.0 <= self.sounds <= 1.0:
            raise ValueError(f"sounds {self.sounds} in the recipe; allowed: from 0 to 1")
        if self.precision not in PRECISIONS or not 0.0 <= self.average < 1.0:
            raise ValueError(
                f"precision {self.precision!r}, average {self.average} in the recipe; allowed: "
                f"{' or '.join(PRECISIONS)}, and from 0 to below 1"
            )


class SimulatorTraining(TimedModule):
    """Draws speech, noise, ears and levels, asks the exact MSBG what is heard, and teaches it to the network."""

    def __init__(self, recipe: SimulatorRecipe, data: TrainingData, max_minutes: float) -> None:
        super().__init__(recipe.learning_rate, max_minutes, recipe.seed)
        torch.manual_seed(recipe.seed)
        self.recipe = recipe
        self.student = started(recipe.start, recipe.model, NeuroConfig, NeuroMSBG, load_pretrained)
        self.student.autocast_dtype = PRECISIONS[recipe.precision]
        self.kept = average_of(self.student, recipe.average)
        self.teacher = MSBG(sample_rate=NEURO_RATE)
        self.truths: list[Tensor] = []
        self.sound_batches = 0  # the last of those to validate on
        self.take(data)

    def take(self, data: TrainingData) -> None:
        """Open what there is to train and validate on."""
        recipe = self.recipe
        options: dict[str, Any] = {"sample_rate": NEURO_RATE, "seconds": recipe.seconds}
        self.speech = Clips(data.speech, **options)
        self.noise = Clips(data.noise, repeat=True, **options) if data.noise else None
        self.ears = read_thresholds(data.audiograms)
        sounds = sound_set(recipe) if recipe.sounds else []
        self.valid, self.sound_batches = [*validation_set(data, recipe), *sounds], len(sounds)

    def training_loss(self, generator: torch.Generator) -> Tensor:
        count = self.recipe.batch
        ears = draw_thresholds(count, generator)
        if self.ears is not None:
            measured = self.ears[torch.randint(len(self.ears), (count,), generator=generator)]
            measured = measured + 10.0 * torch.rand(count, 1, generator=generator) - 5.0
            keep = torch.rand(count, 1, generator=generator) < 0.4
            ears = torch.where(keep, measured.clamp(-10.0, 100.0), ears)
        noise = self.noise.draw(count, generator) if self.noise is not None else None
        clips = self.speech.draw(count, generator)
        if self.recipe.sounds:
            others = draw_sounds(count, clips.shape[-1], NEURO_RATE, generator)
            clips = torch.where(torch.rand(count, 1, generator=generator) < self.recipe.sounds, others, clips)
        signal = vary(
            clips,
            noise,
            ears,
            NEURO_RATE,
            generator,
            levels=self.recipe.levels,
            treated=self.recipe.treated,
        ).to(self.device)
        ears = ears.to(self.device)
        with torch.no_grad():
            truth = self.teacher(signal, ears)
        return self.loss_on(signal, ears, truth)

    def loss_on(self, signal: Tensor, ears: Tensor, truth: Tensor) -> Tensor:
        """Of the network on signals, given what is heard. Shape: (items, time), (items, 8), (items, time) -> ()."""
        heard = self.student(signal, ears)
        unit = truth if self.recipe.unit_power == "truth" else signal
        scale = unit.square().mean(-1, keepdim=True).add(1e-18).rsqrt()
        truth, heard = truth * scale, heard * scale
        weights = self.recipe.weights
        parts = {"snr": noise_to_signal_db(heard, truth) / 10.0}
        self.log("snr", -10.0 * parts["snr"].mean(), prog_bar=True)
        if weights.get("log_spectrum"):
            parts["log_spectrum"] = log_spectral_distance_db(heard, truth) / 10.0
        if set(weights) - {"snr", "log_spectrum"}:
            parts |= paper_parts(heard, truth)
        return weighted_sum(parts, weights).mean()

    def validate(self) -> dict[str, float]:
        """Median and worst tenth of the SNR in dB over the validation items, and of sounds where it trains on them.

        They score by their share of the training.
        """
        values = []
        with torch.no_grad():
            for number, (signal, ears) in enumerate(self.valid):
                signal, ears = signal.to(self.device), ears.to(self.device)
                values.append(-noise_to_signal_db(self.kept.module(signal, ears), self.truth(number)))
        figures: dict[str, float] = {}
        score = 0.0
        speech, share = len(values) - self.sound_batches, self.recipe.sounds
        for name, kind, part in (("", values[:speech], 1.0 - share), ("_sounds", values[speech:], share)):
            if kind:
                snr = torch.cat(kind)
                median, low = float(snr.median()), float(snr.quantile(0.1))
                figures |= {f"valid{name}_snr_median": median, f"valid{name}_snr_worst_tenth": low}
                score += part * (median + 0.5 * low)
        return {"score": score, **figures}

    def examples(self) -> dict[str, Tensor]:
        signal, ears = (tensor[-1:].to(self.device) for tensor in self.valid[0])
        heard = self.kept.module(signal, ears)
        return {"given": signal[0], "heard/truth": self.truth(0)[-1], "heard/network": heard[0]}

    def truth(self, number: int) -> Tensor:
        """What is heard of a batch of validation items, asked for once and in order. Shape: -> (items, time)."""
        if number == len(self.truths):
            signal, ears = (tensor.to(self.device) for tensor in self.valid[number])
            with torch.no_grad():
                self.truths.append(self.teacher(signal, ears))
        return self.truths[number].to(self.device)

    def identity(self, data: Any) -> dict[str, str]:
        """What the training is on, by name: with anything else it is another one."""
        own = {entry.name: str(getattr(data, entry.name)) for entry in fields(data) if entry.compare}
        return own | start_identity(self.recipe.start)

    def trained_parameters(self) -> list[torch.nn.Parameter]:
        return list(self.student.parameters())

    def on_train_batch_end(self, *arguments: Any) -> None:
        self.kept.update_parameters(self.student)


def validation_set(data: TrainingData, recipe: SimulatorRecipe) -> list[tuple[Tensor, Tensor]]:
    """Fixed items: every second one noisy (0 to 20 dB); measured, standard and drawn ears in turn.

    50 to 80 dB SPL, or the recipe's levels where it treats no clip.
    """
    generator = torch.Generator().manual_seed(1_000 + recipe.seed)
    options: dict[str, Any] = {"sample_rate": NEURO_RATE, "seconds": 2.0}
    valid = data.validation()
    speech = Clips(valid.speech, **options)
    noise = Clips(valid.noise, repeat=True, **options) if valid.noise else None
    measured = read_thresholds(valid.audiograms)
    standard = torch.tensor([Audiogram.standard(name).thresholds for name in MILDER])
    batches = []
    for _ in range(0, recipe.validation_items, 8):
        signal = speech.draw(8, generator)
        if noise is not None:
            noisy = mix(signal, noise.draw(8, generator), 20.0 * torch.rand(8, generator=generator))
            signal = torch.where((torch.arange(8) % 2 == 1).unsqueeze(-1), noisy, signal)
        signal = set_level(signal, _valid_levels(recipe, generator))
        ears = draw_thresholds(8, generator)
        ears[0:8:4] = standard[torch.randint(len(standard), (2,), generator=generator)]
        if measured is not None:
            ears[1:8:2] = measured[torch.randint(len(measured), (4,), generator=generator)]
        batches.append((signal, ears))
    return batches


def sound_set(recipe: SimulatorRecipe) -> list[tuple[Tensor, Tensor]]:
    """Fixed tones and clicks at the levels of ``validation_set``, a third as many items, for drawn ears."""
    generator = torch.Generator().manual_seed(2_000 + recipe.seed)
    batches = []
    for _ in range(0, recipe.validation_items, 24):
        signal = draw_sounds(8, 2 * NEURO_RATE, NEURO_RATE, generator)
        signal = set_level(signal, _valid_levels(recipe, generator))
        batches.append((signal, draw_thresholds(8, generator)))
    return batches


def _valid_levels(recipe: SimulatorRecipe, generator: torch.Generator) -> Tensor:
    """Levels in dB SPL of a batch to validate on. Shape: -> (8,)."""
    low, high = (50.0, 80.0) if recipe.treated else recipe.levels
    return low + (high - low) * torch.rand(8, generator=generator)


def train_simulator(
    data: Any,
    recipe: SimulatorRecipe,
    *,
    out: str | Path,
    max_minutes: float,
    max_steps: int = -1,
    accelerator: str = "auto",
    devices: int = 1,
    nodes: int = 1,
    strategy: str = "auto",
    report: Callable[[str], None] = print,
    progress: bool = True,
    kind: type[SimulatorTraining] = SimulatorTraining,
) -> Path:
    """Train, resume, and keep the best checkpoint.

    Args:
        data: a ``TrainingData``, or what another ``kind`` of training takes.

    Returns: the folder that ``load_pretrained`` takes, ``out/checkpoint``.

    Raises:
        ValueError: data or recipe that cannot be used; the message names them.
    """
    module = kind(recipe, data, max_minutes)
    folder = Path(out) / CHECKPOINT
    begun = start_identity(recipe.start)

    def write(figures: dict[str, Any]) -> None:
        from hlsim import __version__

        about = {"hlsim": __version__, "recipe": asdict(recipe), **begun, **figures}
        save_checkpoint(folder, SIMULATOR, module.kept.module, module.student.config.to_dict(), about)

    run(
        module,
        out=out,
        recipe=asdict(recipe) | {"max_minutes": max_minutes} | module.identity(data),
        write=write,
        validate_every=recipe.validate_every,
        begun=bool(recipe.start),
        max_steps=max_steps,
        accelerator=accelerator,
        devices=devices,
        nodes=nodes,
        strategy=strategy,
        report=report,
        progress=progress,
    )
    return folder
