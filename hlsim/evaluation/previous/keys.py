"""Fingerprints of the earlier kind."""

import hashlib
import inspect
import pickle
import uuid
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn


def weights_hash(module: nn.Module) -> str:
    """What makes a simulator or compensator this one: its class, its settings and its weights, kept in it or not.

    Of a class outside hlsim and torch the source counts too, where it can be had; not that of what it calls.
    """
    torchs = vars(nn.Module()).keys()  # what every module has
    settings = [
        (place, name, setting(value))
        for place, part in module.named_modules()
        for name, value in sorted(vars(part).items())
        if name not in torchs
    ]
    kinds = {type(part): None for part in module.modules()}
    about = [f"{kind.__module__}.{kind.__qualname__} {_source(kind)}" for kind in kinds]
    state = hashlib.sha256(f"{about} {settings}".encode())
    for name, tensor in (*module.named_parameters(), *module.named_buffers()):
        state.update(name.encode())
        state.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return state.hexdigest()


def setting(value: Any) -> Any:
    """What tells one value from another, the same in every process where it can be had."""
    match value:
        case bool() | int() | float() | complex() | str() | bytes() | None:
            return value
        case list() | tuple():
            return [setting(part) for part in value]
        case Mapping():
            return sorted((repr(name), setting(part)) for name, part in value.items())
        case np.ndarray():
            held = np.ascontiguousarray(value).tobytes()
            return (value.shape, str(value.dtype), hashlib.sha256(held).hexdigest())
        case Tensor():
            return setting(value.detach().cpu().numpy())
        case torch.dtype() | torch.device():
            return str(value)
        case weakref.ref():  # an LSTM holds some to its weights
            return setting(value())
    try:
        return hashlib.sha256(pickle.dumps(value, protocol=4)).hexdigest()
    except (
        Exception
    ):  # a lambda, an open file: whatever it does may have changed, so it is scored anew
        return uuid.uuid4().hex


def _source(kind: type) -> str:
    """Of classes outside hlsim and torch: those have a version, which is in the keys."""
    if kind.__module__.split(".")[0] in ("hlsim", "compensators", "torch", "torchaudio"):
        return ""
    try:
        return inspect.getsource(kind)
    except (OSError, TypeError):  # typed in, or compiled
        return ""


def samples_hash(*signals: Tensor) -> str:
    """What makes signals these ones."""
    return hashlib.sha256(
        b"".join(signal.contiguous().numpy().tobytes() for signal in signals)
    ).hexdigest()
