"""Training of a compensator through ``HearingLossLoss``, for one ear or for all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

from torch import Tensor, nn

from compensators.hearing_aid import HearingAid
from compensators.loading import CONFIGS, build_compensator, load_compensator
from hlsim.audiogram import Audiogram
from hlsim.checkpoint import read_record
from hlsim.losses.hearing_loss import HearingLossLoss
from hlsim.training.batches import TrainingData, compensator_data
from hlsim.training.data_module import Batch
from hlsim.training.denoising import attenuation_error, missing_intelligibility
from hlsim.training.module import TrainingModule, initial_network
from hlsim.training.recipes import CompensatorRecipe
from hlsim.training.trainer import TrainerOptions, train_network

Simulator = str | Path | nn.Module

_NOISE_REDUCTION_CRITERIA = ("denoising", "intelligibility")
"""Criteria that train a hearing aid's noise reduction. ``HearingLossLoss`` has the others."""


class CompensatorTraining(TrainingModule):
    """Lightning module that trains a compensator in front of a frozen simulator.

    A ``HearingAid`` has two parts, noise reduction and amplification. The criteria ``"denoising"``
    and ``"intelligibility"`` train the noise reduction, those of ``HearingLossLoss`` the
    amplification; a part without criteria in the recipe is frozen. If the parts shared criteria,
    those of noise reduction would change the amplification, because HASPI rewards gain, and those
    of amplification would weaken the noise reduction, because it lowers the level.

    Args:
        recipe: Settings of the network and of the training.
        simulator: ``"neuro-msbg"``, another checkpoint's name or folder, ``"msbg"``, or a module.

    >>> import torch
    >>> module = CompensatorTraining(CompensatorRecipe(model={"channels": 8, "blocks": 1}))
    >>> speech, ears = 0.02 * torch.randn(1, 8000), torch.full((1, 8), 40.0)
    >>> batch = {"signal": speech, "clean": speech, "thresholds": ears}
    >>> bool(module.training_loss(batch) > 0.0)
    True
    """

    recipe: CompensatorRecipe

    def __init__(self, recipe: CompensatorRecipe, *, simulator: Simulator = "neuro-msbg") -> None:
        kind = CONFIGS[recipe.kind]
        network = initial_network(recipe, kind, build_compensator, load_compensator)
        super().__init__(network, recipe)
        used = {name: weight for name, weight in recipe.weights.items() if weight > 0.0}
        self.noise_weights = {
            name: used.pop(name) for name in _NOISE_REDUCTION_CRITERIA if name in used
        }
        self.trains_amplification = bool(used)
        self.loss = HearingLossLoss(
            simulator=simulator, reference=recipe.reference, criterion=used or "coherent-bands"
        )
        if isinstance(network, HearingAid):
            self._freeze_parts(network)

    def _freeze_parts(self, aid: HearingAid) -> None:
        if not self.trains_amplification:
            aid.correct.requires_grad_(False)
        elif not self.noise_weights:
            for part in (aid.enter, aid.recur, aid.leave):
                part.requires_grad_(False)

    def training_loss(self, batch: Batch) -> Tensor:
        signal, clean, ears = batch["signal"], batch["clean"], batch["thresholds"]
        loss = signal.new_zeros(())
        if "denoising" in self.noise_weights:
            error = attenuation_error(self.network, signal, clean)
            loss = loss + self.noise_weights["denoising"] * error.mean()
        if "intelligibility" in self.noise_weights:
            missing = missing_intelligibility(self.network, signal, clean, ears)
            loss = loss + self.noise_weights["intelligibility"] * missing.mean()
        if self.trains_amplification:
            loss = loss + self._amplification_loss(batch)
        return loss

    def _amplification_loss(self, batch: Batch) -> Tensor:
        signal, clean, ears = batch["signal"], batch["clean"], batch["thresholds"]
        if "noise_reduction" not in batch:
            sliders = {"noise_reduction": 1.0} if isinstance(self.network, HearingAid) else {}
            return self.loss(self.network(signal, ears, **sliders), clean, ears)
        # An ear without noise reduction should perceive the noisy speech.
        slider = batch["noise_reduction"]
        reference = signal + slider.unsqueeze(-1) * (clean - signal)
        return self.loss(self.network(signal, ears, slider), reference, ears)

    def evaluate(self, batch: Batch) -> dict[str, Tensor]:
        """Compute the loss of a validation batch, ``valid_loss`` with shape (1,)."""
        return {"valid_loss": self.training_loss(batch)[None]}

    def summarise(self, values: Mapping[str, Tensor]) -> dict[str, float]:
        """Compute ``valid_loss``, the mean over validation batches, and ``score``, minus that."""
        mean = float(values["valid_loss"].double().mean())
        return {"score": -mean, "valid_loss": mean}


def train_compensator(
    data: TrainingData,
    recipe: CompensatorRecipe,
    *,
    out: str | Path,
    audiogram: Audiogram | None = None,
    simulator: Simulator = "neuro-msbg",
    **options: Unpack[TrainerOptions],
) -> Path:
    """Train a compensator, or resume its training, and save it as it is when it validates best.

    Args:
        data: Speech, noise and ears for training and validation.
        recipe: Network, criteria and number of steps.
        out: Folder for the results. A training that was interrupted resumes from it.
        audiogram: Ear of a personal compensator; None trains a general one on random ears.
        simulator: ``"neuro-msbg"``, another checkpoint's name or folder, ``"msbg"``, or a module.
        options: Device, time limit and progress, see ``TrainerOptions``.

    Returns:
        The folder that ``load_compensator`` reads, ``out/checkpoint``.

    Raises:
        ValueError: The data, the recipe or the simulator is invalid.

    >>> def train_and_load(speech: str, out: str) -> nn.Module:
    ...     data, recipe = TrainingData(Path(speech)), CompensatorRecipe(steps=1000)
    ...     ear = Audiogram.standard("N4")
    ...     return load_compensator(train_compensator(data, recipe, out=out, audiogram=ear))
    """
    module = CompensatorTraining(recipe, simulator=simulator)
    batches = compensator_data(data, recipe, audiogram)
    is_module = isinstance(simulator, nn.Module)
    about: dict[str, Any] = {
        "audiogram": audiogram.to_dict() if audiogram else None,
        "simulator": type(simulator).__name__ if is_module else str(simulator),
    }
    if not is_module and str(simulator) != "msbg":
        # The folder may contain another simulator when the training resumes.
        about["simulator_sha256"] = read_record(simulator)["sha256"]  # type: ignore[arg-type]
    return train_network(
        module,
        batches,
        recipe.kind,
        out=out,
        identity=data.identity() | about,
        about=about,
        **options,
    )
