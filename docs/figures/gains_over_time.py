"""Gains of `compensator-general` over time, applied by the filter bank of `hearing-aid`.

A recogniser understands more of the output of `compensator-general` in noise than of that of
`hearing-aid` (docs/measured.md), and the former looks 102 ms ahead. These plug-ins show which part
of its gains matters. They measure the gain of each band from its input and output, change it, and
apply it. Each is an aid for `machine_listener.py`:

    python examples/machine_listener.py compare speech/valid noise/valid --model TINY \\
        --audiograms audiograms/valid.csv --step 2 --snrs 5 --baseline compensator-general \\
        --aids hearing-aid@1 compensator-general docs/figures/gains_over_time.py:PromptGains \\
        docs/figures/gains_over_time.py:LateGains docs/figures/gains_over_time.py:SteadyGains \\
        --out listened
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from compensators import load_compensator
from compensators.filter_bank import DELAY, HOP, RATE, apply_gains, filter_centres
from compensators.limiter import soft_limit
from hlsim import Audiogram
from hlsim.dsp.fft import power
from hlsim.dsp.stft import STFT

BANDS = 20
WINDOW = 400
"""Samples of the frames of 25 ms in which gains are measured, and of those of the network."""

FRAME_HOP = 50
POWER_FLOOR = 1e-12
"""Power that is added to those of bands, so that silence has a gain of 0 dB."""

LIMIT_SPL = 110.0
"""Level of the largest sample in dB relative to 20 micropascals, as for both aids."""


class PromptGains(nn.Module):
    """An aid that applies the band gains of `compensator-general` at their time.

    Attributes:
        lateness: Time in samples at 16 kHz by which the gains are late.
        is_steady: Whether each band has its mean gain in dB all the time.
    """

    lateness = 0
    is_steady = False

    def __init__(self) -> None:
        super().__init__()
        self.teacher = load_compensator("compensator-general")
        self.stft = STFT(WINDOW, WINDOW, FRAME_HOP)
        # Between two centres, a frequency counts for both bands, as in the filter bank.
        frequencies = np.arange(WINDOW // 2 + 1) * RATE / WINDOW
        rows = [np.interp(frequencies, filter_centres(BANDS), row) for row in np.eye(BANDS)]
        self.shares = torch.from_numpy(np.stack(rows, 1)).float()

    @torch.no_grad()
    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Process a waveform in pascals at 16 kHz for an ear. Shape: (time,) -> (time,)."""
        time = len(waveform)
        output = self.teacher(waveform, audiogram)
        gains = self.band_levels(output) - self.band_levels(waveform)
        if self.is_steady:
            gains = gains.mean(0).expand_as(gains)
        hops = -(-(time + DELAY) // HOP)
        # The filters delay the signal. At the end of a hop, it gets the gains of DELAY earlier.
        ends = torch.arange(hops + 1) * HOP - DELAY - self.lateness
        gains = interpolate(gains, ends / FRAME_HOP)
        padded = functional.pad(waveform, (2 * DELAY, hops * HOP - time))
        amplified = apply_gains(padded[None], (10.0 ** (gains / 20.0) - 1.0)[None])[0]
        return soft_limit(amplified[DELAY : DELAY + time], LIMIT_SPL)

    def band_levels(self, waveform: Tensor) -> Tensor:
        """Return the level of each band in each frame in dB. Shape: (time,) -> (frames, 20)."""
        powers = power(self.stft.analyse(waveform[None]))[0]
        return 10.0 * torch.log10(powers @ self.shares + POWER_FLOOR)


class LateGains(PromptGains):
    """`PromptGains` with gains that are 4 ms late."""

    lateness = 64


class LaterGains(PromptGains):
    """`PromptGains` with gains that are 8 ms late."""

    lateness = 128


class SteadyGains(PromptGains):
    """`PromptGains` with gains that do not change over time."""

    is_steady = True


def interpolate(rows: Tensor, positions: Tensor) -> Tensor:
    """Interpolate between rows, and extend the first and the last one.

    Shape: (rows, n), (m,) -> (m, n).

    >>> interpolate(torch.tensor([[0.0], [2.0]]), torch.tensor([-1.0, 0.25, 5.0])).flatten()
    tensor([0.0000, 0.5000, 2.0000])
    """
    inside = positions.clamp(0, len(rows) - 1)
    below = inside.long().clamp(max=len(rows) - 2)
    return torch.lerp(rows[below], rows[below + 1], (inside - below).unsqueeze(-1))
