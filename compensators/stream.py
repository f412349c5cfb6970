"""A wearable aid while it is worn: chunks of any size, one after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from compensators.filter_bank import DELAY, HOP, apply_gains
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import gain_to_pascals
from hlsim.checks import check_waveform

Slider = float | Tensor
State = Mapping[str, Tensor]
"""What is kept from hop to hop, by name, (items, ...) each."""


class Worn(Protocol):
    """What a stream needs of an aid: ``compensators.wearable.Wearable`` says what each is."""

    SLIDERS: tuple[str, ...]
    full_scale_spl: float

    def prepare(
        self, waveform: Tensor, audiogram: AudiogramLike | None, sliders: Sequence[Slider]
    ) -> tuple[torch.Size, Tensor, Tensor]: ...

    def initial(self, sliders: Tensor) -> dict[str, Tensor]: ...

    def advance(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> dict[str, Tensor]: ...

    def step(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]: ...

    def finish(self, samples: Tensor) -> Tensor: ...


class Stream:
    """Called with chunks of any size from one sample, gives as many samples back, ``aid.latency`` late.

    Its sliders are attributes, ``noise_reduction`` and ``amplification`` where the aid has them, and may be set while it
    runs: they take 0.1 s from end to end, so that nothing clicks. Without gradients.

    Shape: (..., time) -> (..., time), the same leading dimensions every time.

    Raises:
        ValueError: as the aid's call, other leading dimensions than before, or samples that are NaN or infinite, which
            would stay in its state. What was refused changes nothing.
        AttributeError: a slider is set that the aid does not have.
    """

    def __init__(
        self, aid: Worn, audiogram: AudiogramLike | None, sliders: Mapping[str, Slider]
    ) -> None:
        self._aid, self._audiogram = aid, audiogram
        for name, slider in sliders.items():
            setattr(self, name, slider)
        self._state: dict[str, Tensor] = {}  # empty before the first chunk
        self._set: list[Slider] = []  # copies, for a tensor may be written into
        self._shape = self._batch = torch.Size()
        self._under_way = self._fitted = self._sliders = torch.empty(0)

    def __setattr__(self, name: str, value: object) -> None:
        if not name.startswith("_") and name not in (sliders := self._aid.SLIDERS):
            raise AttributeError(
                f"{name} of a {type(self._aid).__name__}'s stream; allowed: {', '.join(sliders) or 'nothing'}"
            )
        super().__setattr__(name, value)

    def __call__(self, chunk: Tensor) -> Tensor:
        check_waveform(chunk)
        if not bool(chunk.isfinite().all()):
            raise ValueError("chunk holds samples that are NaN or infinite; allowed: finite ones")
        with torch.no_grad(), torch.autocast(chunk.device.type, enabled=False):
            self._begin(chunk)
            gain = gain_to_pascals(self._aid.full_scale_spl)
            samples = (
                chunk.to(self._fitted.dtype).expand(*self._batch, -1).reshape(len(self._fitted), -1)
                * gain
            )
            outputs = []
            while left := samples.shape[-1]:
                if self._under_way.shape[-1] or left < HOP:
                    count = min(HOP - self._under_way.shape[-1], left)
                    outputs.append(self._within(samples[:, :count]))
                else:
                    count = left // HOP * HOP
                    output, self._state = self._aid.step(
                        samples[:, :count], self._fitted, self._sliders, self._state
                    )
                    outputs.append(output)
                samples = samples[:, count:]
            return (torch.cat(outputs, -1) / gain).reshape(*self._batch, -1).to(chunk.dtype)

    def flush(self) -> Tensor:
        """The last ``latency`` samples; what comes then is heard as after silence.

        Raises:
            ValueError: nothing has been given yet.
        """
        if not self._state:
            raise ValueError(
                "flush of a stream that was given nothing; allowed: after the first chunk"
            )
        rest = self(self._fitted.new_zeros(*self._batch, DELAY))
        self._state = {}
        return rest

    def _begin(self, chunk: Tensor) -> None:
        """Take the ear with the first chunk, and the sliders whenever they were set."""
        sliders = [getattr(self, name) for name in self._aid.SLIDERS]
        begun = bool(self._state)
        if begun and chunk.shape[:-1] not in (self._shape, self._batch):
            raise ValueError(
                f"a chunk of shape {tuple(chunk.shape)} after others of {(*self._shape, 'time')}; allowed: the same "
                "leading dimensions"
            )
        if not begun or not all(map(_same, sliders, self._set)):
            self._batch, self._fitted, self._sliders = self._aid.prepare(
                chunk, self._audiogram, sliders
            )
            self._set = [
                slider.clone() if isinstance(slider, Tensor) else slider for slider in sliders
            ]
        if not begun:
            self._shape = chunk.shape[:-1]
            self._state = self._aid.initial(self._sliders)
            self._under_way = self._fitted.new_zeros(len(self._fitted), 0)

    def _within(self, samples: Tensor) -> Tensor:
        """Samples of the hop that is under way."""
        place, state = self._under_way.shape[-1], self._state
        self._under_way = torch.cat((self._under_way, samples), -1)
        needed = 2 * DELAY + samples.shape[-1]
        padded = torch.cat((state["past"], self._under_way), -1)[:, -needed:]
        output = self._aid.finish(apply_gains(padded, state["gains"], place))
        if self._under_way.shape[-1] == HOP:
            after = self._aid.advance(self._under_way, self._fitted, self._sliders, state)
            self._state = after | {"gains": after["gains"][:, -2:]}
            self._under_way = self._under_way[:, :0]
        return output


def _same(new: Slider, old: Slider) -> bool:
    if isinstance(new, Tensor):
        return isinstance(old, Tensor) and torch.equal(new, old)
    return new is old
