"""NAL-R, a linear prescription of gains for an audiogram."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hlsim.audiogram import HIGHEST_LEVEL
from hlsim.audiogram.thresholds import (
    AudiogramLike,
    as_thresholds,
    has_listeners,
    interpolate,
    resolve_thresholds,
    store_thresholds,
)
from hlsim.calibration import PASCAL_SPL, check_full_scale
from hlsim.checks import check_number, check_rate, check_waveform
from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.dsp.windows import hamming
from hlsim.torchtools import constant_like

BIAS_DB = {250.0: -17.0, 500.0: -8.0, 1000.0: 1.0, 2000.0: -1.0, 4000.0: -2.0, 6000.0: -2.0}
"""Constant of NAL-R's formula at each of its frequencies."""

THRESHOLD_OPTIONS: dict[str, Any] = {"highest": HIGHEST_LEVEL, "consumer": "NAL-R"}


class NALR(nn.Module):
    """The revised prescription of the National Acoustic Laboratories as a linear-phase filter.

    The gains are those of Byrne and Dillon 1986, Ear and Hearing 7(4), and for severe losses Byrne,
    Parkinson and Newall 1990, Ear and Hearing 11(1). The filter is that of pyclarity 0.9.0 without
    its delay of ``order / 2`` samples. The output is linear in the input and has no limit.

    Args:
        audiogram: Ear or ears; may be passed to each call instead. A tensor that requires a
            gradient has to be. The thresholds at 250, 500, 1000, 2000, 4000 and 6000 Hz
            count, interpolated over log frequency where they were not measured.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of RMS 1.0. A linear filter does not need it; all
            compensators accept it.
        order: Order of the filter, even, 2 to 1022.

    Raises:
        ValueError: A value out of range.

    >>> import hlsim
    >>> from hlsim.calibration import level_spl
    >>> output = NALR("N3")(hlsim.example_speech())
    >>> level_spl(output).round()
    tensor(78.)
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
        check_number("order", order, 2, 1022, whole=True)
        if order % 2:
            raise ValueError(f"expected an even order of the NAL-R filter, got {order}")
        self.order = order
        thresholds = store_thresholds(audiogram, **THRESHOLD_OPTIONS)
        if thresholds is not None and thresholds.requires_grad:
            raise ValueError(
                "expected an audiogram without gradient; pass one that is trained to each call"
            )
        self.register_buffer("thresholds", thresholds, persistent=False)
        self._two_ears = has_listeners(audiogram)

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """Return the amplified waveform, time-aligned.

        Args:
            waveform: Input of the aid.
            audiogram: One audiogram, or (..., 8) that broadcasts over the leading dimensions.

        Shape: (..., time) -> (..., time).

        Raises:
            ValueError: No audiogram, levels outside -10 to 120 dB HL, or shapes that do not fit.
        """
        check_waveform(waveform, full_scale_spl=self.full_scale_spl)
        thresholds = resolve_thresholds(
            self.thresholds, audiogram, waveform, two_ears=self._two_ears, **THRESHOLD_OPTIONS
        )
        with torch.autocast(waveform.device.type, enabled=False):
            signal = waveform.to(torch.promote_types(waveform.dtype, torch.float32))
            time = signal.shape[-1]
            points = scipy.fft.next_fast_len(time + self.order, real=True)
            taps = self.taps(thresholds).to(signal.dtype)
            spectrum = torch.fft.rfft(signal, points) * torch.fft.rfft(taps, points)
            delay = self.order // 2
            output = torch.fft.irfft(spectrum, points)[..., delay : delay + time]
            return output.to(waveform.dtype)

    def gains(self, audiogram: AudiogramLike | None = None, level: float = 65.0) -> Tensor:
        """Compute the insertion gains of the prescription, which are the same at every level.

        Args:
            audiogram: One or more ears, by default those that were passed to the constructor.
            level: Presentation level in dB SPL, which all aids accept.

        Returns:
            Gains in dB at the eight ``FREQUENCIES``, (8,) for one ear, else (..., 8).

        Raises:
            ValueError: No audiogram, or levels outside -10 to 120 dB HL.

        >>> NALR().gains("N3").round()
        tensor([ 0.,  9., 20., 21., 22., 23., 24., 24.])
        """
        thresholds = self.thresholds
        if audiogram is not None:
            thresholds = as_thresholds(audiogram, **THRESHOLD_OPTIONS)
        if thresholds is None:
            raise ValueError("no audiogram; pass one to gains, or to NALR when building it")
        return nalr_gains_db(thresholds)

    def taps(self, thresholds: Tensor) -> Tensor:
        """Return the taps of the filter, symmetric around the middle one.

        Shape: (..., 8) dB HL -> (..., order + 1).
        """
        gains = nalr_gains_db(thresholds.double())
        gains = interpolate(gains, _even_frequencies(self.sample_rate, self.order + 1))
        taps = (10.0 ** (gains / 20.0)) @ constant_like(gains, _design, self.order)
        impulse = torch.zeros_like(taps)
        impulse[..., self.order // 2] = 1.0
        return torch.where(_has_loss(thresholds), taps, impulse)

    def extra_repr(self) -> str:
        return (
            f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}, "
            f"order={self.order}"
        )


def nalr_gains_db(thresholds: Tensor) -> Tensor:
    """Return the insertion gain that NAL-R prescribes at the audiometric frequencies.

    The formula is for 250, 500, 1000, 2000, 4000 and 6000 Hz. As in pyclarity, the gain is a
    straight line from 2 to 4 kHz and constant above 6 kHz, so that the thresholds at 3 and 8 kHz do
    not count. An ear without any loss has no gain.

    Shape: (..., 8) dB HL -> (..., 8), 0 dB or more.

    >>> nalr_gains_db(torch.tensor([20.0, 20.0, 25.0, 35.0, 40.0, 45.0, 50.0, 50.0])).round()
    tensor([ 0.,  2., 13., 14., 15., 16., 18., 18.])
    """
    losses = _formula_levels(thresholds)
    three_frequency_sum = losses[..., 1:4].sum(-1, keepdim=True)  # 500, 1000 and 2000 Hz
    common = torch.where(
        three_frequency_sum <= 180.0,
        0.05 * three_frequency_sum,
        9.0 + 0.116 * (three_frequency_sum - 180.0),
    )
    bias = constant_like(losses, tuple, tuple(BIAS_DB.values()))
    gains = (common + 0.31 * losses + bias).clamp_min(0.0)
    low, high = gains[..., :4], gains[..., 4:]
    at_3_khz = 0.5 * (low[..., -1:] + high[..., :1])
    all_gains = torch.cat((low, at_3_khz, high, high[..., -1:]), -1)
    return torch.where(_has_loss(thresholds), all_gains, 0.0)


def _has_loss(thresholds: Tensor) -> Tensor:
    """Return whether each ear has a loss. NaN counts as one, so that it reaches the output."""
    return ~(_formula_levels(thresholds) <= 0.0).all(-1, keepdim=True)


def _formula_levels(thresholds: Tensor) -> Tensor:
    """Select the thresholds at the frequencies of the formula. Shape: (..., 8) -> (..., 6).

    These are all but 3000 and 8000 Hz.
    """
    return torch.cat((thresholds[..., :4], thresholds[..., 5:7]), -1)


@lru_cache(maxsize=8)
def _even_frequencies(sample_rate: int, count: int) -> tuple[float, ...]:
    highest = sample_rate / 2.0
    return tuple(torch.linspace(0.0, highest, count, dtype=torch.float64, device="cpu").tolist())


def _design(order: int) -> NDArray[np.float64]:
    """Return the taps for a gain of 1 at each of ``order + 1`` evenly spaced frequencies.

    The filter is linear in its gains.

    Returns: (order + 1, order + 1), one row per frequency.
    """
    grid = np.arange(order + 1) / order
    window = hamming(order + 1)
    rows = [frequency_sampling_fir(order + 1, grid, gain, window) for gain in np.eye(order + 1)]
    return np.stack(rows)
