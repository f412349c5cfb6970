"""Batches for training and validation, drawn at random from speech, noise and ears."""

from __future__ import annotations

import hashlib
import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from compensators.config import BeamformerConfig, MappingConfig
from hlsim.audiogram import Audiogram
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import NEURO_RATE, level_spl, set_level
from hlsim.data.augment import (
    augment_speech,
    draw_uniform,
    equalise_share,
    replace_share,
)
from hlsim.data.clips import AudioFiles, Clips, hash_source
from hlsim.data.ears import draw_thresholds
from hlsim.data.manifest import read_manifest, warn_of_non_speech
from hlsim.data.mixing import mix
from hlsim.data.recorded_scenes import SceneClips, SceneFiles
from hlsim.data.scenes import draw_scenes
from hlsim.data.tones_and_clicks import draw_sounds
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe, TrainingRecipe

Batch = dict[str, Tensor]
"""Tensors of a batch by name.

- ``signal``: input of the network in pascals with shape (items, time)
- ``thresholds``: thresholds of the ears in dB HL at ``FREQUENCIES`` with shape (items, 8)
- ``clean``: clean speech in pascals with shape (items, time)
- ``noise_reduction`` (hearing aids): strength of noise reduction, 0 (none) or 1, with shape
  (items,)

For several microphones, ``signal`` has the shape (items, microphones, time). For two ears with
several microphones, the shapes are (items, microphones, ears, time), (items, ears, 8) and (items,
ears, time), the left ear first.
"""

MAX_DEVICES = 64
"""Largest number of training devices.

The batches of a step have this many consecutive numbers, of which each device draws one.
"""

_VALIDATION_SECONDS = 2.0
"""Duration in seconds of the clips for validation."""

_VALIDATION_BATCH = 4
"""Number of items in a batch for validation."""

_HIGHEST_CLEAN_LEVEL = 80.0
"""Highest level in dB SPL of the clean speech that belongs to the input of a simulator."""

_MEASURED_SHARE = 0.5
"""Probability with which an ear of a batch is a measured one, if there are any, else random."""

_QUIET_SNR = 60.0
"""Signal-to-noise ratio in dB of scenes that are not noisy."""

_MAX_BABBLE_VOICES = 4
"""Largest number of voices in babble."""


@dataclass(frozen=True)
class TrainingData:
    """Files of speech, noise and ears for training and validation. Only speech is required.

    If data for validation are missing, those for training are used. Without ``valid_speech``,
    validation scores are therefore those of speakers that the network knows.

    Attributes:
        speech: Folder or files of clean speech, see ``AudioFiles``.
        noise: Folder or files of noise that is mixed in, or pairs of files of clean and noisy
            speech, whose difference is the noise.
        audiograms: CSV file of measured ears, which are used in addition to random ones.
        valid_speech: Clean speech for validation, like ``speech``.
        valid_noise: Noise for validation, like ``noise``.
        valid_audiograms: CSV file of measured ears for validation.
        workers: Number of processes that draw batches, in addition to the one that trains.
        scenes: Recorded scenes, from which compensators are trained instead of ``speech`` and
            ``noise``.
        valid_scenes: Recorded scenes for validation.

    >>> data = TrainingData([Path("a.wav")], valid_speech=[Path("b.wav")])
    >>> [path.name for path in data.validation().speech]
    ['b.wav']
    """

    speech: AudioFiles
    noise: AudioFiles | None = None
    audiograms: Path | None = None
    valid_speech: AudioFiles | None = None
    valid_noise: AudioFiles | None = None
    valid_audiograms: Path | None = None
    workers: int = 0
    scenes: Sequence[SceneFiles] = ()
    valid_scenes: Sequence[SceneFiles] = ()

    @classmethod
    def from_manifest(
        cls, manifest: str | Path, root: str | Path | None = None, **attributes: Any
    ) -> TrainingData:
        """Return the training data of a manifest: its splits ``train`` and ``valid``.

        The difference between the manifest's noisy and clean speech is the noise. Rows with a value
        in the column ``reference`` are recorded scenes, clean speech with its signals at several
        microphones, and give no noise.

        Args:
            manifest: CSV file, see ``read_manifest``.
            root: Folder to which its paths are relative; by default the folder of the manifest.
            attributes: Attributes of ``TrainingData`` other than ``speech``, such as ``noise`` or
                ``audiograms``, which replace what the manifest has.

        Raises:
            ValueError: The manifest is invalid, or has scenes although there is ``noise``.
        """
        folder = Path(manifest).parent if root is None else Path(root)
        rows = read_manifest(manifest, root)
        sources: dict[str, Any] = {}
        for split, prefix in (("train", ""), ("valid", "valid_")):
            part = [row for row in rows if row.split == split]
            sources[f"{prefix}speech"] = [folder / row.path for row in part]
            pairs = [row for row in part if row.noisy and not row.reference]
            sources[f"{prefix}noise"] = [(folder / row.path, folder / row.noisy) for row in pairs]
            scenes = [SceneFiles.from_utterance(row, folder) for row in part if row.reference]
            sources[f"{prefix}scenes"] = scenes
        replacements = {name: value for name, value in attributes.items() if value}
        if rows[0].reference and replacements.keys() & {"noise", "valid_noise"}:
            raise ValueError(
                f"{manifest}: its noisy speech at several microphones contains the noise; leave "
                "--noise and --valid-noise out"
            )
        return cls(**(sources | replacements))

    def validation(self) -> TrainingData:
        """Return new data with ``speech``, ``noise``, ``audiograms`` and ``scenes`` for validation.

        They are ``valid_speech``, ``valid_noise``, ``valid_audiograms`` and ``valid_scenes`` where
        these are set, and otherwise the data for training.
        """
        return TrainingData(
            self.valid_speech or self.speech,
            self.valid_noise or self.noise,
            self.valid_audiograms or self.audiograms,
            scenes=self.valid_scenes or self.scenes,
        )

    def identity(self) -> str:
        """Compute a hash of the recordings and ears, in hexadecimal, for a training's record.

        A training resumes only with the same hash. See ``hash_source`` for what is read of large
        corpora. The clean speech of scenes counts only as a part of ``speech``.

        Raises:
            ValueError: A folder does not exist or contains no audio, or a table is not valid.
        """
        sources = [self.speech, self.noise, self.valid_speech, self.valid_noise]
        references: list[tuple[int, ...]] = []
        for scenes in filter(None, (self.scenes, self.valid_scenes)):
            sources.append([file for scene in scenes for file in scene.files])
            references += [scene.references for scene in scenes]
        hashes: list[Any] = [hash_source(source) if source else None for source in sources]
        hashes += references
        tables = (self.audiograms, self.valid_audiograms)
        ears = [_read_ears(table) if table else None for table in tables]
        return hashlib.sha256(repr((hashes, ears)).encode()).hexdigest()


def _read_ears(table: Path) -> list[tuple[float, ...]]:
    """Read the ears of a table, as eight thresholds in dB HL each.

    Raises:
        ValueError: The table cannot be read, or a threshold is above 100 dB HL.
    """
    return [ear.thresholds for _, ear in read_audiograms(table, simulated=True)]


class _RandomBatches(Dataset[Batch]):
    """Data set of batches of random speech, noise and ears, by index.

    A batch depends on the seed of the recipe and on its index alone.

    Args:
        recipe: Settings of the training.
        data: Speech, noise and ears.
        ear: Ear of all items; None draws random ears.
    """

    recipe: TrainingRecipe

    def __init__(self, recipe: TrainingRecipe, data: TrainingData, ear: Audiogram | None) -> None:
        self.recipe = recipe
        self.ear = None if ear is None else torch.tensor(ear.thresholds)
        self.clip_settings: dict[str, Any] = {"sample_rate": NEURO_RATE, "seconds": recipe.seconds}
        self.speech = Clips(data.speech, **self.clip_settings)
        if isinstance(data.speech, str | Path):
            warn_of_non_speech(data.speech, self.speech.files)
        self.noise = Clips(data.noise, repeat=True, **self.clip_settings) if data.noise else None
        self.measured_ears: Tensor | None = None  # (ears, 8) dB HL
        if data.audiograms is not None:
            self.measured_ears = torch.tensor(_read_ears(data.audiograms))

    def __getitem__(self, index: int) -> Batch:
        seed = self.recipe.seed * 1_000_003 * MAX_DEVICES + index
        return self.draw(self.recipe.batch, torch.Generator().manual_seed(seed))

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """Draw the tensors of a batch.

        Args:
            count: Number of items.
            generator: Source of the random numbers.

        Returns:
            The tensors that ``Batch`` describes, of ``count`` items. An aid with one microphone
            gets both ears of recorded scenes for two ears as items: twice as many.
        """
        raise NotImplementedError

    def draw_ears(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw random and measured ears, or repeat the one ear.

        Returns: Thresholds in dB HL, (count, 8).
        """
        if self.ear is not None:
            return self.ear.expand(count, -1)
        ears = draw_thresholds(count, generator)
        if self.measured_ears is None:
            return ears
        numbers = torch.randint(len(self.measured_ears), (count,), generator=generator)
        return replace_share(ears, self.measured_ears[numbers], _MEASURED_SHARE, generator)

    def replace_by_sounds(self, clips: Tensor, generator: torch.Generator) -> Tensor:
        """Replace the recipe's share of clips by tones and clicks, see ``draw_sounds``.

        Shape: (items, time) -> (items, time).
        """
        sounds = draw_sounds(len(clips), clips.shape[-1], generator)
        return replace_share(clips, sounds, self.recipe.sounds, generator)


class _SimulatorBatches(_RandomBatches):
    """Batches for a simulator, whose input is like the output of aids.

    It is clean or noisy speech, or tones and clicks, amplified and compressed if the recipe says
    so.
    """

    recipe: SimulatorRecipe

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        ears = self.draw_ears(count, generator)
        noise = self.noise.draw(count, generator) if self.noise is not None else None
        clips = self.replace_by_sounds(self.speech.draw(count, generator), generator)
        levels, treated = self.recipe.levels, self.recipe.treated
        signal = augment_speech(clips, noise, ears, generator, levels=levels, treated=treated)
        clean = set_level(clips, level_spl(signal).clamp_max(_HIGHEST_CLEAN_LEVEL))
        return {"signal": signal, "clean": clean, "thresholds": ears}


class _CompensatorBatches(_RandomBatches):
    """Batches for a compensator: clean or noisy speech, tones and clicks.

    Raises:
        ValueError: The recipe's network has several microphones, but the scenes have others or
            there are none for them, or a batch has no second voice for random scenes.
    """

    recipe: CompensatorRecipe

    def __init__(
        self, recipe: CompensatorRecipe, data: TrainingData, ear: Audiogram | None
    ) -> None:
        super().__init__(recipe, data, ear)
        self.microphones, self.ears = _microphones_and_ears(recipe)
        self.scenes: SceneClips | None = None
        if data.scenes:
            self.scenes = SceneClips(data.scenes, **self.clip_settings)
            numbers = (self.scenes.microphones, self.scenes.ears)
            if self.microphones > 1 and numbers != (self.microphones, self.ears):
                raise ValueError(
                    f"expected {self.microphones} microphones for each of {self.ears} ears as in "
                    f"the recipe's model, got {numbers[0]} for each of {numbers[1]} ears in the "
                    "manifest; correct the model, or the column 'reference' of the manifest"
                )
            if recipe.weights.get("interaural") and self.scenes.is_diotic:
                warnings.warn(
                    f"{self.scenes.clean_files[0]}: the clean speech is the same at both ears, so "
                    "that the criterion interaural trains an aid to remove the differences between "
                    "the ears; use clean speech with one channel for each ear, or set the weight "
                    "of interaural to 0 unless all talkers are in front",
                    stacklevel=3,
                )
        elif self.microphones > 1 and (self.microphones, self.ears) != (2, 2):
            raise ValueError(
                f"expected recorded scenes for {self.microphones} microphones, because only those "
                "of 2 microphones for each of 2 ears are simulated; add them (--manifest)"
            )
        elif self.microphones > 1 and recipe.batch == 1:
            raise ValueError(
                "recipe: batch is 1, expected 2 or more, because the voices of a random scene are "
                "those of other items"
            )

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        if self.scenes is not None:
            clean, signal = self._draw_recorded_scenes(self.scenes, count, generator)
        else:
            clean, signal = self._draw_signals(count, generator)
        ears = self.draw_ears(count, generator)
        if signal.ndim == 4 and self.microphones == 1:
            # The network gets the reference microphone, and each ear is an item.
            ears = ears.repeat_interleave(clean.shape[1], 0)
            clean, signal = clean.flatten(0, 1), signal[:, 0].flatten(0, 1)
        elif signal.ndim == 4 and self.ears == 1:
            clean, signal = clean[:, 0], signal[:, :, 0]
        elif signal.ndim == 4:
            ears = ears.unsqueeze(1).expand(-1, 2, -1)
        batch = {"clean": clean, "signal": signal, "thresholds": ears}
        if self.recipe.kind == "hearing-aid":
            is_reduced = torch.rand(len(clean), generator=generator) >= self.recipe.unreduced
            batch["noise_reduction"] = is_reduced.to(clean.dtype)
        return batch

    def _draw_recorded_scenes(
        self, scenes: SceneClips, count: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Draw clips of recorded scenes, in which the clean speech has the recipe's levels.

        Args:
            scenes: Clips of recorded scenes.
            count: Number of scenes.
            generator: Source of the random numbers.

        Returns:
            The clean speech, (count, ears, time), and the signals, (count, microphones, ears,
            time), in pascals.
        """
        clean, signal = scenes.draw_scenes(count, generator)
        levels = draw_uniform(*self.recipe.levels, (count,), generator)
        gains = 10.0 ** ((levels - level_spl(clean.flatten(1))) / 20.0)
        return clean * gains[:, None, None], signal * gains[:, None, None, None]

    def _draw_signals(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw clean and noisy speech, and tones and clicks: in scenes for several microphones.

        Args:
            count: Number of items.
            generator: Source of the random numbers.

        Returns:
            Clean speech and input of the aid, (count, time) each; for several microphones, (count,
            ears, time) and (count, microphones, ears, time), with two ears. All are in pascals.
        """
        recipe = self.recipe
        voices = equalise_share(self.speech.draw(count, generator), recipe.equalised, generator)
        clips = self.replace_by_sounds(voices, generator)
        clean = set_level(clips, draw_uniform(*recipe.levels, (count,), generator))
        noise = self.noise.draw(count, generator) if self.noise is not None else None
        if self.microphones > 1:
            snr = draw_uniform(*recipe.snr, (count,), generator)
            is_noisy = torch.rand(count, generator=generator) < recipe.noisy
            snr = torch.where(is_noisy, snr, _QUIET_SNR)
            settings = {
                "mismatch": recipe.mismatch,
                "reverberation_time": recipe.reverberation_time,
            }
            if recipe.kind == "beamforming-aid":
                settings["spacing"] = BeamformerConfig.from_dict(recipe.model).spacing
            scenes = draw_scenes(clean, voices, noise, snr, generator, **settings)
            return scenes.reference, scenes.input
        if noise is None:
            return clean, clean
        noise = equalise_share(noise, recipe.equalised, generator)
        if recipe.babble:
            noise = replace_share(noise, _babble(voices), recipe.babble, generator)
        noisy = mix(clean, noise, draw_uniform(*recipe.snr, (count,), generator))
        noisy = replace_share(clean, noisy, recipe.noisy, generator)
        is_speech = (clips == voices).all(-1, keepdim=True)
        return clean, torch.where(is_speech, noisy, clean)


def _microphones_and_ears(recipe: CompensatorRecipe) -> tuple[int, int]:
    """Return the number of microphones per ear of a recipe's network, and the number of ears."""
    if recipe.kind == "mapping-compensator":
        config = MappingConfig.from_dict(recipe.model)
        return config.microphones, config.ears
    return (2, 2) if recipe.kind == "beamforming-aid" else (1, 1)


def _warn_of_settings_without_effect(recipe: CompensatorRecipe, data: TrainingData) -> None:
    """Warn of settings that a user has changed, and that have no effect on the data."""
    unused: dict[str, Any] = {}  # by name, the value that the data have
    reason = ""
    if data.scenes:
        zero = ("babble", "equalised", "mismatch", "reverberation_time", "sounds")
        unused = {**dict.fromkeys(zero, 0.0), "noisy": 1.0, "snr": None}
        reason = "recorded scenes, which are used as they are, except for their level"
    elif data.noise is None and _microphones_and_ears(recipe)[0] == 1:
        unused = {"noisy": 0.0, "snr": None}
        reason = "data without noise; add a folder of noise (--noise)"
    defaults = {setting.name: setting.default for setting in fields(recipe)}
    changed = [
        name
        for name, value in unused.items()
        if getattr(recipe, name) not in (defaults[name], value)
    ]
    if changed:
        names = ", ".join(sorted(changed))
        warnings.warn(f"recipe: {names} without effect on {reason}", stacklevel=3)


def _babble(voices: Tensor) -> Tensor:
    """Return, for each item, the sum of up to four other items at equal levels.

    Shape: (items, time) -> (items, time).
    """
    count = min(len(voices), _MAX_BABBLE_VOICES + 1)
    shifted = [set_level(voices.roll(shift, 0), 65.0) for shift in range(1, count)]
    return torch.stack(shifted).sum(0)


class BatchData(L.LightningDataModule):
    """Lightning's data module of both trainings: batches by index, and fixed validation batches.

    The batch of device d at step s, both from 0, has the index 64 * s + d. A resumed training
    continues with the batch after the last one. The Trainer requires
    ``use_distributed_sampler=False``.

    Args:
        training: Data set that returns a batch for each index.
        validation: Batches for validation.
        workers: Number of processes that draw batches, in addition to the one that trains.

    >>> data = BatchData([], validation=[{"clean": Tensor([1.0])}])
    >>> next(iter(data.val_dataloader()))
    {'clean': tensor([1.])}
    """

    def __init__(
        self,
        training: Dataset[Batch],
        validation: Sequence[Batch],
        *,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.training = training
        self.validation = validation
        self.workers = workers

    def setup(self, stage: str) -> None:
        trainer: Any = self.trainer
        if trainer.accumulate_grad_batches != 1:
            raise ValueError(
                "accumulate_grad_batches is not supported, because each step has the batch of its "
                "number; raise batch in the recipe instead"
            )

    def train_dataloader(self) -> DataLoader[Any]:
        trainer: Any = self.trainer
        first = MAX_DEVICES * trainer.global_step + trainer.global_rank
        indices = itertools.count(first, MAX_DEVICES)
        return DataLoader(self.training, batch_size=None, sampler=indices, num_workers=self.workers)

    def val_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.validation, batch_size=None)  # type: ignore[arg-type]


def make_data(
    data: TrainingData, recipe: TrainingRecipe, ear: Audiogram | None = None
) -> BatchData:
    """Build the Lightning data module with the batches for a training.

    Clips for validation last 2 s, and are not equalised, amplified or compressed; those for a
    simulator that is trained on treated clips have 50 to 80 dB SPL. If the data have speech for
    validation, none of its files may be used for training.

    Args:
        data: Speech, noise and ears.
        recipe: Settings of the training of a simulator or of a compensator.
        ear: Ear of a personal compensator; None for random and measured ears.

    Raises:
        ValueError: A folder does not exist or has no audio, a table of ears is not valid, files are
            used for both training and validation, no clip for validation can be drawn, the recipe
            requires noise and there is none, a compensator is trained on recorded scenes
            and there is other speech for validation, or the microphones of its network do not fit
            the data (see ``_CompensatorBatches``).

    >>> from hlsim.data.bundled import SPEECH
    >>> batches = make_data(TrainingData(SPEECH), CompensatorRecipe())
    >>> len(batches.validation)  # of 4 items each
    2
    """
    batches: type[_RandomBatches] = _CompensatorBatches
    plain: dict[str, Any] = {"seconds": _VALIDATION_SECONDS}
    if isinstance(recipe, SimulatorRecipe):
        batches = _SimulatorBatches
        if data.scenes and not data.noise:
            warnings.warn(
                "a simulator is trained without the noise of recorded scenes (rows with a value in "
                "the column 'reference'), on clean speech alone; for noisy speech, replace the "
                "manifest by folders (--speech and --noise)",
                stacklevel=2,
            )
        levels = (50.0, 80.0) if recipe.treated else recipe.levels
        plain |= {"levels": levels, "treated": False}
    elif isinstance(recipe, CompensatorRecipe):
        plain["equalised"] = 0.0
        valid_speech_of_scenes = [scene.clean for scene in data.valid_scenes]
        if data.scenes and data.valid_speech not in (None, valid_speech_of_scenes):
            raise ValueError(
                "recorded scenes are validated on recorded scenes, so that valid_speech "
                "(--valid-speech) would have no effect; leave it out, and write valid in the "
                "column 'split' of some rows of the manifest"
            )
        _warn_of_settings_without_effect(recipe, data)
        has_noise = data.noise or data.scenes
        if (recipe.trains_noise_reduction() or recipe.babble) and not has_noise:
            raise ValueError(
                "denoising, intelligibility and babble in the recipe require noise, but the data "
                "has none; add a folder of noise (--noise)"
            )
    training = batches(recipe, data, ear)
    validation = batches(replace(recipe, **plain), data.validation(), ear)
    valid_files = {path.resolve() for path in validation.speech.files}
    shared = {path.resolve() for path in training.speech.files} & valid_files
    if data.valid_speech and shared:
        raise ValueError(
            f"{len(shared)} files are used for both training and validation, such as "
            f"{min(shared)}; use other files for validation, or leave --valid-speech out"
        )
    generator = torch.Generator().manual_seed(2_000 + recipe.seed)
    validation_batches = [
        validation.draw(_VALIDATION_BATCH, generator)
        for _ in range(0, recipe.validation_items, _VALIDATION_BATCH)
    ]
    return BatchData(training, validation_batches, workers=data.workers)
