"""Fingerprints of modules: everything that decides whether a stored score is still valid.

A fingerprint covers class names, configurations and tensors. Source code is not read, so that
moving a class or editing a comment invalidates nothing. Authors of other modules change the
attribute ``fingerprint`` when the outputs of a module change.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hlsim.plugins import WaveformPlugin
from hlsim.version import __version__

HLSIM_PACKAGES = ("hlsim", "compensators")
"""Packages whose classes include the version of hlsim in their fingerprints."""

_MODULE_ATTRIBUTES = frozenset(vars(nn.Module()))


def fingerprint(thing: Any) -> str | None:
    """Compute the SHA-256 of everything that decides the outputs of a module or function.

    An attribute ``fingerprint`` replaces everything else. A module is described by the classes, the
    public attributes and the tensors of all its submodules.

    Returns:
        The hash in hexadecimal, or None if the outputs may change without notice: for a function
        without the attribute, for a module of another package without tensors and ``config``, and
        for a module with a public attribute that cannot be described.

    >>> fingerprint(nn.Linear(2, 2)) == fingerprint(nn.Linear(2, 2))  # random weights
    False
    >>> fingerprint(abs) is None
    True
    """
    if isinstance(thing, WaveformPlugin):
        thing = thing.function
    stated = getattr(thing, "fingerprint", None)
    if stated is not None:
        return text_hash(f"{_name(thing)} {stated}")
    if not isinstance(thing, nn.Module):
        return None
    tensors = dict([*thing.named_parameters(), *thing.named_buffers()])
    if not (_is_from_hlsim(type(thing)) or tensors or hasattr(thing, "config")):
        return None
    parts = {name: [_name(part), _public_attributes(part)] for name, part in thing.named_modules()}
    try:
        return text_hash(_describe([parts, tensors]))
    except TypeError:
        return None


def combined_fingerprint(*parts: str | None) -> str | None:
    """Compute one fingerprint of several parts, or return None if that of a part is unknown.

    >>> combined_fingerprint("a", None) is None
    True
    """
    return None if None in parts else text_hash(" ".join(map(str, parts)))


def text_hash(text: str) -> str:
    """Compute the SHA-256 of a text, in hexadecimal.

    >>> text_hash("abc")[:8]
    'ba7816bf'
    """
    return hashlib.sha256(text.encode()).hexdigest()


def samples_hash(*signals: Tensor) -> str:
    """Compute the SHA-256 of the samples of signals, in hexadecimal.

    >>> samples_hash(torch.ones(3)) == samples_hash(torch.ones(4))
    False
    """
    return text_hash(_describe(signals))


def _public_attributes(part: nn.Module) -> dict[str, Any]:
    """Return the public attributes of one submodule, without those of every module."""
    return {
        name: value
        for name, value in vars(part).items()
        if name not in _MODULE_ATTRIBUTES and not name.startswith("_")
    }


def _is_from_hlsim(kind: Any) -> bool:
    return kind.__module__.split(".")[0] in HLSIM_PACKAGES


def _name(thing: Any) -> str:
    """Return the name of a function or of an object's class, with the version if it is hlsim's."""
    kind = thing if hasattr(thing, "__qualname__") else type(thing)
    version = f" of hlsim {__version__}" if _is_from_hlsim(kind) else ""
    return f"{kind.__qualname__}{version}"


def _describe(value: Any) -> str:
    """Return a text that differs between different settings and is the same in every process."""
    return json.dumps(value, sort_keys=True, default=_describe_object)


def _describe_object(value: Any) -> Any:
    """Convert an object that JSON cannot represent.

    Raises:
        TypeError: The object cannot be described.
    """
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        samples = np.ascontiguousarray(value).tobytes()
        return [str(value.dtype), value.shape, hashlib.sha256(samples).hexdigest()]
    if isinstance(value, Path | torch.dtype | torch.device):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [_name(value), vars(value)]
    if hasattr(value, "__qualname__") and "<" not in value.__qualname__:
        return value.__qualname__
    known = fingerprint(value)
    if known is None:
        raise TypeError(f"{value!r} cannot be described")
    return known
