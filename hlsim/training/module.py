"""The Lightning module of both trainings: learning rate, validation scores, and initial weights."""

import hashlib
import inspect
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import safetensors.torch
import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from hlsim.checkpoint import read_record
from hlsim.files import source_hash
from hlsim.simulators import BUILT_IN, PluginSimulator, load_simulator
from hlsim.training.batches import Batch
from hlsim.training.recipes import TrainingRecipe

_WARM_UP_STEPS = 50
"""Number of steps over which the learning rate rises."""


class TrainingModule(L.LightningModule):
    """Lightning module of both trainings: a network with its loss and its validation.

    The learning rate depends on the step alone, and the training ends with a validation after the
    recipe's last step. Subclasses implement ``compute_loss``; ``validation_step``, which
    appends to ``measured_values``; and ``summarise``.

    Args:
        network: Network to train.
        recipe: Learning rate, number of steps, and settings of the subclass.

    Attributes:
        measured_values: Values that the validation has measured so far, one tensor per batch: one
            value per item, (items,), or their mean, (1,).
        validation: Results of the last validation by name. The best network has the highest
            ``score``.

    >>> from hlsim.training.recipes import CompensatorRecipe
    >>> module = TrainingModule(nn.Linear(2, 1), CompensatorRecipe())
    >>> list(module.state_dict())
    ['network.weight', 'network.bias']
    """

    def __init__(self, network: nn.Module, recipe: TrainingRecipe) -> None:
        super().__init__()
        self.network: Any = network
        self.recipe = recipe
        self.validation: dict[str, float] = {}
        self.measured_values: list[Tensor] = []

    def compute_loss(self, batch: Batch) -> Tensor:
        """Compute the loss of a batch, a scalar tensor with a gradient."""
        raise NotImplementedError

    def summarise(self, values: Tensor) -> dict[str, float]:
        """Summarise the measured values of all validation batches.

        Args:
            values: All ``measured_values`` in one tensor, (values,).

        Returns:
            Dict with means or quantiles, and with ``score``, which is higher for a better network.
        """
        raise NotImplementedError

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Compute and log the loss of a batch; Lightning calls this method at each step.

        Raises:
            ValueError: The loss is not finite.
        """
        # Networks and losses leave autocast by themselves, but not every criterion does.
        with torch.autocast(self.device.type, enabled=False):
            loss = self.compute_loss(batch)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise ValueError(
                f"the loss is {value} at step {self.global_step}, expected a finite value; lower "
                "learning_rate in the recipe"
            )
        self.log("loss", loss, prog_bar=True)
        return loss

    def on_train_batch_end(self, *arguments: Any) -> None:
        # Stopping makes the Trainer validate and save its state, even if the last interval is
        # shorter than the others.
        if self.global_step >= self.recipe.steps:
            self.trainer.should_stop = True

    def on_validation_epoch_start(self) -> None:
        self.measured_values = []

    def on_validation_epoch_end(self) -> None:
        self.validation = self.summarise(torch.cat(self.measured_values))
        if math.isnan(self.validation["score"]):  # which would count as the best score
            raise ValueError(
                f"the validation score is NaN at step {self.global_step}; lower learning_rate in "
                "the recipe"
            )
        self.log_dict(self.validation, prog_bar=True, batch_size=1, sync_dist=True)
        if self.trainer.progress_bar_callback is None:  # a progress bar shows the measures
            texts = [f"{name} {value:.3f}" for name, value in self.validation.items()]
            self.print(f"step {self.global_step} of {self.recipe.steps}: {', '.join(texts)}")

    def configure_optimizers(self) -> OptimizerLRScheduler:
        # Without foreach, each of the many small tensors costs several calls on a CPU.
        optimizer = torch.optim.AdamW(
            self.network.parameters(),
            lr=self.recipe.learning_rate,
            weight_decay=1e-4,
            foreach=True,
        )
        scheduler = LambdaLR(optimizer, partial(relative_learning_rate, steps=self.recipe.steps))
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }


def relative_learning_rate(step: int, steps: int) -> float:
    """Compute the learning rate at a step, relative to the recipe's ``learning_rate``.

    The rate rises linearly over the first 50 steps, from 1/50. It is also multiplied by half a
    period of a cosine, which falls from 1 at the first step to 0 after the last one, but by 0.01 at
    least.

    Args:
        step: Number of the step, from 0.
        steps: Number of steps of the training.

    >>> relative_learning_rate(25, 1000) < relative_learning_rate(50, 1000)
    True
    """
    rise = min(1.0, (step + 1) / _WARM_UP_STEPS)
    fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / steps)))
    return rise * max(0.01, fall)


def initial_network(
    recipe: TrainingRecipe, build: Callable[[], nn.Module], load: Callable[[str], nn.Module]
) -> Any:
    """Build the network to train, with random weights or with those of a checkpoint.

    Args:
        recipe: Recipe with the name of the checkpoint (``start``), the settings of the network
            (``model``) and the seed of random weights.
        build: Function that builds a network with the settings of the recipe.
        load: Function that loads the network of a checkpoint by its name or folder.

    Returns:
        The network, in training mode, all of whose weights are trained.

    Raises:
        ValueError: There is no such checkpoint, it is of another kind, or the recipe has other
            settings of the network.

    >>> from hlsim.neuro import NeuroMSBG, load_pretrained
    >>> from hlsim.training.recipes import SimulatorRecipe
    >>> recipe = SimulatorRecipe(start="neuro-msbg-cnn")
    >>> initial_network(recipe, NeuroMSBG, load_pretrained).config.channels
    32
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        network: Any = build()
        if not recipe.start:
            return network
        torch.manual_seed(recipe.seed)  # ``load`` may add an untrained part, such as a front end
        start: Any = load(recipe.start)
    is_kind = getattr(start, "kind", None) == network.kind
    if not is_kind or (recipe.model and start.config != network.config):
        raise ValueError(
            f"the start {recipe.start!r} is not a {network.kind} with the settings 'model' of the "
            "recipe; choose another start, leave 'model' out if it is a simulator or a "
            "mapping-compensator, or copy the settings of the start into it"
        )
    return start.train().requires_grad_(True)


def describe_simulator(role: str, simulator: str | Path | nn.Module) -> dict[str, str]:
    """Describe a simulator for the record of a training, which resumes only with the same one.

    Args:
        role: Name of the entry, ``"simulator"`` or ``"teacher"``.
        simulator: Name, folder or module, see ``load_simulator``.

    Returns:
        Dict with the entry ``role``: the name of the simulator, or its class with its
        ``extra_repr``. A network, or any module, adds a hash of its weights as ``<role>_sha256``,
        because a file may contain other weights when the training resumes. Your own code adds its
        attribute ``fingerprint`` to the name, as in ``ear.py:Ear (v2)``. Without this attribute, it
        adds a hash of its file as ``<role>_code_sha256``.

    Raises:
        ValueError: There is no such simulator, it is not valid (see ``load_simulator``), or a
            module was built for another sample rate than 16 kHz or for another full scale than
            pascals.

    >>> describe_simulator("teacher", "msbg")
    {'teacher': 'msbg'}
    """
    loaded = load_simulator(simulator)
    code: Any
    if isinstance(loaded, PluginSimulator):
        name, code = loaded.plugin.name, loaded.plugin.function
    elif isinstance(simulator, nn.Module):
        name, code = f"{type(simulator).__name__}({simulator.extra_repr()})", simulator
    elif str(simulator) in BUILT_IN:
        return {role: str(simulator)}
    else:
        return {role: str(simulator), f"{role}_sha256": read_record(simulator)["sha256"]}
    version = getattr(code, "fingerprint", None)
    if version is not None:
        name += f" ({version})"
    return {role: name, **_hash_weights_and_code(role, code)}


def _hash_weights_and_code(role: str, code: Any) -> dict[str, str]:
    """Return hashes of a function or module: of its weights, and of the file of its source code.

    There is no hash of weights for a function. There is none of the file for code of hlsim or
    torch, for code with an attribute ``fingerprint``, and for code without a file.

    Returns: The entries ``<role>_sha256`` and ``<role>_code_sha256`` of ``describe_simulator``.
    """
    hashes = {}
    if isinstance(code, nn.Module):
        state = {name: tensor.cpu().contiguous() for name, tensor in code.state_dict().items()}
        hashes[f"{role}_sha256"] = hashlib.sha256(safetensors.torch.save(state)).hexdigest()
    owner = code if inspect.isroutine(code) else type(code)
    package = str(getattr(owner, "__module__", "")).partition(".")[0]
    digest = source_hash(owner)
    is_versioned = getattr(code, "fingerprint", None) is not None
    if digest and package not in ("hlsim", "torch") and not is_versioned:
        hashes[f"{role}_code_sha256"] = digest
    return hashes
