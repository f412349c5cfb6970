"""Loudness of people and of simulated ears over the hearing loss: discomfort, and growth below it.

An ear's uncomfortable level (UCL) is the level in dB HL from which a tone is uncomfortably loud. A
simulated ear has one, too: the level at which it perceives what a normal ear perceives at the
normal UCL. With full recruitment up to the UCL it would not depend on the loss, and in a linear ear
it rises by 1 dB per dB of loss.

People with a loss also rate loudness on a scale of categories, and their ratings grow faster with
the level. A simulated ear's growth is that of a normal ear times the growth of the perceived level.

``examples/people.py`` uses these functions.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_ndtr
from torch import Tensor, nn

from hlsim.audiogram import HIGHEST_SIMULATED, LOWEST_LEVEL, Audiogram
from hlsim.calibration import PASCAL_SPL

Array = NDArray[np.float64]

RATE = 16000

FREE_FIELD_THRESHOLD_SPL = {500: 4.4, 1000: 2.4, 2000: -1.3, 4000: -5.4}
"""Level in dB SPL of 0 dB HL for a tone from the front (ISO 389-7:2005)."""

NOT_REACHED = 115.0
"""UCL in dB HL from which on tables say that no discomfort was reached."""

MEASURED_HZ = (125, 250, 500, 750, 1000, 1500, 2000, 4000)

_ABOVE_NORMAL_DB = np.append(np.arange(-5.0, 30.0, 5.0), [60.0, 110.0])
"""Levels of the tones relative to a normal ear's, among which that of an ear is interpolated.

The highest ones are for the linear ear.
"""

LOUDNESS_HZ = (1500, 4000)
"""Centre frequencies of the noises whose loudness was rated."""

_GROWTH_SPL = np.array([70.0, 90.0])
"""Levels in dB SPL between which the growth of the perceived level is computed.

They lie above most thresholds, and in MSBG the growth hardly depends on the level up to 100 dB SPL.
"""

_EARS_AT_ONCE = 16


class CensoredFit(NamedTuple):
    """Linear model of levels of which some are only known to exceed a limit.

    Attributes:
        coefficients: Coefficient of each column of the design matrix.
        deviation: Standard deviation of the levels around the model in dB.
    """

    coefficients: Array
    deviation: float


def read_uncomfortable_levels(path: str | Path) -> pd.DataFrame:
    """Read one row per ear and frequency: person, ear, audiogram, frequency, threshold and ucl.

    Thresholds are limited to the range that simulators accept. Rows whose own threshold is above
    it, or whose UCL or threshold was not measured, are left out.
    """
    rows = []
    for _, person in pd.read_csv(path).iterrows():
        for ear in ("left", "right"):
            levels = {hz: person[f"{ear}_{hz}"] for hz in MEASURED_HZ}
            limited = _limit(levels)
            for hz in FREE_FIELD_THRESHOLD_SPL:
                ucl = person[f"ucl_{ear}_{hz}"]
                if np.isnan(ucl) or not levels[hz] <= HIGHEST_SIMULATED:
                    continue
                audiogram = Audiogram(tuple(limited.values()), tuple(map(float, limited)))
                rows.append((person.person, ear, audiogram, hz, levels[hz], ucl))
    return pd.DataFrame(rows, columns=["person", "ear", "audiogram", "hz", "threshold", "ucl"])


def read_loudness(path: str | Path) -> pd.DataFrame:
    """Read one row per ear: person, ear, audiogram, threshold and slope.

    The threshold is the mean at ``LOUDNESS_HZ``. Thresholds are limited as in
    ``read_uncomfortable_levels``. Ears are left out whose slope or threshold at one of these
    frequencies was not measured, or whose threshold at one of them is above the range.
    """
    rows = []
    for _, person in pd.read_csv(path).iterrows():
        for ear in ("left", "right"):
            levels = {hz: person.get(f"{ear}_{hz}", np.nan) for hz in MEASURED_HZ}
            limited = _limit(levels)
            rated = [levels[hz] for hz in LOUDNESS_HZ]
            slope = person[f"mlow_{ear}"]
            if np.isnan(slope) or not np.max(rated) <= HIGHEST_SIMULATED:
                continue
            audiogram = Audiogram(tuple(limited.values()), tuple(map(float, limited)))
            rows.append((person.person, ear, audiogram, np.mean(rated), slope))
    return pd.DataFrame(rows, columns=["person", "ear", "audiogram", "threshold", "slope"])


def _limit(levels: dict[int, float]) -> dict[int, float]:
    """Limit the measured thresholds to the range that simulators accept, and drop the others."""
    return {
        hz: min(max(level, LOWEST_LEVEL), HIGHEST_SIMULATED)
        for hz, level in levels.items()
        if not np.isnan(level)
    }


def fit_censored(design: Array, levels: Array, limit: float | Array = NOT_REACHED) -> CensoredFit:
    """Fit a linear model by maximum likelihood to levels of which those from a limit on are lost.

    The likelihood is that of Tobin's model: a normal density for levels below the limit, and for
    the others the probability that a level exceeds the limit.

    Args:
        design: Predictors, (levels, coefficients).
        levels: Measured levels in dB, (levels,).
        limit: Level in dB from which on a measured level only means "at least the limit".

    >>> design = np.stack([np.ones(4), [0.0, 10.0, 20.0, 30.0]], 1)
    >>> fit_censored(design, np.array([90.0, 93.0, 93.0, 96.0])).coefficients.round(2)
    array([90.3 ,  0.18])
    """
    is_reached = levels < limit
    observed = np.minimum(levels, limit)
    start, *_ = np.linalg.lstsq(design, observed, rcond=None)
    deviation = float(np.std(observed - design @ start)) + 1e-3
    # Scaled coefficients have similar curvature.
    scale = np.sqrt(np.square(design).mean(0))

    def negative_log_likelihood(x: Array) -> tuple[float, Array]:
        spread = np.exp(x[-1])
        score = (observed - design @ (x[:-1] / scale)) / spread
        log_normal = -0.5 * (np.square(score) + np.log(2.0 * np.pi))
        log_density = log_normal - x[-1]
        log_survival = log_ndtr(-score)
        hazard = np.exp(log_normal - log_survival)
        value = np.where(is_reached, log_density, log_survival).sum()
        by_score = np.where(is_reached, -score, -hazard)
        by_coefficients = -(by_score @ design) / (spread * scale)
        by_spread = -(by_score * score + is_reached).sum()
        return -value, -np.append(by_coefficients, by_spread)

    initial = np.append(start * scale, np.log(deviation))
    x = minimize(negative_log_likelihood, initial, jac=True, method="BFGS").x
    return CensoredFit(x[:-1] / scale, float(np.exp(x[-1])))


def line(threshold: Array) -> Array:
    """Return the design matrix of a straight line: a constant and the threshold."""
    return np.stack([np.ones(len(threshold)), threshold], 1)


def full_recruitment(intercept: float, slope: float) -> float:
    """Return the level at which an ear whose UCL follows a line is as loud as a normal one.

    If the perceived level falls from full recruitment R by R / (R - threshold) dB per dB, as in
    MSBG, the UCL rises by (R - UCL of a normal ear) / R dB per dB of loss.

    >>> round(full_recruitment(84.0, 0.2))
    105
    """
    return intercept / (1.0 - slope)


def bootstrap(
    rows: pd.DataFrame, statistic: Callable[[pd.DataFrame], Sequence[float]], draws: int = 200
) -> Array:
    """Compute a statistic of persons drawn with replacement.

    Args:
        rows: Table with the column ``person``.
        statistic: Function of such a table.
        draws: Number of draws.

    Returns:
        Quantiles of 2.5 and 97.5 %, (2, values).
    """
    random = np.random.default_rng(0)
    rows_of_persons = [*rows.groupby("person").indices.values()]
    values = []
    for _ in range(draws):
        drawn = random.integers(len(rows_of_persons), size=len(rows_of_persons))
        values.append(statistic(rows.iloc[np.concatenate([rows_of_persons[i] for i in drawn])]))
    return np.quantile(np.array(values, dtype=float), [0.025, 0.975], axis=0)


def tones(hz: float, spl: Array) -> Tensor:
    """Synthesise tones of 0.1 s at several levels in dB SPL. Shape: -> (levels, time)."""
    seconds = torch.arange(RATE // 10) / RATE
    tone = np.sqrt(2.0) * torch.sin(2.0 * torch.pi * hz * seconds)
    return _at_levels(tone, spl)


def noises(hz: float, spl: Array) -> Tensor:
    """Synthesise a third-octave noise of 0.3 s at several levels in dB SPL.

    Shape: -> (levels, time)
    """
    count = 3 * RATE // 10
    frequencies = np.fft.rfftfreq(count, 1.0 / RATE)
    is_inside = np.abs(np.log2(np.maximum(frequencies, 1.0) / hz)) <= 1.0 / 6.0
    phases = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, len(frequencies))
    noise = np.fft.irfft(is_inside * np.exp(1j * phases), count)
    noise /= np.sqrt(np.square(noise).mean())
    return _at_levels(torch.tensor(noise, dtype=torch.float32), spl)


def _at_levels(sound: Tensor, spl: Array) -> Tensor:
    """Give a sound with an RMS value of 1 several levels in dB SPL, and ramps of 20 ms."""
    seconds = torch.arange(len(sound)) / RATE
    ramp = (torch.minimum(seconds, seconds.flip(0)) / 0.02).clamp_max(1.0)
    amplitudes = 10.0 ** ((spl - PASCAL_SPL) / 20.0)
    return torch.tensor(amplitudes, dtype=torch.float32)[:, None] * ramp * sound


@torch.no_grad()
def perceived_levels(simulator: nn.Module, ears: Sequence[Audiogram], inputs: Tensor) -> Array:
    """Compute the perceived levels of sounds in dB SPL, without their first and last 30 ms.

    Shape: inputs (sounds, time) -> (ears, sounds)
    """
    levels = []
    for first in range(0, len(ears), _EARS_AT_ONCE):
        batch = [[ear] for ear in ears[first : first + _EARS_AT_ONCE]]
        output = simulator(inputs, batch)[..., 3 * RATE // 100 : -3 * RATE // 100]
        levels.append(10.0 * output.double().square().mean(-1).log10() + PASCAL_SPL)
    return torch.cat(levels).numpy()


def simulated_uncomfortable_levels(
    simulator: nn.Module, ears: Sequence[Audiogram], hz: int, normal_ucl: float
) -> Array:
    """Compute the level at which each ear perceives what a normal ear perceives at its UCL.

    Args:
        simulator: Simulator of hearing loss at 16 kHz.
        ears: Ears.
        hz: Frequency of the tone.
        normal_ucl: UCL of the normal ear in dB HL.

    Returns:
        Levels in dB HL, (ears,).
    """
    levels = normal_ucl + _ABOVE_NORMAL_DB
    spl = levels + FREE_FIELD_THRESHOLD_SPL[hz]
    [normal] = perceived_levels(simulator, [Audiogram.standard("NH")], tones(hz, spl))
    target = np.interp(normal_ucl, levels, normal)
    perceived = perceived_levels(simulator, ears, tones(hz, spl))
    return np.array([np.interp(target, level_of_ear, levels) for level_of_ear in perceived])


def growth_of_perceived_level(simulator: nn.Module, ears: Sequence[Audiogram]) -> Array:
    """Compute by how many dB the perceived level of a noise grows per dB of its level.

    Returns:
        Mean growth at ``LOUDNESS_HZ``, (ears,).
    """
    growths = []
    for hz in LOUDNESS_HZ:
        perceived = perceived_levels(simulator, ears, noises(hz, _GROWTH_SPL))
        growths.append(np.diff(perceived)[:, 0] / np.diff(_GROWTH_SPL))
    return np.mean(growths, axis=0)
