"""Values of options of several commands: paths, ears, listeners and compensators.

Invalid values are rejected before torch is imported, if possible.
"""

from __future__ import annotations

import argparse
import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.cli.options import STANDARD_EARS
from hlsim.extras import require

if TYPE_CHECKING:
    from hlsim.audiogram import Audiogram
    from hlsim.audiogram.listener import Listener


def require_installed(extra: str, *modules: str) -> None:
    """Raise MissingExtraError unless the modules are installed, without importing them."""
    for module in modules:
        if find_spec(module) is None:
            require(module, extra)


def check_paths_exist(
    *, folders: tuple[Path | None, ...] = (), files: tuple[Path | None, ...] = ()
) -> None:
    """Raise ValueError unless the folders and files exist. None stands for a missing option."""
    for path in folders:
        if path is not None and not path.is_dir():
            raise ValueError(f"{path}: there is no such folder")
    for path in files:
        # --audiograms standard names no file
        if path is not None and str(path) != "standard" and not path.exists():
            raise ValueError(f"{path}: there is no such file")


def read_ear(text: str) -> Audiogram:
    """Read ``--audiogram``: a standard ear, or eight levels separated by commas or blanks."""
    parts = re.split(r"[,\s]+", text.strip())
    is_name = len(parts) == 1
    if is_name and text.upper() not in STANDARD_EARS:
        raise ValueError(
            f"--audiogram {text}: expected {', '.join(STANDARD_EARS)}, or eight levels in dB HL "
            "separated by commas"
        )
    try:
        levels = () if is_name else tuple(float(part) for part in parts)
    except ValueError:
        raise ValueError(
            f"--audiogram {text}: expected a standard ear such as N3, or eight numbers "
            "separated by commas"
        ) from None
    from hlsim.audiogram import Audiogram

    if is_name:
        return Audiogram.standard(text.upper())
    try:
        return Audiogram(levels)
    except ValueError as error:
        raise ValueError(f"--audiogram {text}: {error}") from error


def read_ears(options: argparse.Namespace) -> Audiogram | Listener:
    """Read ``--audiogram``, or both ears of the listener that ``--listener`` names."""
    if options.listener is None:
        return read_ear(options.audiogram)
    return read_listener(options.listener)


def read_listener(text: str) -> Listener:
    """Read ``--listener``, which is FILE or FILE:NAME.

    Raises:
        ValueError: There is no such file or listener, or an ear is missing.
    """
    file, name = text, ""
    if not Path(text).exists():
        file, _, name = text.rpartition(":")
    if not Path(file).is_file():
        raise ValueError(f"--listener {text}: there is no such file; use --audiogram for one ear")
    from hlsim.audiogram.table import read_listeners

    listeners = read_listeners(file, [name] if name else None)
    if len(listeners) != 1:
        names = ", ".join([*listeners][:5])
        ellipsis = ", ..." if len(listeners) > 5 else ""
        raise ValueError(
            f"--listener {text}: write {file}:NAME, where NAME is one of {names}{ellipsis}"
        )
    listener = next(iter(listeners.values()))
    for missing, other in (("left", "right"), ("right", "left")):
        if getattr(listener, missing) is None:
            raise ValueError(
                f"--listener {text}: the {missing} ear is missing; use --audiogram for the {other} "
                "ear, and a file with that channel"
            )
    return listener


def other_ear_warnings(label: str, name: str, ear: Audiogram | None) -> list[str]:
    """Return a warning if a compensator was trained for one ear and is used for another.

    Args:
        label: Name of the compensator in the warning.
        name: Name or folder of its checkpoint.
        ear: Ear that uses it, or None for several ears.
    """
    from compensators import trained_for

    trained_ear = trained_for(name)
    if trained_ear is None or (ear is not None and trained_ear.thresholds == ear.thresholds):
        return []
    levels = ", ".join(f"{level:g}" for level in trained_ear.thresholds)
    return [f"{label} was trained for one ear, {levels} dB HL, and does not fit other ears."]


def warn_of_other_ear(options: argparse.Namespace) -> None:
    """Print a warning if ``--compensator`` was trained for another ear than ``--audiogram``."""
    name = options.compensator
    ear = read_ear(options.audiogram) if options.audiogram else None
    for line in other_ear_warnings(name, name, ear):
        print(f"hlsim: warning: {line}", file=sys.stderr)


def load_compensator(options: argparse.Namespace, sample_rate: int) -> Any:
    """Load the compensator of ``--compensator``, and check that it has the sliders in use.

    Args:
        options: Options of the command.
        sample_rate: Sample rate in Hz.
    """
    import compensators

    name = options.compensator
    linked = getattr(options, "linked", False)
    settings = {"sample_rate": sample_rate, "full_scale_spl": options.full_scale_spl}
    compensator = compensators.load_compensator(name, **settings, linked=linked)
    for slider in read_sliders(options).keys() - set(getattr(compensator, "SLIDERS", ())):
        option = slider.replace("_", "-")
        raise ValueError(
            f"--{option} has no effect with --compensator {name}; choose a hearing aid"
        )
    return compensator


def read_sliders(options: argparse.Namespace) -> dict[str, float]:
    """Return the values of the sliders that are options."""
    values = {name: getattr(options, name) for name in ("noise_reduction", "amplification")}
    return {name: value for name, value in values.items() if value is not None}
