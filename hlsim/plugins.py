"""Plug-ins: simulators, enhancers, aids and measures from your own code, loaded by name."""

import atexit
import gc
import hashlib
import importlib
import importlib.machinery
import importlib.util
import itertools
import re
import sys
import traceback
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

_NAME = re.compile(r"(?P<source>.+):(?P<attribute>\w+)")
"""Names of plug-ins: a module or a file, and one of its attributes."""

_LARGEST_CHANGE = 0.01
"""Change of a plug-in's output, relative to its RMS, from one call to an equal one."""


def load_plugin(name: str, kind: str) -> Any:
    """Import a function, a PyTorch module or another callable of your own code by its name.

    A class is called without arguments, and its object is returned. As a side effect, Python from
    then on searches for modules in the working directory first, or, if the name is that of a file,
    in its folder.

    Args:
        name: ``package.module:name`` or ``path/to/file.py:name``.
        kind: Noun for the object in error messages, such as ``"simulator"``.

    Returns:
        The function, module or other callable object.

    Raises:
        ValueError: The name has another form, the import fails, the class cannot be called without
            arguments, or the object does not exist or cannot be called.

    >>> load_plugin("math:sqrt", kind="measure")
    <built-in function sqrt>
    """
    parts = _NAME.fullmatch(name)
    if parts is None:
        raise ValueError(
            f"expected the name of the {kind} as package.module:name or path/to/file.py:name, "
            f"got {name!r}"
        )
    # Commands end without a search for unused objects, but files of a user's code that are still
    # open may need it to be written completely.
    atexit.unregister(gc.freeze)
    source, attribute = parts["source"], parts["attribute"]
    try:
        if source.endswith(".py"):
            module = _import_file(Path(source).resolve())
        else:
            _search_first(Path.cwd())
            module = importlib.import_module(source)
        plugin = getattr(module, attribute)
        plugin = plugin() if isinstance(plugin, type) else plugin
    except Exception as error:  # because code of a plug-in may raise anything
        raise ValueError(f"cannot load the {kind} {name}: {_describe(error)}") from error
    if not callable(plugin):
        raise ValueError(
            f"expected {kind} {name} to be a function, a module or a class, got an object of type "
            f"{type(plugin).__name__}"
        )
    return plugin


class WaveformPlugin:
    """Your own function or ``nn.Module`` from waveform to waveform, with validated outputs.

    A class is called without arguments, and its object is the function. A module is set to
    evaluation mode, and moved to the device of its input. A call of the plug-in computes no
    gradients; through its method ``call``, gradients pass.

    Args:
        name: ``package.module:name`` or ``path/to/file.py:name``.
        kind: Noun for the plug-in in error messages: ``"simulator"``, ``"enhancer"`` or ``"aid"``.

    Attributes:
        function: The function or module that was loaded. If it has an attribute ``fingerprint``,
            change the value whenever its outputs change, so that stored results are computed again.

    Raises:
        ValueError: The plug-in cannot be loaded or called.

    >>> rectifier = WaveformPlugin("torch:abs", kind="aid")
    >>> rectifier(torch.tensor([1.0, -2.0]))
    tensor([1., 2.])
    """

    def __init__(self, name: str, kind: str) -> None:
        self.name, self.kind = name, kind
        self.function: Callable[..., Tensor] = load_plugin(name, kind)
        if isinstance(self.function, nn.Module):
            self.function.eval()
        self._number = next(_load_numbers)

    def __str__(self) -> str:
        return self.name

    def __reduce__(self) -> Any:
        return _load_copy, (self.name, self.kind, self._number)

    @torch.no_grad()
    def __call__(self, waveform: Tensor, *arguments: Any) -> Tensor:
        """Call the plug-in without computing gradients; see ``call``."""
        return self.call(waveform, *arguments)

    def call(self, waveform: Tensor, *arguments: Any) -> Tensor:
        """Call the plug-in, and validate its output.

        Shape: (..., time) -> (..., time), in the precision of the waveform; for an aid
        (time,), (2, time) or (microphones, 2, time) -> (samples,) or (2, samples) with any number
        of samples.

        Args:
            waveform: First argument of the plug-in.
            arguments: Further arguments of the plug-in.

        Raises:
            ValueError: The plug-in fails, its output is not a floating-point tensor of this shape,
                or the output contains NaN or infinity. These are accepted in an output with a
                gradient, so that a gradient scaler can detect them.
        """
        if isinstance(self.function, nn.Module):
            self.function.to(waveform.device)
        # Code that changes its arguments in place must not change those of the caller.
        copies = [
            value.clone() if isinstance(value, Tensor) else value
            for value in (waveform, *arguments)
        ]
        try:
            output = self.function(*copies)
        except Exception as error:  # because code of a plug-in may raise anything
            raise ValueError(f"{self.kind} {self.name} failed: {_describe(error)}") from error
        is_real = isinstance(output, Tensor) and output.is_floating_point()
        # An aid may change the duration, and its input may be that of several microphones.
        is_aid = self.kind == "aid"
        shape, end = (waveform.shape[-2:], -1) if is_aid else (waveform.shape, None)
        has_shape = is_real and output.ndim == len(shape)
        if not has_shape or output.shape[:end] != shape[:end]:
            kind = output.dtype if isinstance(output, Tensor) else type(output).__name__
            raise ValueError(
                f"{self.kind} {self.name} returned {kind} of shape "
                f"{tuple(getattr(output, 'shape', ()))}, expected floating-point samples of shape "
                f"{tuple(shape)}"
            )
        if not output.requires_grad and not bool(output.isfinite().all()):
            raise ValueError(f"{self.kind} {self.name} returned samples that are NaN or infinite")
        return output.to(waveform)

    def try_twice(self, waveform: Tensor, *arguments: Any) -> Tensor:
        """Call the plug-in twice, and return the first output.

        A plug-in whose second output has another shape, or differs by more than 1 % (-40 dB),
        causes a warning: it keeps a state or draws random numbers.

        Args:
            waveform: First argument of the plug-in.
            arguments: Further arguments of the plug-in.

        Raises:
            ValueError: A call fails, see ``call``.
        """
        output, repeated = (self(waveform, *arguments) for _ in range(2))
        has_shape = repeated.shape == output.shape
        limit = _LARGEST_CHANGE * float(output.norm())
        if not has_shape or float((repeated - output).norm()) > limit:
            warnings.warn(
                f"{self.kind} {self.name} returns another output if it is called again with the "
                "same input, so that results depend on the order of the items and on the number of "
                "processes; reset its state in each call, or seed its random numbers",
                stacklevel=3,
            )
        return output


_load_numbers = itertools.count()
"""Numbers that distinguish plug-ins that were loaded under one name."""


@lru_cache(maxsize=16)
def _load_copy(name: str, kind: str, number: int) -> WaveformPlugin:
    """Load a plug-in again when it is unpickled or copied.

    Args:
        name: Name of the plug-in.
        kind: Noun for the plug-in in error messages.
        number: Number of the original object. In a process, all copies of it are one object, as
            long as it is one of the 16 that were last copied.
    """
    return WaveformPlugin(name, kind)


_folders: set[Path] = set()
"""Folders in which Python has searched for modules of plug-ins."""


def _search_first(folder: Path) -> None:
    """Make Python search for modules in the folder of a plug-in first.

    Raises:
        ImportError: A module that was imported from the folder of another plug-in has the name of
            one in this folder. Python would use it instead.
    """
    for name, module in [*sys.modules.items()]:
        file = Path(getattr(module, "__file__", None) or "")
        home = file.parents[1] if file.name == "__init__.py" else file.parent
        is_foreign = home in _folders and home != folder
        if is_foreign and importlib.machinery.PathFinder.find_spec(name, [str(folder)]):
            raise ImportError(
                f"the module {name} of {home} was imported before, and would be used instead of "
                f"that of {folder}; rename one of the two"
            )
    _folders.add(folder)
    sys.path.insert(0, str(folder))


def _import_file(path: Path) -> ModuleType:
    """Import a file, which can import modules from its folder.

    Raises:
        ImportError: Python has no loader for the file. The file may raise other errors.
    """
    _search_first(path.parent)
    # Python finds the source of a class by the name of its module, so that files of one name in
    # two folders need different modules.
    number = hashlib.sha256(str(path).encode()).hexdigest()[:8]
    spec = importlib.util.spec_from_file_location(f"_hlsim_plugin_{path.stem}_{number}", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses and pickle look up their module by its name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _describe(error: Exception) -> str:
    """Describe an exception in one line: its type, its text, and where it was raised.

    Places in Python's import system and in this file are skipped.
    """
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename not in (__file__, importlib.__file__)
        and not frame.filename.startswith("<frozen")
    ]
    if not frames:
        return text
    return f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})"
