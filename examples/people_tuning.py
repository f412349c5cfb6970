"""Frequency selectivity of people and of simulated ears, by a forward-masking experiment.

A tone, the masker, is followed by a short soft tone, the probe. The level of the masker that just
masks the probe is low where the masker has the frequency of the probe, and higher for other
frequencies. The difference in dB, the *tuning depth*, is small in ears that are poorly tuned.

The simulated listener is a normal ear behind a simulator of hearing loss. Its detector has no
parameter that was fitted to these people:

- a gammatone filter at the frequency of the probe, as wide as that of a normal ear;
- the internal noise of a normal ear (ANSI S3.5-1997), as the power that passes the filter;
- a temporal window (Plack, Oxenham and Drga 2002) over the power;
- the probe is detected if it raises the output of the window by a factor of 2.

``examples/people.py`` uses these functions.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hlsim.audiogram import HIGHEST_SIMULATED, LOWEST_LEVEL, Audiogram
from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.smearing import BROADENING, SMEARING_DELAY, smear, smearing_matrix

Array = NDArray[np.float64]

RATE = 16000

NOISE_SPECTRUM_LEVEL = {500: -9.7, 1000: -12.5, 2000: -17.7, 4000: -25.9}
"""Internal noise of a normal ear in dB SPL per Hz at the frequencies of the probe (ANSI S3.5)."""

MASKER_RATIOS = (0.7, 1.0, 1.3)
"""Frequency of the masker over that of the probe."""

MASKER_SECONDS, GAP_SECONDS, PROBE_SECONDS, RAMP_SECONDS = 0.108, 0.010, 0.016, 0.004
"""Durations in Lecluyse et al. (2013)."""

PROBE_ABOVE_THRESHOLD_DB = 10.0

DETECTION_RATIO = 2.0
"""Factor by which a probe that is just detected raises the output of the temporal window."""

WINDOW = ((0.83, 0.0046), (0.17, 0.0166))
"""Weight at time 0 and time constant in seconds of the two exponentials of the temporal window."""

BROADENING_LOSSES = (7.5, 25.0, 45.5, 66.0)
"""Losses in dB HL of no, mild, moderate and severe broadening, between which it is interpolated.

They are the middles of MSBG's severities. The last one has no upper limit; 66 dB HL is about as far
above its lower limit as the middle of the moderate losses is above theirs.
"""

_START_SECONDS, _SECONDS = 0.01, 0.18
_PROBE_SPL = np.arange(-10.0, 121.0, 10.0)
_MASKER_OVER_PROBE_DB = np.arange(-20.0, 81.0, 10.0)


def read_tuning(path: str | Path) -> pd.DataFrame:
    """Read one row per ear and frequency: ear, group, audiogram, hz, thresholds and depth.

    The column threshold has dB SPL at the headphone, and hearing_level dB HL, relative to the mean
    thresholds of the group of normal ears.
    """
    table = pd.read_csv(path)
    table["hz"] = table.frequency_hz.astype(int)
    table["threshold"] = table.threshold_500ms_db_spl
    is_normal = table.group == "normal"
    zero = table[is_normal].groupby("hz").threshold.mean()
    hearing_level = (table.threshold - table.hz.map(zero)).clip(LOWEST_LEVEL, HIGHEST_SIMULATED)
    table["hearing_level"] = hearing_level
    rows = []
    for _, ear in table.sort_values("hz").groupby("ear"):
        audiogram = Audiogram(tuple(ear.hearing_level), tuple(map(float, ear.hz)))
        rows.append(ear.assign(audiogram=[audiogram] * len(ear)))
    measured = pd.concat(rows).rename(columns={"tuning_depth_db": "depth"})
    is_compared = measured.hz.isin([*NOISE_SPECTRUM_LEVEL]) & measured.depth.notna()
    columns = ["ear", "group", "audiogram", "hz", "threshold", "hearing_level", "depth"]
    return measured[is_compared & measured.hearing_level.notna()][columns].reset_index(drop=True)


def _tone(hz: float, start: float, seconds: float, spl: Array) -> Tensor:
    """Synthesise tones at several levels in dB SPL. Shape: -> (levels, time)."""
    time = torch.arange(round(_SECONDS * RATE)) / RATE - start
    to_edge = torch.minimum(time, seconds - time).clamp(0.0, RAMP_SECONDS)
    ramp = 0.5 - 0.5 * torch.cos(torch.pi * to_edge / RAMP_SECONDS)
    tone = ramp * torch.sin(2.0 * torch.pi * hz * time)
    peaks = np.sqrt(2.0) * 10.0 ** ((spl - PASCAL_SPL) / 20.0)
    return torch.tensor(peaks, dtype=torch.float32)[..., None] * tone


def _window_output(perceived: Tensor, hz: int) -> Tensor:
    """Compute the output of the temporal window of the filter at ``hz``, with the internal noise.

    Shape: (..., time) -> (..., time).
    """
    samples = perceived.shape[-1]
    points = 2 * samples
    bandwidth = float(erb(np.array(float(hz))))
    frequencies = torch.fft.fftfreq(points, 1.0 / RATE)
    # a gammatone filter of fourth order for positive frequencies
    response = 2.0 * (1.0 + 1j * (frequencies - hz) / (1.019 * bandwidth)) ** -4.0
    response[frequencies < 0.0] = 0.0
    spectrum = torch.fft.fft(perceived.double(), points) * response
    power = 0.5 * torch.fft.ifft(spectrum)[..., :samples].abs().square()
    time = torch.arange(samples, dtype=torch.float64) / RATE
    window = sum(weight * torch.exp(-time / seconds) for weight, seconds in WINDOW)
    window = window / window.sum()
    smoothed = torch.fft.irfft(torch.fft.rfft(power, points) * torch.fft.rfft(window, points))
    noise_db = NOISE_SPECTRUM_LEVEL[hz] + 10.0 * np.log10(bandwidth) - PASCAL_SPL
    return smoothed[..., :samples].clamp_min(0.0) + 10.0 ** (noise_db / 10.0)


def _detectability(with_probe: Tensor, without_probe: Tensor, hz: int) -> Array:
    """Compute how far in dB a probe is above the threshold of detection, nearly.

    It is the power that the probe adds to the output of the window, over that which is detected. It
    is 0 dB at the threshold, and over the level of a probe or masker it is nearly a line.

    Shape: (..., time) -> (...).
    """
    start = round((_START_SECONDS + MASKER_SECONDS + GAP_SECONDS) * RATE)
    ratio = _window_output(with_probe, hz) / _window_output(without_probe, hz)
    rise = ratio[..., start:].amax(-1) - 1.0
    return 10.0 * np.log10(rise.clamp_min(1e-9).numpy() / (DETECTION_RATIO - 1.0))


def _threshold(levels: Array, detectability: Array) -> float:
    """Return the level where detection ends, or NaN if it ends at no level or before the first."""
    masked = np.flatnonzero(detectability < 0.0)
    if not len(masked) or masked[0] == 0:
        return float("nan")
    i = masked[0]
    return float(np.interp(0.0, detectability[[i, i - 1]], levels[[i, i - 1]]))


@torch.no_grad()
def tuning_depth(simulator: nn.Module, ear: Audiogram, hz: int) -> float:
    """Measure the tuning depth of an ear with a simulator of hearing loss.

    Args:
        simulator: Simulator at 16 kHz.
        ear: Ear.
        hz: Frequency of the probe in Hz, one of ``NOISE_SPECTRUM_LEVEL``.

    Returns:
        Mean level in dB of the maskers at 0.7 and 1.3 times the frequency of the probe, minus that
        of the masker at its frequency. NaN if a masker masks the probe at none or at the lowest of
        its levels, -20 to 80 dB relative to the probe.
    """
    probe_start = _START_SECONDS + MASKER_SECONDS + GAP_SECONDS
    probes = simulator(_tone(hz, probe_start, PROBE_SECONDS, _PROBE_SPL), ear)
    detectability = _detectability(probes, torch.zeros_like(probes), hz)
    threshold = _threshold(_PROBE_SPL[::-1], detectability[::-1])
    probe_spl = np.array(threshold + PROBE_ABOVE_THRESHOLD_DB)
    probe = _tone(hz, probe_start, PROBE_SECONDS, probe_spl)
    levels = probe_spl + _MASKER_OVER_PROBE_DB
    maskers = torch.stack(
        [_tone(hz * ratio, _START_SECONDS, MASKER_SECONDS, levels) for ratio in MASKER_RATIOS]
    )
    without_probe, with_probe = simulator(torch.stack((maskers, maskers + probe)), ear)
    detectabilities = _detectability(with_probe, without_probe, hz)
    below, at_probe, above = (_threshold(levels, of_masker) for of_masker in detectabilities)
    return 0.5 * (below + above) - at_probe


def tuning_depths(simulator: nn.Module, ears: Sequence[Audiogram], hz: Sequence[int]) -> Array:
    """Measure the tuning depth of each ear at its frequency in dB. Shape: -> (ears,)."""
    pairs = zip(ears, hz, strict=True)
    return np.array([tuning_depth(simulator, ear, int(frequency)) for ear, frequency in pairs])


def intended_depths(
    ears: Sequence[Audiogram],
    hz: Sequence[int],
    losses: Sequence[float],
    unsmeared: Array,
    is_continuous: bool,
) -> Array:
    """Calculate the tuning depth that MSBG would have if its smearing widened filters as intended.

    On each side of the probe's frequency, the depth is at most the attenuation of the masker by the
    wide filter, and at most the depth without smearing, which recruitment limits.

    Args:
        ears: Ears, whose severity decides how wide the filters are.
        hz: Frequencies of the probes in Hz.
        losses: Thresholds at these frequencies in dB HL.
        unsmeared: Tuning depths in dB without smearing.
        is_continuous: Whether the width follows the threshold at the probe's frequency instead of
            the severity of the ear.

    Returns:
        Tuning depths in dB, (ears,).
    """
    widths = np.array([(1.0, 1.0), *BROADENING.values()])
    severities = ["none", *BROADENING]
    depths = []
    for ear, frequency, loss, depth in zip(ears, hz, losses, unsmeared, strict=True):
        if is_continuous:
            pair = [np.interp(loss, BROADENING_LOSSES, widths[:, side]) for side in (0, 1)]
        else:
            pair = widths[severities.index(ear.severity)]
        distance = 0.3 * 4.0 * frequency / float(erb(np.array(float(frequency))))
        scaled = distance / np.array(pair)
        attenuation = -10.0 * np.log10((1.0 + scaled) * np.exp(-scaled))
        depths.append(np.minimum(attenuation, depth).mean())
    return np.array(depths)


def passed_by_filters(sound: str, hz: int, severity: str) -> tuple[float, float, float]:
    """Compute how much of a sound passes an auditory filter beside it, and how smearing changes it.

    Args:
        sound: ``"tone"``, at 0.7 times the frequency of the filter, or ``"noise"``, from 200 to
            8000 Hz without the band from 0.7 to 1.3 times that frequency.
        hz: Centre frequency of the filter.
        severity: Severity of the loss, which decides the smearing.

    Returns:
        Level in dB relative to the sound: of the unchanged sound behind a normal filter, of the
        smeared sound behind a normal filter, and of the unchanged sound behind the wide filter that
        smearing imitates.
    """
    frequencies = np.fft.rfftfreq(MSBG_RATE, 1.0 / MSBG_RATE)
    if sound == "tone":
        spectrum = (frequencies == round(0.7 * hz)).astype(complex)
    else:
        random = np.random.default_rng(0)
        phases = np.exp(2j * np.pi * random.random(len(frequencies)))
        is_beside = np.abs(frequencies / hz - 1.0) > 0.3
        spectrum = phases * (is_beside & (frequencies > 200.0) & (frequencies < 8000.0))
    waveform = np.fft.irfft(spectrum, MSBG_RATE)
    matrix = torch.from_numpy(np.asarray(smearing_matrix(severity)))
    smeared = smear(torch.from_numpy(np.tile(waveform, 2)), matrix).numpy()
    # The second of two periods, so that nothing begins or ends.
    smeared = smeared[MSBG_RATE + SMEARING_DELAY :][:MSBG_RATE]
    wide = BROADENING[severity]
    return (
        _passed(waveform, hz, (1.0, 1.0)),
        _passed(smeared, hz, (1.0, 1.0)),
        _passed(waveform, hz, wide),
    )


def _passed(waveform: Array, hz: int, widths: tuple[float, float]) -> float:
    """Return the level in dB of what a filter passes of one second of sound, relative to it."""
    power = np.square(np.abs(np.fft.rfft(waveform)))
    frequencies = np.fft.rfftfreq(len(waveform), 1.0 / MSBG_RATE)
    width = np.where(frequencies < hz, *widths)
    g = 4.0 * np.abs(frequencies - hz) / float(erb(np.array(float(hz)))) / width
    weights = (1.0 + g) * np.exp(-g) / np.mean(widths)
    return float(10.0 * np.log10((power * weights).sum() / power.sum()))
