"""Active speech level: the level of speech without its pauses, after method B of ITU-T P.56."""

import math

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.signal import lfilter
from torch import Tensor

_TIME_CONSTANT = 0.03  # s, of each of the two smoothings
_HANGOVER = 0.2  # s for which speech counts as active after its envelope has fallen
_MARGIN_DB = 15.9  # of the active level over the threshold of activity
_THRESHOLDS = 2.0 ** -np.arange(16.0)[::-1]  # of the envelope's maximum, ascending


def active_level_db(waveform: Tensor | np.ndarray, sample_rate: int) -> float:
    """Active speech level in dB relative to RMS 1.0.

    The standard's thresholds are fractions of full scale; these are fractions of the envelope's maximum, so that a gain
    changes the result by exactly that gain.

    Shape: (time,).

    Raises:
        ValueError: the waveform is silent or not (time,).
    """
    samples = np.asarray(waveform, dtype=np.float64)
    if samples.ndim != 1 or not samples.any():
        raise ValueError(
            f"waveform of shape {samples.shape}{'' if samples.ndim != 1 else ', silent'}; allowed: (time,), not silent"
        )
    pole = math.exp(-1.0 / (sample_rate * _TIME_CONSTANT))
    smooth = ([1.0 - pole], [1.0, -pole])
    envelope = lfilter(*smooth, lfilter(*smooth, np.abs(samples)))
    width = max(1, round(_HANGOVER * sample_rate))
    held = maximum_filter1d(
        envelope, width, mode="constant", origin=(width - 1) // 2
    )  # over the last 0.2 s
    thresholds = _THRESHOLDS * envelope.max()
    active = len(held) - np.searchsorted(np.sort(held), thresholds)
    levels = 10.0 * np.log10(np.square(samples).sum() / np.maximum(active, 1))
    margins = levels - 20.0 * np.log10(thresholds)  # they fall as the threshold rises
    above = (
        int(np.argmax(margins <= _MARGIN_DB))
        if bool((margins <= _MARGIN_DB).any())
        else len(margins) - 1
    )
    if above == 0 or margins[above] > _MARGIN_DB:
        return float(levels[above])
    share = (margins[above - 1] - _MARGIN_DB) / (margins[above - 1] - margins[above])
    return float(levels[above - 1] + share * (levels[above] - levels[above - 1]))
