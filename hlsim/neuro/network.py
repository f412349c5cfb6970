"""Base class of the networks that process a waveform for an ear: calibration, rates and memory."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from hlsim.audiogram.thresholds import AudiogramLike, resolve_thresholds
from hlsim.calibration import check_full_scale, gain_to_pascals
from hlsim.checks import broadcast_shape, check_rate, check_waveform
from hlsim.dsp.overlap import split_into_blocks
from hlsim.dsp.resample import resample
from hlsim.neuro.config import NEURO_RATE, NetworkConfig
from hlsim.torchtools import flatten_items

# On a CPU, larger feature maps take time because the C library returns their memory to the system
# after each operation. For smaller ones, the overhead of each operation exceeds its computation.
_CPU_VALUES = 1_100_000
"""Number of values of the widest feature map that run at once on a CPU."""

_MIN_CPU_SAMPLES = 16_000
"""Smallest number of samples at 16 kHz that run at once on a CPU."""

_MAX_CPU_SAMPLES = 128_000
"""Largest number of samples at 16 kHz that run at once on a CPU."""

_DEVICE_SAMPLES = 960_000
"""Samples of a long item, or with ``checkpoint`` of all items, that run at once elsewhere."""


class EarNetwork(nn.Module):
    """Base class of networks from waveform and audiogram to waveform.

    The class converts the input to pascals at 16 kHz, and the output back to its scale and rate.
    Subclasses set ``config`` and implement ``_process``.

    On a CPU, a few items run at a time. Long signals run in overlapping parts if a sample of the
    output depends on a limited part of the input (``cnn`` blocks). This changes no output, and
    limits the memory for signals of any length if no gradient is computed.

    Args:
        sample_rate: Sample rate of inputs and outputs in Hz, from 16000 to 48000. Outputs contain
            the frequencies below 8 kHz only.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0.

    Attributes:
        checkpoint: Whether activations are computed again in the backward pass, a few items or one
            part at a time, instead of being stored. False by default.

    Raises:
        ValueError: The rate or the level is out of range.

    >>> from hlsim import NeuroMSBG
    >>> isinstance(NeuroMSBG(), EarNetwork)
    True
    """

    config: NetworkConfig

    def __init__(self, sample_rate: int, full_scale_spl: float) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.checkpoint = False

    def forward(self, waveform: Tensor, audiogram: AudiogramLike) -> Tensor:
        """Process waveforms for ears.

        Shape: (..., time) -> (..., time).

        Args:
            waveform: Input signals.
            audiogram: One ear for all signals, or ears whose shape (..., 8) in dB HL broadcasts
                over the leading dimensions of the waveform. Of an ``Audiogram`` with other
                frequencies, the network gets ``Audiogram.thresholds``, the eight interpolated ones.

        Raises:
            ValueError: There is no audiogram, a threshold is outside -10 to 100 dB HL, shapes do
                not broadcast, or the waveform is on another device than the weights.
        """
        check_waveform(waveform, full_scale_spl=self.full_scale_spl)
        # Replicas of nn.DataParallel list no parameters.
        weight = next(self.parameters(), None)
        if weight is not None and weight.device != waveform.device:
            raise ValueError(
                f"expected the waveform on {weight.device}, the device of {type(self).__name__}, "
                f"got {waveform.device}; move either with .to()"
            )
        thresholds = resolve_thresholds(None, audiogram, waveform, consumer=type(self).__name__)
        with torch.autocast(waveform.device.type, enabled=False):
            dtype = self._dtype
            batch = broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
            signals = flatten_items(waveform, batch, dtype)
            ears = flatten_items(thresholds, batch, dtype)
            items = self._items_at_once(signals)
            outputs = [
                self._run(item_signals, item_ears)
                for item_signals, item_ears in zip(
                    signals.split(items), ears.split(items), strict=True
                )
            ]
            return torch.cat(outputs).reshape(*batch, -1).to(waveform.dtype)

    def _items_at_once(self, signals: Tensor) -> int:
        """Return the number of items that run at once."""
        on_cpu = signals.device.type == "cpu"
        if torch.compiler.is_compiling() or not (on_cpu or self.checkpoint):
            return len(signals)
        samples_per_item = NEURO_RATE * signals.shape[-1]
        samples = self._samples_at_once if on_cpu else _DEVICE_SAMPLES
        return max(1, samples * self.sample_rate // samples_per_item)

    def _run(self, signals: Tensor, ears: Tensor) -> Tensor:
        """Convert to pascals at 16 kHz, process, and convert back.

        Shape: (items, time), (items, 8) -> (items, time).
        """
        gain = gain_to_pascals(self.full_scale_spl)
        output = self._run_blocks(resample(signals * gain, self.sample_rate, NEURO_RATE), ears)
        output = resample(output, NEURO_RATE, self.sample_rate)[..., : signals.shape[-1]]
        return self._finish(output) / gain

    def _run_blocks(self, signals: Tensor, ears: Tensor) -> Tensor:
        """Process long signals in parts if the receptive field is limited, and others at once.

        Shape: (items, time), (items, 8) -> (items, time).
        """
        process = self._process
        if self.checkpoint:
            # The networks draw no random numbers, whose state need not be stored.
            process = partial(checkpoint, process, use_reentrant=False, preserve_rng_state=False)
        if self._receptive_field is None or torch.compiler.is_compiling():
            return process(signals, ears)
        step, field = self._receptive_field
        hop = self._samples_at_once if signals.device.type == "cpu" else _DEVICE_SAMPLES
        blocks = split_into_blocks(signals.shape[-1], hop, field, field, step)
        outputs = [block.cut_output(process(block.cut_input(signals), ears)) for block in blocks]
        return outputs[0] if len(outputs) == 1 else torch.cat(outputs, -1)

    @property
    def _samples_at_once(self) -> int:
        """Number of samples at 16 kHz that run at once on a CPU."""
        samples = int(_CPU_VALUES / self.config.density)
        return min(max(samples, _MIN_CPU_SAMPLES), _MAX_CPU_SAMPLES)

    @property
    def _receptive_field(self) -> tuple[int, int] | None:
        """Step and receptive field in samples at 16 kHz; None if the field is the whole signal.

        Parts of a signal must start at multiples of the step. The receptive field is the number of
        samples before and after a sample of the output on which it depends.
        """
        raise NotImplementedError

    @property
    def _dtype(self) -> torch.dtype:
        """Precision of a weight. Replicas of ``nn.DataParallel`` have weights, but list none."""
        raise NotImplementedError

    def _process(self, signals: Tensor, ears: Tensor) -> Tensor:
        """Process signals in pascals at 16 kHz for ears in dB HL.

        Shape: (items, time), (items, 8) -> (items, time).
        """
        raise NotImplementedError

    def _finish(self, result: Tensor) -> Tensor:
        """Return the output in pascals from the result at the sample rate of the input.

        Shape: (items, time) -> (items, time).
        """
        return result
