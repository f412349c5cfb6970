"""What every wearable aid is: gains in bands, by frames that have been, on a direct path of 4 ms; whole or streamed."""

from __future__ import annotations

from collections.abc import Sequence

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
from compensators.limiter import soft_limit
from compensators.stream import Slider, State, Stream
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import (
    AudiogramLike,
    as_thresholds,
    check_two_channels,
    resolve_thresholds,
)
from hlsim.calibration import PASCAL_SPL, check_full_scale, gain_to_pascals
from hlsim.checks import broadcast_shape, check_rate, check_waveform, is_finite
from hlsim.dsp.resample import resample

_GLIDE = 0.04  # of a slider's way, a hop at most: 0.1 s from end to end
_BLOCK = 320_000  # samples of all items that run together, and the least of one's: memory, for the output is the same
_RESAMPLED = 136  # samples at 16 kHz on which resampling there and back looks ahead


class Wearable(nn.Module):
    """Subclasses give ``SLIDERS``, ``fit``, ``start`` and ``control``.

    A direct path splits the signal into bands that sum to it, 4 ms late, multiplies each with its gain and adds them. The
    gains come from frames of 16 ms every 4 ms that end where the direct path is, so that the output, aligned with the
    input, looks ``DELAY`` samples ahead and no farther; they go linearly from frame to frame. The whole call and the
    stream run the same ``step``.

    Args:
        sample_rate: of inputs and outputs in Hz, 16000 to 48000. The bands end at 8 kHz; what faster input has above gets
            the gain of the highest, and only whole signals go through: resampling looks 8.5 ms farther ahead.
        full_scale_spl: level in dB SPL of RMS 1.0.
        linked: of two ears, (..., 2, time), the mean power at both sets the gains of each: ears that are fitted alike get
            the same gains, so that differences of level between them stay. The limit of the output is each ear's own.

    Raises:
        ValueError: a rate or level out of range; of a call, with ``linked``, another shape.
    """

    SLIDERS: tuple[str, ...] = ()
    bands: int
    limit_spl: float

    def __init__(self, sample_rate: int, full_scale_spl: float, linked: bool = False) -> None:
        super().__init__()
        self.linked = linked
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)

    @property
    def latency(self) -> int:
        """Samples that the output, which is aligned with the input, looks ahead: what a stream's output is late."""
        return (
            DELAY
            if self.sample_rate == RATE
            else -(-(DELAY + _RESAMPLED) * self.sample_rate // RATE)
        )

    def fit(self, thresholds: Tensor) -> Tensor:
        """What is needed of the ears. Shape: (items, 8) dB HL -> (items, n)."""
        raise NotImplementedError

    def start(self, items: int, like: Tensor) -> dict[str, Tensor]:
        """The state of ``control`` after silence."""
        raise NotImplementedError

    def control(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Gain in dB of each band at the end of each frame, and the state after them.

        Shape: (items, frames, FRAME / 2 + 1) of ``frame_power``, (items, n), (items, frames, sliders) -> (items, frames,
        bands).
        """
        raise NotImplementedError

    def initial(self, sliders: Tensor) -> dict[str, Tensor]:
        """The state after silence. Shape: (items, sliders) -> (items, ...) each."""
        items = len(sliders)
        past, gains = sliders.new_zeros(items, HISTORY), sliders.new_zeros(items, 2, self.bands)
        return {"past": past, "gains": gains, "gliding": sliders, **self.start(items, sliders)}

    def advance(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> dict[str, Tensor]:
        """The state after whole hops; its ``gains`` are all that the hops had, and the next one's.

        Shape: (items, hops * HOP) pascals, (items, n), (items, sliders).
        """
        padded = torch.cat((state["past"], samples), -1)
        powers = frame_power(padded)
        if self.linked:
            powers = powers.unflatten(0, (-1, 2)).mean(1).repeat_interleave(2, 0)
        gliding = _glide(state["gliding"], sliders, powers.shape[1])
        gains_db, kept = self.control(powers, fitted, gliding, state)
        gains = torch.cat((state["gains"], 10.0 ** (gains_db / 20.0) - 1.0), 1)
        return {"past": padded[:, -HISTORY:], "gains": gains, "gliding": gliding[:, -1], **kept}

    def step(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Whole hops, ``DELAY`` samples late, and the state after them.

        Shape: (items, hops * HOP) pascals, (items, n), (items, sliders) -> (items, hops * HOP).
        """
        output, _, after = self._amplified(samples, fitted, sliders, state)
        return self.finish(output), after

    def _amplified(
        self, samples: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """As ``step`` without the limit, and the highest band's gains, less 1. Shape: ... -> ..., (items, hops)."""
        after = self.advance(samples, fitted, sliders, state)
        gains = after["gains"]
        padded = torch.cat((state["past"][:, -2 * DELAY :], samples), -1)
        return (
            apply_gains(padded, gains[:, :-1]),
            gains[:, 2:, -1],
            after | {"gains": gains[:, -2:]},
        )

    def finish(self, samples: Tensor) -> Tensor:
        """The last step, in pascals, sample by sample. Any shape."""
        return soft_limit(samples, 10.0 ** ((self.limit_spl - PASCAL_SPL) / 20.0))

    def whole(
        self, waveform: Tensor, audiogram: AudiogramLike | None, sliders: Sequence[Slider]
    ) -> Tensor:
        """Shape: (..., time) and one audiogram or (..., 8) that broadcasts over the leading dimensions -> (..., time)."""
        check_waveform(waveform)
        with torch.autocast(waveform.device.type, enabled=False):
            batch, fitted, settings = self.prepare(waveform, audiogram, sliders)
            time, gain = waveform.shape[-1], gain_to_pascals(self.full_scale_spl)
            signals = waveform.to(fitted.dtype).expand(*batch, -1).reshape(-1, time) * gain
            low = resample(signals, self.sample_rate, RATE)
            ours = low.shape[-1]
            state, outputs, highest = self.initial(settings), [], [low.new_zeros(len(low), 1)]
            padded = nn.functional.pad(low, (0, DELAY + -(ours + DELAY) % HOP))
            for block in padded.split(max(1, _BLOCK // (len(low) * HOP)) * HOP, -1):
                output, gains, state = self._amplified(block, fitted, settings, state)
                outputs.append(output)
                highest.append(gains)
            result = resample(
                torch.cat(outputs, -1)[:, DELAY : DELAY + ours], RATE, self.sample_rate
            )
            if self.sample_rate != RATE:
                above = signals - resample(low, RATE, self.sample_rate)[:, :time]
                gains = gain_at_rate(torch.cat(highest, -1), self.sample_rate, time)
                result = result[:, :time] + (1.0 + gains) * above
            result = self.finish(result)
            return (result / gain).reshape(*batch, time).to(waveform.dtype)

    def streamed(self, audiogram: AudiogramLike | None, sliders: Sequence[Slider]) -> Stream:
        if self.sample_rate != RATE:
            raise ValueError(
                f"a stream at {self.sample_rate} Hz; allowed: {RATE}, for resampling looks 8.5 ms ahead, beyond the 5 ms"
            )
        set_to = dict(zip(self.SLIDERS, sliders, strict=True))
        for name, slider in set_to.items():  # before the first chunk, which has the items' number
            items = slider.shape if isinstance(slider, Tensor) else torch.Size()
            check_slider(name, slider, items, torch.empty(0))
        as_thresholds(self._given(audiogram), consumer=type(self).__name__)
        # it is asked for again when a slider moves, and a tensor may have been written into
        return Stream(
            self, audiogram.clone() if isinstance(audiogram, Tensor) else audiogram, set_to
        )

    def prepare(
        self, waveform: Tensor, audiogram: AudiogramLike | None, sliders: Sequence[Slider]
    ) -> tuple[torch.Size, Tensor, Tensor]:
        """The leading dimensions of all together, what is needed of the ears, and the sliders.

        Shape: (..., time), (..., 8), (...) each -> (...), (items, n), (items, sliders).
        """
        given = self._given(audiogram)
        thresholds = resolve_thresholds(None, given, waveform, consumer=type(self).__name__)
        own = next((weight.dtype for weight in self.parameters()), waveform.dtype)
        dtype = torch.promote_types(own, torch.float32)
        batch = broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
        if self.linked:
            check_two_channels(waveform)
        settings = [
            check_slider(name, slider, batch, thresholds).expand(batch)
            for name, slider in zip(self.SLIDERS, sliders, strict=True)
        ]
        ears = thresholds.to(dtype).expand(*batch, -1).reshape(-1, len(FREQUENCIES))
        stacked = torch.stack(settings, -1) if settings else ears.new_zeros(*batch, 0)
        return batch, self.fit(ears), stacked.to(dtype).reshape(len(ears), -1)

    def _given(self, audiogram: AudiogramLike | None) -> AudiogramLike:
        if audiogram is None:
            raise ValueError(
                f"no audiogram: give one with each call, {type(self).__name__} holds none"
            )
        return audiogram


def check_slider(name: str, slider: Slider, batch: torch.Size, like: Tensor) -> Tensor:
    """Return a slider as a tensor of the type and on the device of another one.

    The values of a tensor on a GPU are not read, because the host would wait for the GPU. Those that are out of range
    become NaN.

    Raises:
        ValueError: values outside 0 to 1, or a shape that does not broadcast over the items.
    """
    if not (is_finite(slider) or (isinstance(slider, Tensor) and not slider.is_complex())):
        raise ValueError(f"{name} is {slider!r}; allowed: a number or a tensor, 0 to 1")
    if isinstance(slider, Tensor):
        setting = slider.to(like.device, like.dtype, non_blocking=like.device.type != "cpu")
    else:
        setting = like.new_full((), torch.as_tensor(slider).item())
    if isinstance(slider, Tensor) and slider.device.type != "cpu":
        setting = torch.where((setting >= 0.0) & (setting <= 1.0), setting, torch.nan)
    elif not bool(((torch.as_tensor(slider) >= 0.0) & (torch.as_tensor(slider) <= 1.0)).all()):
        raise ValueError(f"{name} is {slider!r}; allowed: 0 to 1")
    if setting.ndim > len(batch) or any(
        own not in (1, size) for own, size in zip(setting.shape[::-1], batch[::-1], strict=False)
    ):
        raise ValueError(
            f"{name} has shape {tuple(setting.shape)} for items {tuple(batch)}; allowed: one, or one an item"
        )
    return setting


def _glide(now: Tensor, target: Tensor, frames: int) -> Tensor:
    """Sliders on their way, so that no jump clicks. Shape: (items, n) twice -> (items, frames, n)."""
    most = _GLIDE * torch.arange(1, frames + 1, dtype=now.dtype, device=now.device).unsqueeze(-1)
    way = (target - now).unsqueeze(1)
    return now.unsqueeze(1) + torch.minimum(torch.maximum(way, -most), most)
