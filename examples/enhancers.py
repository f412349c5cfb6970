"""Enhancers of others before an aid: ``hlsim evaluate-compensator ... --enhancer examples.enhancers:RNNoise``.

An enhancer takes ``(waveform, sample_rate)``, (..., time) in pascals where RMS 1.0 is 94 dB SPL, and returns a waveform
as long and time-aligned: take its delay off here, and its latency is measured as what it looks ahead.
"""

import numpy as np
import torch
from torch import Tensor

from hlsim.dsp.resample import resample


class RNNoise:
    """RNNoise (Valin 2018, arXiv 1709.08243) with the weights in the wheel: ``pip install pyrnnoise``."""

    RATE = 48000
    DELAY = 960  # samples: 20 ms, measured with speech

    def __call__(self, waveform: Tensor, sample_rate: int) -> Tensor:
        signals = resample(waveform.reshape(-1, waveform.shape[-1]), sample_rate, self.RATE)
        enhanced = torch.stack([self._enhance(signal.numpy()) for signal in signals])
        return resample(enhanced, self.RATE, sample_rate)[:, : waveform.shape[-1]].reshape(waveform.shape)

    def _enhance(self, signal: np.ndarray) -> Tensor:
        """Shape: (time,) -> (time,)."""
        from pyrnnoise.rnnoise import FRAME_SIZE, create, destroy, process_mono_frame

        peak = max(1.0, float(np.abs(signal).max()))  # it takes 16-bit samples
        frames = np.pad(signal / peak, (0, self.DELAY + -(len(signal) + self.DELAY) % FRAME_SIZE))
        state = create()
        made = [process_mono_frame(state, frame)[0] for frame in frames.reshape(-1, FRAME_SIZE)]
        destroy(state)
        late = np.concatenate(made)[self.DELAY : self.DELAY + len(signal)]
        return torch.from_numpy(late.astype(np.float32) / 32767.0 * peak)
