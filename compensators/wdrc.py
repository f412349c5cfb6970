"""Wide dynamic range compression around NAL-R, without trained parameters."""

from __future__ import annotations

import torch
from torch import Tensor

from compensators.filter_bank import FRAME, level_db, shares
from compensators.prescription import (
    above_speech,
    compression_ratios,
    compressive_gains,
    losses,
    prescribed_gains,
)
from compensators.smoothing import decay, follow_peaks
from compensators.stream import Stream
from compensators.wearable import State, Wearable
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import check_number
from hlsim.torchtools import constant_like


class WDRC(Wearable):
    """Amplify average speech by NAL-R's gains, louder bands less and softer bands more.

    The level of a band, in frames of 16 ms, rises with ``attack`` and falls with ``release``. Above
    the knee, the input level rises by ``ratio`` dB for each dB of the output level; the ratio is 1
    up to 10 dB HL, rises by 1 per 40 dB, and is 3 at most.

    Args:
        sample_rate: Sample rate in Hz, as in ``Wearable``.
        full_scale_spl: Level in dB SPL of RMS 1.0.
        bands: Number of bands, an equal number of ERBs but at least 125 Hz apart, 4 to 40.
        attack: Time constant in seconds, 0 to 1.
        release: Time constant in seconds, 0.01 to 2.
        knee: Knee of the compression in dB below the level of average speech at 65 dB SPL in the
            band.
        limit_spl: Peak of the output in dB SPL that no sample exceeds, and beyond which no band is
            amplified.
        linked: Link the gains of two ears, as in ``Wearable``.

    Raises:
        ValueError: A value out of range.

    >>> import hlsim
    >>> WDRC()(hlsim.example_speech(), "N3").shape
    torch.Size([64320])
    """

    def __init__(
        self,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        bands: int = 20,
        attack: float = 0.005,
        release: float = 0.1,
        knee: float = 20.0,
        limit_spl: float = 110.0,
        linked: bool = False,
    ) -> None:
        super().__init__(sample_rate, full_scale_spl, linked)
        check_number("bands", bands, 4, 40, whole=True)
        check_number("attack", attack, 0.0, 1.0)
        check_number("release", release, 0.01, 2.0)
        check_number("knee", knee, 0.0, 60.0)
        check_number("limit_spl", limit_spl, 60.0, 140.0)
        self.bands = bands
        self.attack = attack
        self.release = release
        self.knee = knee
        self.limit_spl = limit_spl

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """Return the output for a whole signal, time-aligned.

        Args:
            waveform: Input of the aid.
            audiogram: One audiogram, or (..., 8) that broadcasts over the leading dimensions.

        Shape: (..., time) -> (..., time).

        Raises:
            ValueError: No audiogram, levels outside -10 to 100 dB HL, or shapes that do not fit.
        """
        return self.process(waveform, audiogram, ())

    def stream(self, audiogram: AudiogramLike) -> Stream:
        """Return a stream, which gives the same output for chunks of any size.

        Raises:
            ValueError: The sample rate is not 16000 Hz.
        """
        return Stream(self, audiogram)

    def fit(self, thresholds: Tensor) -> Tensor:
        loss = losses(thresholds, self.bands)
        return torch.cat((prescribed_gains(thresholds, self.bands), compression_ratios(loss)), -1)

    def start(self, items: int, like: Tensor) -> dict[str, Tensor]:
        return {"levels": like.new_zeros(items, 3, self.bands)}

    def control(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        levels = level_db(powers @ constant_like(powers, shares, self.bands, FRAME))
        attack, release = decay(self.attack), decay(self.release)
        levels, level_state = follow_peaks(levels, state["levels"], attack, release)
        prescribed, ratios = fitted.chunk(2, -1)
        gains = compressive_gains(above_speech(levels), prescribed, ratios, -self.knee)
        highest = (self.limit_spl - levels).clamp_min(0.0)
        return torch.minimum(gains, highest), {"levels": level_state}
