"""Export of the gains of an aid that is fitted to an ear, as files of other programs.

Two formats have gains for speech at many levels: a CSV table, and the gain table of openMHA's
compressor ``dc``. CamillaDSP and Equalizer APO are linear: a file has the gains for speech at one
level.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from compensators.aid import Aid, thirds_of_octave
from compensators.filter_bank import RATE, speech_density
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.scale import interpolate_over_log
from hlsim.checks import check_number, suggest
from hlsim.files import csv_text

Array = NDArray[np.float64]

LEVELS = tuple(float(level) for level in range(20, 121, 5))
"""Levels of speech in dB SPL for which tables have gains."""

BAND_LEVELS = tuple(float(level) for level in range(0, 121, 3))
"""Levels in dB SPL of one band for which openMHA's table has gains."""

TAPS = 1023
"""Number of coefficients of the filter for CamillaDSP, up to a sample rate of ``TAPS_RATE`` in Hz.

At higher rates it is larger, so that the filter lasts as long.
"""

TAPS_RATE = 48000

_SETTINGS: dict[str, dict[str, Any]] = {
    "camilladsp": {"level": 65.0, "sample_rate": TAPS_RATE},
    "equalizer-apo": {"level": 65.0},
    "openmha": {"sample_rate": TAPS_RATE},
    "csv": {},
}
"""Settings of ``export_gains`` that change each format, with their default values."""

_HERTZ = np.arange(1, RATE // 2 + 1)
"""Frequencies in Hz of ``speech_density`` and of the gains for the design of filters, (8000,)."""

_FIT_STEPS = 10
"""Number of steps of ``_equaliser_points``, after which gains are within .01 dB of the aid's."""


def export_gains(
    aid: Aid,
    ear: Any,
    program: str,
    level: float | None = None,
    sample_rate: int | None = None,
) -> str:
    """Return the gains of an aid for an ear as the text of a file for another program.

    Args:
        aid: Aid, such as ``NALR()`` or one from ``load_compensator``.
        ear: Audiogram of one ear.
        program: Name of the format: ``camilladsp``, ``equalizer-apo``, ``openmha`` or ``csv``.
        level: Level of speech in dB SPL, 0 to 120, for ``camilladsp`` and ``equalizer-apo``; 65 by
            default. The other formats have gains at many levels.
        sample_rate: Sample rate in Hz of CamillaDSP or openMHA, 16000 to 192000; 48000 by default.

    Returns:
        Text of the configuration file.

    Raises:
        ValueError: There is no such format, an ear or a number is not valid, or a setting has no
            effect on the format.

    >>> from compensators import NALR
    >>> print(export_gains(NALR(), "N3", "equalizer-apo").splitlines()[-1][:33])
    GraphicEQ: 250 -0.29; 500 8.96; 1
    """
    if program not in PROGRAMS:
        raise ValueError(
            f"no format {program!r}{suggest(program, PROGRAMS)}; expected one of "
            f"{', '.join(PROGRAMS)}"
        )
    settings = {**_SETTINGS[program]}
    for name, value in {"level": level, "sample_rate": sample_rate}.items():
        if value is None:
            continue
        if name not in settings:
            option = "--" + name.replace("_", "-")
            raise ValueError(
                f"{name} ({option}) has no effect on the format {program}; leave it out"
            )
        settings[name] = value
    check_number("sample_rate", settings.get("sample_rate", RATE), RATE, 192000, whole=True)
    # A linear aid accepts any level.
    check_number("level", settings.get("level", 65.0), 0.0, 120.0)
    levels = [settings["level"]] if "level" in settings else LEVELS
    gains = np.stack([aid.gains(ear, level).double().cpu().numpy() for level in levels])
    if gains.ndim != 2:
        ears = gains.shape[1]
        raise ValueError(f"expected one ear, got a list of {ears}; export one at a time")
    return PROGRAMS[program](gains, **settings)


def _equaliser_points(gains: Array) -> Array:
    """Compute the points of an equaliser's gain curve that amplifies as an aid does.

    The gains of an aid are those for noise in a third of an octave around each of the eight
    ``FREQUENCIES``, see ``Aid.gains``. An equaliser's gain in dB is a straight line over log
    frequency between its points at these frequencies. Over a third of an octave, it amplifies the
    noise more or less than at the centre, by up to 2 dB (by up to 6 dB at 8 kHz for NAL-RP), so its
    points are fitted in a few steps.

    Args:
        gains: Gains of the aid in dB, (8,).

    Returns: Gains of the equaliser in dB at the points, (8,).
    """
    in_third = thirds_of_octave()[1:]
    density = speech_density(RATE)
    points = gains.copy()
    for _ in range(_FIT_STEPS):
        response = 10.0 ** (_interpolate(points) / 10.0)
        measured = (density * response) @ in_third / (density @ in_third)
        points += gains - 10.0 * np.log10(measured)
    return points


def _interpolate(points: Array) -> Array:
    """Return an equaliser's gains in dB at 1, 2, ..., 8000 Hz from those at ``FREQUENCIES``.

    Shape: (8,) -> (8000,).
    """
    return interpolate_over_log(_HERTZ, FREQUENCIES, points)


def _write_csv(gains: Array) -> str:
    """Return a CSV table of gains in dB, with one row per frequency and one column per level.

    Args:
        gains: Insertion gains in dB for speech at all ``LEVELS``, (levels, 8).
    """
    rows = [["frequency_hz", *(f"gain_db_at_{level:g}" for level in LEVELS)]]
    for hertz, gains_of_levels in zip(FREQUENCIES, gains.T, strict=True):
        rows.append([f"{hertz:g}", *(f"{gain:.2f}" for gain in gains_of_levels)])
    return csv_text(rows)


def _write_equalizer_apo(gains: Array, level: float) -> str:
    """Return the configuration of Equalizer APO, which has these gains in thirds of an octave.

    Args:
        gains: Insertion gains in dB for speech at the level, (1, 8).
        level: Level of speech in dB SPL.
    """
    points = _equaliser_points(gains[0])
    pairs = [f"{hz:g} {gain:.2f}" for hz, gain in zip(FREQUENCIES, points, strict=True)]
    return f"# Gains for speech at {level:g} dB SPL\nGraphicEQ: {'; '.join(pairs)}\n"


def _write_camilladsp(gains: Array, level: float, sample_rate: int) -> str:
    """Return the configuration of CamillaDSP 3: a filter with the gains, from stdin to stdout.

    The filter has minimum phase, for the shortest delay.

    Args:
        gains: Insertion gains in dB for speech at the level, (1, 8).
        level: Level of speech in dB SPL.
        sample_rate: Sample rate in Hz of CamillaDSP.
    """
    points = _equaliser_points(gains[0])
    hertz = np.array([0, *_HERTZ, *[sample_rate / 2][: sample_rate > RATE]])
    response = 10.0 ** (np.interp(hertz, _HERTZ, _interpolate(points)) / 20.0)
    # A filter resolves low frequencies by its duration, which must not fall with a higher rate.
    taps = (TAPS + 1) * math.ceil(sample_rate / TAPS_RATE) - 1
    linear_phase = scipy.signal.firwin2(taps, hertz, response, fs=sample_rate)
    filter_ = scipy.signal.minimum_phase(linear_phase, half=False)
    values = ", ".join(f"{value:.8g}" for value in filter_)
    return f"""\
# Gains for speech at {level:g} dB SPL. Replace capture and playback by your devices.
devices:
  samplerate: {sample_rate}
  chunksize: 256
  capture: {{type: Stdin, channels: 1, format: FLOAT32LE}}
  playback: {{type: Stdout, channels: 1, format: FLOAT32LE}}
filters:
  aid:
    type: Conv
    parameters: {{type: Values, values: [{values}]}}
pipeline:
  - {{type: Filter, channels: [0], names: [aid]}}
"""


def _write_openmha(gains: Array, sample_rate: int) -> str:
    """Return the part of openMHA's configuration for its filter bank and its compressor ``dc``.

    The compressor looks up the gain of a band by the level in this band. The aid's gains are
    measured by the overall level of speech, so each is entered at the level that the band has in
    average speech of this overall level.

    Args:
        gains: Insertion gains in dB for speech at all ``LEVELS``, (levels, 8).
        sample_rate: Sample rate in Hz of openMHA.
    """
    edges = np.sqrt(np.multiply(FREQUENCIES[1:], FREQUENCIES[:-1]))
    powers = np.bincount(np.searchsorted(edges, _HERTZ), speech_density(RATE))
    bands_below_speech = 10.0 * np.log10(powers / powers.sum())
    band_gains = [
        np.interp(BAND_LEVELS, np.array(LEVELS) + below, column)
        for below, column in zip(bands_below_speech, gains.T, strict=True)
    ]
    rows = ";".join(f"[{' '.join(f'{gain:.2f}' for gain in row)}]" for row in band_gains)
    return f"""\
# Plugin mhachain inside overlapadd, one channel at {sample_rate} Hz
algos = [fftfilterbank dc combinechannels]
fftfilterbank.unit = Hz
fftfilterbank.f = [{" ".join(f"{hertz:g}" for hertz in FREQUENCIES)}]
fftfilterbank.fscale = log
fftfilterbank.ftype = center
fftfilterbank.ovltype = rect
dc.fb = fftfilterbank
dc.chname = fftfilterbank_nchannels
dc.log_interp = yes
dc.gtmin = [{BAND_LEVELS[0]:g}]
dc.gtstep = [{BAND_LEVELS[1] - BAND_LEVELS[0]:g}]
dc.gtdata = [{rows}]
combinechannels.outchannels = 1
"""


PROGRAMS: dict[str, Callable[..., str]] = {
    "camilladsp": _write_camilladsp,
    "equalizer-apo": _write_equalizer_apo,
    "openmha": _write_openmha,
    "csv": _write_csv,
}
"""Functions from gains and the ``_SETTINGS`` to the text of a program's file, by the format."""
