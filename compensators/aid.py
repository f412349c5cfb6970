"""A hearing aid that could be worn: learned gains and noise reduction on a direct path of 4 ms."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from compensators.bands import FRAME, level_db, shares
from compensators.config import HearingAidConfig
from compensators.prescription import losses, prescribed_gains, restoring_gains
from compensators.smoothing import average, decay, follow_peaks
from compensators.stream import Slider, State, Stream
from compensators.wearable import Wearable
from hlsim.audiogram import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.torchtools import constant_like

_FADE = 15.0  # dB of level over which the gain of what is quiet fades
_RARELY = -3.0  # start of the logit of noise reduction: 1 dB of 20


class HearingAid(Wearable):
    """Waveform and audiogram to what the impaired ear is to be given, 4 ms late, whole or in chunks as it comes.

    Levels of frames and the encoded ear go through a causal recurrent network with two heads. One corrects the gain that
    would restore loudness band by band (``prescription.restoring_gains``); the correction is 0 before training, and where
    there is no loss. The other takes noise off. In dB, a band's gain is

        amplification * (restoring + correction) - noise_reduction * attenuation,

    so that at 0 and 0 the input passes unchanged. The gain has a cap, and fades for what is quieter than
    ``config.quiet_spl``; the output is softly limited at ``config.limit_spl``.

    Args:
        config: sizes and choices.
        sample_rate, full_scale_spl: as ``Wearable``.

    Raises:
        ValueError: a rate or level out of range, or a configuration of another kind.
    """

    SLIDERS = ("noise_reduction", "amplification")

    def __init__(
        self,
        config: HearingAidConfig | None = None,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
    ) -> None:
        super().__init__(sample_rate, full_scale_spl)
        self.config = config = HearingAidConfig.given(config)
        self.bands, self.limit_spl = config.bands, config.limit_spl
        self.encode_ear = nn.Linear(2 * config.bands, config.width)
        self.enter = nn.Linear(config.bands + config.bins, config.width)
        self.recur = nn.LSTM(config.width, config.hidden, batch_first=True)
        self.leave = nn.Linear(config.hidden + config.width, 2 * config.bands)
        with torch.no_grad():
            self.leave.weight[: config.bands] = 0.0
            self.leave.bias.copy_(torch.tensor([0.0, _RARELY]).repeat_interleave(config.bands))

    def forward(
        self,
        waveform: Tensor,
        audiogram: AudiogramLike | None = None,
        noise_reduction: Slider = 1.0,
        amplification: Slider = 1.0,
    ) -> Tensor:
        """What the ear is to be given, time-aligned.

        Shape: (..., time) and one audiogram or (..., 8) that broadcasts over the leading dimensions -> (..., time).

        Args:
            noise_reduction, amplification: 0 to 1, a number or one an item.

        Raises:
            ValueError: no audiogram, levels outside -10 to 100 dB HL, sliders outside 0 to 1, or shapes that do not fit.
        """
        return self.whole(waveform, audiogram, (noise_reduction, amplification))

    def stream(
        self, audiogram: AudiogramLike, noise_reduction: Slider = 1.0, amplification: Slider = 1.0
    ) -> Stream:
        """The same for chunks of any size. Raises ValueError at other rates than 16000 Hz."""
        return self.streamed(audiogram, (noise_reduction, amplification))

    def fit(self, thresholds: Tensor) -> Tensor:
        loss, prescribed = losses(thresholds, self.bands), prescribed_gains(thresholds, self.bands)
        reach = self.config.reach_db * loss.clamp_min(0.0) / (loss.clamp_min(0.0) + 10.0)
        code = self.encode_ear(torch.cat((loss / 50.0, prescribed / 20.0), -1))
        return torch.cat((loss, reach, code), -1)

    def start(self, items: int, like: Tensor) -> dict[str, Tensor]:
        zeros, bands = like.new_zeros, self.bands
        return {
            "levels": zeros(items, 3, bands + 1),
            "correction": zeros(items, bands),
            "attenuation": zeros(items, 3, bands),
            "hidden": zeros(items, 2, self.config.hidden),
        }

    def control(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        config = self.config
        loss, reach, code = fitted.split((self.bands, self.bands, config.width), -1)
        noise_reduction, amplification = sliders.split(1, -1)
        by_band = powers @ constant_like(powers, shares, self.bands, FRAME)
        levels = level_db(
            torch.cat((by_band, powers.sum(-1, keepdim=True), powers[..., 1 : config.bins + 1]), -1)
        )
        seen = torch.cat((levels[..., : self.bands], levels[..., self.bands + 1 :]), -1)
        entered = torch.tanh(self.enter((seen - 40.0) / 20.0) + code.unsqueeze(1))
        recalled, hidden = self.recur(
            entered, state["hidden"].movedim(1, 0).contiguous().unsqueeze(1).unbind()
        )
        correction, logit = self.leave(torch.cat((recalled, entered), -1)).chunk(2, -1)

        slow = decay(config.attack), decay(config.release)
        followed, kept = follow_peaks(levels[..., : self.bands + 1], state["levels"], *slow)
        level, total = followed.split((self.bands, 1), -1)
        correction = average(
            reach.unsqueeze(1) * torch.tanh(correction), state["correction"], decay(config.smoothing)
        )
        gain = restoring_gains(level, loss) + correction
        audible = ((total - config.quiet_spl) / _FADE + 1.0).clamp(0.0, 1.0)
        gain = audible * gain.clamp(0.0, config.cap_db)

        quick = decay(config.opening), decay(config.closing)
        taken, quickly = follow_peaks(
            -config.reduction_db * torch.sigmoid(logit), state["attenuation"], *quick
        )
        after = {
            "levels": kept,
            "correction": correction[:, -1],
            "attenuation": quickly,
            "hidden": torch.cat(hidden).movedim(0, 1),
        }
        return amplification * gain + noise_reduction * taken, after

    def extra_repr(self) -> str:
        return f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}"
