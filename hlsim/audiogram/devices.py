"""Tensors of thresholds on a GPU and on the CPU, copied so that the CPU rarely waits for the GPU.

Copying a tensor to a GPU, or back, makes the CPU (the *host*) wait until the GPU has done
everything that was queued before. Therefore each copy is made once. It is remembered, in both
directions, for as long as the original tensor lives and nobody writes into it.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

_HOST = torch.device("cpu")

_COPIES = WeakTensorKeyDictionary()
"""Copies by original and device, each with the number of changes of the original when it was made.

They are forgotten with their original.
"""


def _find_copy(tensor: Tensor, device: torch.device) -> Tensor | None:
    """Return the copy on a device, or None if there is none or the original has changed."""
    if not _is_remembered(tensor):
        return None
    version, copy = _COPIES.get(tensor, {}).get(device, (None, None))
    return copy if version == tensor._version else None


def _add_copy(tensor: Tensor, copy: Tensor) -> None:
    if _is_remembered(tensor):
        _COPIES.setdefault(tensor, {})[copy.device] = tensor._version, copy


def _is_remembered(tensor: Tensor) -> bool:
    # a compiled program must not hold values, and inference tensors do not count their changes
    return not (torch.compiler.is_compiling() or tensor.is_inference())


def on_device(levels: Tensor, device: torch.device) -> Tensor:
    """Return thresholds on a device, without making the CPU wait for it if they are constants.

    Reading them back would make the CPU wait. If they come from the CPU, the original is
    remembered, so that ``on_host`` need not wait either.

    Args:
        levels: Thresholds of any shape.
        device: Device of the result.

    >>> on_device(torch.zeros(8), torch.device("cpu")).device
    device(type='cpu')
    """
    if levels.device == device:
        return levels
    if levels.device != _HOST or levels.requires_grad:
        return levels.to(device)
    copy = _find_copy(levels, device)
    if copy is None:
        copy = levels.to(device, non_blocking=True)
        _add_copy(levels, copy)
        _add_copy(copy, levels)
    return copy


def on_host(levels: Tensor) -> Tensor:
    """Return thresholds on the CPU, which waits for another device unless it knows their values.

    Args:
        levels: Thresholds of any shape, on any device.

    >>> on_host(torch.zeros(8)).device
    device(type='cpu')
    """
    if levels.device == _HOST:
        return levels.detach()
    copy = known_on_host(levels)
    if copy is None:
        copy = levels.detach().cpu()
        _add_copy(levels, copy)
    return copy


def known_on_host(levels: Tensor) -> Tensor | None:
    """Return thresholds on the CPU if their values are known there, else None.

    Args:
        levels: Thresholds of any shape, on any device.

    >>> known_on_host(torch.zeros(2))
    tensor([0., 0.])
    """
    return levels.detach() if levels.device == _HOST else _find_copy(levels, _HOST)
