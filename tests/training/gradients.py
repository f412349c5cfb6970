"""Check that several tests of training share."""

from hlsim.training.batches import Batch
from hlsim.training.module import TrainingModule


def check_gradients(module: TrainingModule, batch: Batch) -> float:
    """Check that loss and gradients of a batch are finite and precise, and return the loss."""
    loss = module.training_step(batch, 0)
    loss.backward()
    assert bool(loss.isfinite())
    for parameter in module.network.parameters():
        if parameter.requires_grad:
            assert parameter.grad is not None and parameter.grad.dtype == parameter.dtype
            assert bool(parameter.grad.isfinite().all())
    return float(loss.detach())
