"""One error for every missing optional dependency, naming the command that installs it."""

import importlib
from types import ModuleType


class MissingExtraError(ImportError):
    """An optional dependency is not installed."""


def require(module: str, extra: str) -> ModuleType:
    """Import an optional module, or say how to install it.

    Args:
        module: dotted module name, e.g. ``"clarity.evaluator.haspi"``.
        extra: the extra of hlsim that brings it, e.g. ``"eval"``.

    Raises:
        MissingExtraError: the module (or something it needs) is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"{module.split('.')[0]} is needed here and not installed ({error}): pip install 'hlsim[{extra}]'"
        ) from error
