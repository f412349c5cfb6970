"""Fingerprints of modules: what decides whether a stored score still holds.

A fingerprint is made of the class name, the configuration and the tensors. Source code is not read, so
that moving a class or editing a comment discards nothing; who changes what foreign code computes also
changes its ``fingerprint``.
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

_OWN_PACKAGES = ("hlsim", "compensators")
_MODULE_ATTRIBUTES = frozenset(vars(nn.Module()))


def fingerprint(thing: Any) -> str | None:
    """Return the SHA-256 of what decides the outputs of a module, or None if that is unknown.

    Anything may state its own in an attribute ``fingerprint``. A function states nothing else; an
    ``nn.Module`` is described by its classes, the public attributes and the tensors of all its parts.
    Classes of hlsim include the version of hlsim. The fingerprint of a foreign module without tensors,
    ``config`` and ``fingerprint`` is unknown, as is one with a public attribute that cannot be described.
    """
    if isinstance(thing, WaveformPlugin):
        thing = thing.function
    stated = getattr(thing, "fingerprint", None)
    if stated is not None:
        return text_hash(f"{_name(thing)} {stated}")
    if not isinstance(thing, nn.Module):
        return None
    tensors = dict([*thing.named_parameters(), *thing.named_buffers()])
    ours = type(thing).__module__.split(".")[0] in _OWN_PACKAGES
    if not (ours or tensors or hasattr(thing, "config")):
        return None
    parts = {name: [_name(part), _public(part)] for name, part in thing.named_modules()}
    try:
        return text_hash(_describe([parts, tensors]))
    except TypeError:
        return None


def combined_fingerprint(*parts: str | None) -> str | None:
    """Return one fingerprint for several parts; None if that of a part is unknown."""
    return None if None in parts else text_hash(" ".join(map(str, parts)))


def text_hash(text: str) -> str:
    """Return the SHA-256 of a text, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def samples_hash(*signals: Tensor) -> str:
    """Return the SHA-256 of the samples of signals, in hexadecimal."""
    return text_hash(_describe(signals))


def _public(part: nn.Module) -> dict[str, Any]:
    """Return the public attributes of one submodule, without those of every module."""
    return {
        name: value
        for name, value in vars(part).items()
        if name not in _MODULE_ATTRIBUTES and not name.startswith("_")
    }


def _name(thing: Any) -> str:
    """Return the name of a function or of an object's class; for hlsim's own with its version."""
    kind = thing if hasattr(thing, "__qualname__") else type(thing)
    ours = kind.__module__.split(".")[0] in _OWN_PACKAGES
    return f"{kind.__qualname__} of hlsim {__version__}" if ours else str(kind.__qualname__)


def _describe(value: Any) -> str:
    """Return a text that differs where settings differ, the same in every process."""
    return json.dumps(value, sort_keys=True, default=_describe_object)


def _describe_object(value: Any) -> Any:
    """Describe what JSON does not know; TypeError if that is impossible."""
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
