"""Base class of the wearable aids: hearing aids with a gain per band and a delay of 4 ms.

Every 4 ms (a *hop*), an aid computes the gains of its bands from the last 16 ms of its input (a
*frame*). Terms of all methods:

- An *item* is one signal for one ear. Methods with ``samples`` take all items of a call as rows,
  (items, time), in pascals at 16 kHz.
- ``fitted`` (items, n) holds the parameters that ``fit`` computes once from the audiogram.
- A *slider* is a setting from 0 to 1 that may change meanwhile, such as ``noise_reduction``.
- The *state* is all that an aid remembers from one hop to the next: tensors (items, ...) by name,
  such as earlier samples and smoothed levels. Methods take the state and return the next one. The
  aid itself stores none, so that whole signals, streams and exported programs run the same code.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from compensators.filter_bank import (
    DELAY,
    HISTORY,
    HOP,
    RATE,
    apply_gains,
    frame_power,
    gain_at_rate,
)
from compensators.gains import MeasuredAid
from compensators.limiter import soft_limit
from hlsim.audiogram.thresholds import (
    AudiogramLike,
    check_two_channels,
    resolve_thresholds,
)
from hlsim.calibration import check_full_scale, gain_to_pascals
from hlsim.checks import broadcast_shape, check_number, check_rate, check_waveform
from hlsim.dsp.resample import resample
from hlsim.torchtools import flatten_items

Slider = float | Tensor
"""Value of a slider, 0 to 1: one number, or one value per item."""

State = Mapping[str, Tensor]
"""Tensors that an aid remembers from one hop to the next, by name, (items, ...) each."""

SLIDER_STEP = 0.04
"""Largest change of a slider per hop, so that the way from 0 to 1 takes 0.1 s."""

BLOCK_SAMPLES = 320_000
"""Samples of all items that are processed together, which limits memory and changes no output."""

RESAMPLER_LOOKAHEAD = 136
"""Samples at 16 kHz by which resampling to 16 kHz and back looks ahead."""


class Wearable(MeasuredAid):
    """Base class of hearing aids that amplify bands with a delay of 4 ms.

    The signal is divided into bands, which are multiplied by their gains and added up again. This
    delays it by 64 samples at 16 kHz. The gain of a band is computed from the spectrum of the last
    16 ms, every 4 ms, and interpolated linearly between these times.

    A slider is a control that the user may set from 0 to 1, such as the strength of noise
    reduction. Subclasses define ``bands``, ``limit_spl``, ``fit`` and ``compute_gains``; if they
    have sliders, ``SLIDERS``; and if their gains depend on the past, ``initial_state``.

    Args:
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. The bands end at 8
            kHz; components above get the gain of the highest band. A ``Stream`` accepts only 16000
            Hz. Whole signals at other rates are resampled, which adds 8.5 ms of look-ahead.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0.
        linked: Give two ears, (..., 2, time), gains from their mean power, so that the differences
            in level between them stay if their audiograms are equal. The output of each ear is
            limited separately.

    Attributes:
        SLIDERS: Default value of each slider under its name.
        bands: Number of bands.
        limit_spl: Peak of the output in dB SPL.

    Raises:
        ValueError: A rate or level is out of range.

    >>> from compensators import WDRC
    >>> aid = WDRC()
    >>> aid.SLIDERS, aid.latency
    ({}, 64)
    """

    SLIDERS: ClassVar[dict[str, float]] = {}
    bands: int
    limit_spl: float

    def __init__(self, sample_rate: int, full_scale_spl: float, linked: bool = False) -> None:
        super().__init__()
        self.linked = linked
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)

    @property
    def latency(self) -> int:
        """Delay of a stream in samples, and look-ahead of the output for a whole signal."""
        if self.sample_rate == RATE:
            return DELAY
        return -(-(DELAY + RESAMPLER_LOOKAHEAD) * self.sample_rate // RATE)

    def fit(self, thresholds: Tensor) -> Tensor:
        """Compute the parameters of the aid for each ear, such as the prescribed gains.

        Shape: (items, 8) in dB HL -> (items, n), where n is the number of parameters that the
            subclass needs for an ear.
        """
        raise NotImplementedError

    def compute_gains(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the gain of each band, every 4 ms.

        Args:
            powers: Power spectrum in Pa^2 of each frame, the last 16 ms, from ``frame_power``.
            fitted: Parameters of the aid for the ear of each item, from ``fit``.
            sliders: Values of the sliders in each frame, such as noise reduction.
            state: Memory of earlier frames, as ``initial_state`` returns it.

        Returns:
            The gains in dB, and the new values of those entries of the state that this class adds
            to ``initial_state``.

        Shape: (items, frames, FRAME / 2 + 1), (items, n), (items, frames, sliders) -> (items,
            frames, bands).
        """
        raise NotImplementedError

    def initial_state(self, sliders: Tensor) -> dict[str, Tensor]:
        """Return what the aid remembers at the beginning of a signal: silence.

        Args:
            sliders: Values of the sliders at the beginning. Shape: (items, sliders).

        Returns: Named tensors, (items, ...) each, of the type and device of ``sliders``.
        """
        past = sliders.new_zeros(len(sliders), HISTORY)
        gains = sliders.new_zeros(len(sliders), 2, self.bands)
        return {"past": past, "gains": gains, "gliding": sliders}

    def excess_gains(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the gain of each band for some hops of 64 samples (4 ms) of the input.

        The filters delay the signal by one hop. While the first of these hops comes in, the
        preceding one goes out, so the gains at the beginning and the end of that hop are included.

        Args:
            samples: Input in pascals at 16 kHz.
            fitted: Parameters of the aid for the ear of each item, from ``fit``.
            sliders: New values of the sliders, such as noise reduction. A slider changes gradually
                from its previous value to the new one.
            state: Memory of earlier hops: ``initial_state``, or the state that the call for the
                preceding hops returned.

        Returns:
            Linear gains minus 1 at the ends of the two hops before the first one, followed by those
            at the end of each hop; and the state after the last hop.

        Shape: (items, hops * HOP), (items, n), (items, sliders) -> (items, 2 + hops, bands).
        """
        padded = torch.cat((state["past"], samples), -1)
        powers = frame_power(padded)
        if self.linked:
            powers = powers.unflatten(0, (-1, 2)).mean(1).repeat_interleave(2, 0)
        gliding = _glide(state["gliding"], sliders, powers.shape[1])
        gains_db, changed_state = self.compute_gains(powers, fitted, gliding, state)
        gains = torch.cat((state["gains"], 10.0 ** (gains_db / 20.0) - 1.0), 1)
        state = {"past": padded[:, -HISTORY:], "gains": gains[:, -2:], "gliding": gliding[:, -1]}
        return gains, state | changed_state

    def process_hops(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Compute the output, before its limit, for some hops of 64 samples (4 ms) of the input.

        The arguments are those of ``excess_gains``.

        Returns:
            The output in pascals, delayed by 64 samples; linear gains minus 1 of the highest band
            at the end of each hop; and the state after the last hop.

        Shape: (items, hops * HOP), (items, n), (items, sliders) -> (items, hops * HOP), (items,
            hops).
        """
        gains, next_state = self.excess_gains(samples, fitted, sliders, state)
        padded = torch.cat((state["past"][:, -2 * DELAY :], samples), -1)
        return apply_gains(padded, gains[:, :-1]), gains[:, 2:, -1], next_state

    def _amplify(self, signals: Tensor, ears: Tensor) -> Tensor:
        sliders = signals.new_tensor([float(name != "noise_reduction") for name in self.SLIDERS])
        sliders = sliders.expand(len(signals), -1)
        return self.process_hops(signals, self.fit(ears), sliders, self.initial_state(sliders))[0]

    def _process(
        self, waveform: Tensor, audiogram: AudiogramLike | None, sliders: Sequence[Slider]
    ) -> Tensor:
        """Return the time-aligned output for whole signals.

        Args:
            waveform: Input of the aid.
            audiogram: One audiogram, or (..., 8) that broadcasts over the leading dimensions.
            sliders: Values of ``SLIDERS``.

        Shape: (..., time) -> (..., time).
        """
        check_waveform(waveform, full_scale_spl=self.full_scale_spl)
        with torch.autocast(waveform.device.type, enabled=False):
            batch, fitted = self.prepare(waveform, audiogram)
            settings = self.stack_sliders(sliders, batch, fitted)
            time = waveform.shape[-1]
            gain = gain_to_pascals(self.full_scale_spl)
            signals = flatten_items(waveform, batch, fitted.dtype) * gain
            low = resample(signals, self.sample_rate, RATE)
            state = self.initial_state(settings)
            outputs = []
            highest_gains = [low.new_zeros(len(low), 1)]
            low_time = low.shape[-1]
            padded = nn.functional.pad(low, (0, DELAY + -(low_time + DELAY) % HOP))
            block_samples = max(1, BLOCK_SAMPLES // (len(low) * HOP)) * HOP
            for block in padded.split(block_samples, -1):
                output, gains, state = self.process_hops(block, fitted, settings, state)
                outputs.append(output)
                highest_gains.append(gains)
            aligned = torch.cat(outputs, -1)[:, DELAY : DELAY + low_time]
            result = resample(aligned, RATE, self.sample_rate)
            if self.sample_rate != RATE:
                above_8_khz = signals - resample(low, RATE, self.sample_rate)[:, :time]
                gains = gain_at_rate(torch.cat(highest_gains, -1), self.sample_rate, time)
                result = result[:, :time] + (1.0 + gains) * above_8_khz
            limited = soft_limit(result, self.limit_spl)
            return (limited / gain).reshape(*batch, time).to(waveform.dtype)

    def prepare(
        self, waveform: Tensor, audiogram: AudiogramLike | None
    ) -> tuple[torch.Size, Tensor]:
        """Validate the arguments of a call, and fit the aid to the ear of each item.

        Args:
            waveform: Input of the aid, (..., time).
            audiogram: One ear, or ears whose shape (..., 8) broadcasts over the leading dimensions.

        Returns:
            The common leading dimensions of waveform and ears, whose product is the number of
            items, and the parameters from ``fit``, (items, n).

        Raises:
            ValueError: An ear is not valid, or shapes do not fit.
        """
        thresholds = resolve_thresholds(None, audiogram, waveform)
        if self.linked:
            check_two_channels(waveform)
        batch = broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
        own_dtype = next((weight.dtype for weight in self.parameters()), waveform.dtype)
        dtype = torch.promote_types(own_dtype, torch.float32)
        return batch, self.fit(flatten_items(thresholds, batch, dtype))

    def stack_sliders(self, sliders: Sequence[Slider], batch: torch.Size, like: Tensor) -> Tensor:
        """Stack the values of the sliders, such as noise reduction, to one row per item.

        Values on a GPU are not read, because the host would wait for the GPU. Those that are out of
        range become NaN instead of raising an error.

        Args:
            sliders: Value of each slider in the order of ``SLIDERS``.
            batch: Leading dimensions of the signals and ears.
            like: Tensor whose dtype and device the result has.

        Returns: Values from 0 to 1, (items, sliders).

        Raises:
            ValueError: A value is outside 0 to 1.
            RuntimeError: A shape does not broadcast to ``batch``.
        """
        values = []
        for name, slider in zip(self.SLIDERS, sliders, strict=True):
            if not isinstance(slider, Tensor):
                check_number(name, slider, 0.0, 1.0)
                slider = like.new_full((), slider)
            in_range = (slider >= 0.0) & (slider <= 1.0)
            if slider.device.type == "cpu" and not bool(in_range.all()):
                raise ValueError(f"expected {name} from 0 to 1, got {slider!r}")
            value = torch.where(in_range, slider, torch.nan)
            value = value.to(like.device, like.dtype, non_blocking=like.device.type != "cpu")
            values.append(value.expand(batch))
        if not values:
            return like.new_zeros(batch.numel(), 0)
        return torch.stack(values, -1).reshape(-1, len(values))

    def extra_repr(self) -> str:
        return (
            f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}, "
            f"bands={self.bands}"
        )


def _glide(start: Tensor, target: Tensor, frames: int) -> Tensor:
    """Return the sliders in each frame on their way to new values, because a jump would click.

    Shape: (items, sliders) twice -> (items, frames, sliders).
    """
    steps = torch.arange(1, frames + 1, dtype=start.dtype, device=start.device)
    limit = SLIDER_STEP * steps.unsqueeze(-1)
    distance = (target - start).unsqueeze(1)
    return start.unsqueeze(1) + torch.minimum(torch.maximum(distance, -limit), limit)
