"""The short-time Fourier transform and its inverse, for models and criteria."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.fft import rfft
from hlsim.torchtools import constant


@dataclass(frozen=True)
class STFT:
    """A short-time Fourier transform (STFT): spectra of short, overlapping frames of a signal.

    Frames are multiplied by a Hann window, and the first one is centred on the first sample.
    Samples before the beginning and after the end of a signal count as zeros.

    Args:
        fft: Length of the Fourier transform in samples, an even number.
        window: Length of the Hann window in samples, at most ``fft``.
        hop: Number of samples from one frame to the next, at most half of ``window``. If spectra
            are modified before synthesis, choose a quarter of ``window`` or less: with longer hops,
            the last samples may be divided by a number close to zero.

    Raises:
        ValueError: The lengths do not fit together.

    >>> stft = STFT(fft=400, window=400, hop=100)
    >>> waveform = torch.randn(1, 1600)
    >>> spectrum = stft.analyse(waveform)
    >>> spectrum.shape
    torch.Size([1, 17, 201])
    >>> torch.allclose(stft.synthesise(spectrum, 1600), waveform, atol=1e-5)
    True
    """

    fft: int = 400
    window: int = 400
    hop: int = 100

    def __post_init__(self) -> None:
        if not 0 < 2 * self.hop <= self.window <= self.fft or self.fft % 2:
            raise ValueError(
                "expected 2 * hop <= window <= fft with an even fft and a positive hop, got "
                f"fft={self.fft}, window={self.window}, hop={self.hop}"
            )

    @property
    def frequencies(self) -> int:
        """Number of frequencies of a frame's spectrum, ``fft // 2 + 1``."""
        return self.fft // 2 + 1

    def analyse(self, waveform: Tensor) -> Tensor:
        """Compute the spectrum of each frame of waveforms.

        The result equals that of ``torch.stft`` with a Hann window and ``pad_mode="constant"``,
        with its last two dimensions swapped.

        Shape: (items, time) -> complex (items, time // hop + 1, frequencies).
        """
        margin = self.fft - self.window
        margin_before = margin // 2
        margin_after = margin - margin_before
        half = self.fft // 2
        padded = functional.pad(waveform, (half - margin_before, half - margin_after))
        windowed = padded.unfold(-1, self.window, self.hop) * _hann(self.window, like=waveform)
        return rfft(functional.pad(windowed, (margin_before, margin_after)))

    def synthesise(self, spectrum: Tensor, length: int) -> Tensor:
        """Compute waveforms from the spectra of their frames, the inverse of ``analyse``.

        The result equals that of ``torch.istft``, which exports to an ONNX graph with an index that
        onnxruntime rejects.

        Shape: complex (items, frames, frequencies) -> (items, length).

        Args:
            spectrum: Spectra of the frames.
            length: Number of samples of the result, that of the waveforms that were analysed.
        """
        window = _hann(self.window, like=spectrum)
        margin_before = (self.fft - self.window) // 2
        frames = torch.fft.irfft(spectrum, self.fft)
        windowed = frames[..., margin_before : margin_before + self.window] * window
        weights = window.square().expand(1, spectrum.shape[-2], -1)
        start = self.fft // 2 - margin_before
        total = self._overlap_add(windowed)[:, start : start + length]
        total_weight = self._overlap_add(weights)[:, start : start + length]
        return total / total_weight

    def _overlap_add(self, frames: Tensor) -> Tensor:
        """Add frames that begin one hop apart.

        Each frame is zero-padded and cut into parts of one hop. Part p of frame k belongs to hop
        k + p of the result.

        Shape: (items, frames, window) -> (items, (frames - 1 + parts) * hop).
        """
        parts = -(-self.window // self.hop)
        padded = functional.pad(frames, (0, parts * self.hop - self.window))
        rows = padded.unflatten(-1, (parts, self.hop))
        delayed = [
            functional.pad(rows[:, :, part], (0, 0, part, parts - 1 - part))
            for part in range(parts)
        ]
        return sum(delayed[1:], start=delayed[0]).flatten(1)


@constant
def _hann(points: int) -> NDArray[np.float64]:
    """Compute a periodic Hann window of shape (points,)."""
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(points) / points)
