"""Training of a compensator through ``HearingLossLoss``, for one ear or for all."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from compensators.beamformer import BeamformingAid
from compensators.config import BeamformerConfig
from compensators.hearing_aid import HearingAid
from compensators.loading import TRAINED, load_compensator
from hlsim.audiogram import Audiogram
from hlsim.losses.hearing_loss import HearingLossLoss
from hlsim.training.batches import Batch, TrainingData, make_data
from hlsim.training.denoising import attenuation_error, missing_intelligibility
from hlsim.training.module import TrainingModule, describe_simulator, initial_network
from hlsim.training.recipes import CompensatorRecipe
from hlsim.training.trainer import train_network

Simulator = str | Path | nn.Module


class CompensatorTraining(TrainingModule):
    """Lightning module that trains a compensator in front of a frozen simulator.

    A ``HearingAid`` has two parts, noise reduction and amplification. The criteria ``"denoising"``
    and ``"intelligibility"`` train the noise reduction, those of ``HearingLossLoss`` the
    amplification; a part without criteria in the recipe is frozen. No criterion has a gradient for
    the other part: criteria of noise reduction would change the amplification, because HASPI rises
    with gain, and those of amplification would weaken the noise reduction, because it lowers the
    level.

    Args:
        recipe: Settings of the network and of the training.
        simulator: Name, folder or module, see ``load_simulator``.

    Raises:
        ValueError: The recipe, its start network or the simulator is not valid.

    >>> module = CompensatorTraining(CompensatorRecipe(model={"channels": 8, "blocks": 1}))
    >>> speech, ears = 0.02 * torch.randn(1, 8000), torch.full((1, 8), 40.0)
    >>> batch = {"signal": speech, "clean": speech, "thresholds": ears}
    >>> bool(module.compute_loss(batch) > 0.0)
    True
    """

    recipe: CompensatorRecipe

    def __init__(self, recipe: CompensatorRecipe, *, simulator: Simulator = "neuro-msbg") -> None:
        aid_class = TRAINED[recipe.kind]
        config: Any = aid_class.config_class.from_dict(recipe.model)
        load: Callable[[str], nn.Module] = load_compensator
        if isinstance(config, BeamformerConfig):
            load = partial(_load_beamforming_aid, config)
        network = initial_network(recipe, partial(aid_class, config=config), load)
        if isinstance(network, HearingAid):
            network.limit_to_ear = recipe.limit_to_ear
        elif isinstance(config, BeamformerConfig) and network.config.spacing != config.spacing:
            raise ValueError(
                f"expected scenes for the microphones of the start, {network.config.spacing:g} m "
                "apart; copy the settings 'model' of its recipe"
            )
        super().__init__(network, recipe)
        weights = {name: weight for name, weight in recipe.weights.items() if weight > 0.0}
        self.denoising = weights.pop("denoising", 0.0)
        self.intelligibility = weights.pop("intelligibility", 0.0)
        self.trains_amplification = bool(weights)
        self.loss = HearingLossLoss(
            simulator=simulator,
            criterion=weights or "coherent-bands",
            loudness=recipe.loudness,
        )
        if not self.trains_amplification:
            network.correct.requires_grad_(False)
        elif isinstance(network, BeamformingAid):
            network.aid.requires_grad_(False)
        elif isinstance(network, HearingAid) and not recipe.trains_noise_reduction():
            network.noise_reduction_network.requires_grad_(False)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        with torch.autocast(self.device.type, enabled=False):
            self.measured_values.append(self.compute_loss(batch)[None])

    def compute_loss(self, batch: Batch) -> Tensor:
        """Compute the loss of a batch, a scalar: the weighted sum of the recipe's criteria."""
        signal, clean, ears = batch["signal"], batch["clean"], batch["thresholds"]
        loss = signal.new_zeros(())
        if self.denoising:
            error = attenuation_error(self.network, signal, clean)
            loss = loss + self.denoising * error.mean()
        if self.intelligibility:
            with _freeze(self.network.correct):
                missing = missing_intelligibility(self.network, signal, clean, ears)
            loss = loss + self.intelligibility * missing.mean()
        if not self.trains_amplification:
            return loss
        if isinstance(self.network, BeamformingAid):
            output = self.network(signal, ears, noise_reduction=0.0)
            return loss + self.loss(output, clean, ears)
        if "noise_reduction" not in batch:
            return loss + self.loss(self.network(signal, ears), clean, ears)
        slider = batch["noise_reduction"]
        # An ear without noise reduction should perceive the noisy speech.
        reference = torch.lerp(signal, clean, slider.unsqueeze(-1))
        with _freeze(self.network.noise_reduction_network):
            output = self.network(signal, ears, slider)
        return loss + self.loss(output, reference, ears)

    def summarise(self, values: Tensor) -> dict[str, float]:
        """Compute ``valid_loss``, the mean loss of validation batches, and ``score``, its negative.

        Args:
            values: Losses of the batches, (batches,).
        """
        mean = float(values.double().mean())
        return {"score": -mean, "valid_loss": mean}


@contextmanager
def _freeze(part: nn.Module) -> Iterator[None]:
    """Freeze the weights of a part of a network inside a ``with`` block."""
    trained = [weight for weight in part.parameters() if weight.requires_grad]
    for weight in trained:
        weight.requires_grad_(False)
    try:
        yield
    finally:
        for weight in trained:
            weight.requires_grad_(True)


def _load_beamforming_aid(config: BeamformerConfig, name: str) -> nn.Module:
    """Load the aid of a checkpoint, and place a new front end before it if it is a ``HearingAid``.

    Any other aid is returned as it is. The new front end is untrained.

    Args:
        config: Settings of the front end, which joins several microphones.
        name: Name or folder of the checkpoint.

    Raises:
        ValueError: There is no such checkpoint.
    """
    start: Any = load_compensator(name)
    if not isinstance(start, HearingAid):
        return start
    aid = BeamformingAid(config=replace(config, aid=start.config.to_dict()))
    aid.aid.load_state_dict(start.state_dict())
    return aid


def train_compensator(
    data: TrainingData,
    recipe: CompensatorRecipe,
    *,
    out: str | Path,
    audiogram: Audiogram | None = None,
    simulator: Simulator = "neuro-msbg",
    **options: Any,
) -> Path:
    """Train a compensator, or resume its training, and save it as it is when it validates best.

    Args:
        data: Speech, noise and ears for training and validation.
        recipe: Network, criteria and number of steps.
        out: Folder for the results. A training that was interrupted resumes from it.
        audiogram: Ear of a personal compensator; None trains a general one on random ears and
            those of ``data``.
        simulator: Name, folder or module, see ``load_simulator``.
        options: ``max_minutes`` and options of Lightning's ``Trainer``, see ``train_network``.

    Returns:
        The folder that ``load_compensator`` reads, ``out/checkpoint``.

    Raises:
        ValueError: The data, the recipe or the simulator is invalid, there is an ``audiogram``
            although the data have ears, or the training fails, see ``train_network``.
        TypeError, KeyboardInterrupt: See ``train_network``.

    >>> def train_and_load(speech: str, out: str) -> nn.Module:
    ...     data, recipe = TrainingData(Path(speech)), CompensatorRecipe(steps=1000)
    ...     ear = Audiogram.standard("N4")
    ...     return load_compensator(train_compensator(data, recipe, out=out, audiogram=ear))
    """
    if audiogram and (data.audiograms or data.valid_audiograms):
        raise ValueError(
            "audiogram (--audiogram) excludes the data's audiograms and valid_audiograms "
            "(--audiograms, --valid-audiograms), because it trains for one ear; leave one or the "
            "other out"
        )
    about = {
        "data": data.identity(),
        "audiogram": audiogram.to_dict() if audiogram else None,
        **describe_simulator("simulator", simulator),
    }
    return train_network(
        CompensatorTraining(recipe, simulator=simulator),
        make_data(data, recipe, audiogram),
        out=out,
        about=about,
        **options,
    )
