"""Wide dynamic range compression in bands, as most hearing aids have it; nothing of it is trained."""

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
from compensators.stream import State, Stream
from compensators.wearable import Wearable
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import check_number
from hlsim.torchtools import constant_like


class WDRC(Wearable):
    """NAL-R's gains for speech of 65 dB SPL, less for what is louder and more for what is softer in its band.

    A band's level, of frames of 16 ms, rises with ``attack`` and falls with ``release``. Above the knee, ``ratio`` dB
    more make one dB more of output; ``ratio`` is 1 up to 10 dB HL, 1 more for every 40 dB, and 3 at most.

    Args:
        sample_rate, full_scale_spl, linked: as ``Wearable``.
        bands: an equal number of ERBs apart, but no less than 125 Hz; 4 to 40.
        attack, release: time constants in seconds; 0 to 1, and 0.01 to 2.
        knee: of the compression in dB below average speech of 65 dB SPL, in its band.
        limit_spl: peak of the output in dB SPL that no sample passes; no band is amplified beyond it.

    Raises:
        ValueError: a value out of range.
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
        self.bands, self.attack, self.release = bands, attack, release
        self.knee, self.limit_spl = knee, limit_spl

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """The amplified waveform, time-aligned.

        Shape: (..., time) and one audiogram or (..., 8) that broadcasts over the leading dimensions -> (..., time).

        Raises:
            ValueError: no audiogram, levels outside -10 to 100 dB HL, or shapes that do not fit.
        """
        return self.whole(waveform, audiogram, ())

    def stream(self, audiogram: AudiogramLike) -> Stream:
        """The same for chunks of any size. Raises ValueError at other rates than 16000 Hz."""
        return self.streamed(audiogram, ())

    def fit(self, thresholds: Tensor) -> Tensor:
        loss = losses(thresholds, self.bands)
        return torch.cat((prescribed_gains(thresholds, self.bands), compression_ratios(loss)), -1)

    def start(self, items: int, like: Tensor) -> dict[str, Tensor]:
        return {"levels": like.new_zeros(items, 3, self.bands)}

    def control(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        levels = level_db(powers @ constant_like(powers, shares, self.bands, FRAME))
        levels, kept = follow_peaks(
            levels, state["levels"], decay(self.attack), decay(self.release)
        )
        prescribed, ratios = fitted.chunk(2, -1)
        gains = compressive_gains(above_speech(levels), prescribed, ratios, -self.knee)
        return torch.minimum(gains, (self.limit_spl - levels).clamp_min(0.0)), {"levels": kept}

    def extra_repr(self) -> str:
        return f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}, bands={self.bands}"
