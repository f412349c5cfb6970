"""Streams, in which a wearable aid processes chunks of any size."""

from __future__ import annotations

import torch
from torch import Tensor

from compensators.filter_bank import DELAY, HOP, RATE, apply_gains
from compensators.wearable import Slider, Wearable, check_slider
from hlsim.audiogram.thresholds import AudiogramLike, as_thresholds
from hlsim.calibration import gain_to_pascals
from hlsim.checks import check_waveform


class Stream:
    """Process chunks of any size, without gradients. The output has the size of the chunk.

    The output is delayed by ``aid.latency`` samples. The sliders of the aid, such as
    ``noise_reduction`` and ``amplification``, are attributes that may be set at any time: they move
    from end to end in 0.1 s, so that nothing clicks. For more than eight items, a chunk has nine
    samples or more, because a smaller one looks like an array with time first.

    Shape: (..., time) -> (..., time); the leading dimensions of all chunks are the same.

    Raises:
        ValueError: As the call of the aid, or the leading dimensions change, or samples are NaN or
            infinite, which would stay in the state. A rejected chunk changes nothing.
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
                f"expected a sample rate of {RATE} Hz for a stream, got {aid.sample_rate}; "
                "resampling would look 8.5 ms farther ahead"
            )
        as_thresholds(audiogram, consumer=type(aid).__name__)
        self._aid = aid
        # A copy, because the caller may write into a tensor, and the ear is read with each slider.
        self._audiogram = audiogram.clone() if isinstance(audiogram, Tensor) else audiogram
        self._state: dict[str, Tensor] = {}  # empty before the first chunk
        self._previous_sliders: list[Slider] = []
        self._shape = self._batch = torch.Size()
        self._partial_hop = self._fitted = self._sliders = torch.empty(0)
        for name, slider in sliders.items():
            items = slider.shape if isinstance(slider, Tensor) else torch.Size()
            check_slider(name, slider, items, torch.empty(0))
            setattr(self, name, slider)

    def __setattr__(self, name: str, value: Slider) -> None:
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
            samples = chunk.to(self._fitted.dtype).expand(*self._batch, -1)
            samples = samples.reshape(len(self._fitted), -1) * gain
            outputs = []
            while samples.shape[-1] > 0:
                time = samples.shape[-1]
                missing = HOP - self._partial_hop.shape[-1]
                if missing == HOP and time >= HOP:
                    count = time // HOP * HOP
                    outputs.append(self._process_hops(samples[:, :count]))
                else:
                    count = min(missing, time)
                    outputs.append(self._process_partial_hop(samples[:, :count]))
                samples = samples[:, count:]
            output = torch.cat(outputs, -1) / gain
            return output.reshape(*self._batch, -1).to(chunk.dtype)

    def flush(self) -> Tensor:
        """Return the last ``latency`` samples, and begin again: the next chunk follows silence.

        Raises:
            ValueError: No chunk was processed.
        """
        if not self._state:
            raise ValueError("expected a chunk before flush, got none")
        rest = self(self._fitted.new_zeros(*self._batch, DELAY))
        self._state = {}
        return rest

    def _prepare(self, chunk: Tensor) -> None:
        """Compute the parameters for the ear from the first chunk, and update the sliders."""
        is_first = not self._state
        if not is_first and chunk.shape[:-1] not in (self._shape, self._batch):
            raise ValueError(
                f"expected a chunk of shape {(*self._shape, 'time')} as before, "
                f"got {tuple(chunk.shape)}"
            )
        sliders = [getattr(self, name) for name in self._aid.SLIDERS]
        if is_first or not all(map(_is_same, sliders, self._previous_sliders)):
            self._batch, self._fitted, self._sliders = self._aid.prepare(
                chunk, self._audiogram, sliders
            )
            # These are copies, because the caller may write into a tensor.
            self._previous_sliders = [
                slider.clone() if isinstance(slider, Tensor) else slider for slider in sliders
            ]
        if is_first:
            self._shape = chunk.shape[:-1]
            self._state = self._aid.initial(self._sliders)
            self._partial_hop = self._fitted.new_zeros(len(self._fitted), 0)

    def _process_hops(self, samples: Tensor) -> Tensor:
        output, self._state = self._aid.step(samples, self._fitted, self._sliders, self._state)
        return output

    def _process_partial_hop(self, samples: Tensor) -> Tensor:
        """Process samples that do not go beyond the end of the current hop."""
        first = self._partial_hop.shape[-1]
        state = self._state
        self._partial_hop = torch.cat((self._partial_hop, samples), -1)
        needed = 2 * DELAY + samples.shape[-1]
        padded = torch.cat((state["past"], self._partial_hop), -1)[:, -needed:]
        output = self._aid.finish(apply_gains(padded, state["gains"], first))
        if self._partial_hop.shape[-1] == HOP:
            after = self._aid.advance(self._partial_hop, self._fitted, self._sliders, state)
            self._state = after | {"gains": after["gains"][:, -2:]}
            self._partial_hop = self._partial_hop[:, :0]
        return output


def _is_same(new: Slider, old: Slider) -> bool:
    if isinstance(new, Tensor):
        return isinstance(old, Tensor) and torch.equal(new, old)
    return new is old
