"""Copies of ears on other devices, which are made once so that the host never waits for the device.

Moving an ear to a GPU, or reading its values back, would make the host wait until the GPU has done
everything that was queued before. Both directions are remembered for as long as the ear lives and
nobody writes into it.
"""

from __future__ import annotations

import weakref

import torch
from torch import Tensor


class _Copies:
    """Copies of tensors, by tensor and device. A copy is forgotten with its tensor."""

    def __init__(self) -> None:
        self._entries: dict[tuple[int, torch.device], tuple[weakref.ref[Tensor], int, Tensor]] = {}

    def find(self, tensor: Tensor, device: torch.device) -> Tensor | None:
        """Return the copy on a device, or None if there is none or the tensor has changed since."""
        if not _is_remembered(tensor):
            return None
        owner, version, copy = self._entries.get((id(tensor), device), (None, 0, None))
        if owner is None or owner() is not tensor or version != tensor._version:
            return None
        return copy

    def add(self, tensor: Tensor, copy: Tensor) -> None:
        if not _is_remembered(tensor):
            return
        key = id(tensor), copy.device
        owner = weakref.ref(tensor, lambda _: self._entries.pop(key, None))
        self._entries[key] = owner, tensor._version, copy


def _is_remembered(tensor: Tensor) -> bool:
    # a compiled program must not hold values, and inference tensors do not count their changes
    return not (torch.compiler.is_compiling() or tensor.is_inference())


_COPIES = _Copies()
_HOST = torch.device("cpu")


def on_device(levels: Tensor, device: torch.device) -> Tensor:
    """Return thresholds on a device, without making the host wait.

    The copy of thresholds from the CPU is stored, so that ``on_host`` finds their values.

    Shape: any -> the same.

    >>> on_device(torch.zeros(8), torch.device("cpu")).device
    device(type='cpu')
    """
    if levels.device == device:
        return levels
    copy = None if levels.requires_grad else _COPIES.find(levels, device)
    if copy is None:
        copy = levels.to(device, non_blocking=device != _HOST)
        if levels.device == _HOST and not levels.requires_grad:
            _COPIES.add(levels, copy)
    if levels.device == _HOST:
        _COPIES.add(copy, levels.detach())
    return copy


def on_host(levels: Tensor) -> Tensor:
    """Return thresholds on the CPU. The host waits for the device unless a copy is stored.

    Shape: any -> the same.

    >>> on_host(torch.zeros(8)).device
    device(type='cpu')
    """
    if levels.device == _HOST:
        return levels.detach()
    copy = known_on_host(levels)
    if copy is None:
        copy = levels.detach().cpu()
        _COPIES.add(levels, copy)
    return copy


def known_on_host(levels: Tensor) -> Tensor | None:
    """Return thresholds on the CPU if a copy is stored, else None.

    >>> known_on_host(torch.zeros(2))
    tensor([0., 0.])
    """
    return levels.detach() if levels.device == _HOST else _COPIES.find(levels, _HOST)
