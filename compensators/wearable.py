"""Base class of wearable aids, which amplify bands with a delay of 4 ms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
from compensators.gains import measure_gains
from compensators.limiter import soft_limit
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import (
    AudiogramLike,
    check_two_channels,
    resolve_thresholds,
)
from hlsim.calibration import PASCAL_SPL, check_full_scale, gain_to_pascals
from hlsim.checks import broadcast_shape, check_number, check_rate, check_waveform, describe
from hlsim.dsp.resample import resample

Slider = float | Tensor

State = Mapping[str, Tensor]
"""Tensors that are carried from hop to hop, by name, (items, ...) each."""

SLIDER_STEP = 0.04
"""Largest change of a slider per hop: 0.1 s from end to end."""

BLOCK_SAMPLES = 320_000
"""Samples of all items that are processed together, which limits memory and changes no output."""

RESAMPLER_LOOKAHEAD = 136
"""Samples at 16 kHz by which resampling to 16 kHz and back looks ahead."""


class Wearable(nn.Module):
    """An aid with gains in bands.

    Subclasses have ``SLIDERS`` with ``DEFAULT_SLIDERS``, ``fit``, ``start`` and ``control``.

    A direct path splits the signal into bands that sum to the signal with a delay of 4 ms,
    multiplies each band by its gain, and adds them. The gains come from frames of 16 ms every 4 ms
    that end where the direct path is. The output, aligned with the input, therefore has a
    look-ahead of ``DELAY`` samples. The gains go linearly from frame to frame. Whole signals and
    streams run the same ``step``.

    Args:
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. The bands end at 8
            kHz; components above get the gain of the highest band. Other rates than 16000 are
            supported for whole signals only, and resampling adds 8.5 ms of look-ahead.
        full_scale_spl: Level in dB SPL of RMS 1.0.
        linked: For two ears, (..., 2, time), set the gains of both ears by their mean power, so
            that differences in level between ears with the same fitting stay. The limit of the
            output is that of each ear.

    Raises:
        ValueError: A rate or level out of range; in a call with ``linked``, another shape.

    >>> from compensators import WDRC
    >>> aid = WDRC()
    >>> aid.SLIDERS, aid.latency
    ((), 64)
    """

    SLIDERS: tuple[str, ...] = ()
    DEFAULT_SLIDERS: tuple[float, ...] = ()
    bands: int
    limit_spl: float

    def __init__(self, sample_rate: int, full_scale_spl: float, linked: bool = False) -> None:
        super().__init__()
        self.linked = linked
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)

    @property
    def latency(self) -> int:
        """Look-ahead of the aligned output in samples, which is the delay of a stream."""
        if self.sample_rate == RATE:
            return DELAY
        return -(-(DELAY + RESAMPLER_LOOKAHEAD) * self.sample_rate // RATE)

    def fit(self, thresholds: Tensor) -> Tensor:
        """Compute the parameters of ``control`` for ears. Shape: (items, 8) dB HL -> (items, n)."""
        raise NotImplementedError

    def start(self, items: int, like: Tensor) -> dict[str, Tensor]:
        """Return the state of ``control`` after silence, of the type and device of a tensor."""
        raise NotImplementedError

    def control(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute each band's gain in dB at the end of each frame, and the state after the last.

        Args:
            powers: Result of ``frame_power``.
            fitted: Result of ``fit``.
            sliders: Values of the sliders in each frame.
            state: State before the first frame.

        Shape: (items, frames, FRAME / 2 + 1), (items, n), (items, frames, sliders)
            -> (items, frames, bands).
        """
        raise NotImplementedError

    def initial(self, sliders: Tensor) -> dict[str, Tensor]:
        """Return the state after silence. Shape: (items, sliders) -> (items, ...) each."""
        items = len(sliders)
        past = sliders.new_zeros(items, HISTORY)
        gains = sliders.new_zeros(items, 2, self.bands)
        return {"past": past, "gains": gains, "gliding": sliders, **self.start(items, sliders)}

    def advance(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> dict[str, Tensor]:
        """Process a whole number of hops, and return the new state.

        Its entry ``gains`` contains the gains of all these hops, not only of the last one.

        Shape: (items, hops * HOP) in pascals, (items, n), (items, sliders), where n is the number
            of parameters that are fitted to an ear.
        """
        padded = torch.cat((state["past"], samples), -1)
        powers = frame_power(padded)
        if self.linked:
            powers = powers.unflatten(0, (-1, 2)).mean(1).repeat_interleave(2, 0)
        gliding = _glide(state["gliding"], sliders, powers.shape[1])
        gains_db, control_state = self.control(powers, fitted, gliding, state)
        gains = torch.cat((state["gains"], 10.0 ** (gains_db / 20.0) - 1.0), 1)
        common = {"past": padded[:, -HISTORY:], "gains": gains, "gliding": gliding[:, -1]}
        return common | control_state

    def step(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the output for whole hops, ``DELAY`` samples late, and the state after them.

        Shape: (items, hops * HOP) in pascals, (items, n), (items, sliders) -> (items, hops * HOP).
        """
        output, _, after = self._amplify(samples, fitted, sliders, state)
        return self.finish(output), after

    def _amplify(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Return the output of ``step`` before the limit, the highest gains minus 1, and the state.

        Shape: as ``step`` -> (items, hops * HOP), (items, hops).
        """
        after = self.advance(samples, fitted, sliders, state)
        gains = after["gains"]
        padded = torch.cat((state["past"][:, -2 * DELAY :], samples), -1)
        output = apply_gains(padded, gains[:, :-1])
        return output, gains[:, 2:, -1], after | {"gains": gains[:, -2:]}

    def finish(self, samples: Tensor) -> Tensor:
        """Apply the limit of the output to samples in pascals. Any shape."""
        return soft_limit(samples, 10.0 ** ((self.limit_spl - PASCAL_SPL) / 20.0))

    def process(
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
            batch, fitted, settings = self.prepare(waveform, audiogram, sliders)
            time = waveform.shape[-1]
            gain = gain_to_pascals(self.full_scale_spl)
            signals = waveform.to(fitted.dtype).expand(*batch, -1).reshape(-1, time) * gain
            low = resample(signals, self.sample_rate, RATE)
            state = self.initial(settings)
            outputs = []
            highest_gains = [low.new_zeros(len(low), 1)]
            low_time = low.shape[-1]
            padded = nn.functional.pad(low, (0, DELAY + -(low_time + DELAY) % HOP))
            block_samples = max(1, BLOCK_SAMPLES // (len(low) * HOP)) * HOP
            for block in padded.split(block_samples, -1):
                output, gains, state = self._amplify(block, fitted, settings, state)
                outputs.append(output)
                highest_gains.append(gains)
            aligned = torch.cat(outputs, -1)[:, DELAY : DELAY + low_time]
            result = resample(aligned, RATE, self.sample_rate)
            if self.sample_rate != RATE:
                above_8_khz = signals - resample(low, RATE, self.sample_rate)[:, :time]
                gains = gain_at_rate(torch.cat(highest_gains, -1), self.sample_rate, time)
                result = result[:, :time] + (1.0 + gains) * above_8_khz
            result = self.finish(result)
            return (result / gain).reshape(*batch, time).to(waveform.dtype)

    def prepare(
        self, waveform: Tensor, audiogram: AudiogramLike | None, sliders: Sequence[Slider]
    ) -> tuple[torch.Size, Tensor, Tensor]:
        """Return the common leading dimensions, the result of ``fit``, and the sliders.

        Shape: (..., time), (..., 8), (...) each -> (...), (items, n), (items, sliders).
        """
        thresholds = resolve_thresholds(None, audiogram, waveform, consumer=type(self).__name__)
        own_dtype = next((weight.dtype for weight in self.parameters()), waveform.dtype)
        dtype = torch.promote_types(own_dtype, torch.float32)
        batch = broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
        if self.linked:
            check_two_channels(waveform)
        settings = [
            check_slider(name, slider, batch, thresholds)
            for name, slider in zip(self.SLIDERS, sliders, strict=True)
        ]
        ears = thresholds.to(dtype).expand(*batch, -1).reshape(-1, len(FREQUENCIES))
        stacked = torch.stack(settings, -1) if settings else ears.new_zeros(*batch, 0)
        return batch, self.fit(ears), stacked.to(dtype).reshape(len(ears), -1)

    def gains(self, audiogram: AudiogramLike, level: float = 65.0) -> Tensor:
        """Measure the insertion gains for noise with the spectrum of average speech.

        Noise reduction is off, and the limit of the output does not count.

        Args:
            audiogram: One or more ears.
            level: Presentation level in dB SPL, 0 to 120.

        Returns:
            Gains in dB at the eight ``FREQUENCIES``, (8,) for one ear, else (..., 8).

        Raises:
            ValueError: An ear or the level is not valid.

        >>> from compensators import WDRC
        >>> WDRC().gains("N3", level=65.0).round()
        tensor([ 1.,  8., 18., 20., 21., 22., 23., 24.])
        """

        def amplify(noise: Tensor, ears: Tensor) -> Tensor:
            sliders = noise.new_tensor([float(name != "noise_reduction") for name in self.SLIDERS])
            sliders = sliders.expand(len(noise), -1)
            return self._amplify(noise, self.fit(ears), sliders, self.initial(sliders))[0]

        weight = next(self.parameters(), torch.empty(0))
        return measure_gains(amplify, audiogram, level, weight.dtype, weight.device)

    def extra_repr(self) -> str:
        return (
            f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}, "
            f"bands={self.bands}"
        )


def check_slider(name: str, slider: Slider, batch: torch.Size, like: Tensor) -> Tensor:
    """Return a slider as a tensor with one value per item, of the type of another tensor.

    The values of a tensor on a GPU are not read, because the host would wait for the GPU. Those
    that are out of range become NaN.

    Args:
        name: Name of the slider, for messages.
        slider: Number or tensor from 0 to 1.
        batch: Shape of the result, to which a tensor has to broadcast.
        like: Tensor with the type and the device of the result.

    Raises:
        ValueError: Values outside 0 to 1, or a shape that does not broadcast over the items.

    >>> check_slider("amplification", 0.5, torch.Size([2]), torch.empty(0))
    tensor([0.5000, 0.5000])
    """
    if not isinstance(slider, Tensor):
        check_number(name, slider, 0.0, 1.0)
        return like.new_full(batch, float(slider))
    if slider.is_complex():
        raise ValueError(f"expected {name} from 0 to 1, got {describe(slider)}")
    values = slider.to(like.device, like.dtype, non_blocking=like.device.type != "cpu")
    in_range = (slider >= 0.0) & (slider <= 1.0)
    if slider.device.type != "cpu":
        values = torch.where(in_range, values, torch.nan)
    elif not bool(in_range.all()):
        raise ValueError(f"expected {name} from 0 to 1, got {slider!r}")
    try:
        return values.expand(batch)
    except RuntimeError:
        raise ValueError(
            f"expected one value of {name}, or one per item in the shape {tuple(batch)}, "
            f"got shape {tuple(values.shape)}"
        ) from None


def _glide(now: Tensor, target: Tensor, frames: int) -> Tensor:
    """Move sliders gradually to new values, because a jump would click.

    Shape: (items, n) twice -> (items, frames, n).
    """
    steps = torch.arange(1, frames + 1, dtype=now.dtype, device=now.device)
    limit = SLIDER_STEP * steps.unsqueeze(-1)
    distance = (target - now).unsqueeze(1)
    return now.unsqueeze(1) + torch.minimum(torch.maximum(distance, -limit), limit)
