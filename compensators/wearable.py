"""Base class of the wearable aids, hearing aids with a delay of 4 ms, and their streams.

Every 4 ms (a *hop*), an aid computes the gains of its bands from the last 16 ms of its input (a
*frame*). Terms of all methods:

- An *item* is one signal for one ear. Methods with ``samples`` take all items of a call as rows,
  (items, time), in pascals at 16 kHz.
- ``fitted`` (items, n) holds the parameters that ``fit_with_limits`` computes once for the ear.
- A *slider* is a setting from 0 to 1, such as ``noise_reduction``, which a user may change while a
  stream runs.
- The *state* is all that an aid remembers from one hop to the next: tensors (items, ...) by name,
  such as earlier samples and smoothed levels. Methods take the state and return the next one. The
  aid itself stores none, so that whole signals, streams and exported programs run the same code.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

from compensators.aid import Aid
from compensators.filter_bank import (
    DELAY,
    HISTORY,
    HOP,
    RATE,
    apply_gains,
    filter_centres,
    frame_power,
    gain_at_rate,
)
from compensators.limiter import find_highest_levels, limit_gains, soft_limit
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.discomfort import predict_limits
from hlsim.audiogram.prescription import nalr_gains_db
from hlsim.audiogram.thresholds import (
    AudiogramLike,
    check_two_channels,
    find_limits,
)
from hlsim.calibration import gain_to_pascals
from hlsim.checks import check_device, check_flag, check_names, check_number, check_waveform
from hlsim.dsp.interpolation import interpolate
from hlsim.dsp.resample import resample
from hlsim.torchtools import (
    Audio,
    as_samples,
    as_type_of,
    broadcast_shape,
    flatten_items,
    not_compiled,
    on_device,
)

Slider = float | Tensor
"""Value of a slider, 0 to 1: one number, or a tensor with one value per item.

The tensor broadcasts to the leading dimensions of the output.
"""

State = Mapping[str, Tensor]
"""Tensors that an aid remembers from one hop to the next, by name, (items, ...) each."""

SLIDER_STEP = 0.04
"""Largest change of a slider per hop, so that a change from 0 to 1 takes 0.1 s."""

BLOCK_SAMPLES = 320_000
"""Number of samples of all items together that are processed at once, to limit the memory."""


class Wearable(Aid):
    """Base class of hearing aids that amplify bands with a delay of 4 ms.

    The signal is divided into bands, which are multiplied by their gains and added up again. This
    delays it by 64 samples at 16 kHz. The gain of a band is computed from the spectrum of the last
    16 ms, every 4 ms, and interpolated linearly between these times.

    A slider is a control that the user may set from 0 to 1, such as the strength of noise
    reduction. Subclasses define ``bands``, ``limit_spl``, ``compute_gains`` and ``state_shapes``,
    which is empty if their gains do not depend on the past; if they have sliders, they define
    ``SLIDERS``, too.

    Args:
        audiogram: One or more ears, which are used by all calls that pass none.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. The bands end at 8
            kHz; components above get the gain of the highest band. A ``Stream`` accepts only 16000
            Hz. Whole signals at other rates are resampled, which adds up to 8.5 ms of look-ahead.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.
        linked: Give two ears, (..., 2, time), gains from their mean power, so that the differences
            in level between them stay if their audiograms are equal. The output of each ear is
            limited separately.
        limit_to_ear: Limit the level of the output in each band to 4 dB below the uncomfortable
            level of the ear if one was measured, and otherwise to 4 dB below a predicted level with
            a margin (``hlsim.audiogram.discomfort.predict_limits``). A tensor of thresholds has
            predicted levels. The limit of the peaks stays.

    Attributes:
        SLIDERS: Default value of each slider under its name.
        bands: Number of bands.
        limit_spl: Peak of the output in dB SPL.
        state_shapes: Shape per item of each tensor that the subclass adds to the state, by name.
        latency: Delay of a stream in samples at 16 kHz.

    Raises:
        ValueError: A rate or level is out of range, ``linked`` or ``limit_to_ear`` is neither True
            nor False, or an ear is not valid.

    >>> from compensators import WDRC
    >>> aid = WDRC()
    >>> aid.SLIDERS, aid.latency
    ({}, 64)
    """

    SLIDERS: ClassVar[dict[str, float]] = {}
    latency = DELAY
    bands: int
    limit_spl: float
    state_shapes: Mapping[str, tuple[int, ...]]

    def __init__(
        self,
        audiogram: AudiogramLike | None,
        sample_rate: int,
        full_scale_spl: float,
        linked: bool,
        limit_to_ear: bool = False,
    ) -> None:
        super().__init__(audiogram, sample_rate=sample_rate, full_scale_spl=full_scale_spl)
        check_flag("linked", linked)
        check_flag("limit_to_ear", limit_to_ear)
        self.linked = linked
        self.limit_to_ear = limit_to_ear

    def store_ears(self, audiogram: AudiogramLike | None) -> None:
        """Store ears as ``Aid.store_ears`` does, and the levels that limit the output for them."""
        super().store_ears(audiogram)
        self._limits = find_limits(audiogram)

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """Return the output for whole signals, see ``Aid.forward``."""
        return self.process_block(waveform, audiogram, {})[0]

    def stream(self, audiogram: AudiogramLike | None = None, **sliders: Slider) -> Stream:
        """Return a function that processes a signal in chunks of any size, as it arrives.

        The output is that for the whole signal, ``latency`` samples late. The method ``set`` of the
        stream changes sliders between chunks.

        Args:
            audiogram: One ear for all signals, or ears whose shape (..., 8) broadcasts over the
                leading dimensions of the chunks; by default those of the constructor.
            sliders: Value from 0 to 1 under each slider's name, such as ``noise_reduction``, one
                number or one value per item; by default those of ``SLIDERS``.

        Raises:
            ValueError: The sample rate is not 16000 Hz, the audiogram is not valid, or the aid has
                no such slider.
        """
        return Stream(self, audiogram, **sliders)

    def fit(self, thresholds: Tensor) -> Tensor:
        """Compute the parameters of the aid for each ear.

        They are the hearing loss in dB HL in each band, followed by NAL-R's gain in dB in each
        band.

        Shape: (items, 8) in dB HL -> (items, 2 * bands).
        """
        centres = filter_centres(self.bands)
        prescribed = interpolate(nalr_gains_db(thresholds), FREQUENCIES, centres)
        return torch.cat((interpolate(thresholds, FREQUENCIES, centres), prescribed), -1)

    def fit_with_limits(self, thresholds: Tensor, limits: Tensor | None = None) -> Tensor:
        """Compute what ``fit`` does, followed by the highest level of each band if there is one.

        Args:
            thresholds: Thresholds in dB HL.
            limits: Levels of tones in dB HL that bands stay below, by default predicted ones.

        Shape: (items, 8) twice -> (items, n), with ``limit_to_ear`` (items, n + bands).
        """
        fitted = self.fit(thresholds)
        if not self.limit_to_ear:
            return fitted
        if limits is None:
            limits = predict_limits(thresholds)
        return torch.cat((fitted, find_highest_levels(limits, self.bands)), -1)

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
            The gains in dB, and the new values of the entries of the state in ``state_shapes``.

        Shape: (items, frames, FRAME / 2 + 1), (items, n), (items, frames, sliders) -> (items,
            frames, bands).
        """
        raise NotImplementedError

    def initial_state(self, sliders: Tensor) -> dict[str, Tensor]:
        """Return the state at the beginning of a signal, before which there is silence.

        Args:
            sliders: Values of the sliders at the beginning. Shape: (items, sliders).

        Returns: Tensors by name, (items, ...) each, of the type and device of ``sliders``.
        """
        shapes = {"past": (HISTORY,), "gains": (2, self.bands), **self.state_shapes}
        if self.limit_to_ear:
            shapes["loudest"] = (3, self.bands)
        zeros = {name: sliders.new_zeros(len(sliders), *shape) for name, shape in shapes.items()}
        return {**zeros, "gliding": sliders}

    def process_hops(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Compute the output, before its peaks are limited, for some hops of 64 samples (4 ms).

        Args:
            samples: Input in pascals at 16 kHz.
            fitted: Parameters of the aid for the ear of each item, from ``fit_with_limits``. If the
                aid is ``linked``, items are pairs: the left and the right ear of a listener.
            sliders: New values of the sliders, such as noise reduction. A slider changes gradually
                from its previous value to the new one.
            state: Memory of earlier hops: ``initial_state``, or the state that the call for the
                preceding hops returned.

        Returns:
            The output in pascals, delayed by 64 samples; linear gains minus 1 of the highest band
            at the end of each hop; and the state after the last hop.

        Shape: (items, hops * HOP), (items, n), (items, sliders) -> (items, hops * HOP), (items,
            hops).
        """
        padded = torch.cat((state["past"], samples), -1)
        own_powers = powers = frame_power(padded)
        limits = None
        if self.limit_to_ear:
            fitted, limits = fitted[:, : -self.bands], fitted[:, -self.bands :]
        if self.linked:
            powers = powers.unflatten(0, (-1, 2)).mean(1).repeat_interleave(2, 0)
        gliding = _glide(state["gliding"], sliders, powers.shape[1])
        gains_db, changed_state = self.compute_gains(powers, fitted, gliding, state)
        if limits is not None:
            gains_db, changed_state["loudest"] = limit_gains(
                gains_db, own_powers, limits, state["loudest"]
            )
        # While the first of these hops comes in, the preceding one goes out, because the filters
        # delay by one hop: its two gains are in the state.
        gains = torch.cat((state["gains"], 10.0 ** (gains_db / 20.0) - 1.0), 1)
        output = apply_gains(padded[:, HISTORY - 2 * DELAY :], gains[:, :-1])
        state = {"past": padded[:, -HISTORY:], "gains": gains[:, -2:], "gliding": gliding[:, -1]}
        return output, gains[:, 2:, -1], state | changed_state

    def _amplify(self, signals: Tensor, ears: Tensor) -> Tensor:
        sliders = signals.new_tensor([float(name != "noise_reduction") for name in self.SLIDERS])
        ears_per_gain = 2 if self.linked else 1  # the two ears of a pair get the same noise
        signals, ears = (rows.repeat_interleave(ears_per_gain, 0) for rows in (signals, ears))
        sliders = sliders.expand(len(signals), -1)
        fitted = self.fit_with_limits(ears, torch.full_like(ears, 1000.0))  # no limit
        output = self.process_hops(signals, fitted, sliders, self.initial_state(sliders))[0]
        return output[::ears_per_gain]

    def process_portions(
        self,
        samples: Tensor,
        fitted: Tensor,
        sliders: Tensor,
        state: State,
        state_time: int | None,
    ) -> tuple[Tensor, Tensor, State]:
        """Compute the same as ``process_hops``, a portion of the hops at a time, to save memory.

        Args:
            samples, fitted, sliders, state: See ``process_hops``.
            state_time: Time at which the state is returned, in samples and whole hops; by default
                at the end.

        Returns:
            The output of ``process_hops``; the linear gains minus 1 of the highest band, that
            before the first hop, then that at the end of each hop, (items, hops + 1); and the state
            at ``state_time``.
        """
        outputs = []
        gains = [state["gains"][:, -1:, -1]]
        states = []
        portion = max(1, BLOCK_SAMPLES // (len(samples) * HOP)) * HOP
        for part in samples.tensor_split([] if state_time is None else [state_time], -1):
            for block in part.split(portion, -1):
                output, block_gains, state = self.process_hops(block, fitted, sliders, state)
                outputs.append(output)
                gains.append(block_gains)
            states.append(state)
        return torch.cat(outputs, -1), torch.cat(gains, -1), states[0]

    @not_compiled  # tracing unrolls the loops over hops, which takes many minutes
    def process_block(
        self,
        waveform: Tensor,
        audiogram: AudiogramLike | None,
        sliders: Mapping[str, Slider],
        state: State | None = None,
        *,
        lead: int = 0,
        lag: int = 0,
        state_time: int | None = None,
    ) -> tuple[Tensor, State]:
        """Return the output for a whole signal or a block of one, time-aligned with the input.

        Args:
            waveform: Input of the aid.
            audiogram: Ears of the signals, or None for those of the constructor.
            sliders: Value under each slider's name; by default those of ``SLIDERS``.
            state: State of the aid after the lead; None at the beginning of a signal.
            lead: Number of samples at the start of the block that have no output. Resampling needs
                them.
            lag: Number of samples at the end of the block that resampling needs and that have no
                output, as the 4 ms before them; 0 at the end of a signal.
            state_time: Time after the lead at which the state is returned, in samples at 16 kHz and
                whole hops; by default at the end.

        Returns:
            The output after the lead, (..., time), and the state.

        Raises:
            ValueError: The waveform, the audiogram or a slider is not valid, see ``Aid.forward``.
        """
        check_waveform(waveform, full_scale_spl=self.full_scale_spl)
        rate = self.sample_rate
        with torch.autocast(waveform.device.type, enabled=False):
            batch, fitted = self.prepare(waveform, audiogram)
            settings = self.stack_sliders(sliders, batch, fitted)
            gain = gain_to_pascals(self.full_scale_spl)
            signals = flatten_items(waveform, batch, fitted.dtype) * gain
            low = resample(signals, rate, RATE)[:, lead * RATE // rate :]
            if lag:
                samples = low[:, : -(lag * RATE // rate)]
                low = samples[:, :-DELAY]
            else:
                padding = DELAY + -(low.shape[-1] + DELAY) % HOP
                samples = nn.functional.pad(low, (0, padding))
            low_time = low.shape[-1]
            signals = signals[:, lead:][:, : math.ceil(low_time * rate / RATE)]

            start = state or self.initial_state(settings)
            delayed, gains, state = self.process_portions(
                samples, fitted, settings, start, state_time
            )
            output = resample(delayed[:, DELAY : DELAY + low_time], RATE, rate)
            if rate != RATE:
                time = signals.shape[-1]
                above_8_khz = signals - resample(low, RATE, rate)[:, :time]
                gain_above = gain_at_rate(gains, rate, time)
                output = output[:, :time] + (1.0 + gain_above) * above_8_khz
            output = soft_limit(output, self.limit_spl) / gain
            return output.reshape(*batch, -1).to(waveform.dtype), state

    def prepare(
        self, waveform: Tensor, audiogram: AudiogramLike | None
    ) -> tuple[torch.Size, Tensor]:
        """Fit the aid to the ear of each item of a call.

        Args:
            waveform: Input of the aid, (..., time), whose samples are not validated here.
            audiogram: One ear, or ears whose shape (..., 8) broadcasts over the leading dimensions;
                None for the ears of the constructor.

        Returns:
            The common leading dimensions of waveform and ears, whose product is the number of
            items, and the parameters from ``fit_with_limits``, (items, n).

        Raises:
            ValueError: There is no ear, an ear is not valid, shapes do not fit, the waveform of a
                ``linked`` aid is not of shape (..., 2, time), or the waveform is on another device
                than the weights.
        """
        check_device(self, waveform.device)
        thresholds = self.resolve_thresholds(waveform, audiogram)
        if self.linked:
            check_two_channels(waveform)
        batch = broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
        own_dtype = next((weight.dtype for weight in self.parameters()), waveform.dtype)
        dtype = torch.promote_types(own_dtype, torch.float32)
        ears = flatten_items(thresholds, batch, dtype)
        if not self.limit_to_ear:
            return batch, self.fit(ears)
        levels = self._limits
        if audiogram is not None:
            levels = find_limits(audiogram)
        if levels is not None:
            levels = on_device(levels, waveform.device).reshape(thresholds.shape)
            levels = flatten_items(levels, batch, dtype)
        return batch, self.fit_with_limits(ears, levels)

    def check_sliders(self, names: Iterable[str]) -> None:
        """Raise ValueError unless the aid has sliders of these names."""
        check_names(names, self.SLIDERS, f"sliders of {type(self).__name__}")

    def stack_sliders(
        self, sliders: Mapping[str, Slider], batch: torch.Size, like: Tensor
    ) -> Tensor:
        """Stack the values of the sliders, such as noise reduction, to one row per item.

        Values on a GPU or in a compiled program are not read. Those that are out of range become
        NaN instead of raising an error.

        Args:
            sliders: Value under each slider's name; by default those of ``SLIDERS``.
            batch: Leading dimensions of the signals and ears.
            like: Tensor whose dtype and device the result has.

        Returns: Values from 0 to 1, (items, sliders), in the order of ``SLIDERS``.

        Raises:
            ValueError: A value is outside 0 to 1, its shape does not broadcast to ``batch``, or the
                aid has no such slider.
        """
        self.check_sliders(sliders)
        values = like.new_zeros(batch.numel(), len(self.SLIDERS))
        for column, (name, slider) in enumerate({**self.SLIDERS, **sliders}.items()):
            if not isinstance(slider, Tensor):
                check_number(name, slider, 0.0, 1.0)
                slider = like.new_full((), slider)
            in_range = (slider >= 0.0) & (slider <= 1.0)
            is_known = slider.device.type == "cpu" and not torch.compiler.is_compiling()
            if is_known and not bool(in_range.all()):
                raise ValueError(f"expected {name} from 0 to 1, got {slider!r}")
            try:
                values[:, column] = torch.where(in_range, slider, torch.nan).expand(batch).flatten()
            except RuntimeError as error:
                raise ValueError(
                    f"expected {name} to be one number, or one value per item in the shape "
                    f"{tuple(batch)}, got the shape {tuple(slider.shape)}"
                ) from error
        return values


class Stream:
    """An aid for a signal that arrives in chunks: a function from a chunk to the next output.

    Chunks may have any number of samples above 0. The output has as many, and is delayed by
    ``aid.latency`` samples. It is that of the aid for the whole signal, without gradients.

    Sliders of the aid, such as ``noise_reduction``, may be set at any time. They take 0.1 s from 0
    to 1, so that nothing clicks. If the dimension before time is larger than eight, a chunk needs
    at least nine samples, because a smaller one looks like an array with time first. At the end of
    a signal, ``flush`` returns the last ``aid.latency`` samples of its output.

    Chunks are tensors or NumPy arrays, and so are the outputs; ``flush`` returns a tensor.

    Shape: (..., time) -> (..., time), with the leading dimensions of chunk and ears broadcast;
        those of all chunks are the same.

    Attributes:
        sliders: Value of each slider by its name, as it was set. The value in use moves there.

    Args:
        aid: Aid at 16 kHz.
        audiogram: One ear for all signals, or ears whose shape (..., 8) broadcasts over the leading
            dimensions of the chunks; None for the ears of the aid.
        sliders: Value from 0 to 1 under each slider's name, one number or one value per item; by
            default those of ``aid.SLIDERS``.

    Raises:
        ValueError: For the constructor: the aid has another sample rate, rejects the ear or has no
            such slider. For a call: a slider is outside 0 to 1 (a tensor on a GPU is not checked,
            and the output is NaN until ``flush``) or does not broadcast to the items, the leading
            dimensions differ from those of earlier chunks or do not fit the ears, there are no
            samples, samples are no floating-point numbers or, on a CPU, above 1e9 in magnitude, or
            a sample is NaN or infinite, which would affect all later output. A rejected chunk
            leaves the stream as it was. A rejected value of a slider stays until ``set`` replaces
            it.

    >>> import hlsim
    >>> stream = hlsim.load_compensator("hearing-aid").stream("N3")
    >>> stream.set(noise_reduction=0.3)
    >>> stream(torch.zeros(100)).shape
    torch.Size([100])
    """

    def __init__(self, aid: Wearable, audiogram: AudiogramLike | None, **sliders: Slider) -> None:
        if aid.sample_rate != RATE:
            raise ValueError(
                f"expected an aid with sample_rate={RATE} for a stream, got {aid.sample_rate}; "
                f"use such an aid, and resample the signal to {RATE} Hz"
            )
        aid.find_thresholds(audiogram)  # validates it now, because the first chunk may come later
        self._aid = aid
        self._audiogram = audiogram
        self._state: dict[str, Tensor] = {}  # empty before the first chunk
        self._shape = self._batch = torch.Size()
        self._partial_hop = self._fitted = self._sliders = torch.empty(0)
        self.sliders: dict[str, Slider] = dict(aid.SLIDERS)
        self.set(**sliders)

    def set(self, **sliders: Slider) -> None:
        """Set sliders, which move to their new values in the chunks that follow.

        Args:
            sliders: Value from 0 to 1 under each slider's name, one number or one value per item.

        Raises:
            ValueError: The aid has no such slider.
        """
        self._aid.check_sliders(sliders)
        self.sliders |= sliders

    def __call__(self, chunk: Audio) -> Audio:
        waveform = as_samples(chunk)
        check_waveform(waveform, "chunk", full_scale_spl=self._aid.full_scale_spl)
        if not bool(waveform.isfinite().all()):
            raise ValueError(
                "expected finite samples in a chunk, got NaN or infinity; the chunk was not "
                "processed, replace its samples, for example by torch.nan_to_num"
            )
        with torch.no_grad(), torch.autocast(waveform.device.type, enabled=False):
            self._prepare(waveform)
            gain = gain_to_pascals(self._aid.full_scale_spl)
            samples = flatten_items(waveform, self._batch, self._fitted.dtype) * gain
            outputs = []
            while samples.shape[-1] > 0:
                count = HOP - self._partial_hop.shape[-1]
                if count == HOP <= samples.shape[-1]:
                    count = samples.shape[-1] // HOP * HOP
                outputs.append(self._process_piece(samples[:, :count]))
                samples = samples[:, count:]
            output = soft_limit(torch.cat(outputs, -1), self._aid.limit_spl) / gain
            output = output.reshape(*self._batch, -1).to(waveform.dtype)
            return as_type_of(chunk, output)

    def flush(self) -> Tensor:
        """Return the end of the output, which is still missing because of the delay.

        The next chunk is then the beginning of another signal. The output is a tensor, also for
        chunks that are arrays, in the precision in which the aid computes.

        Shape: -> (..., latency), with the leading dimensions of the other outputs.

        Raises:
            ValueError: A slider is outside 0 to 1, or does not broadcast to the items; or there was
                no chunk yet, and a ``linked`` aid or a listener needs two channels.
        """
        rest = self(self._fitted.new_zeros(*self._shape, DELAY))
        self._state = {}
        return rest

    def _prepare(self, chunk: Tensor) -> None:
        """Read the sliders, and with the first chunk fit the aid to the ears and begin its state.

        Raises:
            ValueError: The leading dimensions are not those of the first chunk, or the ears or a
                slider are not valid.
        """
        is_first = not self._state
        batch, fitted = self._batch, self._fitted
        if is_first:
            batch, fitted = self._aid.prepare(chunk, self._audiogram)
        elif chunk.shape[:-1] != self._shape:
            raise ValueError(
                f"expected a chunk of shape {(*self._shape, 'time')} as before, "
                f"got {tuple(chunk.shape)}; call flush before a signal of another shape"
            )
        self._sliders = self._aid.stack_sliders(self.sliders, batch, fitted)
        if is_first:
            self._shape, self._batch, self._fitted = chunk.shape[:-1], batch, fitted
            self._state = self._aid.initial_state(self._sliders)
            self._partial_hop = self._fitted.new_zeros(len(self._fitted), 0)

    def _process_piece(self, samples: Tensor) -> Tensor:
        """Process either whole hops, or a piece that lies within one hop.

        Shape: (items, time) -> (items, time) in pascals, before the peaks are limited.
        """
        position, time, state = self._partial_hop.shape[-1], samples.shape[-1], self._state
        self._partial_hop = hops = torch.cat((self._partial_hop, samples), -1)
        if hops.shape[-1] % HOP == 0:
            self._partial_hop = hops[:, :0]
            output, _, self._state = self._aid.process_hops(
                hops, self._fitted, self._sliders, state
            )
            if position == 0:
                return output
        padded = torch.cat((state["past"], hops), -1)[:, -2 * DELAY - time :]
        return apply_gains(padded, state["gains"], position)


def _glide(start: Tensor, target: Tensor, frames: int) -> Tensor:
    """Move sliders to new values by at most ``SLIDER_STEP`` per frame, because a jump would click.

    Args:
        start: Values before the first frame.
        target: New values.
        frames: Number of frames, which are 4 ms apart.

    Returns: Values in each frame.

    Shape: (items, sliders), (items, sliders) -> (items, frames, sliders).
    """
    steps = torch.arange(1, frames + 1, dtype=start.dtype, device=start.device)
    limit = SLIDER_STEP * steps.unsqueeze(-1)
    distance = (target - start).unsqueeze(1)
    return start.unsqueeze(1) + torch.minimum(torch.maximum(distance, -limit), limit)
