"""A hearing aid with trained gains and trained noise reduction, and a delay of 4 ms."""

from typing import ClassVar, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from compensators.config import HearingAidConfig
from compensators.filter_bank import (
    HISTORY,
    filter_powers,
    frame_power,
    level_db,
)
from compensators.smoothing import follow_peaks
from compensators.wearable import Slider, State, Wearable
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checkpoint import HubModel
from hlsim.checks import check_number, check_settings
from hlsim.msbg.recruitment import CATCH_UP_SPL
from hlsim.torchtools import built_in_float32

DEFAULT_NOISE_REDUCTION = 0.5
"""Default of the slider ``noise_reduction``, the share of the attenuation that is applied.

Whisper base behind the simulated ear finds most words in noise with half of it (docs/measured.md).
"""

QUIET_FADE_DB = 15.0
"""Range of levels in dB over which the gain of quiet sounds fades."""

INITIAL_REDUCTION_LOGIT = -3.0
"""Initial bias of the logits of noise reduction: 5 % of the largest attenuation."""

NO_GAIN_SPL = 100.0
"""Level of a band in dB SPL from which the restoring gain is 0.

The bands are wider than MSBG's, and louder than each part of them: of 95, 100, 105 and 110 dB SPL,
100 came closest to normal hearing of speech.
"""

LOUDNESS_RANGE = (-40.0, 0.0)
"""Lowest and highest loudness of the output in dB relative to a normal ear."""

SOFTEST_SPL = 20.0
"""Level of a band in dB SPL below which the restoring gain does not rise."""


class HearingAid(Wearable, HubModel):
    """A hearing aid with trained gains and trained noise reduction, and a delay of 4 ms.

    The gain of each frequency band changes every 4 ms. In dB, it is

        amplification * (restoring gain + correction) - noise_reduction * attenuation,

    where ``amplification`` and ``noise_reduction`` are sliders from 0 to 1 that the wearer sets. If
    both are 0, the input passes unchanged up to the limits. The terms are:

    - The restoring gain makes the band about as loud for the impaired ear as for a normal one. It
      inverts the formula by which MSBG simulates the growth of loudness. ``loudness`` lowers it.
    - The correction comes from a network that gets the audiogram and the level of each band. It is
      0 before training, and where there is no loss.
    - The attenuation comes from a recurrent network that gets levels, but no audiogram.

    The sum of restoring gain and correction is limited to 0 to ``config.cap_db`` dB before the
    slider ``amplification`` scales it, and fades for sounds below ``config.quiet_spl`` dB SPL. The
    peak of the output is softly limited at ``config.limit_spl`` dB SPL.

    Args:
        audiogram: One or more ears, which are used by all calls that pass none.
        config: Sizes of the networks, and limits of the gains; by default ``HearingAidConfig()``.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. Streams need 16000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.
        linked: Give two ears, (..., 2, time), gains from their mean power, so that the differences
            in level between them stay if their audiograms are equal.
        limit_to_ear: Limit the level of the output in each band to 4 dB below the uncomfortable
            level of the ear if one was measured, and otherwise to 4 dB below a predicted level with
            a margin (``hlsim.audiogram.discomfort.predict_limits``). A tensor of thresholds has
            predicted levels. The limit of the peaks stays.
        loudness: Loudness of the output for the impaired ear, in dB relative to a normal ear, -40
            to 0. Most people prefer less than 0 (docs/guide/levels.md). The sum of restoring gain
            and correction stays 0 dB or more.

    Raises:
        ValueError: A rate, level or ``loudness`` is out of range, ``linked`` or ``limit_to_ear`` is
            neither True nor False, an ear is not valid, or ``config`` is not a
            ``HearingAidConfig``.

    >>> import hlsim
    >>> aid = HearingAid().eval()
    >>> output = aid(hlsim.example_speech(), "N3", noise_reduction=0.0)
    >>> output.shape
    torch.Size([64320])
    """

    kind = "hearing-aid"
    config_class = HearingAidConfig

    SLIDERS: ClassVar = {"noise_reduction": DEFAULT_NOISE_REDUCTION, "amplification": 1.0}

    @check_settings
    @built_in_float32
    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        config: HearingAidConfig | None = None,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        linked: bool = False,
        limit_to_ear: bool = False,
        loudness: float = 0.0,
    ) -> None:
        super().__init__(audiogram, sample_rate, full_scale_spl, linked, limit_to_ear)
        check_number("loudness", loudness, *LOUDNESS_RANGE)
        self.loudness = loudness
        self.config = config = HearingAidConfig.resolve(config)
        self.bands = config.bands
        self.limit_spl = config.limit_spl
        self.state_shapes = {
            "levels": (3, config.bands + 1),
            "attenuation": (3, config.bands),
            "hidden": (2, config.hidden),
        }
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
        nn.init.zeros_(corrections.weight)
        nn.init.zeros_(corrections.bias)
        nn.init.constant_(self.leave.bias, INITIAL_REDUCTION_LOGIT)

    @property
    def noise_reduction_network(self) -> nn.ModuleList:
        """Modules that compute the attenuation of noise, to train or freeze them separately.

        The other network, ``correct``, computes the correction of the restoring gain.
        """
        return nn.ModuleList([self.enter, self.recur, self.leave])

    def train(self, mode: bool = True) -> Self:
        """Set the mode of all modules except the LSTM, which stays in training mode.

        cuDNN computes no gradient through an LSTM in evaluation mode. The output of the LSTM is the
        same in both modes, because it has no dropout.
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
        """Return the output for whole signals, see ``Aid.forward``.

        Args:
            waveform: Input of the aid.
            audiogram: Ears of the signals, by default those of the constructor.
            noise_reduction: Share of the attenuation of noise that is applied, 0 to 1: one number,
                or values that broadcast to the leading dimensions of the output.
            amplification: Share of the amplification that is applied, in the same form.

        Shape: (..., time) -> (..., time).

        Raises:
            ValueError: A slider is outside 0 to 1 (on a GPU this gives NaN) or has another number
                of values, or an argument is not valid, see ``Aid.forward``.
        """
        sliders: dict[str, Slider] = {
            "noise_reduction": noise_reduction,
            "amplification": amplification,
        }
        return self.process_block(waveform, audiogram, sliders)[0]

    def compute_gains(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        noise_reduction, amplification = sliders.split(1, -1)
        levels = self._levels(powers)
        gain, level_state = self._amplification(levels[..., : self.bands + 1], fitted, state)
        attenuation, reduction_state = self._attenuation(levels, state)
        total = amplification * gain + noise_reduction * attenuation
        return total, level_state | reduction_state

    def attenuation(self, samples: Tensor) -> Tensor:
        """Compute the gains with which noise reduction attenuates each band, every 4 ms.

        They are those for the slider ``noise_reduction`` at 1, and do not depend on the ear.

        Args:
            samples: Input of the aid in pascals at 16 kHz, a multiple of 64 samples long.

        Shape: (items, time) -> (items, time / 64, bands) in dB, 0 or less.
        """
        levels = self._levels(frame_power(functional.pad(samples, (HISTORY, 0))))
        state = self.initial_state(samples.new_zeros(len(samples), len(self.SLIDERS)))
        return self._attenuation(levels, state)[0]

    def _levels(self, powers: Tensor) -> Tensor:
        """Return the levels of the bands, of the whole frame, and of single frequencies in dB SPL.

        Args:
            powers: Powers in Pa^2 from ``frame_power``.

        Shape: (items, frames, FRAME / 2 + 1) -> (items, frames, bands + 1 + bins).
        """
        by_band = filter_powers(powers, self.bands)
        bins = powers[..., 1 : self.config.bins + 1]
        return level_db(torch.cat((by_band, powers.sum(-1, keepdim=True), bins), -1))

    def _amplification(
        self, levels: Tensor, fitted: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return restoring gain plus correction in dB, and the new ``levels`` of the state.

        The sum is limited, and fades for quiet sounds.

        Args:
            levels: Levels in dB SPL of the bands and of the whole frame.
            fitted: Hearing loss in dB HL in each band, then NAL-R's gain in dB in each band.
            state: Memory of earlier frames, of which ``levels`` is used.

        Shape: (items, frames, bands + 1), (items, 2 * bands) -> (items, frames, bands).
        """
        config = self.config
        present = levels[..., : self.bands]
        levels, memory = follow_peaks(levels, state["levels"], config.attack, config.release)
        level, total = levels.split((self.bands, 1), -1)
        loss, prescribed = fitted.chunk(2, -1)
        ear = torch.cat((loss / 50.0, prescribed / 20.0), -1)
        ear = ear.unsqueeze(1).expand(-1, level.shape[1], -1)
        positive_loss = loss.clamp_min(0.0)
        reach = config.reach_db * positive_loss / (positive_loss + 10.0)
        features = torch.cat((ear, (levels - 40.0) / 20.0, (present - level) / 10.0), -1)
        correction = reach.unsqueeze(1) * torch.tanh(self.correct(features))
        # The inverse of MSBG's recruitment, by which an ear perceives 0 dB SPL of a sound whose
        # level in dB SPL is the loss, and of one at 105 dB SPL the same as a normal ear.
        below_no_gain = (NO_GAIN_SPL - level.clamp_min(SOFTEST_SPL)).clamp_min(0.0)
        share = (positive_loss / CATCH_UP_SPL).unsqueeze(1)
        # With recruitment, 1 dB less of output lowers the perceived level by 1 / (1 - share) dB.
        restoring_gain = share * below_no_gain + self.loudness * (1.0 - share).clamp_min(0.0)
        gain = (restoring_gain + correction).clamp(0.0, config.cap_db)
        fade = ((total - config.quiet_spl) / QUIET_FADE_DB + 1.0).clamp(0.0, 1.0)
        return fade * gain, {"levels": memory}

    def _attenuation(self, levels: Tensor, state: State) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the gain of noise reduction in dB, 0 or less, and its state after these frames.

        Args:
            levels: Levels in dB SPL from ``_levels``.
            state: Memory of earlier frames, of which ``attenuation`` and ``hidden`` are used and
                returned.

        Shape: (items, frames, bands + 1 + bins) -> (items, frames, bands).
        """
        config = self.config
        without_total = torch.cat((levels[..., : self.bands], levels[..., self.bands + 1 :]), -1)
        entered = torch.tanh(self.enter((without_total - 40.0) / 20.0))
        hidden, cell = state["hidden"].unbind(1)
        if entered.shape[1] == 1:
            # For one frame, a call of the LSTM takes four times as long.
            weights = self.recur.all_weights[0]
            hidden, cell = torch.lstm_cell(entered[:, 0], (hidden, cell), *weights)
            recurrent = hidden.unsqueeze(1)
        else:
            before = (hidden.unsqueeze(0).contiguous(), cell.unsqueeze(0).contiguous())
            recurrent, (hidden, cell) = self.recur(entered, before)
            hidden, cell = hidden.squeeze(0), cell.squeeze(0)
        logits = self.leave(torch.cat((recurrent, entered), -1))
        gain = -config.reduction_db * torch.sigmoid(logits)
        gain, memory = follow_peaks(gain, state["attenuation"], config.opening, config.closing)
        return gain, {"attenuation": memory, "hidden": torch.stack((hidden, cell), 1)}
