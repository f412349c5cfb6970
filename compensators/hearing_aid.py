"""A hearing aid that could be worn: learned gains and noise reduction on a direct path of 4 ms."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from compensators.config import HearingAidConfig
from compensators.filter_bank import FRAME, HISTORY, frame_power, level_db, shares
from compensators.prescription import losses, prescribed_gains, restoring_gains
from compensators.smoothing import decay, follow_peaks
from compensators.stream import Slider, State, Stream
from compensators.wearable import Wearable
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.torchtools import constant_like

_FADE = 15.0  # dB of level over which the gain of what is quiet fades
_RARELY = -3.0  # start of the logit of noise reduction: 1 dB of 20


class HearingAid(Wearable):
    """Waveform and audiogram to what the impaired ear is to be given, 4 ms late, whole or in chunks as it comes.

    Two networks that know nothing of one another set its gains. One, without memory, sees the ear and each band's level,
    of late and now, and corrects the gain that would restore loudness band by band
    (``prescription.restoring_gains``); the correction is 0 before training, and where there is no loss. The other, causal
    and recurrent, sees the levels of frames, not the ear, and takes noise off. In dB, a band's gain is

        amplification * (restoring + correction) - noise_reduction * attenuation,

    so that at 0 and 0 the input passes unchanged. The gain has a cap, and fades for what is quieter than
    ``config.quiet_spl``; the output is softly limited at ``config.limit_spl``.

    Args:
        config: sizes and choices.
        sample_rate, full_scale_spl, linked: as ``Wearable``.

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
        linked: bool = False,
    ) -> None:
        super().__init__(sample_rate, full_scale_spl, linked)
        self.config = config = HearingAidConfig.from_optional(config)
        self.bands, self.limit_spl = config.bands, config.limit_spl
        width, inner, corrections = (
            config.width,
            config.inner,
            nn.Linear(config.inner, config.bands),
        )
        self.correct = nn.Sequential(
            *(nn.Linear(4 * config.bands + 1, inner), nn.SiLU()),
            *(nn.Linear(inner, inner), nn.SiLU()),
            *(nn.Linear(inner, inner), nn.SiLU()),
            corrections,
        )
        self.enter = nn.Linear(config.bands + config.bins, width)
        self.recur = nn.LSTM(width, config.hidden, batch_first=True)
        self.leave = nn.Linear(config.hidden + width, config.bands)
        with torch.no_grad():
            corrections.weight.zero_()
            corrections.bias.zero_()
            self.leave.bias.fill_(_RARELY)

    def train(self, mode: bool = True) -> Self:
        """Set the mode of all modules but the LSTM, which stays in training mode.

        cuDNN computes no gradient through an LSTM in evaluation mode. The two modes differ in nothing
        else, because the LSTM has no dropout.
        """
        super().train(mode)
        self.recur.train()
        return self

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
        return torch.cat(
            (losses(thresholds, self.bands), prescribed_gains(thresholds, self.bands)), -1
        )

    def start(self, items: int, like: Tensor) -> dict[str, Tensor]:
        zeros, bands = like.new_zeros, self.bands
        return {
            "levels": zeros(items, 3, bands + 1),
            "attenuation": zeros(items, 3, bands),
            "hidden": zeros(items, 2, self.config.hidden),
        }

    def control(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        noise_reduction, amplification = sliders.split(1, -1)
        levels = self._levels(powers)
        gain, followed = self._amplification(levels[..., : self.bands + 1], fitted, state)
        taken, recalled = self._reduction(levels, state)
        return amplification * gain + noise_reduction * taken, followed | recalled

    def attenuation(self, samples: Tensor) -> Tensor:
        """What noise reduction adds to each band's gain at the end of each frame, in dB, 0 or less; it knows no ear.

        Shape: (items, hops * HOP) pascals -> (items, hops, bands).
        """
        levels = self._levels(frame_power(functional.pad(samples, (HISTORY, 0))))
        return self._reduction(levels, self.start(len(samples), samples))[0]

    def _levels(self, powers: Tensor) -> Tensor:
        """Levels of the bands, of all, and of single frequencies. Shape: as ``control`` -> (..., bands + 1 + bins)."""
        by_band = powers @ constant_like(powers, shares, self.bands, FRAME)
        bins = powers[..., 1 : self.config.bins + 1]
        return level_db(torch.cat((by_band, powers.sum(-1, keepdim=True), bins), -1))

    def _amplification(
        self, levels: Tensor, fitted: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Shape: (items, frames, bands + 1), of bands and of all, (items, n) -> (items, frames, bands) dB."""
        config, now = self.config, levels[..., : self.bands]
        levels, kept = follow_peaks(
            levels, state["levels"], decay(config.attack), decay(config.release)
        )
        level, total = levels.split((self.bands, 1), -1)
        loss, prescribed = fitted.chunk(2, -1)
        ear = (
            torch.cat((loss / 50.0, prescribed / 20.0), -1)
            .unsqueeze(1)
            .expand(-1, level.shape[1], -1)
        )
        reach = config.reach_db * loss.clamp_min(0.0) / (loss.clamp_min(0.0) + 10.0)
        seen = torch.cat((ear, (levels - 40.0) / 20.0, (now - level) / 10.0), -1)
        correction = reach.unsqueeze(1) * torch.tanh(self.correct(seen))
        gain = (restoring_gains(level, loss) + correction).clamp(0.0, config.cap_db)
        audible = ((total - config.quiet_spl) / _FADE + 1.0).clamp(0.0, 1.0)
        return audible * gain, {"levels": kept}

    def _reduction(self, levels: Tensor, state: State) -> tuple[Tensor, dict[str, Tensor]]:
        """Shape: (items, frames, bands + 1 + bins) -> (items, frames, bands) dB, 0 or less."""
        config = self.config
        seen = torch.cat((levels[..., : self.bands], levels[..., self.bands + 1 :]), -1)
        entered = torch.tanh(self.enter((seen - 40.0) / 20.0))
        hidden, cell = state["hidden"].unbind(1)
        if entered.shape[1] == 1:  # a stream's: the LSTM would repack its weights for one frame
            hidden, cell = _lstm_step(self.recur, entered[:, 0], hidden, cell)
            recalled = hidden.unsqueeze(1)
        else:
            before = (hidden.unsqueeze(0).contiguous(), cell.unsqueeze(0).contiguous())
            recalled, (hidden, cell) = self.recur(entered, before)
            hidden, cell = hidden.squeeze(0), cell.squeeze(0)
        taken = -config.reduction_db * torch.sigmoid(self.leave(torch.cat((recalled, entered), -1)))
        taken, kept = follow_peaks(
            taken, state["attenuation"], decay(config.opening), decay(config.closing)
        )
        return taken, {"attenuation": kept, "hidden": torch.stack((hidden, cell), 1)}

    def extra_repr(self) -> str:
        return f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}"


def _lstm_step(lstm: nn.LSTM, frame: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    """Run a one-layer LSTM for one frame, four times as fast as the module itself and with the same bits on a CPU.

    Shape: (items, inputs), (items, units) twice -> hidden and cell state, (items, units) each.
    """
    input_weight, hidden_weight, input_bias, hidden_bias = lstm.all_weights[0]
    recurrent = functional.linear(hidden, hidden_weight, hidden_bias)
    gates = recurrent + functional.linear(frame, input_weight, input_bias)
    enter, forget, candidate, leave = gates.chunk(4, -1)
    cell = forget.sigmoid() * cell + enter.sigmoid() * candidate.tanh()
    return leave.sigmoid() * cell.tanh(), cell
