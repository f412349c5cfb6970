"""The short-time Fourier transform and its inverse, for models and criteria alike."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.fft import rfft
from hlsim.torchtools import constant_like


@dataclass(frozen=True)
class STFT:
    """A short-time Fourier transform with a Hann window, centred frames and zeros beyond the ends.

    Args:
        fft: points of the transform; fft // 2 + 1 frequencies.
        window: samples of the Hann window, at most ``fft``.
        hop: samples from frame to frame, at most half of ``window``; a quarter where spectra are changed and then
            synthesised, or the last samples may be divided by almost nothing.

    Raises:
        ValueError: lengths that do not fit together.
    """

    fft: int = 400
    window: int = 400
    hop: int = 100

    def __post_init__(self) -> None:
        if not 0 < 2 * self.hop <= self.window <= self.fft or self.fft % 2:
            raise ValueError(
                f"STFT of fft {self.fft}, window {self.window}, hop {self.hop}; allowed: 2 hop <= window <= fft, fft even"
            )

    @property
    def frequencies(self) -> int:
        return self.fft // 2 + 1

    def analyse(self, waveform: Tensor) -> Tensor:
        """Spectrum. Shape: (items, time) -> complex (items, frames, frequencies), frames = time // hop + 1."""
        # as torch.stft, whose gradient takes half as long again
        side, before = self.fft // 2, (self.fft - self.window) // 2
        behind = self.fft - self.window - before
        padded = functional.pad(waveform, (side - before, side - behind))
        windowed = padded.unfold(-1, self.window, self.hop) * self._hann(waveform)
        return rfft(functional.pad(windowed, (before, behind)))

    def synthesise(self, spectrum: Tensor, length: int) -> Tensor:
        """Waveform by overlap-add. Shape: complex (items, frames, frequencies) -> (items, length)."""
        # as torch.istft, which takes longer, and of which ONNX gets an index that its runtime refuses
        window, before = self._hann(spectrum.real), (self.fft - self.window) // 2
        frames = torch.fft.irfft(spectrum, self.fft)[..., before : before + self.window] * window
        weights = window.square().expand(1, spectrum.shape[-2], -1)
        kept = slice(self.fft // 2 - before, self.fft // 2 - before + length)
        return self._overlap_add(frames)[:, kept] / self._overlap_add(weights)[:, kept]

    def _overlap_add(self, frames: Tensor) -> Tensor:
        """Shape: (items, frames, window) -> (items, time)."""
        items, count, window = frames.shape
        parts = -(
            -window // self.hop
        )  # of a frame, each added to the next part of the frame before
        if window % self.hop:
            frames = functional.pad(frames, (0, parts * self.hop - window))
        rows = frames.reshape(items, count, parts, self.hop).transpose(1, 2)
        # zeros after each row, and rows that are one shorter than that: each begins one place later than the one before
        places = count + parts - 1
        late = functional.pad(rows, (0, 0, 0, parts)).flatten(1, 2)[:, : parts * places]
        return late.reshape(items, parts, places, self.hop).sum(1).flatten(1)

    def _hann(self, like: Tensor) -> Tensor:
        return constant_like(like, _hann, self.window)


def _hann(points: int) -> NDArray[np.float64]:
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(points) / points)
