"""Batches to train and validate on: drawn anew at every step from folders of audio, or from a prepared plan."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from hlsim.audio import find_audio
from hlsim.audiogram import Audiogram
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.data.module import Batch, BatchData, PlanData, Step, collate
from hlsim.data.teacher import Reference, Teacher
from hlsim.data.writing import Recipe
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.augment import KNOTS, augment_speech, equalise, mix
from hlsim.training.clips import Clips
from hlsim.training.ears import MILDER, draw_thresholds
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe, TrainingRecipe
from hlsim.training.sounds import draw_sounds

_VALID_SECONDS = 2.0
_VOICES = 4  # of babble, at most


@dataclass(frozen=True)
class TrainingData:
    """Folders and files to train and validate on. Speech is all that is needed, a folder or a list of files.

    Without ``valid_speech`` validation is on the training speech, and says nothing of other speakers; without the other
    two it takes training's noise and ears. Ears from the CSV files join the drawn ones.
    """

    speech: Path | Sequence[Path]
    noise: Path | None = None
    audiograms: Path | None = None
    valid_speech: Path | Sequence[Path] | None = None
    valid_noise: Path | None = None
    valid_audiograms: Path | None = None

    def validation(self) -> TrainingData:
        """The same, with what there is to validate on in the place of what there is to train on.

        Raises:
            ValueError: speech or noise to validate on is also trained on: the best checkpoint would be chosen on it.
        """
        for name in ("speech", "noise"):
            training, validation = getattr(self, name), getattr(self, f"valid_{name}")
            if not training or not validation:
                continue
            trained, validated = (
                {path.resolve() for path in _files(one)} for one in (training, validation)
            )
            if shared := len(trained & validated):
                raise ValueError(
                    f"{shared} of {len(validated)} files of the {name} to validate on are also trained on; give folders "
                    f"that share none, or no {name} to validate on"
                )
        speech, noise = self.valid_speech or self.speech, self.valid_noise or self.noise
        return TrainingData(speech, noise, self.valid_audiograms or self.audiograms)


def _files(source: Path | Sequence[Path]) -> Sequence[Path]:
    return find_audio(source) if isinstance(source, str | Path) else source


@dataclass(frozen=True)
class PlannedSource:
    """A prepared plan, or its ``manifest.csv``, to train and validate on, as ``PlanData`` takes it."""

    manifest: Path
    root: Path | None = None
    prepared: bool = False
    workers: int = field(default=1, compare=False)  # a run may go on with others


def identity_of(data: TrainingData | PlannedSource) -> dict[str, str]:
    """What a training on them is told from others by."""
    return {entry.name: str(getattr(data, entry.name)) for entry in fields(data) if entry.compare}


class DrawnBatches(Dataset[Batch]):
    """Random speech, noise and ears; a batch depends on seed, step and rank alone."""

    recipe: TrainingRecipe

    def __init__(self, recipe: TrainingRecipe, data: TrainingData) -> None:
        self.recipe, self.batch, self.seed = recipe, recipe.batch, recipe.seed
        options: dict[str, Any] = {"sample_rate": NEURO_RATE, "seconds": recipe.seconds}
        self.speech = Clips(data.speech, **options)
        self.noise = Clips(data.noise, repeat=True, **options) if data.noise else None
        self.ears: Tensor | None = None  # measured ones. Shape: (ears, 8) dB HL
        if data.audiograms is not None:
            measured = read_audiograms(data.audiograms, simulated=True)
            self.ears = torch.tensor([ear.thresholds for _, ear in measured])

    def __getitem__(self, step: Step) -> Batch:
        number = (self.seed * 1_000_003 + step.number) * 64 + step.rank
        return self.draw(
            self.batch, torch.Generator().manual_seed(number % 2**63)
        )  # which takes no more

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """``clean`` and ``signal`` (count, time) in pascals, ``thresholds`` (count, 8) dB HL."""
        raise NotImplementedError

    def join_measured(
        self, ears: Tensor, share: float, moved: float, generator: torch.Generator
    ) -> Tensor:
        """A share of the drawn ears, replaced by measured ones, where there are, moved by up to some dB either way."""
        if self.ears is None:
            return ears
        measured = self.ears[torch.randint(len(self.ears), (len(ears),), generator=generator)]
        if moved:
            measured = (
                measured + 2.0 * moved * torch.rand(len(ears), 1, generator=generator) - moved
            )
            measured = measured.clamp(-10.0, 100.0)
        return torch.where(torch.rand(len(ears), 1, generator=generator) < share, measured, ears)

    def join_sounds(self, clips: Tensor, generator: torch.Generator, begun: float = 0.0) -> Tensor:
        """The recipe's share of the clips, replaced by tones and clicks."""
        if not (share := self.recipe.sounds):
            return clips
        others = draw_sounds(len(clips), clips.shape[-1], NEURO_RATE, generator, begun)
        return torch.where(torch.rand(len(clips), 1, generator=generator) < share, others, clips)


class SimulatorBatches(DrawnBatches):
    """What a simulator is to hear: speech, noise, tones and clicks as compensators emit them, at any level."""

    recipe: SimulatorRecipe

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        ears = self.join_measured(draw_thresholds(count, generator), 0.4, 5.0, generator)
        noise = self.noise.draw(count, generator) if self.noise is not None else None
        clips = self.join_sounds(self.speech.draw(count, generator), generator)
        given = (clips, noise, ears, NEURO_RATE, generator)
        signal = augment_speech(*given, levels=self.recipe.levels, treated=self.recipe.treated)
        return {"clean": set_level(clips, level_spl(signal)), "signal": signal, "thresholds": ears}


class CompensatorBatches(DrawnBatches):
    """What a compensator is given: speech, clean or noisy, and the ears that it is for, ``ear`` or drawn ones."""

    recipe: CompensatorRecipe

    def __init__(
        self, recipe: CompensatorRecipe, data: TrainingData, ear: Audiogram | None
    ) -> None:
        super().__init__(recipe, data)
        self.ear = None if ear is None else torch.tensor(ear.thresholds)

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(count, *shape, generator=generator)

        def equalised(clips: Tensor) -> Tensor:
            changed = equalise(
                clips, uniform(-15.0, 15.0, len(KNOTS)), torch.tensor(KNOTS), NEURO_RATE
            )
            return torch.where(uniform(0.0, 1.0, 1) < self.recipe.equalised, changed, clips)

        voices = equalised(self.speech.draw(count, generator))
        # or a hearing aid learns that a tone is one only if it was silent before
        sounds = self.join_sounds(voices, generator, begun=1.0)
        signal = clean = set_level(sounds, uniform(*self.recipe.levels))
        if self.noise is not None:
            noise = equalised(self.noise.draw(count, generator))
            if self.recipe.babble:
                others = [voices.roll(apart, 0) for apart in range(1, min(count, _VOICES + 1))]
                babble = torch.stack([set_level(one, 65.0) for one in others]).sum(0)
                noise = torch.where(uniform(0.0, 1.0, 1) < self.recipe.babble, babble, noise)
            noisy = (uniform(0.0, 1.0, 1) < self.recipe.noisy) & (sounds == voices).all(
                -1, keepdim=True
            )
            signal = torch.where(noisy, mix(clean, noise, uniform(*self.recipe.snr)), clean)
        if self.ear is not None:
            ears = self.ear.expand(count, -1)
        else:
            ears = self.join_measured(draw_thresholds(count, generator), 0.5, 0.0, generator)
        batch = {"clean": clean, "signal": signal, "thresholds": ears}
        if self.recipe.unreduced:
            batch["noise_reduction"] = (uniform(0.0, 1.0) >= self.recipe.unreduced).to(clean.dtype)
        return batch


def simulator_data(
    data: TrainingData | PlannedSource, recipe: SimulatorRecipe, reference: Reference | None = None
) -> BatchData:
    """What a simulator is trained and validated on, with what is heard from the exact MSBG, or another reference.

    Raises ValueError of data that cannot be used; the message names it."""
    if isinstance(data, PlannedSource):
        return PlannedData(data, recipe, reference)
    training = SimulatorBatches(recipe, data)
    validation = [
        *speech_to_validate(data, recipe),
        *(sounds_to_validate(recipe) if recipe.sounds else []),
    ]
    return BatchData(training, validation, teacher=Teacher(NEURO_RATE, reference=reference))


def compensator_data(
    data: TrainingData, recipe: CompensatorRecipe, ear: Audiogram | None
) -> BatchData:
    """What a compensator for an ear, or else for all, is trained and validated on. Raises ValueError as
    ``simulator_data``, and where a recipe that trains noise reduction has no noise."""
    reducing = sorted(
        {"denoising", "intelligibility"} & {name for name, w in recipe.weights.items() if w}
    )
    if data.noise is None and (reducing or recipe.babble):
        raise ValueError(
            f"no noise, and the recipe's {reducing[0] if reducing else 'babble'} is for it; allowed: --noise DIR"
        )
    plain = replace(recipe, equalised=0.0, seconds=_VALID_SECONDS)
    valid = CompensatorBatches(plain, data.validation(), ear)
    generator = torch.Generator().manual_seed(2_000 + recipe.seed)
    validation = [valid.draw(4, generator) for _ in range(0, recipe.validation_items, 4)]
    return BatchData(CompensatorBatches(recipe, data, ear), validation)


def speech_to_validate(data: TrainingData, recipe: SimulatorRecipe) -> list[Batch]:
    """Fixed items: every second one noisy (0 to 20 dB); measured, standard and drawn ears in turn."""
    generator = torch.Generator().manual_seed(1_000 + recipe.seed)
    valid = SimulatorBatches(replace(recipe, seconds=_VALID_SECONDS), data.validation())
    standard = torch.tensor([Audiogram.standard(name).thresholds for name in MILDER])
    batches = []
    for _ in range(0, recipe.validation_items, 8):
        signal = valid.speech.draw(8, generator)
        if valid.noise is not None:
            noisy = mix(
                signal, valid.noise.draw(8, generator), 20.0 * torch.rand(8, generator=generator)
            )
            signal = torch.where((torch.arange(8) % 2 == 1).unsqueeze(-1), noisy, signal)
        signal = set_level(signal, _levels_to_validate(recipe, generator))
        ears = draw_thresholds(8, generator)
        ears[0:8:4] = standard[torch.randint(len(standard), (2,), generator=generator)]
        if valid.ears is not None:
            ears[1:8:2] = valid.ears[torch.randint(len(valid.ears), (4,), generator=generator)]
        batches.append({"signal": signal, "thresholds": ears})
    return batches


def sounds_to_validate(recipe: SimulatorRecipe) -> list[Batch]:
    """Fixed tones and clicks, marked with ``sounds``, a third as many items as of speech, for drawn ears."""
    generator = torch.Generator().manual_seed(2_000 + recipe.seed)
    batches = []
    for _ in range(0, recipe.validation_items, 24):
        signal = draw_sounds(8, round(_VALID_SECONDS * NEURO_RATE), NEURO_RATE, generator)
        signal = set_level(signal, _levels_to_validate(recipe, generator))
        batch = {"signal": signal, "thresholds": draw_thresholds(8, generator)}
        batches.append(batch | {"sounds": torch.ones(8, dtype=torch.bool)})
    return batches


def _levels_to_validate(recipe: SimulatorRecipe, generator: torch.Generator) -> Tensor:
    """50 to 80 dB SPL, or the recipe's levels where ``treated`` is off. Shape: -> (8,)."""
    low, high = (50.0, 80.0) if recipe.treated else recipe.levels
    return low + (high - low) * torch.rand(8, generator=generator)


class PlannedData(PlanData):
    """A plan's training split, validated on the middle 2 s of instances evenly spread over its validation split, or else
    over test's, or training's.

    What is prepared is heard as it lies on disk, in validation too, and needs no corpus.
    """

    def __init__(
        self, source: PlannedSource, recipe: SimulatorRecipe, reference: Reference | None = None
    ) -> None:
        if recipe.sounds:
            raise ValueError(f"sounds {recipe.sounds} in the recipe, with a manifest; allowed: 0")
        clips = {
            name: getattr(recipe, name)
            for name in ("batch", "seconds", "seed", "levels", "treated")
        }
        where = {name: getattr(source, name) for name in ("root", "prepared", "workers")}
        making = Recipe(reference=reference)
        super().__init__(source.manifest, recipe=making, **where, **clips)
        if self.plan.rate != NEURO_RATE:
            raise ValueError(
                f"{source.manifest}: prepared at {self.plan.rate} Hz; allowed: {NEURO_RATE}"
            )
        split = next(split for split in ("valid", "test", "train") if len(self.plan.indices(split)))
        if split != "valid":
            warnings.warn(
                f"the plan has no split 'valid': the best checkpoint is chosen on {split!r}, whose figures then say too "
                "much",
                stacklevel=2,
            )
        items = self.items(split)
        chosen = (
            torch.linspace(0, len(items) - 1, min(recipe.validation_items, len(items)))
            .round()
            .int()
        )
        samples = round(_VALID_SECONDS * NEURO_RATE)
        whole = [items[place] for place in chosen.tolist()]
        middle = [one.clip(max(0, (len(one.signal) - samples) // 2), samples) for one in whole]
        self.validation = [collate(middle[i : i + 8]) for i in range(0, len(middle), 8)]

    val_dataloader = BatchData.val_dataloader
