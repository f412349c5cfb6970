"""Active speech level: the level of speech without its pauses, after method B of ITU-T P.56."""

import math

import numpy as np
import scipy
from torch import Tensor

_TIME_CONSTANT = 0.03
"""Time constant in seconds of each of the two filters that smooth the envelope."""

_HANGOVER = 0.2
"""Time in seconds for which speech counts as active after its envelope has fallen."""

_MARGIN_DB = 15.9
"""Active speech level minus the threshold of activity in dB, as the standard defines it."""

_THRESHOLDS = 2.0 ** -np.arange(16.0)[::-1]
"""Thresholds of activity relative to the envelope's maximum, in ascending order."""


def active_level_db(waveform: Tensor | np.ndarray, sample_rate: int) -> float:
    """Compute the level of speech without its pauses, the active speech level.

    Samples count as speech where the envelope is above a threshold. The standard's thresholds are
    fractions of full scale. Here they are fractions of the envelope's maximum, so that a gain of
    the waveform changes the result by exactly this gain.

    Source: ITU-T P.56, method B.

    Args:
        waveform: Samples of one channel, (time,).
        sample_rate: Sample rate in Hz.

    Returns:
        Level in dB relative to RMS 1.0.

    Raises:
        ValueError: The waveform is silent or empty.

    >>> speech = np.sin(np.arange(16000.0))
    >>> with_pause = np.concatenate((speech, np.zeros(64000)))
    >>> round(active_level_db(with_pause, 16000) - active_level_db(speech, 16000))
    -1
    """
    samples = np.asarray(waveform, dtype=np.float64)
    if not samples.any():
        raise ValueError("expected speech, got a waveform that is silent or empty")
    pole = math.exp(-1.0 / (sample_rate * _TIME_CONSTANT))
    envelope = np.abs(samples)
    for _ in range(2):
        envelope = scipy.signal.lfilter([1.0 - pole], [1.0, -pole], envelope)
    thresholds = _THRESHOLDS * envelope.max()
    # A sample is active if the envelope reaches the threshold there or within the hangover before.
    width = max(1, round(_HANGOVER * sample_rate))
    recent_maximum = scipy.ndimage.maximum_filter1d(
        envelope, width, mode="constant", origin=(width - 1) // 2
    )
    inactive_samples = np.searchsorted(np.sort(recent_maximum), thresholds)
    active_samples = np.maximum(len(samples) - inactive_samples, 1)
    levels = 10.0 * np.log10(np.square(samples).sum() / active_samples)
    # The margin falls as the threshold rises. The active speech level lies where it is 15.9 dB.
    margins = np.minimum.accumulate(levels - 20.0 * np.log10(thresholds))
    return float(np.interp(_MARGIN_DB, margins[::-1], levels[::-1]))
