"""Streams, in which a wearable aid processes a signal in chunks of any size."""

from typing import Any

import torch
from torch import Tensor

from compensators.filter_bank import DELAY, HOP, RATE, apply_gains
from compensators.limiter import soft_limit
from compensators.wearable import Slider, Wearable
from hlsim.audiogram.thresholds import AudiogramLike, as_thresholds
from hlsim.calibration import gain_to_pascals
from hlsim.checks import check_waveform
from hlsim.torchtools import flatten_items


class Stream:
    """An aid for a signal that arrives in chunks: a function from a chunk to the next output.

    Chunks may have any number of samples. The output has as many, and is delayed by ``aid.latency``
    samples. It is that of the aid for the whole signal, without gradients.

    Sliders of the aid, such as ``noise_reduction``, are attributes that may be set at any time.
    They take 0.1 s from 0 to 1, so that nothing clicks. For more than eight items, a chunk needs at
    least nine samples, because a smaller one looks like an array with time first.

    Shape: (..., time) -> (..., time); the leading dimensions of all chunks are the same.

    Args:
        aid: Aid at 16 kHz.
        audiogram: One ear for all signals, or ears whose shape (..., 8) broadcasts over the leading
            dimensions of the chunks.
        sliders: Value from 0 to 1 under each slider's name, one number or one value per item.

    Raises:
        ValueError: The aid has another sample rate, or rejects the ear; a call rejects the value of
            a slider, other leading dimensions than before, and samples that are NaN or infinite,
            which would affect all later output. After a rejected chunk, the stream goes on as if
            there had been none.
        AttributeError: An attribute is set that is not a slider of the aid.

    >>> import hlsim
    >>> stream = hlsim.load_compensator("hearing-aid").stream("N3")
    >>> stream.noise_reduction = 0.3
    >>> stream(torch.zeros(100)).shape
    torch.Size([100])
    """

    def __init__(self, aid: Wearable, audiogram: AudiogramLike, **sliders: Slider) -> None:
        if aid.sample_rate != RATE:
            raise ValueError(
                f"expected an aid with sample_rate={RATE} for a stream, got {aid.sample_rate}; "
                f"use such an aid, and resample the signal to {RATE} Hz"
            )
        as_thresholds(audiogram)  # the first chunk may come later
        self._aid = aid
        self._audiogram = audiogram
        self._state: dict[str, Tensor] = {}  # empty before the first chunk
        self._shape = self._batch = torch.Size()
        self._partial_hop = self._fitted = self._sliders = torch.empty(0)
        for name, slider in {**aid.SLIDERS, **sliders}.items():
            setattr(self, name, slider)

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_") and name not in self._aid.SLIDERS:
            sliders = ", ".join(self._aid.SLIDERS) or "no sliders"
            aid = type(self._aid).__name__
            raise AttributeError(f"the stream of a {aid} has no slider {name}; it has {sliders}")
        super().__setattr__(name, value)

    def __call__(self, chunk: Tensor) -> Tensor:
        check_waveform(chunk, "chunk", full_scale_spl=self._aid.full_scale_spl)
        if not bool(chunk.isfinite().all()):
            raise ValueError("expected finite samples in a chunk, got NaN or infinity")
        with torch.no_grad(), torch.autocast(chunk.device.type, enabled=False):
            self._prepare(chunk)
            gain = gain_to_pascals(self._aid.full_scale_spl)
            samples = flatten_items(chunk, self._batch, self._fitted.dtype) * gain
            outputs = []
            while samples.shape[-1] > 0:
                count = HOP - self._partial_hop.shape[-1]
                if count == HOP <= samples.shape[-1]:
                    count = samples.shape[-1] // HOP * HOP
                    outputs.append(self._process_hops(samples[:, :count]))
                else:
                    outputs.append(self._process_partial_hop(samples[:, :count]))
                samples = samples[:, count:]
            output = soft_limit(torch.cat(outputs, -1), self._aid.limit_spl) / gain
            return output.reshape(*self._batch, -1).to(chunk.dtype)

    def flush(self) -> Tensor:
        """Return the output that is still missing because of the delay, and begin again.

        The next chunk is the beginning of another signal.

        Shape: -> (..., latency), with the leading dimensions of the chunks.
        """
        rest = self(self._fitted.new_zeros(*self._shape, DELAY))
        self._state = {}
        return rest

    def _prepare(self, chunk: Tensor) -> None:
        """Fit the aid to the ears with the first chunk, and read the sliders."""
        is_first = not self._state
        if is_first:
            self._shape = chunk.shape[:-1]
            self._batch, self._fitted = self._aid.prepare(chunk, self._audiogram)
        elif chunk.shape[:-1] != self._shape:
            raise ValueError(
                f"expected a chunk of shape {(*self._shape, 'time')} as before, "
                f"got {tuple(chunk.shape)}"
            )
        values = [getattr(self, name) for name in self._aid.SLIDERS]
        self._sliders = self._aid.stack_sliders(values, self._batch, self._fitted)
        if is_first:
            self._state = self._aid.initial_state(self._sliders)
            self._partial_hop = self._fitted.new_zeros(len(self._fitted), 0)

    def _process_hops(self, samples: Tensor) -> Tensor:
        output, _, self._state = self._aid.process_hops(
            samples, self._fitted, self._sliders, self._state
        )
        return output

    def _process_partial_hop(self, samples: Tensor) -> Tensor:
        """Process samples that do not go beyond the end of the current hop."""
        position = self._partial_hop.shape[-1]
        self._partial_hop = torch.cat((self._partial_hop, samples), -1)
        needed = 2 * DELAY + samples.shape[-1]
        padded = torch.cat((self._state["past"], self._partial_hop), -1)[:, -needed:]
        output = apply_gains(padded, self._state["gains"], position)
        if self._partial_hop.shape[-1] == HOP:
            self._process_hops(self._partial_hop)
            self._partial_hop = self._partial_hop[:, :0]
        return output
