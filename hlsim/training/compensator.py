"""Training a compensator through ``HearingLossLoss``, for one ear or for all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from compensators.config import MappingConfig
from compensators.mapping import MappingCompensator
from compensators.pretrained import KIND, load_compensator
from hlsim.audiogram import Audiogram, draw_thresholds
from hlsim.calibration import set_level
from hlsim.checks import refuse_other_kinds, refuse_seed, refuse_unknown, refuse_weights
from hlsim.data.augment import equalise, mix
from hlsim.data.clips import Clips
from hlsim.data.sounds import draw_sounds
from hlsim.loss import HearingLossLoss
from hlsim.neuro.config import NEURO_RATE
from hlsim.pretrained import checkpoint_digest, save_checkpoint
from hlsim.training.beginning import start_identity, started
from hlsim.training.loop import TimedModule, run
from hlsim.training.sources import TrainingData, read_thresholds
from hlsim.training.state import CHECKPOINT

CRITERIA = ("bands", "paper")

_KNOTS = (100.0, 250.0, 600.0, 1500.0, 3500.0, 7000.0)  # Hz, of the random equaliser


@dataclass(frozen=True)
class CompensatorRecipe:
    """What a training of a compensator is made of; a YAML file holds the same names.

    The defaults are for one ear and a few minutes: many small steps. All ears need larger batches and hours.

    Attributes:
        model: settings of ``MappingConfig``.
        start: checkpoint whose weights to start from, a name or a folder; its settings are the model's. It is
            also what is kept until the training gives a better one. Without it they are random.
        batch: clips a step.
        seconds: length of a clip.
        learning_rate: of AdamW at its highest.
        weights: of ``HearingLossLoss``'s criteria: ``bands`` (dB) and ``paper``.
        reference: what the paper's criterion compares with, ``clean`` or ``normal-hearing``.
        sounds: share of clips that are tones or clicks instead of speech, 0 to 1. Speech in noise alone teaches a network
            that what is steady is noise, to be taken away.
        levels: lowest and highest level of the speech in dB SPL.
        equalised: share of clips whose speech is equalised at random by up to 15 dB. Few voices teach few spectra, and
            the gain for another can be 20 dB off.
        noisy: share of noisy clips, where there is noise.
        snr: lowest and highest signal-to-noise ratio in dB.
        validate_every: steps.
        validation_items: how many.
        seed: of every random draw.
    """

    model: dict[str, Any] = field(default_factory=dict)
    start: str = ""
    batch: int = 2
    seconds: float = 0.6
    learning_rate: float = 3e-3
    weights: dict[str, float] = field(default_factory=lambda: {"bands": 1.0})
    reference: str = "clean"
    sounds: float = 0.2
    levels: tuple[float, float] = (50.0, 80.0)
    equalised: float = 0.7
    noisy: float = 0.5
    snr: tuple[float, float] = (0.0, 20.0)
    validate_every: int = 50
    validation_items: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        refuse_other_kinds(self, "in the recipe")
        refuse_weights(self.weights, CRITERIA, "in the recipe")
        for name in ("levels", "snr"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        counts = (self.batch, self.validate_every, self.validation_items)
        if min(counts) < 1 or self.seconds <= 0.0 or self.learning_rate <= 0.0:
            raise ValueError(
                f"batch {self.batch}, validate_every {self.validate_every}, validation_items {self.validation_items}, "
                f"seconds {self.seconds}, learning_rate {self.learning_rate} in the recipe; allowed: counts from 1 up, "
                "seconds and learning_rate above 0"
            )
        refuse_seed(self.seed, "in the recipe")
        shares = {name: getattr(self, name) for name in ("sounds", "equalised", "noisy")}
        if not all(0.0 <= share <= 1.0 for share in shares.values()):
            told = ", ".join(f"{name} {share}" for name, share in shares.items())
            raise ValueError(f"{told} in the recipe; allowed: 0 to 1")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> CompensatorRecipe:
        """Raises ValueError where a name is unknown or a value is not allowed."""
        refuse_unknown(data, (entry.name for entry in fields(cls)), "settings", "in the recipe")
        return cls(**data)


class CompensatorTraining(TimedModule):
    """Draws speech, noise, levels and ears, and hears the compensator's output through the frozen simulator.

    Args:
        audiogram: the ear of a personal compensator; None trains a general one on drawn ears.
        simulator: as ``HearingLossLoss`` takes it.
    """

    def __init__(
        self,
        recipe: CompensatorRecipe,
        data: TrainingData,
        max_minutes: float,
        *,
        audiogram: Audiogram | None = None,
        simulator: str | Path | torch.nn.Module = "neuro-msbg",
    ) -> None:
        super().__init__(recipe.learning_rate, max_minutes, recipe.seed)
        torch.manual_seed(recipe.seed)
        self.recipe = recipe
        self.compensator = started(
            recipe.start, recipe.model, MappingConfig, MappingCompensator, load_compensator
        )
        self.criteria = torch.nn.ModuleDict()
        for name, weight in recipe.weights.items():
            if weight > 0.0:
                loss = HearingLossLoss(simulator=simulator, reference=recipe.reference, criterion=name)
                simulator = loss.simulator  # the next criterion shares it
                self.criteria[name] = loss
        self.ear = None if audiogram is None else torch.tensor(audiogram.thresholds)
        self.training_items = Items(recipe, data, recipe.seconds)
        valid = Items(replace(recipe, equalised=0.0), data.validation(), seconds=2.0)
        generator = torch.Generator().manual_seed(2_000 + recipe.seed)
        self.valid = [valid.draw(4, generator, self.ear) for _ in range(0, recipe.validation_items, 4)]

    def training_loss(self, generator: torch.Generator) -> Tensor:
        return self._loss(*self.training_items.draw(self.recipe.batch, generator, self.ear))

    def validate(self) -> dict[str, float]:
        """Mean of the loss over the validation items."""
        with torch.no_grad():
            losses = [float(self._loss(*batch)) for batch in self.valid]
        mean = sum(losses) / len(losses)
        return {"score": -mean, "valid_loss": mean}

    def examples(self) -> dict[str, Tensor]:
        speech, _, ears = (tensor[:1].to(self.device) for tensor in self.valid[0])
        aided = self.compensator(speech, ears)
        loss = next(iter(self.criteria.values()))
        assert isinstance(loss, HearingLossLoss)
        return {"given": speech[0], "aided": aided[0], "heard": loss.simulator(aided, ears)[0]}

    def trained_parameters(self) -> list[torch.nn.Parameter]:
        return list(self.compensator.parameters())

    def _loss(self, speech: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
        speech, clean, ears = (tensor.to(self.device) for tensor in (speech, clean, ears))
        aided = self.compensator(speech, ears)
        parts = [
            self.recipe.weights[name] * criterion(aided, clean, ears)
            for name, criterion in self.criteria.items()
        ]
        return torch.stack(parts).sum()


class Items:
    """Random speech, clean or noisy, and the ears that it is for."""

    def __init__(self, recipe: CompensatorRecipe, data: TrainingData, seconds: float) -> None:
        self.recipe = recipe
        options: dict[str, Any] = {"sample_rate": NEURO_RATE, "seconds": seconds}
        self.speech = Clips(data.speech, **options)
        self.noise = Clips(data.noise, repeat=True, **options) if data.noise else None
        self.ears = read_thresholds(data.audiograms)

    def draw(
        self, count: int, generator: torch.Generator, ear: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The compensator's input, the same without its noise, and the ears: ``ear`` or drawn ones.

        Shape: -> (count, time) in pascals twice, (count, 8) dB HL.
        """

        def uniform(low: float, high: float) -> Tensor:
            return low + (high - low) * torch.rand(count, generator=generator)

        clean = self.speech.draw(count, generator)
        gains = 30.0 * torch.rand(count, len(_KNOTS), generator=generator) - 15.0
        equalised = equalise(clean, gains, torch.tensor(_KNOTS), NEURO_RATE)
        clean = torch.where((uniform(0.0, 1.0) < self.recipe.equalised).unsqueeze(-1), equalised, clean)
        if self.recipe.sounds:
            sounds = draw_sounds(count, clean.shape[-1], NEURO_RATE, generator)
            clean = torch.where((uniform(0.0, 1.0) < self.recipe.sounds).unsqueeze(-1), sounds, clean)
        clean = set_level(clean, uniform(*self.recipe.levels))
        speech = clean
        if self.noise is not None:
            noisy = mix(clean, self.noise.draw(count, generator), uniform(*self.recipe.snr))
            speech = torch.where((uniform(0.0, 1.0) < self.recipe.noisy).unsqueeze(-1), noisy, clean)
        if ear is not None:
            return speech, clean, ear.expand(count, -1)
        ears = draw_thresholds(count, generator)
        if self.ears is not None:
            measured = self.ears[torch.randint(len(self.ears), (count,), generator=generator)]
            ears = torch.where((uniform(0.0, 1.0) < 0.5).unsqueeze(-1), measured, ears)
        return speech, clean, ears


def train_compensator(
    data: TrainingData,
    recipe: CompensatorRecipe,
    *,
    out: str | Path,
    audiogram: Audiogram | None = None,
    simulator: str | Path | torch.nn.Module = "neuro-msbg",
    max_minutes: float,
    max_steps: int = -1,
    accelerator: str = "auto",
    devices: int = 1,
    nodes: int = 1,
    strategy: str = "auto",
    report: Callable[[str], None] = print,
    progress: bool = True,
) -> Path:
    """Train, resume, and keep the best checkpoint.

    Args:
        audiogram: the ear of a personal compensator; None trains a general one on drawn ears.
        simulator: ``"neuro-msbg"``, another checkpoint's name or folder, ``"msbg"``, or a module.

    Returns: the folder that ``load_compensator`` takes, ``out/checkpoint``.

    Raises:
        ValueError: data, recipe or simulator that cannot be used; the message names them.
    """
    module = CompensatorTraining(recipe, data, max_minutes, audiogram=audiogram, simulator=simulator)
    folder = Path(out) / CHECKPOINT
    start = module.validate()["valid_loss"]
    report(f"start: valid_loss {start:.3f}")
    trained = {
        "audiogram": audiogram.to_dict() if audiogram else None,
        "simulator": type(simulator).__name__ if isinstance(simulator, torch.nn.Module) else str(simulator),
    }
    if isinstance(simulator, str | Path) and str(simulator) != "msbg":
        trained["simulator_sha256"] = checkpoint_digest(simulator)  # a folder may hold another one next time
    trained |= start_identity(recipe.start)

    def write(figures: dict[str, Any]) -> None:
        from hlsim import __version__

        about = {
            "hlsim": __version__,
            "recipe": asdict(recipe),
            **trained,
            "start_valid_loss": start,
            **figures,
        }
        save_checkpoint(folder, KIND, module.compensator, module.compensator.config.to_dict(), about)

    run(
        module,
        out=out,
        recipe=asdict(recipe)
        | {"max_minutes": max_minutes}
        | {name: str(path) for name, path in asdict(data).items()}
        | trained,
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
