"""Recipes: the settings of a training, by the same names in Python, YAML and the command line.

The command line shows the docstrings of these classes as help. This module does not import torch,
so that the help is shown at once.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

_SHARES = ("sounds", "equalised", "noisy", "babble", "unreduced")
"""Settings from 0 to 1."""

_NOISE_REDUCTION_CRITERIA = ("denoising", "intelligibility")
"""Criteria that train the noise reduction of a hearing aid, and nothing else."""

_SCORES = ("haspi", "hasqi", "intelligibility")
"""Criteria that are scores, which mean nothing for short clips."""


@dataclass(frozen=True, kw_only=True)
class TrainingRecipe:
    """Settings that the trainings of simulators and compensators share.

    The defaults are those of a simulator. The subclasses have further settings.

    Attributes:
        model: Settings of the network by name, such as ``channels``.
        start: Name or folder of a checkpoint to start from, instead of random weights. The network
            has the settings of the checkpoint. It is saved as the best network until training finds
            a better one.
        steps: Number of training steps, 1 or more. The learning rate falls over them.
        batch: Number of clips per step and device, 1 or more.
        seconds: Duration of each clip in seconds, above 0 and at most 600.
        learning_rate: Highest learning rate of the optimiser, AdamW, above 0.
        weights: Weight under the name of each criterion, 0 or more, at least one of them above 0.
        levels: Lowest and highest level of the speech in dB SPL.
        sounds: Share of clips that are tones or clicks instead of speech, from 0 to 1.
        validate_every: Number of steps between validations, 1 or more.
        validation_items: Number of validation items, 1 or more, rounded up to batches of 4.
        seed: Seed of every random draw, a whole number below 2**32 in magnitude.

    Raises:
        ValueError: A setting is out of range, or the settings contradict each other.

    >>> CompensatorRecipe(batch=0)
    Traceback (most recent call last):
    ValueError: recipe: batch is 0, expected 1 or more
    """

    model: dict[str, Any] = field(default_factory=dict)
    start: str = ""
    steps: int = 10_800
    batch: int = 8
    seconds: float = 1.3
    learning_rate: float = 3e-3
    weights: dict[str, float]
    levels: tuple[float, float] = (40.0, 95.0)
    sounds: float = 0.2
    validate_every: int = 300
    validation_items: int = 48
    seed: int = 0

    @classmethod
    def criteria(cls) -> tuple[str, ...]:
        """Return the names of the criteria that ``weights`` may contain.

        Raises:
            NotImplementedError: This class has none; each subclass returns its own.
        """
        raise NotImplementedError

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "validate_every", "validation_items"):
            self._require(name, getattr(self, name) >= 1, "1 or more")
        self._require("seconds", 0.0 < self.seconds <= 600.0, "above 0 and at most 600")
        self._require("learning_rate", self.learning_rate > 0.0, "a number above 0")
        self._require("seed", abs(self.seed) < 2**32, "a whole number below 2**32 in magnitude")
        for name in ("levels", "snr"):
            lowest, highest = getattr(self, name, (0.0, 0.0))
            expected = "the lowest and the highest number of dB"
            self._require(name, -math.inf < lowest <= highest < math.inf, expected)
        for name in _SHARES:
            self._require(name, 0.0 <= getattr(self, name, 0.0) <= 1.0, "a share from 0 to 1")
        criteria = self.criteria()
        for name, weight in self.weights.items():
            expected = f"weights of 0 or more of {', '.join(criteria)}"
            self._require("weights", name in criteria and weight >= 0.0, expected)
        self._require("weights", any(self.weights.values()), "at least one weight above 0")

    def _require(self, name: str, is_valid: bool, expected: str) -> None:
        if not is_valid:
            value = getattr(self, name)
            raise ValueError(f"recipe: {name} is {value!r}, expected {expected}")


@dataclass(frozen=True, kw_only=True)
class SimulatorRecipe(TrainingRecipe):
    """Settings of the training of a simulator.

    Attributes:
        model: Settings of ``NeuroConfig``.
        weights: Weights of ``snr``, ``log_spectrum`` and ``levels`` (of bands, where the input is
            audible), all in dB / 10; of ``gradient``, 1 minus the cosine of the gradients through
            the network and through the teacher; and of the paper's ``magnitude``, ``phase``,
            ``complex`` and ``time``. Gradients are compared in every third step (in all, without
            another criterion), and such a step takes three to four times as long.
        unit_power: Signal that is scaled to unit power, ``truth`` or ``input``. Estimate and target
            are multiplied by the same factor before all criteria but ``levels`` and ``gradient``.
            ``truth`` is the target, with which soft items count as much as loud ones. ``input`` is
            the choice of MP-SENet. The paper's criteria require ``input`` for networks
            without a prior: at first, the errors of these networks for severe ears are 50 dB above
            the target, and they would learn to be silent.
        levels: Lowest and highest level of the speech in dB SPL, before amplification.
        treated: Whether clips are equalised, amplified and compressed at random, like the outputs
            of compensators.
        precision: Number format of the network's layers, ``float32`` or ``bfloat16``. With
            ``bfloat16``, a step takes 0.4 to 0.95 of the time on a GPU that supports it
            (docs/gpu.md); hardware that does not may be slower. Transforms, prior, scans and
            criteria remain in float32, and so does a network of the structure ``bands``.
        average: Weight of the past in the moving average of the weights, from 0 (none) to below 1.
            The average is validated and saved.

    >>> SimulatorRecipe(steps=1000).learning_rate
    0.003
    """

    weights: dict[str, float] = field(
        default_factory=lambda: {"snr": 1.0, "log_spectrum": 0.5, "levels": 2.0, "gradient": 2.0}
    )
    unit_power: Literal["truth", "input"] = "truth"
    treated: bool = True
    precision: Literal["float32", "bfloat16"] = "float32"
    average: float = 0.99

    @classmethod
    def criteria(cls) -> tuple[str, ...]:
        paper = ("complex", "magnitude", "phase", "time")
        return ("gradient", "levels", "log_spectrum", "snr", *paper)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("average", 0.0 <= self.average < 1.0, "a weight from 0 to below 1")


@dataclass(frozen=True, kw_only=True)
class CompensatorRecipe(TrainingRecipe):
    """Settings of the training of a compensator.

    The defaults are for one ear and a few minutes, with many small steps. A compensator for all
    ears requires larger batches and hours.

    Attributes:
        kind: Type of the network, ``mapping-compensator``, ``hearing-aid`` or ``beamforming-aid``.
            The last one, and a ``mapping-compensator`` with ``ears: 2``, are trained in random
            scenes, see ``draw_scenes``, or in recorded ones, which are used as they are, except for
            their level. The hearing aid inside a ``beamforming-aid`` is not trained; ``start`` may
            name a trained one.
        model: Settings of ``MappingConfig``, ``HearingAidConfig`` or ``BeamformerConfig``.
        weights: Weights of the criteria ``coherent-bands``, ``bands``, ``paper``, ``haspi``,
            ``hasqi``, ``interaural``, ``denoising`` and ``intelligibility``. The first six are
            those of ``HearingLossLoss``; ``interaural`` needs the two ears of a
            ``beamforming-aid``, or ``ears: 2`` in ``model``. The last two train a hearing aid's
            noise reduction alone, and the others its amplification alone: ``denoising`` is the
            error of the gains of noise reduction, ``intelligibility`` is 1 - HASPI at equal level.
            ``haspi``, ``hasqi`` (1 - score) and ``intelligibility`` require clips of 0.7 s or more
            (``seconds``); ``denoising`` and ``intelligibility`` require noise or recorded scenes.
        sounds: Share of clips that are tones or clicks instead of speech, from 0 to 1. Without
            them, a network learns that steady sounds are noise.
        equalised: Share of clips of speech, and of noise outside random scenes, that are equalised
            at random by up to 15 dB, from 0 to 1. A few voices have few spectra, and the gains for
            other voices would be up to 20 dB wrong.
        noisy: Share of noisy clips among those of speech, if there is noise, from 0 to 1. In random
            scenes it is that of all clips, and the others have an SNR of 60 dB.
        babble: Share of noisy clips whose noise consists of other voices of the batch, at most
            four, from 0 to 1; 0 for random scenes of several microphones, which have other voices
            in any case.
        snr: Lowest and highest signal-to-noise ratio in dB. The level of the speech is its active
            level, without pauses.
        mismatch: Standard deviation in dB of the gains of the microphones in random scenes.
        reverberation_time: Longest reverberation time in s of the rooms of half of the random
            scenes, 0.2 to 1.5; 0 for scenes without rooms. It needs the extra ``scenes``.
        unreduced: Share of items for which a hearing aid's noise reduction is off, from 0 to 1.
        loudness: Loudness in dB relative to a normal ear that the amplification aims at, a number
            from -40 to 20 or numbers by level of the speech in dB SPL, see ``HearingLossLoss``;
            where noise reduction is off (``unreduced``), this is the level with its noise. It is 0
            for a ``beamforming-aid``, whose amplification is not trained.
        limit_to_ear: Whether the output of a hearing aid is limited in training to the
            uncomfortable levels that are predicted for the ear, see ``HearingAid``. The saved aid
            is limited only if it is loaded with ``limit_to_ear``.

    >>> CompensatorRecipe(kind="hearing-aid", weights={"denoising": 1.0}).steps
    3000
    """

    kind: Literal["mapping-compensator", "hearing-aid", "beamforming-aid"] = "mapping-compensator"
    steps: int = 3_000
    batch: int = 2
    seconds: float = 0.6
    weights: dict[str, float] = field(default_factory=lambda: {"coherent-bands": 1.0})
    levels: tuple[float, float] = (50.0, 80.0)
    equalised: float = 0.7
    noisy: float = 0.5
    babble: float = 0.0
    snr: tuple[float, float] = (0.0, 20.0)
    mismatch: float = 0.0
    reverberation_time: float = 0.0
    unreduced: float = 0.0
    loudness: float | dict[float, float] = 0.0
    limit_to_ear: bool = False
    validate_every: int = 50
    validation_items: int = 8

    @classmethod
    def criteria(cls) -> tuple[str, ...]:
        from hlsim.losses.criteria import CRITERIA  # imports torch

        return (*CRITERIA, *_NOISE_REDUCTION_CRITERIA)

    def __post_init__(self) -> None:
        from hlsim.data.rooms import Room  # imports torch
        from hlsim.metrics.pair import SHORTEST_SECONDS  # imports torch

        super().__post_init__()
        scores = [name for name in _SCORES if self.weights.get(name)]
        expected = f"{SHORTEST_SECONDS} or more for {' and '.join(scores)}"
        self._require("seconds", self.seconds >= SHORTEST_SECONDS or not scores, expected)
        expected = "2 or more, because babble consists of the other items"
        self._require("batch", self.batch > 1 or not self.babble, expected)
        expected = "beamforming-aid, or ears: 2 in model, because interaural compares two ears"
        has_two_ears = self.kind == "beamforming-aid" or self.model.get("ears") == 2
        self._require("kind", has_two_ears or not self.weights.get("interaural"), expected)
        expected = "beamforming-aid, or ears: 2 in model, because mismatch is that of microphones"
        self._require("kind", has_two_ears or not self.mismatch, expected)
        has_rooms = self.reverberation_time != 0.0
        expected = "beamforming-aid, or ears: 2 in model, because only random scenes have rooms"
        self._require("kind", has_two_ears or not has_rooms, expected)
        if has_rooms:
            Room(reverberation_time=self.reverberation_time)  # rejects what is out of range
        expected = "0 for two ears, because their scenes have other voices in any case"
        self._require("babble", not self.babble or not has_two_ears, expected)
        if self.trains_noise_reduction() or self.unreduced > 0.0:
            expected = "hearing-aid, because only a hearing aid has noise reduction"
            self._require("kind", self.kind == "hearing-aid", expected)
        amplification = self.weights.keys() - {*_NOISE_REDUCTION_CRITERIA}
        is_trained = any(self.weights[name] for name in amplification)
        expected = "0, because this recipe trains no amplification; load the aid with loudness"
        is_amplified = is_trained and self.kind != "beamforming-aid"
        self._require("loudness", is_amplified or not self.loudness, expected)
        self._require("limit_to_ear", isinstance(self.limit_to_ear, bool), "true or false")
        if self.limit_to_ear:
            expected = "hearing-aid, the only kind that is trained with limit_to_ear"
            self._require("kind", self.kind == "hearing-aid", expected)

    def trains_noise_reduction(self) -> bool:
        """Return whether a criterion of the recipe trains the noise reduction of a hearing aid.

        >>> CompensatorRecipe().trains_noise_reduction()
        False
        """
        return any(self.weights.get(name) for name in _NOISE_REDUCTION_CRITERIA)
