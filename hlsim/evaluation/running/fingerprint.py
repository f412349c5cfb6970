"""Fingerprints: hashes of which the key of a stored score consists.

A score is computed again if its key is not in the store (``run_measures`` of ``study.py``).

The fingerprint of a module covers class names, settings and tensors and, for a class outside hlsim
and torch, the file with its source code and the files of the user that this file imports. The code
of hlsim has a hash of its own, ``code_version``, which is part of the key of each stored score.
Authors of modules outside hlsim may add an attribute ``fingerprint``, such as a version, which they
change when the outputs change.
"""

import ast
import dataclasses
import hashlib
import importlib.util
import io
import json
import os
import sys
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
from torch import Tensor, fx, jit, nn

import compensators
from hlsim.files import sha256, source_hash
from hlsim.plugins import WaveformPlugin

_MODULE_ATTRIBUTES = frozenset(vars(nn.Module()))
"""Attributes that every ``nn.Module`` has, which do not describe its outputs."""

_KNOWN_PACKAGES = frozenset({"hlsim", "compensators", "torch", "builtins"})
"""Packages whose code counts by its name alone, because it is part of no user's code."""

_ROOMS_WITHOUT_SCORES = frozenset({"cli", "report", "training"})
"""Packages of hlsim that no score depends on: commands, pages and training."""


def code_version() -> str:
    """Return a hash of the source code of hlsim, on which all scores depend.

    The code of commands, pages and training does not count.

    >>> code_version() == code_version()
    True
    """
    return _hash_sources(Path(__file__).parents[2], Path(compensators.__path__[0]))


@cache
def _hash_sources(*folders: Path) -> str:
    """Compute the SHA-256 of the names and contents of all .py and .json files that scores may use.

    The folders ``cli``, ``report`` and ``training`` are left out.

    Args:
        folders: Folders of the packages.
    """
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.json")]):
            place = path.relative_to(folder)
            if place.parts[0] not in _ROOMS_WITHOUT_SCORES:
                digest.update(f"{folder.name}/{place.as_posix()}\n".encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def fingerprint(processing: Any) -> str | None:
    """Compute a hash that changes when the outputs of a module or function may have changed.

    Args:
        processing: Function or ``torch.nn.Module``. If it has an attribute ``fingerprint``, its
            name and this attribute are hashed. Otherwise, the classes, the attributes, the hooks
            and the tensors of a module and its submodules are, without private attributes of
            modules of hlsim and torch, and for other classes their source files and those that
            these import, or the program of a module of TorchScript or ``torch.fx``.

    Returns:
        The SHA-256 in hexadecimal, or None if the outputs could change while the hash does not:
        for a function without the attribute ``fingerprint``, for a module outside hlsim with
        neither tensors nor an attribute ``config``, for a class without a source file, for a module
        with an attribute that cannot be hashed, such as a lambda, and for a module of hlsim that
        contains one of these, unless it is one of torch's or Python's own.

    >>> fingerprint(nn.Linear(2, 2)) == fingerprint(nn.Linear(2, 2))  # random weights
    False
    >>> fingerprint(abs) is None
    True
    """
    name = _name(processing)
    if isinstance(processing, WaveformPlugin):
        name, processing = processing.name, processing.function
    stated = getattr(processing, "fingerprint", None)
    if stated is not None:
        return value_hash([name, str(stated)])
    if not isinstance(processing, nn.Module):
        return None
    tensors = dict([*processing.named_parameters(), *processing.named_buffers()])
    if not (_is_from_hlsim(processing) or tensors or hasattr(processing, "config")):
        return None
    parts: dict[str, list[Any]] = {}
    for place, module in processing.named_modules():
        try:
            program = _program(module)
        except RuntimeError:
            return None
        parts[place] = [
            _name(module),
            [_hash_source(kind) for kind in type(module).__mro__ if not _is_known(kind)],
            _attributes(module),
            str(getattr(module, "fingerprint", None)),
            program,
            _hooks(module),
        ]
        # A condition of hlsim, such as an aid at another's level, contains the aids of a user.
        contained = _parts(module) if _is_from_hlsim(module) else ()
        if any(fingerprint(part) is None for part in contained if not _is_known(_code(part))):
            return None
        if None in parts[place][1]:
            return None
    try:
        return value_hash([parts, tensors])
    except (TypeError, RecursionError):  # of modules that refer to each other by methods
        return None


def value_hash(value: Any) -> str:
    """Compute the SHA-256 of a value in hexadecimal, the same in every process.

    Args:
        value: Text, number of Python, list, or dict (in any order), nested as you like, with
            tensors, arrays, dataclasses, modules with a fingerprint, and functions and classes. Of
            a function or class of hlsim or torch, only the name counts; of another one, also the
            file with its source code and the user's files that it imports, or the attribute
            ``fingerprint`` of a function in place of these.

    Raises:
        TypeError: The value contains something else, such as a function without ``fingerprint``
            that is a lambda, lies within a function or has no source file, or a module whose
            ``fingerprint`` is None.

    >>> value_hash({"a": 1, "b": [2.0]}) == value_hash({"b": [2.0], "a": 1})
    True
    """
    text = json.dumps(value, sort_keys=True, default=_describe)
    return hashlib.sha256(text.encode()).hexdigest()


def _is_from_hlsim(module: nn.Module) -> bool:
    """Return whether the class of a module belongs to hlsim, whose code has a hash of its own."""
    return type(module).__module__.startswith(("hlsim.", "compensators."))


def _is_known(code: Any) -> bool:
    """Return whether a class or function belongs to hlsim or torch, or is built into Python.

    Those of Python's library, such as ``abc.ABC``, are not known.
    """
    package = (code.__module__ or "builtins").split(".")[0]
    return package in _KNOWN_PACKAGES


def _parts(module: nn.Module) -> list[Any]:
    """Return the submodules of a module, and those of ``_attributes`` that can be called."""
    return [*module.children(), *filter(callable, _attributes(module).values())]


def _code(thing: Any) -> Any:
    """Return a function or class as it is, and the class of another object."""
    return thing if hasattr(thing, "__qualname__") else type(thing)


@cache
def _hash_source(code: Any) -> str | None:
    """Return the hash of the source file of a class or function, and of the files it imports.

    Files of installed packages, Python and hlsim are left out. It is None without a source file.
    """
    file_hash = source_hash(code)
    module = sys.modules.get(str(code.__module__))
    if file_hash is None or module is None:
        return file_hash
    modules, hashes = [module], {module.__name__: file_hash}
    while modules:
        for name in _imported_names(modules.pop()):
            imported = sys.modules.get(name)
            if name not in hashes and imported is not None and _is_written_by_user(imported):
                hashes[name] = sha256(Path(str(imported.__file__)))
                modules.append(imported)
    return value_hash(sorted(hashes.values()))


def _imported_names(module: ModuleType) -> Iterator[str]:
    """Yield the full names that the source of a module imports, of which some are modules."""
    file = Path(module.__file__ or "")
    if file.suffix != ".py":
        return
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and (module.__package__ or not node.level):
            relative_name = "." * node.level + (node.module or "")
            parent = importlib.util.resolve_name(relative_name, module.__package__)
            yield parent
            yield from (f"{parent}.{alias.name}" for alias in node.names)


def _is_written_by_user(module: ModuleType) -> bool:
    """Return whether the file of a module belongs to neither Python, a package nor hlsim."""
    if not getattr(module, "__file__", None) or module.__name__.split(".")[0] in _KNOWN_PACKAGES:
        return False
    file = Path(str(module.__file__)).resolve()
    is_installed = {"site-packages", "dist-packages"}.intersection(file.parts)
    return not is_installed and not file.is_relative_to(Path(os.__file__).resolve().parent)


def _program(module: nn.Module) -> str | None:
    """Return a hash of a TorchScript module, or the code of one of ``torch.fx``; None for others.

    The class of such a module says nothing about its code.

    Raises:
        RuntimeError: TorchScript cannot save and load the module.
    """
    if isinstance(module, jit.ScriptModule):
        program = module.save_to_buffer()
        # Without an error, it lacks weights that torch.jit.optimize_for_inference has converted.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # TorchScript is deprecated
            jit.load(io.BytesIO(program))
        return hashlib.sha256(program).hexdigest()
    return module.code if isinstance(module, fx.GraphModule) else None


def _hooks(module: nn.Module) -> list[Any]:
    """Return the functions that change inputs or outputs of a module, except those of torch."""
    hooks = [*module._forward_pre_hooks.values(), *module._forward_hooks.values()]
    return [hook for hook in hooks if not _is_known(_code(hook))]


def _attributes(module: nn.Module) -> dict[str, Any]:
    """Return the attributes of a module without those that every ``nn.Module`` has.

    Parameters, buffers and submodules are not included. Private attributes are left out if the
    class belongs to hlsim or torch, because calls have computed them. Functions replace the methods
    of the module itself.
    """
    return {
        name: value.__func__ if getattr(value, "__self__", None) is module else value
        for name, value in vars(module).items()
        if name not in _MODULE_ATTRIBUTES and not (name.startswith("_") and _is_known(type(module)))
    }


def _name(thing: Any) -> str:
    """Return the qualified name of a function or class, or of the class of another object."""
    return str(_code(thing).__qualname__)


def _describe(value: Any) -> Any:
    """Convert an object that JSON cannot represent: the ``default`` function of ``value_hash``.

    A tensor or array becomes its type, shape and hash; a dataclass its name and attributes, which
    JSON converts in turn; a function or class its name, with a hash unless it belongs to hlsim or
    torch; a method also its object; and a module its fingerprint.

    Raises:
        TypeError: The object is none of these, a lambda or a function within another one, a module
            whose ``fingerprint`` is None, or has no source file, as in a notebook.
    """
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        samples = np.ascontiguousarray(value).tobytes()
        return [str(value.dtype), value.shape, hashlib.sha256(samples).hexdigest()]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [_name(value), vars(value)]
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if hasattr(value, "__qualname__") and "<" not in value.__qualname__:
        return [value.__qualname__, None if _is_known(value) else _hash_code(value)]
    known = fingerprint(value)
    if known is None:
        raise TypeError(f"{value!r} cannot be described")
    return known


def _hash_code(code: Any) -> str | None:
    """Return the fingerprint of a function, or else the hash of the source of a function or class.

    It is None for a compiled function, such as one of NumPy.

    Raises:
        TypeError: There is no source file, as in a notebook or for a class of a built-in module.
    """
    # The fingerprint of a class may be a property of its objects.
    stated = None if isinstance(code, type) else fingerprint(code)
    known = stated or _hash_source(code)
    if known is None and isinstance(code, type | FunctionType):
        raise TypeError(f"the source of {code!r} is unknown")
    return known
