"""Optional dependencies, and one error that names the command that installs them."""

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType


class MissingExtraError(ImportError):
    """An optional dependency is not installed."""


def require(module: str, extra: str) -> ModuleType:
    """Import an optional module, or raise an error that says how to install it.

    Args:
        module: dotted module name, e.g. ``"matplotlib.figure"``.
        extra: hlsim's extra that installs it, e.g. ``"eval"``.

    Raises:
        MissingExtraError: the module, or one that it imports, is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise MissingExtraError(
            f"{package} is needed here and not installed ({error}); install it: {install_command(extra)}"
        ) from error


def is_installed(module: str) -> bool:
    """Whether a top-level module can be found; it is not imported, which may take seconds."""
    return find_spec(module) is not None


def install_command(extra: str) -> str:
    """The command that installs one of hlsim's extras."""
    return f"pip install 'hlsim[{extra}]'"
