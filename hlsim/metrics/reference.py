"""pyclarity's own MSBG, made comparable: no rescaling, time-aligned, at any rate."""

import logging
import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.signal import resample_poly
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import PASCAL_SPL, gain_to_pascals
from hlsim.extras import require
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.model import MSBG

_TAIL = 2048  # samples of silence in which what is delayed comes out


def pyclarity_msbg(waveform: Tensor, audiogram: Audiogram, sample_rate: int) -> Tensor:
    """What pyclarity's ``Ear.process`` makes of a signal in pascals, as an aligned simulator would give it.

    The signal is resampled to 44.1 kHz and back by scipy, followed by silence, and scaled so that the reference's own
    rescaling by active level ends at the level it had. One so soft, 30 dB SPL as a rule, that the reference finds no
    active level in it is a ValueError.

    Shape: (time,) -> (time,), float64.
    """
    msbg, utils = (
        require(f"clarity.evaluator.msbg.{name}", "pyclarity") for name in ("msbg", "msbg_utils")
    )
    ear = msbg.Ear()  # RMS 1.0 is 120 dB SPL
    disabled = logging.root.manager.disable
    logging.disable(max(disabled, logging.WARNING))
    try:
        ear.set_audiogram(audiogram.to_clarity())
        to_reference = gain_to_pascals(PASCAL_SPL) / gain_to_pascals(
            float(ear.equiv_0db_spl + ear.ahr)
        )
        common = math.gcd(MSBG_RATE, sample_rate)
        up, down = MSBG_RATE // common, sample_rate // common
        signal = (
            resample_poly(waveform.double().numpy(), up, down, window=("kaiser", 12.0))
            * to_reference
        )
        signal = np.append(signal, np.zeros(_TAIL))
        heard = ear.process(signal * _undo_rescaling(signal, utils.measure_rms))[0]
    finally:
        logging.disable(disabled)
    delay = MSBG(sample_rate=MSBG_RATE).delay(audiogram.severity)
    heard = heard[delay : delay + len(signal) - _TAIL] / to_reference
    back = resample_poly(heard, down, up, window=("kaiser", 12.0))[: len(waveform)]
    return torch.from_numpy(np.pad(back, (0, len(waveform) - len(back))))


def _undo_rescaling(signal: np.ndarray, measure_rms: Callable[..., tuple[float, ...]]) -> float:
    """The factor that the reference's rescaling, overall over active RMS, turns back into 1.

    The ratio depends on the level where the threshold of activity meets its floor, hence the rounds.
    """
    overall = np.sqrt(np.mean(signal**2))
    factor = 1.0
    for _ in range(5):
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = float(measure_rms(signal * factor, MSBG_RATE, -12)[0] / (overall * factor))
        if not math.isfinite(factor):
            raise ValueError(
                "too soft for pyclarity's active level, which starts at 40 dB SPL; allowed: louder signals, or the "
                "teacher msbg"
            )
    return factor
