"""A running average of weights."""

from collections.abc import Sequence

from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel


def average_of(model: nn.Module, decay: float) -> AveragedModel:
    """A copy of a model that follows it as an exponential average; ``.module`` is the averaged model.

    The first steps count as much as their number allows, (1 + n) / (10 + n), so that it does not keep its random start.

    Args:
        decay: weight of the past, 0 to below 1; 0 copies.
    """

    def follow(kept: Sequence[Tensor], new: Sequence[Tensor], count: Tensor | int) -> None:
        weight = min(decay, (1.0 + float(count)) / (10.0 + float(count)))
        for old, now in zip(kept, new, strict=True):
            old.lerp_(now.to(old), 1.0 - weight)

    average = AveragedModel(model, multi_avg_fn=follow)
    average.requires_grad_(False)  # several processes would wait for its gradients
    return average
