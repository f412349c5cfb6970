"""Plug-ins: teachers, enhancers, aids and measures of your own, loaded by name."""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

MAX_DELAY = 2e-3  # seconds between input and output of a plug-in that must be time-aligned

_NAME = re.compile(r"(?P<source>.+):(?P<attribute>\w+)")


def load_plugin(name: str, kind: str) -> Any:
    """Load the object that a name means; a class is called without arguments.

    Modules are searched for in the working directory first, and files import their neighbours, but
    only during the import: import at the top of the module, not inside its functions.

    Args:
        name: ``package.module:name``, or ``path/to/file.py:name``.
        kind: What the object is called in errors, such as ``"teacher"``.

    Raises:
        ValueError: The name has another form, the import fails, or there is no such object.
    """
    parts = _NAME.fullmatch(name)
    if parts is None:
        raise ValueError(
            f"{kind} {name!r} is not a plug-in's name; write package.module:name or path/to/file.py:name"
        )
    source, attribute = parts["source"], parts["attribute"]
    try:
        if source.endswith(".py"):
            module = _import_file(Path(source))
        else:
            with _searched_first(os.getcwd()):
                importlib.invalidate_caches()  # the file may be new
                module = importlib.import_module(source)
        plugin = getattr(module, attribute)
        return plugin() if isinstance(plugin, type) else plugin
    except Exception as error:  # the code of others may raise anything
        raise ValueError(f"cannot load the {kind} {name}: {_describe(error)}") from error


class WaveformPlugin:
    """A plug-in from waveform to waveform, whose output is checked at every call.

    It is called without gradients. A module is set to eval mode and follows the device of its input.

    Args:
        name: As for ``load_plugin``.
        kind: ``"teacher"``, ``"enhancer"`` or ``"aid"``, for errors.

    Attributes:
        function: The object that was loaded.
        fingerprint: The attribute ``fingerprint`` of the object, which its author changes when its
            outputs change, as text; None if it has none.

    Raises:
        ValueError: As ``load_plugin``, or the object is not callable.
    """

    def __init__(self, name: str, kind: str) -> None:
        self.name, self.kind = name, kind
        self.function: Callable[..., Tensor] = load_plugin(name, kind)
        if not callable(self.function):
            type_name = type(self.function).__name__
            raise ValueError(f"{kind} {name} is of type {type_name}, expected a callable")
        if isinstance(self.function, nn.Module):
            self.function.eval()
        fingerprint = getattr(self.function, "fingerprint", None)
        self.fingerprint = None if fingerprint is None else str(fingerprint)
        self._number = next(_load_numbers)

    def __str__(self) -> str:
        return self.name if self.fingerprint is None else f"{self.name} ({self.fingerprint})"

    def __reduce__(self) -> Any:
        return _load_copy, (self.name, self.kind, self._number)

    @torch.no_grad()
    def __call__(self, waveform: Tensor, *arguments: Any) -> Tensor:
        """Call the plug-in.

        Shape: (..., time) -> (..., time), in the waveform's dtype.

        Raises:
            ValueError: The plug-in fails, or its output is not a real, finite tensor of the same shape.
        """
        if isinstance(self.function, nn.Module):
            self.function.to(waveform.device)
        try:
            output = self.function(waveform, *arguments)
        except Exception as error:  # the code of others may raise anything
            raise ValueError(f"{self.kind} {self.name} failed: {_describe(error)}") from error
        if not isinstance(output, Tensor) or output.is_complex() or output.shape != waveform.shape:
            raise ValueError(
                f"{self.kind} {self.name} returned {_describe_output(output)}, expected a real tensor "
                f"of shape {tuple(waveform.shape)}"
            )
        if not bool(output.isfinite().all()):
            raise ValueError(f"{self.kind} {self.name} returned samples that are NaN or infinite")
        return output.to(waveform)

    def check_aligned(self, waveform: Tensor, sample_rate: int, *arguments: Any) -> None:
        """Call the plug-in and reject an output that is delayed or advanced by more than 2 ms.

        Shape: (..., time); the first channel is compared.

        Raises:
            ValueError: As for a call, or the output is not time-aligned.
        """
        output = self(waveform, *arguments)
        samples = 2 * waveform.shape[-1]
        spectra = [
            torch.fft.rfft(signal.reshape(-1, signal.shape[-1])[0].float(), samples)
            for signal in (waveform, output)
        ]
        correlation = torch.fft.irfft(spectra[1] * spectra[0].conj(), samples)
        delay = int(correlation.abs().argmax())
        if delay > samples // 2:
            delay -= samples
        if abs(delay) > MAX_DELAY * sample_rate:
            raise ValueError(
                f"{self.kind} {self.name} delays by {1000 * delay / sample_rate:.1f} ms; its output must "
                "be time-aligned with its input"
            )


_load_numbers = itertools.count()


@lru_cache(maxsize=16)
def _load_copy(name: str, kind: str, number: int) -> WaveformPlugin:
    """Load a plug-in in another process; the same object for all pickles of one, by its number."""
    return WaveformPlugin(name, kind)


def _import_file(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"_hlsim_plugin_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and pickle look their module up by name
    with _searched_first(str(path.resolve().parent)):
        spec.loader.exec_module(module)
    return module


@contextmanager
def _searched_first(folder: str) -> Iterator[None]:
    before = list(sys.path)
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path[:] = before


def _describe(error: Exception) -> str:
    """Type and text of an exception in one line, with the place where it was raised."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    traceback = error.__traceback__
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    if traceback is None:
        return text
    file = Path(traceback.tb_frame.f_code.co_filename).name
    return f"{text} ({file}, line {traceback.tb_lineno})"


def _describe_output(output: Any) -> str:
    if not isinstance(output, Tensor):
        return f"an object of type {type(output).__name__}"
    number = "complex" if output.is_complex() else "real"
    return f"a {number} tensor of shape {tuple(output.shape)}"
