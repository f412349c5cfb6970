"""What every network here does with a waveform and an ear before and after its work."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike, resolve_thresholds
from hlsim.calibration import check_full_scale, gain_to_pascals
from hlsim.checks import broadcast_shape, check_rate, check_waveform
from hlsim.dsp.overlap import split_into_blocks
from hlsim.dsp.resample import resample
from hlsim.neuro.config import NEURO_RATE, NetworkConfig

# Values of the widest feature map of all items that run together on a CPU, and the samples at 16 kHz that this is at
# least and at most. Larger maps the C library gives back to the system, and pays for their pages anew with every one; of
# smaller ones the steps from one to the next take longer than the sums.
_CPU_VALUES, _CPU_SAMPLES = 1_100_000, (16_000, 128_000)
_DEVICE_SAMPLES = 960_000  # of a long item that run together elsewhere


class EarNetwork(nn.Module):
    """Waveform and audiogram to waveform, in pascals at 16 kHz inside. Subclasses give ``config`` and ``_process``.

    On a CPU a few items run at a time. Long signals go through in overlapping blocks where the network looks no farther
    than these overlap (``cnn`` blocks): the output is the same, and without gradients memory grows by it alone.

    Args:
        sample_rate: of inputs and outputs in Hz, 16000 to 48000; inside it is 16000, so that only the band under 8 kHz
            of faster input comes back.
        full_scale_spl: level in dB SPL of RMS 1.0.

    Raises:
        ValueError: a rate or level out of range.
    """

    config: NetworkConfig

    def __init__(self, sample_rate: int, full_scale_spl: float) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)

    def forward(self, waveform: Tensor, audiogram: AudiogramLike) -> Tensor:
        """What the ear hears of a waveform, or is to be given.

        Shape: (..., time) and one audiogram or (..., 8) that broadcasts over the leading dimensions -> (..., time).

        Raises:
            ValueError: no audiogram, levels outside -10 to 100 dB HL, shapes that do not fit, or a waveform on another
                device than the weights.
        """
        check_waveform(waveform)
        weight = next(self.parameters(), None)  # replicas of nn.DataParallel list none
        if weight is not None and weight.device != waveform.device:
            raise ValueError(
                f"the waveform is on {waveform.device} and {type(self).__name__} on {weight.device}; allowed: the same "
                "device, move either with .to()"
            )
        thresholds = resolve_thresholds(None, audiogram, waveform, consumer=type(self).__name__)
        with torch.autocast(waveform.device.type, enabled=False):
            dtype = self._dtype
            batch = broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
            signals = waveform.to(dtype).expand(*batch, -1).reshape(-1, waveform.shape[-1])
            ears = thresholds.to(dtype).expand(*batch, -1).reshape(-1, len(FREQUENCIES))
            together = len(signals)
            if signals.device.type == "cpu" and not torch.compiler.is_compiling():
                together = max(
                    1, self._at_once * self.sample_rate // (NEURO_RATE * signals.shape[-1])
                )
            parts = zip(signals.split(together), ears.split(together), strict=True)
            result = torch.cat([self._run(some, theirs) for some, theirs in parts])
            return result.reshape(*batch, -1).to(waveform.dtype)

    def _run(self, signals: Tensor, ears: Tensor) -> Tensor:
        """``_process`` at the waveform's rate and level. Shape: (items, time), (items, 8) -> (items, time)."""
        gain = gain_to_pascals(self.full_scale_spl)
        result = self._in_blocks(resample(signals * gain, self.sample_rate, NEURO_RATE), ears)
        return (
            self._finish(resample(result, NEURO_RATE, self.sample_rate)[..., : signals.shape[-1]])
            / gain
        )

    def _in_blocks(self, signals: Tensor, ears: Tensor) -> Tensor:
        """``_process``, of long signals by blocks where that is the same. Shapes as ``_process``'s."""
        if self._receptive_field is None or torch.compiler.is_compiling():
            return self._process(signals, ears)
        unit, field = self._receptive_field
        hop = self._at_once if signals.device.type == "cpu" else _DEVICE_SAMPLES
        blocks = split_into_blocks(signals.shape[-1], hop, field, field, unit)
        outputs = [
            block.cut_output(self._process(block.cut_input(signals), ears)) for block in blocks
        ]
        return outputs[0] if len(outputs) == 1 else torch.cat(outputs, -1)

    @property
    def _at_once(self) -> int:
        """Samples at 16 kHz that run together on a CPU."""
        least, most = _CPU_SAMPLES
        return min(max(int(_CPU_VALUES / self.config.density), least), most)

    @property
    def _receptive_field(self) -> tuple[int, int] | None:
        """Samples of which blocks begin at multiples, and on how many to either side one depends; None if on all."""
        raise NotImplementedError

    @property
    def _dtype(self) -> torch.dtype:
        """Of the weights, by one that has a name: replicas of ``nn.DataParallel`` list none."""
        raise NotImplementedError

    def _process(self, signals: Tensor, ears: Tensor) -> Tensor:
        """Shape: (items, time) pascals at 16 kHz, (items, 8) dB HL -> (items, time)."""
        raise NotImplementedError

    def _finish(self, result: Tensor) -> Tensor:
        """The last step, in pascals at the output's rate. Shape: (items, time) -> the same."""
        return result
