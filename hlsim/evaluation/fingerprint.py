"""Fingerprints of modules: what decides whether a stored score still holds.

A fingerprint is made of the class name, the configuration and the tensors. Source code is not read, so
that moving a class or editing a comment discards nothing; who changes what foreign code computes also
changes its ``fingerprint``.
"""

from __future__ import annotations

import dataclasses
import enum
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hlsim.plugins import WaveformPlugin
from hlsim.version import __version__

_OWN_PACKAGES = ("hlsim", "compensators")
_MODULE_ATTRIBUTES = frozenset(vars(nn.Module()))


class UnknownSettingError(Exception):
    """A setting has no text that is the same in every process."""


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
        return text_hash(f"{_class_name(thing)} {stated}")
    if not isinstance(thing, nn.Module):
        return None
    ours = type(thing).__module__.split(".")[0] in _OWN_PACKAGES
    tensors = [*thing.named_parameters(), *thing.named_buffers()]
    if not (ours or tensors or hasattr(thing, "config")):
        return None
    try:
        settings = [_describe_part(name, part) for name, part in thing.named_modules()]
    except UnknownSettingError:
        return None
    digest = hashlib.sha256(repr(settings).encode())
    for name, tensor in tensors:
        digest.update(f"{name} {_describe(tensor)}".encode())
    return digest.hexdigest()


def combined_fingerprint(*parts: str | None) -> str | None:
    """Return one fingerprint for several parts; None if that of a part is unknown."""
    return None if None in parts else text_hash(" ".join(map(str, parts)))


def text_hash(text: str) -> str:
    """Return the SHA-256 of a text, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def samples_hash(*signals: Tensor) -> str:
    """Return the SHA-256 of the samples of signals, in hexadecimal."""
    return text_hash(" ".join(_describe(signal) for signal in signals))


def _describe_part(name: str, part: nn.Module) -> tuple[str, str, list[tuple[str, str]]]:
    """Describe one submodule by its name, its class and its public attributes."""
    public = {
        key: value
        for key, value in vars(part).items()
        if key not in _MODULE_ATTRIBUTES and not key.startswith("_")
    }
    return name, _class_name(part), [(key, _describe(public[key])) for key in sorted(public)]


def _class_name(thing: Any) -> str:
    """Return the name of a function or of an object's class; for hlsim's own with its version."""
    kind = thing if hasattr(thing, "__qualname__") else type(thing)
    ours = kind.__module__.split(".")[0] in _OWN_PACKAGES
    return f"{kind.__qualname__} of hlsim {__version__}" if ours else str(kind.__qualname__)


def _describe(value: Any) -> str:
    """Return a text that differs where settings differ, the same in every process."""
    match value:
        case enum.Enum() | Path() | torch.dtype() | torch.device():
            return str(value)
        case None | bool() | int() | float() | complex() | str() | bytes():
            return repr(value)
        case list() | tuple():
            return f"[{', '.join(map(_describe, value))}]"
        case Mapping():
            entries = sorted(f"{_describe(key)}: {_describe(value[key])}" for key in value)
            return f"{{{', '.join(entries)}}}"
        case Tensor():
            return _describe(value.detach().cpu().numpy())
        case np.ndarray():
            samples = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
            return f"{value.dtype} {value.shape} {samples}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return f"{type(value).__name__} {_describe(fields)}"
    name = getattr(value, "__qualname__", "<")  # of a function or class
    if "<" not in name:
        return str(name)
    known = fingerprint(value)
    if known is None:
        raise UnknownSettingError
    return known
