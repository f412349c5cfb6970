"""Wide dynamic range compression around NAL-R, without trained parameters."""

import torch
from torch import Tensor

from compensators.filter_bank import filter_powers, level_db, speech_band_levels
from compensators.smoothing import follow_peaks
from compensators.wearable import State, Wearable
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import check_number

KNEE_DB = 20.0
"""Level of a band in dB below that of average speech, below which softer sounds get no more gain.
"""


class WDRC(Wearable):
    """A hearing aid that amplifies loud sounds less than soft ones, without trained parameters.

    Each band of average speech at 65 dB SPL gets the gain that NAL-R prescribes. The gain is
    smaller if the band is louder, and larger if it is softer, by up to 20 dB: the output changes by
    1 dB if the input changes by as many dB as the compression ratio. The ratio is 1 up to a loss of
    10 dB HL, rises by 1 per 40 dB of loss, and is 3 at most. Gains are 0 dB or more. The delay is 4
    ms.

    Args:
        audiogram: One or more ears, which are used by all calls that pass none.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. Streams need 16000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0.
        attack: Time constant in seconds with which the measured level of a band rises, 0 to 1.
        release: Time constant in seconds with which this level falls, 0.01 to 2.
        limit_spl: Peak of the output in dB SPL, 60 to 140, that no sample exceeds. A band is not
            amplified beyond this level.
        linked: Give two ears, (..., 2, time), gains from their mean power, so that the differences
            in level between them stay if their audiograms are equal.

    Raises:
        ValueError: A value is out of range.

    >>> import hlsim
    >>> WDRC("N3")(hlsim.example_speech()).shape
    torch.Size([64320])
    """

    bands = 20

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        attack: float = 0.005,
        release: float = 0.1,
        limit_spl: float = 110.0,
        linked: bool = False,
    ) -> None:
        super().__init__(audiogram, sample_rate, full_scale_spl, linked)
        check_number("attack", attack, 0.0, 1.0)
        check_number("release", release, 0.01, 2.0)
        check_number("limit_spl", limit_spl, 60.0, 140.0)
        self.attack = attack
        self.release = release
        self.limit_spl = limit_spl
        self.state_shapes = {"levels": (3, self.bands)}

    def compute_gains(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        levels, memory = follow_peaks(
            level_db(filter_powers(powers, self.bands)), state["levels"], self.attack, self.release
        )
        above_speech = levels - speech_band_levels(self.bands, like=levels)
        loss, prescribed = fitted.chunk(2, -1)
        ratios = 1.0 + ((loss - 10.0) / 40.0).clamp(0.0, 2.0)
        slope = (1.0 / ratios - 1.0).unsqueeze(1)
        gains = prescribed.unsqueeze(1) + slope * above_speech.clamp_min(-KNEE_DB)
        highest_gains = (self.limit_spl - levels).clamp_min(0.0)
        return torch.minimum(gains.clamp_min(0.0), highest_gains), {"levels": memory}
