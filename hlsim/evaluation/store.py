"""Scores on disk, each appended as it is made, so that a run that was killed goes on where it was; and their keys.

Lines of JSON, not sqlite or diskcache: two runs may share a file, and people read it.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import pickle
import uuid
import weakref
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hlsim.files import sha256


class ScoreStore:
    """A file of JSON lines, ``{"key": ..., ...}``, that only ever grows; the last line of a key counts.

    Nothing is written before the first record. A line that a kill cut short is passed over, and the next begins anew.
    ``path`` is there or not; None keeps the records in memory. ValueError where it cannot be read.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = None if path is None else Path(path)
        self.records: dict[str, dict[str, Any]] = {}
        self._torn = False
        if self.path is not None and self.path.exists():
            self._read(self.path)

    def __len__(self) -> int:
        return len(self.records)

    def get(self, key: str) -> dict[str, Any] | None:
        """The record of a key, or None."""
        return self.records.get(key)

    def append(self, key: str, record: Mapping[str, Any]) -> None:
        """Keep a record, and put it on the disk before returning; ValueError where that fails, or JSON cannot hold it."""
        line = json.dumps({"key": key, **record}, ensure_ascii=False, allow_nan=False) + "\n"
        if self.path is not None:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with open(self.path, "ab", buffering=0) as file:
                    # one write of whole lines at the end: two runs may share a store
                    data = ("\n" * self._torn + line).encode()
                    self._torn = file.write(data) < len(data)
                    os.fsync(file.fileno())
            except OSError as error:
                raise ValueError(f"{self.path}: scores cannot be stored ({error})") from error
            if self._torn:
                raise ValueError(f"{self.path}: scores cannot be stored (the disk is full)")
        self.records[key] = dict(record)

    def _read(self, path: Path) -> None:
        try:
            with open(path, encoding="utf-8", errors="replace") as file:
                for line in file:
                    self._torn = not line.endswith("\n")
                    # what is cut short, or not ours, is scored again
                    with suppress(ValueError, KeyError, TypeError, AttributeError):
                        record = json.loads(line)
                        self.records[record.pop("key")] = record
        except OSError as error:
            raise ValueError(f"{path}: stored scores cannot be read ({error})") from error


def content_hash(path: str | Path) -> str:
    """SHA-256 of a file's contents, in hexadecimal; ValueError where it cannot be read."""
    try:
        return sha256(Path(path))
    except OSError as error:
        reason = (
            "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error})"
        )
        raise ValueError(f"{path}: {reason}") from error


def key_of(settings: Mapping[str, Any]) -> str:
    """SHA-256, in hexadecimal, of settings that JSON can hold, whatever their order."""
    return hashlib.sha256(
        json.dumps(settings, sort_keys=True, allow_nan=False).encode()
    ).hexdigest()


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
