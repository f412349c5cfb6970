"""A direct path through filters of minimum phase, made anew for every hop of the gains that each frequency is to have."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from compensators.bands import DELAY, GLIDE, HISTORY, HOP, LONG_FRAME
from hlsim.torchtools import constant_like

TAPS = 256
"""Of a filter. Minimum phase puts most of its energy first, so that it adds next to no delay of its own."""

_NEPER = math.log(10.0) / 20.0


def filter_taps(gains_db: Tensor) -> Tensor:
    """Taps of the filter of minimum phase with these gains, less the impulse: gains of 0 dB give zeros, to the bit.

    The phase is the Hilbert transform of the logarithm of the gains (Oppenheim and Schafer, *Discrete-Time Signal
    Processing*, 12), here a matrix, and so is the transform back.

    Shape: (..., LONG_FRAME / 2 + 1) dB, evenly spaced from 0 to 8 kHz -> (..., TAPS).
    """
    logarithm = _NEPER * gains_db
    phase = logarithm @ constant_like(gains_db, _hilbert)
    gain = logarithm.exp()
    spectrum = torch.cat((gain * phase.cos() - 1.0, gain * phase.sin()), -1)
    return spectrum @ constant_like(gains_db, _back)


def apply_filters(padded: Tensor, taps: Tensor) -> Tensor:
    """A signal through filters that change over the first 2 ms of each hop, ``DELAY`` samples late.

    Args:
        padded: whole hops, and ``HISTORY`` samples before them.
        taps: of ``filter_taps``, before each hop and in it.

    Shape: (items, HISTORY + hops * HOP), (items, hops + 1, TAPS) -> (items, hops * HOP).
    """
    late = padded[:, HISTORY - DELAY - TAPS + 1 : padded.shape[-1] - DELAY]
    # what a hop is made of ends before it begins, so that the transform's rounding knows nothing of what comes
    hops = torch.fft.rfft(late.unfold(-1, HOP + TAPS - 1, HOP), LONG_FRAME)
    filters = torch.fft.rfft(taps, LONG_FRAME)
    before, after = (
        torch.fft.irfft(hops * some, LONG_FRAME)[..., TAPS - 1 : TAPS - 1 + HOP]
        for some in (filters[:, :-1], filters[:, 1:])
    )
    added = torch.lerp(before, after, constant_like(padded, _glide)).flatten(1)
    return late[:, TAPS - 1 :] + added


def _hilbert() -> NDArray[np.float64]:
    """Phase of minimum phase from the logarithm of gains, at the frequencies. Returns (n, n), n = LONG_FRAME / 2 + 1."""
    fold = np.zeros(LONG_FRAME)
    fold[1 : LONG_FRAME // 2] = 2.0
    fold[[0, LONG_FRAME // 2]] = 1.0
    cepstra = np.fft.irfft(np.eye(LONG_FRAME // 2 + 1), LONG_FRAME)
    return np.fft.rfft(fold * cepstra).imag


def _back() -> NDArray[np.float64]:
    """Taps of the real and the imaginary part of a spectrum. Returns (LONG_FRAME + 2, TAPS)."""
    unit = np.eye(LONG_FRAME // 2 + 1)
    return np.concatenate([np.fft.irfft(part, LONG_FRAME) for part in (unit, 1j * unit)])[:, :TAPS]


def _glide() -> NDArray[np.float64]:
    """Weight of a hop's own filter at each sample of it. Returns (HOP,)."""
    return np.minimum(np.arange(1.0, HOP + 1.0) / GLIDE, 1.0)
