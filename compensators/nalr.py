"""NAL-R, the closed-form prescription that a trained compensator has to beat."""

from functools import lru_cache
from numbers import Integral
from typing import Any

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES, HIGHEST_LEVEL
from hlsim.audiogram.thresholds import (
    AudiogramLike,
    has_listeners,
    interpolate,
    resolve_thresholds,
    store_thresholds,
)
from hlsim.calibration import PASCAL_SPL, check_full_scale
from hlsim.checks import check_rate, check_waveform
from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.dsp.windows import hamming
from hlsim.torchtools import constant, constant_like

_BIAS = {250.0: -17.0, 500.0: -8.0, 1000.0: 1.0, 2000.0: -1.0, 4000.0: -2.0, 6000.0: -2.0}
_LIMITS: dict[str, Any] = {"highest": HIGHEST_LEVEL, "consumer": "NAL-R"}
_PRESCRIBED = tuple(FREQUENCIES.index(hz) for hz in _BIAS)


class NALR(nn.Module):
    """The revised prescription of the National Acoustic Laboratories as a linear-phase filter, time-aligned.

    Gains of Byrne and Dillon 1986, Ear and Hearing 7(4), and for severe losses Byrne, Parkinson and Newall 1990, Ear and
    Hearing 11(1); the filter is that of pyclarity 0.9.0 with its delay of ``order / 2`` samples taken off. The output is
    linear in the input and has no limit.

    Args:
        audiogram: the ear or ears; may be given with each call instead.
        sample_rate: of inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of RMS 1.0. A linear filter needs none; every compensator takes it.
        order: of the filter, even, 2 to 1022.

    Raises:
        ValueError: a value out of range.
    """

    thresholds: Tensor | None
    _two_ears: bool

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        order: int = 220,
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        if not isinstance(order, Integral) or order % 2 or not 2 <= order <= 1022:
            raise ValueError(
                f"order of the NAL-R filter is {order!r}; allowed: even whole numbers from 2 to 1022"
            )
        self.order: int = int(order)
        levels = store_thresholds(audiogram, **_LIMITS)
        if levels is not None and levels.requires_grad:
            raise ValueError(
                "the audiogram is trained, and a prescription's own stays; allowed: with each call"
            )
        self.register_buffer("thresholds", levels, persistent=False)
        self._two_ears = has_listeners(audiogram)

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """The amplified waveform.

        Shape: (..., time) and one audiogram or (..., 8) that broadcasts over the leading dimensions -> (..., time).

        Raises:
            ValueError: no audiogram, levels outside -10 to 120 dB HL, or shapes that do not fit.
        """
        check_waveform(waveform)
        thresholds = resolve_thresholds(
            self.thresholds, audiogram, waveform, two_ears=self._two_ears, **_LIMITS
        )
        with torch.autocast(waveform.device.type, enabled=False):
            signal = waveform.to(torch.promote_types(waveform.dtype, torch.float32))
            time = signal.shape[-1]
            points = scipy.fft.next_fast_len(time + self.order, real=True)
            taps = self.taps(thresholds).to(signal.dtype)
            spectrum = torch.fft.rfft(signal, points) * torch.fft.rfft(taps, points)
            delay = self.order // 2
            return torch.fft.irfft(spectrum, points)[..., delay : delay + time].to(waveform.dtype)

    def taps(self, thresholds: Tensor) -> Tensor:
        """Coefficients of the filter, symmetric about the middle one. Shape: (..., 8) dB HL -> (..., order + 1)."""
        gains = nalr_gains_db(thresholds.double())
        gains = interpolate(gains, _steps_hz(self.sample_rate, self.order + 1))
        taps = (10.0 ** (gains / 20.0)) @ constant_like(gains, _design, self.order)
        flat = torch.zeros_like(taps)
        flat[..., self.order // 2] = 1.0
        return torch.where(_impaired(thresholds), taps, flat)

    def extra_repr(self) -> str:
        return f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}, order={self.order}"


def nalr_gains_db(thresholds: Tensor) -> Tensor:
    """Insertion gain that NAL-R prescribes at the audiometric frequencies, 0 dB or more.

    The formula is for 250, 500, 1000, 2000, 4000 and 6000 Hz. Between 2 and 4 kHz pyclarity joins the gains by a line
    and has them flat above 6 kHz, so that the thresholds at 3 and 8 kHz do not count. An ear without any loss gets none.

    Shape: (..., 8) dB HL -> (..., 8) dB.
    """
    losses = _prescribed(thresholds)
    three = losses[..., 1:4].sum(-1, keepdim=True)  # at 500, 1000 and 2000 Hz
    common = torch.where(three <= 180.0, 0.05 * three, 9.0 + 0.116 * (three - 180.0))
    bias = constant_like(losses, tuple, tuple(_BIAS.values()))
    gains = (common + 0.31 * losses + bias).clamp_min(0.0)
    low, high = gains[..., :4], gains[..., 4:]
    between = 0.5 * (low[..., -1:] + high[..., :1])
    return torch.where(
        _impaired(thresholds), torch.cat((low, between, high, high[..., -1:]), -1), 0.0
    )


def _impaired(thresholds: Tensor) -> Tensor:
    # NaN, an ear out of range, is to reach the output
    return ~(_prescribed(thresholds) <= 0.0).all(-1, keepdim=True)


def _prescribed(thresholds: Tensor) -> Tensor:
    """At the formula's frequencies. Shape: (..., 8) -> (..., 6)."""
    places = constant(tuple, _PRESCRIBED, dtype=torch.int64, device=thresholds.device)
    return thresholds.index_select(-1, places)


@lru_cache(maxsize=8)
def _steps_hz(sample_rate: int, count: int) -> tuple[float, ...]:
    return tuple(
        torch.linspace(0.0, sample_rate / 2.0, count, dtype=torch.float64, device="cpu").tolist()
    )


def _design(order: int) -> NDArray[np.float64]:
    """The filter is linear in its gains: one row a gain on ``order + 1`` even steps. Returns (order + 1, order + 1)."""
    grid, window = np.arange(order + 1) / order, hamming(order + 1)
    return np.stack(
        [frequency_sampling_fir(order + 1, grid, gain, window) for gain in np.eye(order + 1)]
    )
