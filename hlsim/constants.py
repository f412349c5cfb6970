"""Constants as tensors, copied to a device once: each copy makes the device wait for the processor."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from hlsim.compiling import lasting


def constant(make: Callable[..., Any], *arguments: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    """What ``make`` returns for these arguments, an array or numbers, as a tensor that nobody may write into."""
    # what a trace or a mode, as that of fake tensors, makes is of no use to others
    if torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack():
        return _made(make, arguments, dtype, device)
    return _kept(make, arguments, dtype, device)


def _made(
    make: Callable[..., Any], arguments: tuple[Any, ...], dtype: torch.dtype, device: torch.device
) -> Tensor:
    return torch.as_tensor(make(*arguments)).to(device=device, dtype=dtype)


@lru_cache(maxsize=128)
def _kept(
    make: Callable[..., Any], arguments: tuple[Any, ...], dtype: torch.dtype, device: torch.device
) -> Tensor:
    with lasting():
        return _made(make, arguments, dtype, device)
