"""Conversion of options into ears, listeners, simulators and compensators, for several commands.

Modules that need torch are imported in the functions, so that ``--help`` is fast.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.extras import is_installed, require

if TYPE_CHECKING:
    from hlsim.audiogram import Audiogram
    from hlsim.audiogram.listener import Listener

PACKAGES = {
    "train": ("lightning", "tensorboard"),
    "eval": ("joblib", "pandas", "matplotlib", "jinja2", "pystoi"),
}
"""Packages that the commands need from each extra."""


def use_one_thread() -> None:
    """Make torch, which is not imported yet, compute in one thread.

    It has no effect if the user has set OMP_NUM_THREADS. On a busy machine, threads wait for each
    other for longer than their short computations last.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def check_extras(*extras: str) -> None:
    """Raise MissingExtraError unless the packages of extras, such as ``"eval"``, are installed.

    Otherwise, a command could fail after hours of work, when it first needs a missing package.
    """
    for extra in extras:
        for package in PACKAGES[extra]:
            if not is_installed(package):
                require(package, extra)  # raises the error


def parse_ear(options: argparse.Namespace) -> Audiogram | Listener | None:
    """Return the ear of ``--audiogram``, or the listener with two ears that ``--listener`` names.

    Args:
        options: Parsed options of a command.

    Returns:
        The ear or the listener, or None if both options are missing.

    Raises:
        ValueError: See ``parse_ears``.
    """
    ears = parse_ears(options, [options.audiogram] if options.audiogram else [])
    return next(iter(ears.values()), None)


def level_and_gain(power: float, options: argparse.Namespace) -> tuple[float, float]:
    """Compute the level of a recording and its gain for ``--spl``, both in dB.

    Args:
        power: Mean square of the samples of all channels.
        options: Options ``full_scale_spl`` and ``spl``, which is None if it is not set.

    Returns:
        The level in dB SPL before the gain, and the gain, 0 if ``spl`` is None.

    >>> level_and_gain(0.01, argparse.Namespace(full_scale_spl=94.0, spl=65.0))
    (74.0, -9.0)
    """
    level = 10.0 * math.log10(power) + options.full_scale_spl
    return level, 0.0 if options.spl is None else options.spl - level


def parse_ears(
    options: argparse.Namespace, values: Sequence[Any]
) -> dict[str, Audiogram | Listener]:
    """Return the ears of a repeated ``--audiogram``, or the listener of ``--listener``.

    Prints a warning if the compensator of the options was trained for another ear.

    Args:
        options: Parsed options of a command.
        values: Values of ``--audiogram``, see ``ear`` of ``options.py``.

    Returns:
        Ears by their names. A standard ear has its own name, and any other ear one that consists
        of its levels, such as "10-20-30-40-50-60-70-80" or "500_30-4000_60". A listener has the
        name "listener".

    Raises:
        ValueError: There is no such file, listener or compensator, an audiogram is not valid, two
            have the same name, or the levels of ``--ucl`` are not valid, have no effect, or are not
            for one ear.
    """
    from hlsim.audiogram import as_audiogram
    from hlsim.audiogram.discomfort import read_points

    ucl = read_points(getattr(options, "ucl", None))
    if ucl and not getattr(options, "limit_to_ear", True):
        raise ValueError("--ucl has no effect without --limit-to-ear; add it, or leave --ucl out")
    if ucl and len(values) != 1:
        raise ValueError(
            f"--ucl has the levels of one ear of --audiogram, got {len(values)} ears; process each "
            "alone, or write the levels into the file of --listener or --audiograms, in columns "
            "such as ucl_left_500 or ucl_500"
        )
    ears: dict[str, Audiogram | Listener] = {}
    if getattr(options, "listener", None):
        ears["listener"] = _read_listener(options.listener)
    for value in values:
        if isinstance(value, str):
            name = value.upper()
        elif isinstance(value, dict):
            name = "-".join(f"{hertz:g}_{level:g}" for hertz, level in value.items())
        else:
            name = "-".join(f"{level:g}" for level in value)
        if name in ears:
            raise ValueError(f"--audiogram {name} appears twice; leave one out")
        ears[name] = replace(as_audiogram(value), ucl=ucl)
    if compensator := getattr(options, "compensator", ""):
        for ear in ears.values():
            warn_of_other_ears({compensator: compensator}, ear)
    return ears


def _read_listener(text: str) -> Listener:
    """Read the listener of ``--listener``: that of FILE, if it has only one, or of FILE:NAME.

    Raises:
        ValueError: NAME is missing although the file has several listeners, the listener lacks an
            ear, or the file cannot be read as a table of listeners.
    """
    from hlsim.audiogram.table import read_listeners

    file, name = text, ""
    if ":" in text and not Path(text).exists():
        file, _, name = text.rpartition(":")
    listeners = read_listeners(file, [name] if name else None)
    if len(listeners) != 1:
        names = ", ".join([*listeners][:5])
        raise ValueError(
            f"--listener {text}: write {file}:NAME, where NAME is one of the {len(listeners)} "
            f"listeners, such as {names}"
        )
    (listener,) = listeners.values()
    if listener.left is None or listener.right is None:
        raise ValueError(
            f"--listener {text}: expected two ears, but one is missing; use --audiogram for the "
            "other one and a file with its channel"
        )
    return listener


def warn_of_other_ears(
    checkpoints: Mapping[str, str], ears: Audiogram | Listener | None
) -> list[str]:
    """Print a warning for each compensator that was trained for one ear and is used for another.

    Args:
        checkpoints: Names or folders of compensators, by the name to use in the warning.
        ears: Ear or listener for whom they are used; None if there are several ears.

    Returns:
        The warnings.

    Raises:
        ValueError: There is no such compensator, or its checkpoint cannot be read.
    """
    from compensators import trained_for
    from hlsim.audiogram.listener import Listener

    used = [*ears.ears().values()] if isinstance(ears, Listener) else [ears]
    thresholds = {ear and ear.thresholds for ear in used}
    warnings = []
    for label, checkpoint in checkpoints.items():
        trained_ear = trained_for(checkpoint)
        if trained_ear and thresholds != {trained_ear.thresholds}:
            levels = ", ".join(f"{level:g}" for level in trained_ear.thresholds)
            text = f"{label} was trained for one ear, {levels} dB HL, and does not fit other ears."
            print(f"hlsim: warning: {text}", file=sys.stderr)
            warnings.append(text)
    return warnings


def build_simulator(options: argparse.Namespace, sample_rate: int) -> Any:
    """Load the simulator that ``--simulator`` names, at the scale of ``--full-scale-spl``.

    It is a module that is called with a waveform and an ear.

    Args:
        options: Options ``simulator`` and ``full_scale_spl``.
        sample_rate: Sample rate in Hz of the signals to process, 16000 to 48000.

    Raises:
        ValueError: See ``load_simulator``.
    """
    from hlsim.simulators import load_simulator

    return load_simulator(
        options.simulator, sample_rate=sample_rate, full_scale_spl=options.full_scale_spl
    )


def build_compensator(options: argparse.Namespace, sample_rate: int) -> Any:
    """Load the compensator that ``--compensator`` names, at the scale of ``--full-scale-spl``.

    It is a module that is called with a waveform and an ear.

    Args:
        options: Options ``compensator`` and ``full_scale_spl`` and, where a command has them,
            ``linked``, ``limit_to_ear``, ``loudness`` and the sliders. Sliders are only validated;
            they are arguments of each call of the compensator.
        sample_rate: Sample rate in Hz of the signals to process, 16000 to 48000.

    Raises:
        ValueError: See ``load_compensator``; or the compensator lacks a slider that is passed.
    """
    from compensators import load_compensator
    from compensators.directional import behind_front_end

    compensator = load_compensator(
        options.compensator,
        sample_rate=sample_rate,
        full_scale_spl=options.full_scale_spl,
        linked=getattr(options, "linked", False),
        limit_to_ear=getattr(options, "limit_to_ear", False),
        loudness=getattr(options, "loudness", 0.0),
    )
    # A directional aid passes the sliders to the hearing aid behind its front end.
    amplifier = behind_front_end(compensator)
    if not read_sliders(options).keys() <= {*getattr(amplifier, "SLIDERS", ())}:
        raise ValueError(
            f"--noise-reduction and --amplification have no effect with {options.compensator}; "
            "leave them out, or choose a hearing aid"
        )
    return compensator


def build_single_microphone_aid(options: argparse.Namespace, sample_rate: int) -> Any:
    """Load the compensator that ``--compensator`` names, and reject one for several microphones.

    It is a module that is called with one signal per ear, and an ear.

    Args:
        options: See ``build_compensator``.
        sample_rate: Sample rate in Hz of the signals to process, 16000 to 48000.

    Raises:
        ValueError: See ``build_compensator``; or the compensator takes several microphones.
    """
    compensator = build_compensator(options, sample_rate)
    if getattr(compensator, "takes_microphones", False):
        raise ValueError(
            f"{options.compensator} has several microphones, but there is one signal per ear; "
            "choose an aid with one microphone"
        )
    return compensator


def read_sliders(options: argparse.Namespace) -> dict[str, float]:
    """Return the values of the sliders of a hearing aid that a user has set, by name.

    Raises:
        ValueError: A slider, ``--loudness`` or ``--limit-to-ear`` is set, and there is no aid.
    """
    values = {name: getattr(options, name, None) for name in ("noise_reduction", "amplification")}
    sliders = {name: value for name, value in values.items() if value is not None}
    simulates = getattr(options, "simulate", False)
    settings = [name for name in ("loudness", "limit_to_ear") if getattr(options, name, None)]
    if settings := [*sliders, *settings]:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in settings)
        if simulates:
            raise ValueError(f"{flags}: no effect with --simulate; leave one of them out")
        if not getattr(options, "compensator", None):
            raise ValueError(f"{flags}: no effect without an aid; name one by --compensator")
    return sliders
