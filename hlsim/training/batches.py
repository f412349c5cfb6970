"""Batches for training and validation, drawn at random from speech, noise and ears."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from hlsim.audio import find_audio
from hlsim.audiogram import HIGHEST_SIMULATED, LOWEST_LEVEL, Audiogram
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.augment import (
    EQUALISER_FREQUENCIES,
    augment_speech,
    draw_uniform,
    equalise,
    mix,
)
from hlsim.training.clips import Clips, Source
from hlsim.training.corpora.manifest import SPLITS, read_manifest
from hlsim.training.data_module import Batch, BatchData, Step
from hlsim.training.ears import draw_thresholds
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe, TrainingRecipe
from hlsim.training.teacher import PluginTeacher, Teacher
from hlsim.training.tones_and_clicks import draw_sounds

_VALIDATION_SECONDS = 2.0
"""Duration of the clips for validation."""

_MAX_BABBLE_VOICES = 4
"""Largest number of voices in babble."""


@dataclass(frozen=True)
class TrainingData:
    """Files of speech, noise and ears for training and validation. Only speech is required.

    What is missing for validation is taken from training. Without ``valid_speech``, validation
    scores are therefore those of speakers that the network knows.

    Attributes:
        speech: Folder or files of clean speech, see ``Source``.
        noise: Folder or files of noise that is mixed in, or pairs of clean and noisy speech.
        audiograms: CSV file of measured ears, which are used in addition to random ones.
        valid_speech: Clean speech for validation, like ``speech``.
        valid_noise: Noise for validation, like ``noise``.
        valid_audiograms: CSV file of measured ears for validation.
        workers: Number of processes that draw batches, in addition to the one that trains.

    >>> data = TrainingData([Path("a.wav")], valid_speech=[Path("b.wav")])
    >>> [path.name for path in data.validation().speech]
    ['b.wav']
    """

    speech: Source
    noise: Source | None = None
    audiograms: Path | None = None
    valid_speech: Source | None = None
    valid_noise: Source | None = None
    valid_audiograms: Path | None = None
    workers: int = field(default=0, compare=False)

    @classmethod
    def from_manifest(
        cls, manifest: str | Path, root: str | Path | None = None, **attributes: Any
    ) -> TrainingData:
        """Return the training data of a manifest: its splits ``train`` and ``valid``.

        The difference between the manifest's noisy and clean speech is the noise, unless there is
        an attribute ``noise``.

        Args:
            manifest: CSV file, see ``read_manifest``.
            root: Folder to which its paths are relative; by default the folder of the manifest.
            attributes: Attributes of ``TrainingData`` other than ``speech``, such as ``noise`` or
                ``audiograms``, which replace what the manifest has.

        Raises:
            ValueError: The manifest is invalid, or has no training speech.
        """
        folder = Path(manifest).parent if root is None else Path(root)
        speech: dict[str, list[Path]] = {split: [] for split in SPLITS}
        pairs: dict[str, list[tuple[Path, Path]]] = {split: [] for split in SPLITS}
        for row in read_manifest(manifest, root):
            clean = folder / row.path
            speech[row.split].append(clean)
            if row.noisy:
                pairs[row.split].append((clean, folder / row.noisy))
        if not speech["train"]:
            raise ValueError(
                f"{manifest}: no row has the split 'train', which holds the speech to train on; "
                "correct the column 'split'"
            )
        if not (speech["valid"] or attributes.get("valid_speech")):
            warnings.warn(
                f"{manifest}: no row has the split 'valid', so training speech is used for "
                "validation; 'hlsim prepare --valid-share 0.1' moves a tenth of the speakers to "
                "that split",
                stacklevel=2,
            )
        if not attributes.get("noise"):
            attributes["noise"] = pairs["train"]
            attributes["valid_noise"] = attributes.get("valid_noise") or pairs["valid"]
        attributes["valid_speech"] = attributes.get("valid_speech") or speech["valid"]
        return cls(speech["train"], **attributes)

    def validation(self) -> TrainingData:
        """Return the data for validation as ``speech``, ``noise`` and ``audiograms``.

        They are ``valid_speech``, ``valid_noise`` and ``valid_audiograms`` where these are set, and
        otherwise the data for training.

        Raises:
            ValueError: Training and validation share files of speech or noise.
        """
        for name in ("speech", "noise"):
            training = getattr(self, name)
            validation = getattr(self, f"valid_{name}")
            if not training or not validation:
                continue
            shared = _resolved_files(training) & _resolved_files(validation)
            if shared:
                raise ValueError(
                    f"{len(shared)} files of {name} are used for both training and validation, "
                    f"such as {min(shared)}; use other files for validation, or leave "
                    f"--valid-{name} out"
                )
        return TrainingData(
            self.valid_speech or self.speech,
            self.valid_noise or self.noise,
            self.valid_audiograms or self.audiograms,
        )

    def identity(self) -> dict[str, str]:
        """Describe the data in order to recognise a training that should resume.

        Returns:
            Paths, or hashes of lists of files, by the name of the attribute.
        """
        return {
            entry.name: _describe(getattr(self, entry.name))
            for entry in fields(self)
            if entry.compare
        }


def _resolved_files(source: Source) -> set[Path]:
    """Return the absolute paths of files, or of the noisy file of each pair."""
    files = find_audio(source) if isinstance(source, str | Path) else source
    paths = [file[-1] if isinstance(file, tuple) else file for file in files]
    return {path.resolve() for path in paths}


def _describe(source: Any) -> str:
    if source is None or isinstance(source, str | Path):
        return str(source)
    names = "\n".join(map(str, source))
    return f"{len(source)} files, sha256 {hashlib.sha256(names.encode()).hexdigest()}"


class _RandomBatches(Dataset[Batch]):
    """Batches of random speech, noise and ears, which depend on seed, step and rank alone."""

    recipe: TrainingRecipe

    def __init__(self, recipe: TrainingRecipe, data: TrainingData) -> None:
        self.recipe = recipe
        settings: dict[str, Any] = {"sample_rate": NEURO_RATE, "seconds": recipe.seconds}
        self.speech = Clips(data.speech, **settings)
        self.noise = Clips(data.noise, repeat=True, **settings) if data.noise else None
        self.measured_ears: Tensor | None = None  # (ears, 8) dB HL
        if data.audiograms is not None:
            measured = read_audiograms(data.audiograms, simulated=True)
            self.measured_ears = torch.tensor([ear.thresholds for _, ear in measured])

    def __getitem__(self, step: Step) -> Batch:
        seed = (self.recipe.seed * 1_000_003 + step.number) * 64 + step.rank
        generator = torch.Generator().manual_seed(seed % 2**63)  # Larger seeds are rejected.
        return self.draw(self.recipe.batch, generator)

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """Draw the tensors of a batch.

        Args:
            count: Number of items.
            generator: Source of the random numbers.

        Returns:
            ``clean`` and ``signal`` in pascals with shape (count, time), and ``thresholds`` in dB
            HL with shape (count, 8); see ``Batch``.
        """
        raise NotImplementedError

    def _join_measured_ears(
        self, ears: Tensor, share: float, shift_db: float, generator: torch.Generator
    ) -> Tensor:
        """Replace a share of random ears by measured ones, if there are any.

        Args:
            ears: Thresholds in dB HL with shape (items, 8).
            share: Probability with which an ear is replaced.
            shift_db: Largest random shift of a measured ear in dB.
            generator: Source of the random numbers.
        """
        if self.measured_ears is None:
            return ears
        numbers = torch.randint(len(self.measured_ears), (len(ears),), generator=generator)
        measured = self.measured_ears[numbers]
        if shift_db:
            shift = 2.0 * torch.rand(len(ears), 1, generator=generator) - 1.0
            measured = (measured + shift_db * shift).clamp(LOWEST_LEVEL, HIGHEST_SIMULATED)
        return torch.where(torch.rand(len(ears), 1, generator=generator) < share, measured, ears)

    def _join_sounds(
        self, clips: Tensor, generator: torch.Generator, early_share: float = 0.0
    ) -> Tensor:
        """Replace the recipe's share of clips by tones and clicks, see ``draw_sounds``."""
        share = self.recipe.sounds
        if not share:
            return clips
        sounds = draw_sounds(len(clips), clips.shape[-1], NEURO_RATE, generator, early_share)
        return torch.where(torch.rand(len(clips), 1, generator=generator) < share, sounds, clips)


class _SimulatorBatches(_RandomBatches):
    """Batches for a simulator: speech, noise, tones and clicks, like the outputs of aids."""

    recipe: SimulatorRecipe

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        ears = draw_thresholds(count, generator)
        ears = self._join_measured_ears(ears, 0.4, 5.0, generator)
        noise = self.noise.draw(count, generator) if self.noise is not None else None
        clips = self._join_sounds(self.speech.draw(count, generator), generator)
        signal = augment_speech(
            clips,
            noise,
            ears,
            NEURO_RATE,
            generator,
            levels=self.recipe.levels,
            treated=self.recipe.treated,
        )
        return {"clean": set_level(clips, level_spl(signal)), "signal": signal, "thresholds": ears}


class CompensatorBatches(_RandomBatches):
    """Data set of random batches for a compensator: clean or noisy speech, tones and clicks.

    The index of the data set is a ``Step``, the number of the training step. An entry is a batch, a
    dictionary: ``clean`` is the reference and ``signal`` the input of the aid, both in pascals with
    shape (items, time); ``thresholds`` are the ears in dB HL with shape (items, 8). For tones and
    clicks, both signals are the same. If ``recipe.unreduced`` is above 0, ``noise_reduction`` is 0
    for items without noise reduction and 1 for others, with shape (items,).

    Args:
        recipe: Settings of the training.
        data: Speech, noise and ears.
        ear: Ear of all items; None draws random ears.

    >>> speech = Path(__file__).parents[1] / "data" / "speech" / "train"
    >>> batches = CompensatorBatches(CompensatorRecipe(), TrainingData(speech), ear=None)
    >>> {name: tensor.shape[0] for name, tensor in batches[Step(0)].items()}
    {'clean': 2, 'signal': 2, 'thresholds': 2}
    """

    recipe: CompensatorRecipe

    def __init__(
        self, recipe: CompensatorRecipe, data: TrainingData, ear: Audiogram | None
    ) -> None:
        super().__init__(recipe, data)
        self.ear = None if ear is None else torch.tensor(ear.thresholds)

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        recipe = self.recipe

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return draw_uniform(low, high, (count, *shape), generator)

        def equalise_some(clips: Tensor) -> Tensor:
            gains = uniform(-15.0, 15.0, len(EQUALISER_FREQUENCIES))
            equalised = equalise(clips, gains, torch.tensor(EQUALISER_FREQUENCIES), NEURO_RATE)
            return torch.where(uniform(0.0, 1.0, 1) < recipe.equalised, equalised, clips)

        voices = equalise_some(self.speech.draw(count, generator))
        # Some tones begin before the clip. Otherwise a hearing aid would learn that a tone always
        # follows silence.
        clips = self._join_sounds(voices, generator, early_share=1.0)
        clean = set_level(clips, uniform(*recipe.levels))
        signal = clean
        if self.noise is not None:
            noise = equalise_some(self.noise.draw(count, generator))
            if recipe.babble:
                noise = torch.where(uniform(0.0, 1.0, 1) < recipe.babble, _babble(voices), noise)
            is_speech = (clips == voices).all(-1, keepdim=True)
            is_noisy = (uniform(0.0, 1.0, 1) < recipe.noisy) & is_speech
            noisy = mix(clean, noise, uniform(*recipe.snr), NEURO_RATE)
            signal = torch.where(is_noisy, noisy, clean)
        if self.ear is not None:
            ears = self.ear.expand(count, -1)
        else:
            ears = draw_thresholds(count, generator)
            ears = self._join_measured_ears(ears, 0.5, 0.0, generator)
        batch = {"clean": clean, "signal": signal, "thresholds": ears}
        if recipe.unreduced:
            is_reduced = uniform(0.0, 1.0) >= recipe.unreduced
            batch["noise_reduction"] = is_reduced.to(clean.dtype)
        return batch


def _babble(voices: Tensor) -> Tensor:
    """Add up to four other items at equal levels, for each item."""
    count = min(len(voices), _MAX_BABBLE_VOICES + 1)
    shifted = [set_level(voices.roll(shift, 0), 65.0) for shift in range(1, count)]
    return torch.stack(shifted).sum(0)


def simulator_data(
    data: TrainingData, recipe: SimulatorRecipe, plugin: PluginTeacher | None = None
) -> BatchData:
    """Make the Lightning data module with the batches for the training of a Neuro-MSBG.

    Args:
        data: Speech, noise and ears.
        recipe: Settings of the training.
        plugin: Simulator that replaces the exact MSBG as the teacher, whose output is learnt.

    Returns:
        Batches for training and validation, with the teacher.

    Raises:
        ValueError: Files are missing or invalid.

    >>> speech = Path(__file__).parents[1] / "data" / "speech" / "train"
    >>> batches = simulator_data(TrainingData(speech), SimulatorRecipe())
    >>> list(batches.training[Step(0)])
    ['clean', 'signal', 'thresholds']
    """
    return BatchData(
        _SimulatorBatches(recipe, data),
        simulator_validation(data, recipe),
        teacher=Teacher(NEURO_RATE, plugin),
        workers=data.workers,
    )


def compensator_data(
    data: TrainingData, recipe: CompensatorRecipe, ear: Audiogram | None
) -> BatchData:
    """Make the Lightning data module with the batches for the training of a compensator.

    Args:
        data: Speech, noise and ears.
        recipe: Settings of the training.
        ear: Ear of a personal compensator; None for a general one.

    Returns:
        Batches for training and validation.

    Raises:
        ValueError: Files are missing or invalid, or the recipe requires noise and there is none.

    >>> speech = Path(__file__).parents[1] / "data" / "speech" / "train"
    >>> batches = compensator_data(TrainingData(speech), CompensatorRecipe(), ear=None)
    >>> len(batches.validation)  # of 4 items each
    2
    """
    needs_noise = [name for name in ("denoising", "intelligibility") if recipe.weights.get(name)]
    if recipe.babble:
        needs_noise.append("babble")
    if needs_noise and not data.noise:
        raise ValueError(
            f"{needs_noise[0]} in the recipe requires noise, but the data has none; "
            "add a folder of noise (--noise)"
        )
    plain = replace(recipe, equalised=0.0, seconds=_VALIDATION_SECONDS)
    batches = CompensatorBatches(plain, data.validation(), ear)
    generator = torch.Generator().manual_seed(2_000 + recipe.seed)
    validation = [batches.draw(4, generator) for _ in range(0, recipe.validation_items, 4)]
    return BatchData(CompensatorBatches(recipe, data, ear), validation, workers=data.workers)


def simulator_validation(data: TrainingData, recipe: SimulatorRecipe) -> list[Batch]:
    """Draw the validation batches of a simulator: fixed clips of 2 s.

    They are drawn as for training, but not equalised, amplified or compressed. If the recipe trains
    on tones and clicks, one item of them, marked with ``sounds``, is added per three items of
    speech.

    Args:
        data: Speech, noise and ears for training and validation.
        recipe: Settings of the training.

    Raises:
        ValueError: Files are missing or invalid, or used for both training and validation.

    >>> speech = Path(__file__).parents[1] / "data" / "speech" / "train"
    >>> len(simulator_validation(TrainingData(speech), SimulatorRecipe()))  # of 8 items each
    6
    """
    data = data.validation()
    generator = torch.Generator().manual_seed(1_000 + recipe.seed)
    levels = (50.0, 80.0) if recipe.treated else recipe.levels
    plain = replace(recipe, seconds=_VALIDATION_SECONDS, levels=levels, treated=False, sounds=0.0)
    speech = _SimulatorBatches(plain, data)
    batches = [speech.draw(8, generator) for _ in range(0, recipe.validation_items, 8)]
    if recipe.sounds:
        sounds = _SimulatorBatches(replace(plain, sounds=1.0), replace(data, noise=None))
        marked = {"sounds": torch.ones(8, dtype=torch.bool)}
        for _ in range(0, recipe.validation_items, 24):
            batches.append(sounds.draw(8, generator) | marked)
    return batches
