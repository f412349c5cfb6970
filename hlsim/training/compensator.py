"""Training a compensator through ``HearingLossLoss``, for one ear or for all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

import torch
from torch import Tensor, nn

from compensators.hearing_aid import HearingAid
from compensators.pretrained import CONFIGS, build_compensator, load_compensator
from hlsim.audiogram import Audiogram
from hlsim.losses.criteria import Criterion
from hlsim.losses.hearing_loss import HearingLossLoss
from hlsim.pretrained import checkpoint_digest
from hlsim.training.batches import TrainingData, compensator_data
from hlsim.training.data_module import Batch
from hlsim.training.denoising import attenuation_error, missing_intelligibility
from hlsim.training.loop import RunOptions, train_network
from hlsim.training.module import ScheduledModule, initial_network
from hlsim.training.recipes import CompensatorRecipe

Simulator = str | Path | nn.Module


class CompensatorTraining(ScheduledModule):
    """Hears the compensator's output through the simulator, as ``HearingLossLoss`` takes it, frozen."""

    def __init__(self, recipe: CompensatorRecipe, *, simulator: Simulator = "neuro-msbg") -> None:
        super().__init__(recipe.learning_rate, recipe.steps)
        torch.manual_seed(recipe.seed)
        self.recipe = recipe
        network = (CONFIGS[recipe.kind], build_compensator, load_compensator)
        self.compensator = initial_network(recipe.start, recipe.model, *network)
        counted = {name: weight for name, weight in recipe.weights.items() if weight > 0.0}
        self.denoising, self.intelligibility = (
            counted.pop(name, 0.0) for name in ("denoising", "intelligibility")
        )
        criterion: Criterion = (
            counted or "coherent-bands"
        )  # for the examples, where nothing is learned through it
        self.loss = HearingLossLoss(
            simulator=simulator, reference=recipe.reference, criterion=criterion
        )
        self.hears = bool(counted)
        if isinstance(aid := self.compensator, HearingAid):
            if not self.hears:
                aid.correct.requires_grad_(False)  # or HASPI would amplify
            elif not (self.denoising or self.intelligibility):
                for part in (
                    aid.enter,
                    aid.recur,
                    aid.leave,
                ):  # to be heard at the right level it would not reduce
                    part.requires_grad_(False)

    def training_loss(self, batch: Batch) -> Tensor:
        signal, clean, ears = (batch[name] for name in ("signal", "clean", "thresholds"))
        value = signal.new_zeros(())
        if self.denoising:
            assert isinstance(self.compensator, HearingAid)
            value = (
                value + self.denoising * attenuation_error(self.compensator, signal, clean).mean()
            )
        if self.intelligibility:
            assert isinstance(self.compensator, HearingAid)
            missing = missing_intelligibility(self.compensator, signal, clean, ears)
            value = value + self.intelligibility * missing.mean()
        if not self.hears:
            return value
        if "noise_reduction" not in batch:
            return value + self.loss(self.compensator(signal, ears), clean, ears)
        given = self.compensator(signal, ears, batch["noise_reduction"])
        aim = signal + batch["noise_reduction"].unsqueeze(-1) * (clean - signal)
        return value + self.loss(given, aim, ears)

    def evaluate(self, batch: Batch) -> dict[str, Tensor]:
        return {"valid_loss": self.training_loss(batch)[None]}

    def figures(self, values: Mapping[str, Tensor]) -> dict[str, float]:
        """Mean of the loss over the validation batches."""
        mean = float(values["valid_loss"].double().mean())
        return {"score": -mean, "valid_loss": mean}

    def examples(self, batch: Batch) -> dict[str, Tensor]:
        signal, ears = batch["signal"][:1], batch["thresholds"][:1]
        aided = self.compensator(signal, ears)
        return {"given": signal[0], "aided": aided[0], "heard": self.loss.simulator(aided, ears)[0]}

    def released(self) -> nn.Module:
        return self.compensator


def train_compensator(
    data: TrainingData,
    recipe: CompensatorRecipe,
    *,
    out: str | Path,
    audiogram: Audiogram | None = None,
    simulator: Simulator = "neuro-msbg",
    **options: Unpack[RunOptions],
) -> Path:
    """Train, resume, and keep the best checkpoint.

    Args:
        audiogram: the ear of a personal compensator; None trains a general one on drawn ears.
        simulator: ``"neuro-msbg"``, another checkpoint's name or folder, ``"msbg"``, or a module.

    Returns: the folder that ``load_compensator`` takes, ``out/checkpoint``.

    Raises:
        ValueError: data, recipe or simulator that cannot be used; the message names them.
    """
    module = CompensatorTraining(recipe, simulator=simulator)
    batches = compensator_data(data, recipe, audiogram)
    start = module.validate(batches.val_dataloader())["valid_loss"]
    options.get("report", print)(f"start: valid_loss {start:.3f}")
    trained = {
        "audiogram": audiogram.to_dict() if audiogram else None,
        "simulator": type(simulator).__name__
        if isinstance(simulator, nn.Module)
        else str(simulator),
    }
    if isinstance(simulator, str | Path) and str(simulator) != "msbg":
        trained["simulator_sha256"] = checkpoint_digest(
            simulator
        )  # a folder may hold another one next time
    about = trained | {"start_valid_loss": start}
    how: dict[str, Any] = {"out": out, "identity": data.identity() | trained, "about": about}
    return train_network(module, batches, recipe, recipe.kind, **how, **options)
