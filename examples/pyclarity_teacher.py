"""pyclarity's own MSBG as a teacher: time-aligned, at any sample rate, and without its rescaling of
the level.

    hlsim evaluate-simulator neuro-msbg --teacher examples/pyclarity_teacher.py:PyclarityMSBG ...

pyclarity (`pip install 'pyclarity==0.9.*'`) computes one signal at a time on a CPU, at 44.1 kHz;
hlsim's exact MSBG gives the same output to 3e-4 of the signal, 23 to 31 times as fast.
"""

import logging
import math

import numpy as np
import torch
from clarity.evaluator.msbg.msbg import Ear
from clarity.evaluator.msbg.msbg_utils import measure_rms
from scipy.signal import resample_poly
from torch import Tensor

from hlsim import MSBG, Audiogram
from hlsim.calibration import PASCAL_SPL, gain_to_pascals
from hlsim.msbg.ear import MSBG_RATE

PADDING = 2048  # samples of silence after the signal, so that the delayed end is not cut off


class PyclarityMSBG:
    """A teacher: (items, time) in pascals and (items, 8) in dB HL -> (items, time), at 16 kHz."""

    sample_rate = 16000
    fingerprint = "pyclarity 0.9"

    def __call__(self, waveform: Tensor, audiogram: Tensor) -> Tensor:
        outputs = []
        for signal, thresholds in zip(waveform.cpu(), audiogram.tolist(), strict=True):
            outputs.append(pyclarity_msbg(signal, Audiogram(tuple(thresholds)), self.sample_rate))
        return torch.stack(outputs)


def pyclarity_msbg(waveform: Tensor, audiogram: Audiogram, sample_rate: int) -> Tensor:
    """Run pyclarity's ``Ear.process``, aligned with its input and without its change of the level.

    The signal is resampled to 44.1 kHz and back by scipy, followed by silence, and scaled so that
    the rescaling by active level inside ``Ear.process`` ends at the level that the signal had.

    Shape: (time,) in pascals -> (time,), float64.

    Raises:
        ValueError: The signal is too soft (about 30 dB SPL) to have an active level.
    """
    ear = Ear()
    disabled = logging.root.manager.disable
    logging.disable(max(disabled, logging.WARNING))  # pyclarity logs each audiogram.
    try:
        ear.set_audiogram(audiogram.to_clarity())
        from_pascals = gain_to_pascals(PASCAL_SPL) / gain_to_pascals(
            float(ear.equiv_0db_spl + ear.ahr)
        )
        common = math.gcd(MSBG_RATE, sample_rate)
        up, down = MSBG_RATE // common, sample_rate // common
        signal = resample_poly(waveform.double().numpy(), up, down, window=("kaiser", 12.0))
        signal = np.append(signal * from_pascals, np.zeros(PADDING))
        output = ear.process(signal * gain_before_rescaling(signal))[0]
    finally:
        logging.disable(disabled)
    delay = MSBG(sample_rate=MSBG_RATE).delay(audiogram.severity)
    output = output[delay : delay + len(signal) - PADDING] / from_pascals
    output = resample_poly(output, down, up, window=("kaiser", 12.0))[: len(waveform)]
    return torch.from_numpy(np.pad(output, (0, len(waveform) - len(output))))


def gain_before_rescaling(signal: np.ndarray) -> float:
    """Compute the gain that cancels the rescaling in ``Ear.process`` by overall over active RMS.

    The active RMS depends on the level where its threshold meets its floor, hence the iteration.
    """
    overall = np.sqrt(np.mean(signal**2))
    gain = 1.0
    for _ in range(5):
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = float(measure_rms(signal * gain, MSBG_RATE, -12)[0] / (overall * gain))
        if not math.isfinite(gain):
            raise ValueError(
                "the signal is too soft for pyclarity's active level, which needs about 40 dB SPL; "
                "use a louder signal, or the teacher msbg"
            )
    return gain
