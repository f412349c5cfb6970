"""Recipes: the settings of a training, whose names are the same in Python, in YAML files and on the command line.

Nothing here imports torch, so that the command line can show the settings at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

Kind = Literal["mapping-compensator", "hearing-aid"]
Precision = Literal["float32", "bfloat16"]
UnitPower = Literal["truth", "input"]
ReferenceName = Literal["clean", "normal-hearing"]


@dataclass(frozen=True, kw_only=True)
class TrainingRecipe:
    """Settings that both trainings have, with the defaults of a simulator.

    Attributes:
        model: settings of the network, such as ``channels``.
        start: name or folder of a checkpoint whose weights to start from, instead of random ones. Its settings are those
            of the model. It remains the best network until training finds a better one.
        steps: number of training steps, over which the learning rate falls.
        batch: number of clips per step.
        seconds: duration of a clip.
        learning_rate: highest learning rate of AdamW.
        weights: weight of each criterion.
        levels: lowest and highest level of the speech in dB SPL.
        sounds: share of clips that are tones or clicks instead of speech, from 0 to 1.
        validate_every: number of steps between validations.
        validation_items: number of items to validate on, rounded up to whole batches of 4 (compensators) or 8.
        seed: seed of every random draw.
    """

    model: dict[str, Any] = field(default_factory=dict)
    start: str = ""
    steps: int = 19_400
    batch: int = 6
    seconds: float = 1.3
    learning_rate: float = 1e-3
    weights: dict[str, float]
    levels: tuple[float, float] = (40.0, 95.0)
    sounds: float = 0.0
    validate_every: int = 200
    validation_items: int = 48
    seed: int = 0

    criteria: ClassVar[tuple[str, ...]]
    counts: ClassVar[tuple[str, ...]] = ("steps", "batch", "validate_every", "validation_items")
    ranges: ClassVar[tuple[str, ...]] = ("levels",)
    shares: ClassVar[tuple[str, ...]] = ("sounds",)

    def __post_init__(self) -> None:
        for name in self.counts:
            self._require(name, getattr(self, name) >= 1, "1 or more")
        for name in ("seconds", "learning_rate"):
            self._require(name, getattr(self, name) > 0.0, "a number above 0")
        for name in self.shares:
            self._require(name, 0.0 <= getattr(self, name) <= 1.0, "a share from 0 to 1")
        for name in self.ranges:
            low, high = getattr(self, name)
            self._require(name, low <= high, "a lowest and a highest value")
            object.__setattr__(self, name, (low, high))  # a list in YAML
        self._require("seed", abs(self.seed) < 2**62, "less than 2**62")
        are_known = set(self.weights) <= set(self.criteria)
        self._require("weights", are_known, f"weights of {', '.join(self.criteria)}")
        are_useful = any(self.weights.values()) and min(self.weights.values()) >= 0.0
        self._require("weights", are_useful, "0 or more for each, and more than 0 for one")

    def _require(self, name: str, is_valid: bool, expected: str) -> None:
        if not is_valid:
            raise ValueError(
                f"{name} of the recipe is {getattr(self, name)!r}; expected {expected}"
            )


@dataclass(frozen=True, kw_only=True)
class SimulatorRecipe(TrainingRecipe):
    """Settings of the training of a simulator.

    Attributes:
        model: settings of ``NeuroConfig``.
        weights: weights of ``snr`` and ``log_spectrum``, both in dB / 10, and of the paper's ``magnitude``, ``phase``,
            ``complex`` and ``time``.
        unit_power: signal that is scaled to unit power before the criteria, and all others with it: ``truth``, the
            target, so that soft items count as much as loud ones, or ``input``, as in MP-SENet. The paper's criteria on
            a network without a prior need the latter: the first errors of a severe ear are 50 dB above its target, and
            the network would learn to be silent.
        levels: lowest and highest level of the speech in dB SPL, before amplification.
        treated: whether clips are equalised, amplified and compressed at random, as compensators do.
        precision: ``float32``, or ``bfloat16`` for the network's own layers. The latter is several times faster on
            hardware with units for it and several times slower on other hardware. Transforms, physics, scans and criteria
            stay in float32.
        average: weight of the past in the moving average of the weights, which is validated and kept; 0 for none.
    """

    weights: dict[str, float] = field(default_factory=lambda: {"snr": 1.0, "log_spectrum": 0.5})
    unit_power: UnitPower = "truth"
    treated: bool = True
    precision: Precision = "float32"
    average: float = 0.99

    criteria = ("complex", "log_spectrum", "magnitude", "phase", "snr", "time")

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("average", 0.0 <= self.average < 1.0, "a weight from 0 to below 1")


@dataclass(frozen=True, kw_only=True)
class CompensatorRecipe(TrainingRecipe):
    """Settings of the training of a compensator.

    The defaults are for one ear and a few minutes: many small steps. All ears require larger batches and hours.

    Attributes:
        kind: ``mapping-compensator`` or ``hearing-aid``.
        model: settings of ``MappingConfig`` or ``HearingAidConfig``.
        weights: weights of the criteria of ``HearingLossLoss``: ``coherent-bands``, ``bands`` (in dB), ``paper``, and
            ``haspi`` and ``hasqi`` (1 minus the score, for clips of 0.7 s or more); and of those of a hearing aid's noise
            reduction: ``denoising``, the error of its gains, and ``intelligibility``, 1 minus HASPI at equal level.
            Amplification is trained by the former alone, noise reduction by the latter alone.
        reference: signal that the paper's criterion compares with, ``clean`` or ``normal-hearing``.
        sounds: share of clips that are tones or clicks instead of speech, from 0 to 1. From speech in noise alone, a
            network learns that steady sounds are noise.
        equalised: share of clips whose speech is equalised at random by up to 15 dB, and of those whose noise is. Few
            voices have few spectra, and the gain for other ones could be 20 dB off.
        noisy: share of the clips of speech that are noisy, if there is noise.
        babble: share of the noisy clips whose noise is up to four other voices.
        snr: lowest and highest signal-to-noise ratio in dB.
        unreduced: share of items for which a hearing aid's noise reduction is off.
    """

    kind: Kind = "mapping-compensator"
    steps: int = 3_000
    batch: int = 2
    seconds: float = 0.6
    learning_rate: float = 3e-3
    weights: dict[str, float] = field(default_factory=lambda: {"coherent-bands": 1.0})
    reference: ReferenceName = "clean"
    sounds: float = 0.2
    levels: tuple[float, float] = (50.0, 80.0)
    equalised: float = 0.7
    noisy: float = 0.5
    babble: float = 0.0
    snr: tuple[float, float] = (0.0, 20.0)
    unreduced: float = 0.0
    validate_every: int = 50
    validation_items: int = 8

    criteria = (
        "coherent-bands",
        "bands",
        "paper",
        "haspi",
        "hasqi",
        "denoising",
        "intelligibility",
    )
    ranges = ("levels", "snr")
    shares = ("sounds", "equalised", "noisy", "babble", "unreduced")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self._weighs("haspi", "hasqi", "intelligibility"):
            from hlsim.metrics.pair import SHORTEST_SECONDS

            expected = f"{SHORTEST_SECONDS} or more for haspi, hasqi and intelligibility"
            self._require("seconds", self.seconds >= SHORTEST_SECONDS, expected)
        reduces_noise = self._weighs("denoising", "intelligibility")
        if reduces_noise or self.unreduced > 0.0:
            expected = "hearing-aid, because only a hearing aid has noise reduction"
            self._require("kind", self.kind == "hearing-aid", expected)
        if reduces_noise or self.babble > 0.0:
            self._require("noisy", self.noisy > 0.0, "more than 0 for babble and noise reduction")
        if self.babble > 0.0:
            self._require("batch", self.batch >= 2, "2 or more for babble, which is other voices")

    def _weighs(self, *criteria: str) -> bool:
        return any(self.weights.get(name, 0.0) > 0.0 for name in criteria)
