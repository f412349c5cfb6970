"""A hearing aid with trained gains and trained noise reduction, and a delay of 4 ms."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from compensators.config import HearingAidConfig
from compensators.filter_bank import FRAME, HISTORY, frame_power, level_db, shares
from compensators.prescription import losses, prescribed_gains, restoring_gains
from compensators.smoothing import decay, follow_peaks
from compensators.stream import Stream
from compensators.wearable import Slider, State, Wearable
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.torchtools import constant_like

DEFAULT_NOISE_REDUCTION = 0.5
"""Share of the attenuation by default.

HASPI is highest with all of it, but a speech recogniser behind the simulated ear finds most words
with half of it (docs/measured.md).
"""

QUIET_FADE_DB = 15.0
"""Range of levels in dB over which the gain of quiet sounds fades."""

INITIAL_REDUCTION_LOGIT = -3.0
"""Initial logit of noise reduction: 5 % of the largest attenuation."""


class HearingAid(Wearable):
    """A hearing aid with a delay of 4 ms, for whole signals or chunks.

    Two independent networks set its gains. The first has no memory. It sees the ear and the
    smoothed and present level of each band, and corrects the gain that would restore loudness band
    by band (``prescription.restoring_gains``); the correction is 0 before training, and where there
    is no loss. The second is causal and recurrent. It sees the levels of frames, not the ear, and
    reduces noise. In dB, the gain of a band is

        amplification * (restoring + correction) - noise_reduction * attenuation,

    so that at 0 and 0 the input passes unchanged. The gain has a maximum, and fades for sounds
    below ``config.quiet_spl``; the output is softly limited at ``config.limit_spl``.

    Args:
        config: Sizes and choices.
        sample_rate: Sample rate in Hz, as in ``Wearable``.
        full_scale_spl: Level in dB SPL of RMS 1.0.
        linked: Link the gains of two ears, as in ``Wearable``.

    Raises:
        ValueError: A rate or level out of range, or a configuration of another type.

    >>> import hlsim
    >>> aid = HearingAid().eval()
    >>> output = aid(hlsim.example_speech(), "N3", noise_reduction=0.0)
    >>> output.shape
    torch.Size([64320])
    """

    SLIDERS = ("noise_reduction", "amplification")
    DEFAULT_SLIDERS = (DEFAULT_NOISE_REDUCTION, 1.0)

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
        self.bands = config.bands
        self.limit_spl = config.limit_spl
        inner = config.inner
        corrections = nn.Linear(inner, config.bands)
        self.correct = nn.Sequential(
            nn.Linear(4 * config.bands + 1, inner),
            nn.SiLU(),
            nn.Linear(inner, inner),
            nn.SiLU(),
            nn.Linear(inner, inner),
            nn.SiLU(),
            corrections,
        )
        self.enter = nn.Linear(config.bands + config.bins, config.width)
        self.recur = nn.LSTM(config.width, config.hidden, batch_first=True)
        self.leave = nn.Linear(config.hidden + config.width, config.bands)
        with torch.no_grad():
            corrections.weight.zero_()
            corrections.bias.zero_()
            self.leave.bias.fill_(INITIAL_REDUCTION_LOGIT)

    def train(self, mode: bool = True) -> Self:
        """Set the mode of all modules except the LSTM, which stays in training mode.

        cuDNN computes no gradient through an LSTM in evaluation mode. The two modes differ in
        nothing else, because the LSTM has no dropout.
        """
        super().train(mode)
        self.recur.train()
        return self

    def forward(
        self,
        waveform: Tensor,
        audiogram: AudiogramLike | None = None,
        noise_reduction: Slider = DEFAULT_NOISE_REDUCTION,
        amplification: Slider = 1.0,
    ) -> Tensor:
        """Return the output for a whole signal, time-aligned.

        Args:
            waveform: Input of the aid.
            audiogram: One audiogram, or (..., 8) that broadcasts over the leading dimensions.
            noise_reduction: Share of the attenuation, 0 to 1, one number or one per item.
            amplification: Share of the amplification, 0 to 1, one number or one per item.

        Shape: (..., time) -> (..., time).

        Raises:
            ValueError: No audiogram, levels outside -10 to 100 dB HL, sliders outside 0 to 1, or
                shapes that do not fit.
        """
        return self.process(waveform, audiogram, (noise_reduction, amplification))

    def stream(
        self,
        audiogram: AudiogramLike,
        noise_reduction: Slider = DEFAULT_NOISE_REDUCTION,
        amplification: Slider = 1.0,
    ) -> Stream:
        """Return a stream, which gives the same output for chunks of any size.

        Raises:
            ValueError: The sample rate is not 16000 Hz, or an argument is not valid.
        """
        return Stream(self, audiogram, noise_reduction=noise_reduction, amplification=amplification)

    def fit(self, thresholds: Tensor) -> Tensor:
        loss = losses(thresholds, self.bands)
        return torch.cat((loss, prescribed_gains(thresholds, self.bands)), -1)

    def start(self, items: int, like: Tensor) -> dict[str, Tensor]:
        return {
            "levels": like.new_zeros(items, 3, self.bands + 1),
            "attenuation": like.new_zeros(items, 3, self.bands),
            "hidden": like.new_zeros(items, 2, self.config.hidden),
        }

    def control(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        noise_reduction, amplification = sliders.split(1, -1)
        levels = self._levels(powers)
        gain, level_state = self._amplification(levels[..., : self.bands + 1], fitted, state)
        attenuation, reduction_state = self._reduction(levels, state)
        total = amplification * gain + noise_reduction * attenuation
        return total, level_state | reduction_state

    def attenuation(self, samples: Tensor) -> Tensor:
        """Return the gain in dB, 0 or less, that noise reduction adds at the end of each frame.

        It does not depend on the ear.

        Shape: (items, hops * HOP) in pascals -> (items, hops, bands).
        """
        levels = self._levels(frame_power(functional.pad(samples, (HISTORY, 0))))
        return self._reduction(levels, self.start(len(samples), samples))[0]

    def _levels(self, powers: Tensor) -> Tensor:
        """Return the levels of the bands, of the whole frame, and of single frequencies in dB SPL.

        Shape: (items, frames, FRAME / 2 + 1) -> (items, frames, bands + 1 + bins).
        """
        by_band = powers @ constant_like(powers, shares, self.bands, FRAME)
        bins = powers[..., 1 : self.config.bins + 1]
        return level_db(torch.cat((by_band, powers.sum(-1, keepdim=True), bins), -1))

    def _amplification(
        self, levels: Tensor, fitted: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the restoring gain with its correction in dB, and the state of the levels.

        Shape: (items, frames, bands + 1) for the bands and the whole frame, (items, n)
            -> (items, frames, bands).
        """
        config = self.config
        present = levels[..., : self.bands]
        attack, release = decay(config.attack), decay(config.release)
        levels, level_state = follow_peaks(levels, state["levels"], attack, release)
        level, total = levels.split((self.bands, 1), -1)
        loss, prescribed = fitted.chunk(2, -1)
        ear = torch.cat((loss / 50.0, prescribed / 20.0), -1)
        ear = ear.unsqueeze(1).expand(-1, level.shape[1], -1)
        reach = config.reach_db * loss.clamp_min(0.0) / (loss.clamp_min(0.0) + 10.0)
        features = torch.cat((ear, (levels - 40.0) / 20.0, (present - level) / 10.0), -1)
        correction = reach.unsqueeze(1) * torch.tanh(self.correct(features))
        gain = (restoring_gains(level, loss) + correction).clamp(0.0, config.cap_db)
        fade = ((total - config.quiet_spl) / QUIET_FADE_DB + 1.0).clamp(0.0, 1.0)
        return fade * gain, {"levels": level_state}

    def _reduction(self, levels: Tensor, state: State) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the gain of noise reduction in dB, 0 or less, and its state.

        Shape: (items, frames, bands + 1 + bins) -> (items, frames, bands).
        """
        config = self.config
        without_total = torch.cat((levels[..., : self.bands], levels[..., self.bands + 1 :]), -1)
        entered = torch.tanh(self.enter((without_total - 40.0) / 20.0))
        hidden, cell = state["hidden"].unbind(1)
        if entered.shape[1] == 1:
            hidden, cell = _lstm_step(self.recur, entered[:, 0], hidden, cell)
            recurrent = hidden.unsqueeze(1)
        else:
            before = (hidden.unsqueeze(0).contiguous(), cell.unsqueeze(0).contiguous())
            recurrent, (hidden, cell) = self.recur(entered, before)
            hidden, cell = hidden.squeeze(0), cell.squeeze(0)
        logits = self.leave(torch.cat((recurrent, entered), -1))
        gain = -config.reduction_db * torch.sigmoid(logits)
        opening, closing = decay(config.opening), decay(config.closing)
        gain, gain_state = follow_peaks(gain, state["attenuation"], opening, closing)
        return gain, {"attenuation": gain_state, "hidden": torch.stack((hidden, cell), 1)}


def _lstm_step(lstm: nn.LSTM, frame: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    """Run a one-layer LSTM for one frame.

    It takes a quarter of the module's time, and gives the same bits on a CPU.

    Shape: (items, inputs), (items, units) twice -> hidden and cell state, (items, units) each.
    """
    input_weight, hidden_weight, input_bias, hidden_bias = lstm.all_weights[0]
    recurrent = functional.linear(hidden, hidden_weight, hidden_bias)
    gates = recurrent + functional.linear(frame, input_weight, input_bias)
    enter, forget, candidate, leave = gates.chunk(4, -1)
    cell = forget.sigmoid() * cell + enter.sigmoid() * candidate.tanh()
    return leave.sigmoid() * cell.tanh(), cell
