"""Optional dependencies of hlsim, its *extras*, and an error that says how to install them."""

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType


class MissingExtraError(ImportError):
    """Error that an optional dependency is not installed.

    >>> try:
    ...     require("no_such_module", extra="eval")
    ... except MissingExtraError as error:
    ...     print(str(error).split("; ")[1])
    install it with: pip install 'hlsim[eval]'
    """


def require(module: str, extra: str) -> ModuleType:
    """Import and return an optional module, or raise an error that says how to install it.

    Args:
        module: Dotted module name, e.g. ``"matplotlib.figure"``.
        extra: Optional extra of hlsim that installs it, e.g. ``"eval"`` as in ``hlsim[eval]``.

    Raises:
        MissingExtraError: The module, or one that it imports, cannot be imported.

    >>> require("json", extra="eval").dumps([1])
    '[1]'
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise MissingExtraError(
            f"{package} is not installed ({error}); install it with: {install_command(extra)}"
        ) from error


def is_installed(module: str) -> bool:
    """Return whether a module is installed, without importing it, which may take seconds.

    Args:
        module: Name of a top-level module.

    >>> is_installed("json")
    True
    """
    return find_spec(module) is not None


def install_command(extra: str) -> str:
    """Return the shell command that installs one of hlsim's extras.

    Args:
        extra: Name of the extra, e.g. ``"eval"``.

    >>> install_command("eval")
    "pip install 'hlsim[eval]'"
    """
    return f"pip install 'hlsim[{extra}]'"
