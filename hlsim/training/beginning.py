"""What a training begins with: random weights, or those of a checkpoint."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from torch import nn

from hlsim.neuro.config import NetworkConfig
from hlsim.pretrained import checkpoint_digest

Network = TypeVar("Network", bound=nn.Module)


def started(
    start: str,
    settings: Mapping[str, Any],
    config_kind: type[NetworkConfig],
    kind: type[Network],
    load: Callable[[str], nn.Module],
) -> Network:
    """The network to train.

    Args:
        start: a checkpoint's name or folder; empty for random weights.
        settings: of the network; with ``start`` those of the checkpoint, or none.
        config_kind, kind: of the network.
        load: what loads a checkpoint by name, frozen.

    Raises:
        ValueError: no such checkpoint, or one of another kind or with other settings.
    """
    config = config_kind.from_dict(settings)
    if not start:
        return kind(config)
    network = load(start)
    if not isinstance(network, kind):
        raise ValueError(
            f"start {start!r} in the recipe is none to be trained; allowed: a checkpoint's name or folder"
        )
    if settings and config != network.config:
        ours, theirs = config.to_dict(), network.config.to_dict()  # type: ignore[operator,union-attr]
        differing = ", ".join(name for name in ours if ours[name] != theirs[name])
        raise ValueError(
            f"start {start!r} in the recipe has other settings of the model than the recipe ({differing}); allowed: the "
            "same, or no 'model' in the recipe"
        )
    return network.train().requires_grad_(True)


def start_identity(start: str) -> dict[str, str]:
    """Which weights these are, for a folder may hold others next time; empty without ``start``."""
    return {"start_sha256": checkpoint_digest(start)} if start else {}
