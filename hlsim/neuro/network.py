"""Base class of the networks that process a waveform for an ear: calibration, rates and memory."""

import torch
from torch import Tensor, nn

from hlsim.audiogram.thresholds import AudiogramLike, resolve_thresholds
from hlsim.calibration import NEURO_RATE, check_full_scale, gain_to_pascals
from hlsim.checks import check_device, check_rate, check_waveform
from hlsim.dsp.overlap import split_into_blocks
from hlsim.dsp.resample import resample
from hlsim.neuro.config import NetworkConfig
from hlsim.torchtools import checkpointed, pair_items

# On a CPU, larger feature maps take time because the C library returns their memory to the system
# after each operation.
_CPU_SAMPLES = 128_000
"""Approximate number of samples at 16 kHz that run at once on a CPU."""

_DEVICE_SAMPLES = 960_000
"""Approximate number of samples at 16 kHz that run at once on a GPU.

It applies to each item, or with ``checkpoint`` to all items together.
"""


class EarNetwork(nn.Module):
    """Base class of networks from waveform and audiogram to waveform.

    The class converts the input to pascals at 16 kHz, and the output back to its scale and rate.
    Subclasses set ``config`` and implement ``process_items``.

    On a CPU, a few items run at a time. Long signals run in overlapping parts if a sample of the
    output depends on a limited part of the input (``cnn`` blocks, no normalisation). The parts
    change the output by rounding errors only, and limit the memory for long signals if no gradient
    is computed, or with ``checkpoint``.

    Args:
        sample_rate: Sample rate of inputs and outputs in Hz, from 16000 to 48000. Outputs contain
            the frequencies below 8 kHz only.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Attributes:
        checkpoint: Whether to use gradient checkpointing: activations are computed again in the
            backward pass, a few items or one part at a time, instead of stored. False by default.
        microphones: Number of signals per item. With more than 1, inputs have the shape (...,
            microphones, time), and the input of ``process_items`` (items, microphones, time).

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
        self.microphones = 1
        # receptive field in samples at 16 kHz of what a subclass adds to the layers of ``config``
        self._additional_field = 0

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None) -> Tensor:
        """Process waveforms for ears.

        Shape: (..., time) -> (..., time), with the leading dimensions of waveform and ears
            broadcast.

        Args:
            waveform: Input signals, where RMS 1.0 has the level ``full_scale_spl``.
            audiogram: One ear for all signals, or ears whose thresholds in dB HL, (..., 8),
                broadcast over the leading dimensions of the waveform. An ``Audiogram`` with other
                frequencies is interpolated to these eight (``Audiogram.thresholds``).

        Raises:
            ValueError: There is no audiogram, a threshold is outside -10 to 100 dB HL, shapes do
                not broadcast, or the waveform is not a floating-point tensor with time last, has no
                samples or one above 1e9 in magnitude, or is on another device than the weights. The
                values of tensors on a GPU are not validated.
        """
        check_waveform(waveform, full_scale_spl=self.full_scale_spl)
        weight = next(self.parameters())
        check_device(self, waveform.device)
        first = waveform if self.microphones == 1 else waveform[..., 0, :]
        thresholds = resolve_thresholds(None, audiogram, first)
        with torch.autocast(waveform.device.type, enabled=False):
            batch, signals, ears = pair_items(first, thresholds, weight.dtype)
            items = len(signals)
            if self.microphones > 1:
                all_signals = waveform.to(weight.dtype).expand(*batch, -1, -1)
                signals = all_signals.reshape(items, self.microphones, -1)
            if self.checkpoint or signals.device.type == "cpu":
                samples_per_item = NEURO_RATE * signals.shape[-1]
                items = max(1, _samples_at_once(signals) * self.sample_rate // samples_per_item)
            parts = zip(signals.split(items), ears.split(items), strict=True)
            outputs = [self._run(*part) for part in parts]
            return torch.cat(outputs).reshape(*batch, -1).to(waveform.dtype)

    def _run(self, signals: Tensor, ears: Tensor) -> Tensor:
        """Convert signals to pascals at 16 kHz, process them in blocks or whole, and convert back.

        Shape: (items, time), or (items, microphones, time), and (items, 8) in dB HL -> (items,
            time).
        """
        gain = gain_to_pascals(self.full_scale_spl)
        inputs = resample(signals * gain, self.sample_rate, NEURO_RATE)
        process = self.process_items
        if self.checkpoint:
            process = checkpointed(process)
        if self.receptive_field is None:
            output = process(inputs, ears)
        else:
            step, field = self.receptive_field
            hop = _samples_at_once(inputs)
            blocks = split_into_blocks(inputs.shape[-1], hop, field, field, step)
            outputs = [block.cut_output(process(block.cut_input(inputs), ears)) for block in blocks]
            output = torch.cat(outputs, -1)
        output = resample(output, NEURO_RATE, self.sample_rate)[..., : signals.shape[-1]]
        return self._finish(output) / gain

    @property
    def receptive_field(self) -> tuple[int, int] | None:
        """Step and receptive field in samples at 16 kHz; None if the field is the whole signal.

        Parts of a signal must start at multiples of the step. The receptive field is the number of
        input samples before and after an output sample that can influence it.
        """
        field = self.config.receptive_field
        return None if field is None else (self.config.step, field + self._additional_field)

    def process_items(self, signals: Tensor, ears: Tensor) -> Tensor:
        """Compute the output in pascals for signals in pascals at 16 kHz and ears in dB HL.

        A simulator's output is what the ear perceives. Subclasses implement this method.

        Shape: (items, time), (items, 8) -> (items, time); see ``microphones`` for several.
        """
        raise NotImplementedError

    def _finish(self, result: Tensor) -> Tensor:
        """Return the result, in pascals at the sample rate of the input, as it is.

        Subclasses may post-process it.

        Shape: (items, time) -> (items, time).
        """
        return result


def _samples_at_once(signals: Tensor) -> int:
    """Return the number of samples at 16 kHz to process at once on the signals' device."""
    return _CPU_SAMPLES if signals.device.type == "cpu" else _DEVICE_SAMPLES
