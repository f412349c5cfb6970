"""Recipes: what a training of a simulator or a compensator is made of; a YAML file holds the same names."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Literal, Self

from hlsim.checks import check_choice, check_names, check_number, check_weights, describe
from hlsim.losses.frozen_simulator import ReferenceName
from hlsim.metrics.pair import SHORTEST_SECONDS

_WHERE = "in the recipe"
_SMALLEST = 1e-9  # of a duration or a learning rate

Kind = Literal["mapping-compensator", "hearing-aid"]
Precision = Literal["float32", "bfloat16"]
Unit = Literal["truth", "input"]


@dataclass(frozen=True, kw_only=True)
class TrainingRecipe:
    """What both recipes have, with a simulator's defaults.

    Attributes:
        model: settings of the network.
        start: checkpoint whose weights to start from, a name or a folder; its settings are the model's. It is
            also what is kept until the training gives a better one. Without it they are random.
        steps: number of training steps; the learning rate falls with them.
        batch: clips a step.
        seconds: length of a clip.
        learning_rate: of AdamW at its highest.
        weights: of the criteria.
        levels: lowest and highest level of the speech in dB SPL.
        sounds: share of clips that are tones or clicks instead of speech, 0 to 1.
        validate_every: steps.
        validation_items: how many, rounded up to whole batches of 4 (compensators) or 8.
        seed: of every random draw.
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
    shares: ClassVar[tuple[str, ...]] = ("sounds",)
    ranges: ClassVar[tuple[str, ...]] = ("levels",)
    choices: ClassVar[dict[str, Any]] = {}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Raises ValueError where a name is unknown or a value is not allowed."""
        check_names(data, (entry.name for entry in fields(cls)), "settings", _WHERE)
        return cls(**data)

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "validate_every", "validation_items"):
            check_number(name, getattr(self, name), 1, whole=True)
        for name in ("seconds", "learning_rate"):
            check_number(name, getattr(self, name), _SMALLEST)
        for name in self.shares:
            check_number(name, getattr(self, name), 0.0, 1.0)
        for name in self.ranges:
            object.__setattr__(self, name, _check_range(name, getattr(self, name)))
        for name, choice in self.choices.items():
            check_choice(name, getattr(self, name), choice, _WHERE)
        check_number("seed", self.seed, 1 - 2**62, 2**62 - 1, whole=True)
        check_weights(self.weights, self.criteria, "criteria")
        if not isinstance(self.model, Mapping):
            raise ValueError(f"expected model to hold settings by name, got {describe(self.model)}")
        if not isinstance(self.start, str):
            raise ValueError(f"expected start to be a name or a folder, got {describe(self.start)}")

    def _refuse(self, wrong: bool, names: tuple[str, ...], allowed: str) -> None:
        if wrong:
            found = ", ".join(f"{name} {getattr(self, name)!r}" for name in names)
            raise ValueError(f"{found} {_WHERE}; allowed: {allowed}")


@dataclass(frozen=True, kw_only=True)
class SimulatorRecipe(TrainingRecipe):
    """What a training of a simulator is made of.

    Attributes:
        model: settings of ``NeuroConfig``.
        weights: of ``snr`` (dB / 10), ``log_spectrum`` (dB / 10) and the paper's ``magnitude``, ``phase``, ``complex``,
            ``time``.
        unit_power: the signal that is scaled to unit power before the criteria, and all others with it: ``truth``, the
            target, so that quiet items count as much as loud ones, or ``input``, as in MP-SENet. The paper's criteria on
            a network without a prior want the latter: a severe ear's first errors are 50 dB above its target, and the
            network learns to be silent.
        levels: before amplification.
        treated: whether clips are equalised, amplified and compressed at random, as compensators do.
        precision: ``float32``, or ``bfloat16`` for the network's own layers: several times faster where the hardware has
            units for it, several times slower where it has not. Transforms, physics, scans and criteria stay in float32.
        average: weight of the past in the exponential moving average of the weights; the average is validated and kept. 0
            for none.
    """

    weights: dict[str, float] = field(default_factory=lambda: {"snr": 1.0, "log_spectrum": 0.5})
    unit_power: Unit = "truth"
    treated: bool = True
    precision: Precision = "float32"
    average: float = 0.99

    criteria = ("complex", "log_spectrum", "magnitude", "phase", "snr", "time")
    choices: ClassVar[dict[str, Any]] = {"unit_power": Unit, "precision": Precision}

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("average", self.average, 0.0, 0.99999)
        if not isinstance(self.treated, bool):
            raise ValueError(f"expected treated to be true or false, got {describe(self.treated)}")


@dataclass(frozen=True, kw_only=True)
class CompensatorRecipe(TrainingRecipe):
    """What a training of a compensator is made of.

    The defaults are for one ear and a few minutes: many small steps. All ears need larger batches and hours.

    Attributes:
        kind: ``mapping-compensator`` or ``hearing-aid``.
        model: settings of its ``MappingConfig`` or ``HearingAidConfig``.
        weights: of ``HearingLossLoss``'s criteria: ``coherent-bands``, ``bands`` (dB), ``paper``, and ``haspi``
            and ``hasqi`` (1 less the score; clips of 0.7 s and more); and of what a hearing aid's noise reduction is
            trained for (``hlsim.training.denoising``): ``denoising``, the error of its gains, and ``intelligibility``,
            what HASPI lacks of 1 at equal level. Without one of the others its amplification stays as it is, without
            these two its noise reduction.
        reference: what the paper's criterion compares with, ``clean`` or ``normal-hearing``.
        sounds: speech in noise alone teaches a network that what is steady is noise, to be taken away.
        equalised: share of clips whose speech is equalised at random by up to 15 dB, and of those whose noise is. Few
            voices teach few spectra, and the gain for another can be 20 dB off.
        noisy: share of noisy clips of speech, where there is noise; sounds have none.
        babble: share of these whose noise is up to four other voices.
        snr: lowest and highest signal-to-noise ratio in dB.
        unreduced: share of items of a hearing aid without noise reduction: the ear is to hear the noisy speech.
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
    shares = ("sounds", "equalised", "noisy", "babble", "unreduced")
    ranges = ("levels", "snr")
    choices: ClassVar[dict[str, Any]] = {"kind": Kind, "reference": ReferenceName}

    def __post_init__(self) -> None:
        super().__post_init__()
        scored = sum(self.weights.get(name, 0.0) for name in ("haspi", "hasqi", "intelligibility"))
        wrong = scored > 0.0 and self.seconds < SHORTEST_SECONDS
        self._refuse(
            wrong, ("seconds",), f"{SHORTEST_SECONDS} or more with haspi, hasqi or intelligibility"
        )
        reduced = sum(self.weights.get(name, 0.0) for name in ("denoising", "intelligibility"))
        wrong = self.kind != "hearing-aid" and self.unreduced + reduced > 0.0
        self._refuse(
            wrong, ("unreduced", "weights", "kind"), "no noise reduction but a hearing-aid's"
        )
        noiseless = not self.noisy and self.babble + reduced > 0.0
        self._refuse(
            noiseless,
            ("noisy", "babble", "weights"),
            "noisy above 0 with babble or noise reduction",
        )
        self._refuse(
            self.babble > 0.0 and self.batch < 2,
            ("babble", "batch"),
            "batches of 2 or more with babble",
        )


def _check_range(name: str, limits: Any) -> tuple[float, float]:
    """Return a lowest and a highest number, or raise ValueError unless there are two, ascending."""
    if not isinstance(limits, list | tuple) or len(limits) != 2:
        raise ValueError(f"expected {name} to be a pair such as [0, 20], got {describe(limits)}")
    for limit in limits:
        check_number(name, limit, -math.inf)
    if limits[0] > limits[1]:
        raise ValueError(f"expected {name} in ascending order, got {list(limits)}")
    return limits[0], limits[1]
