"""What options name: ears, models, recipes and files, and what is refused before anything slow is imported."""

from __future__ import annotations

import argparse
import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.cli.options import STANDARD_EARS
from hlsim.extras import require
from hlsim.files import resolved

if TYPE_CHECKING:
    from hlsim.audiogram import Audiogram
    from hlsim.audiogram.listener import Listener


_LONGEST_NAME = 220  # bytes: 255, less what a file is called until it is whole


def need(extra: str, *modules: str) -> None:
    """Raise MissingExtraError where one is not installed, without the seconds that importing them takes."""
    for module in modules:
        if find_spec(module) is None:
            require(module, extra)


def check_there(
    *, folders: tuple[Path | None, ...] = (), files: tuple[Path | None, ...] = ()
) -> None:
    """Refuse folders and files to read that are not there; those that were not given pass."""
    for path in folders:
        if path is not None and not path.is_dir():
            raise ValueError(f"{path}: no such folder")
    for path in files:
        if path is not None and not path.exists():
            raise ValueError(f"{path}: no such file")


def check_files(source: Path, target: Path) -> None:
    """Refuse an IN and OUT that would end in nothing after the work, or in the loss of IN."""
    if not target.parent.is_dir():
        found = "not a folder" if target.parent.exists() else "no such folder"
        raise ValueError(f"{target.parent}: {found}; allowed: an OUT in a folder that is there")
    if not source.exists():
        raise ValueError(f"{source}: no such file")
    if len(os.fsencode(target.name)) > _LONGEST_NAME:
        raise ValueError(
            f"{target}: a name of more than {_LONGEST_NAME} bytes; allowed: a shorter OUT"
        )
    if target.exists() and target.samefile(source):
        raise ValueError(f"{target}: OUT is IN itself; allowed: another file, for IN would be lost")


def check_folders(source: Path, target: Path) -> None:
    """Refuse an OUT that cannot be a folder, or in which the files of IN would be lost or found again."""
    if os.path.lexists(target) and not target.is_dir():
        raise ValueError(f"{target}: not a folder; allowed: a folder, there or not, for IN is one")
    if resolved(target).is_relative_to(resolved(source)):
        raise ValueError(f"{target}: in IN itself; allowed: another folder")


def read_ear(text: str) -> Audiogram:
    """An ear from what ``--audiogram`` holds."""
    levels = None
    if "," in text:
        try:
            levels = tuple(float(part) for part in text.split(","))
        except ValueError:
            raise ValueError(
                f"--audiogram {text}; allowed: a standard ear such as N3, or eight numbers in dB HL separated by commas"
            ) from None
    elif text.upper() not in STANDARD_EARS:
        raise ValueError(f"no standard audiogram {text!r}; allowed: {', '.join(STANDARD_EARS)}")
    from hlsim.audiogram import Audiogram

    if levels is None:
        return Audiogram.standard(text.upper())
    try:
        return Audiogram(levels)
    except ValueError as error:
        raise ValueError(f"--audiogram {text}: {error}") from error


def read_ears(options: argparse.Namespace) -> Audiogram | Listener:
    """The ear that ``--audiogram`` holds, or the two of the listener that ``--listener`` names."""
    text = options.listener
    if text is None:
        return read_ear(options.audiogram)
    from hlsim.audiogram.listener import read_listeners

    file, _, name = (text, "", "") if Path(text).exists() else text.rpartition(":")
    listeners = read_listeners(file or text)
    chosen = (
        next(iter(listeners.values())) if not name and len(listeners) == 1 else listeners.get(name)
    )
    if chosen is None:
        few = ", ".join([*listeners][:5]) + (", ..." if len(listeners) > 5 else "")
        found = f"no listener {name!r}" if name else f"{len(listeners)} listeners"
        raise ValueError(
            f"--listener {text}: {found}; allowed: {file or text}:NAME, with a NAME of {few}"
        )
    for gone, there in (("left", "right"), ("right", "left")):
        if getattr(chosen, gone) is None:
            raise ValueError(
                f"--listener {text}: the {gone} ear is missing; allowed: a listener with both, or --audiogram with the "
                f"{there} ear's levels and a file of that channel"
            )
    return chosen


def other_ear(label: str, name: str, ear: Audiogram | None) -> list[str]:
    """What there is to say of a compensator that was trained for one ear and is given another, or several (None)."""
    from compensators import trained_for

    own = trained_for(name)
    if own is None or (ear is not None and own.thresholds == ear.thresholds):
        return []
    levels = ", ".join(f"{level:g}" for level in own.thresholds)
    return [f"{label} was trained for one ear, {levels} dB HL, and is meant for no other."]


def read_compensator(
    options: argparse.Namespace, sample_rate: int, *, warn: bool = True
) -> tuple[Any, dict[str, float]]:
    """The compensator that is asked for, and its sliders; on stderr, with ``warn``, that it is for another ear."""
    from compensators import load_compensator

    name = options.compensator
    settings = {"sample_rate": sample_rate, "full_scale_spl": options.full_scale_spl}
    compensator = load_compensator(name, **settings, linked=getattr(options, "linked", False))
    ear = read_ear(options.audiogram) if options.audiogram else None
    for line in other_ear(name, name, ear) if warn else ():
        print(f"hlsim: warning: {line}", file=sys.stderr)
    names = ("noise_reduction", "amplification")
    sliders = {given: value for given in names if (value := getattr(options, given)) is not None}
    if idle := sorted(sliders.keys() - getattr(compensator, "SLIDERS", ())):
        raise ValueError(
            f"{', '.join(idle)} of {name}, which has no such slider; allowed: with a hearing aid"
        )
    return compensator, sliders
