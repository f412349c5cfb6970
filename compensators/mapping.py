"""The paper's compensator: Neuro-MSBG's family, with a magnitude path that maps instead of masking."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from compensators.config import MappingConfig
from compensators.limiter import soft_limit
from compensators.nalr import nalr_gains_db
from hlsim.audiogram.thresholds import interpolate
from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.erb import erb_number
from hlsim.dsp.fft import power
from hlsim.neuro.blocks import DualPathBlock
from hlsim.neuro.config import NEURO_RATE
from hlsim.neuro.decoders import Decoder, PhaseDecoder
from hlsim.neuro.encoder import AudiogramEncoder, DenseEncoder, log_magnitude, sine_of_phase
from hlsim.neuro.network import EarNetwork
from hlsim.torchtools import constant_like

_NEPER_DB = 20.0 / math.log(10.0)


class MappingCompensator(EarNetwork):
    """Waveform and audiogram to what the impaired ear is to be given, time-aligned and limited.

    Log magnitude, encoded audiogram (Equation 1) and the prescribed gain enter as channels; a dense encoder and dual-path
    blocks follow, and a decoder gives the log magnitude of the output. It is the input's plus the prescription
    ``config.start`` plus the network's correction, which is smooth over time and frequency and 0 before training. Started
    from no gain and free at every frequency, training ends below NAL-R: a band that is not heard has almost no gradient.
    With ``config.phase`` "predicted" the phase enters too, and another decoder shifts it; otherwise it stays.

    The level counts, in pascals, and nothing is normalised. The output is softly limited at ``config.limit_spl``.

    Args:
        config: sizes and choices.
        sample_rate, full_scale_spl: as ``EarNetwork``.

    Raises:
        ValueError: a rate or level out of range, or a configuration of another kind.
    """

    config: MappingConfig

    def __init__(
        self,
        config: MappingConfig | None = None,
        *,
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
    ) -> None:
        super().__init__(sample_rate, full_scale_spl)
        self.config = config = MappingConfig.from_optional(config)
        self.stft = config.stft
        size, depth, stride = config.channels, config.dense_depth, config.stride
        self.audiogram_encoder = AudiogramEncoder(self.stft.frequencies)
        predicted = config.phase == "predicted"
        self.encoder = DenseEncoder(4 if predicted else 3, size, depth, stride, normalise=False)
        self.blocks = nn.ModuleList(DualPathBlock(config) for _ in range(config.blocks))
        self.magnitude_decoder = Decoder(size, 1, depth, stride, normalise=False)
        self.phase_decoder = (
            PhaseDecoder(size, depth, stride, normalise=False) if predicted else None
        )

    def start_gains_db(self, thresholds: Tensor) -> Tensor:
        """Gain before training at the transform's frequencies. Shape: (items, 8) dB HL -> (items, frequencies) dB."""
        start = self.config.start
        gains = (
            nalr_gains_db(thresholds)
            if start == "nalr"
            else float(start) * thresholds.clamp_min(0.0)
        )
        return interpolate(gains, self.config.hz)

    def extra_repr(self) -> str:
        return f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}, start={self.config.start!r}"

    @property
    def _receptive_field(self) -> tuple[int, int] | None:
        if self.config.receptive_field is None:
            return None
        steady = self.config.step - self.config.hop
        return self.config.step, self.config.receptive_field + steady

    @property
    def _dtype(self) -> torch.dtype:
        return self.magnitude_decoder.leave.weight.dtype

    def _finish(self, result: Tensor) -> Tensor:
        # last of all, for resampling can overshoot
        return soft_limit(result, 10.0 ** ((self.config.limit_spl - PASCAL_SPL) / 20.0))

    def _process(self, signals: Tensor, ears: Tensor) -> Tensor:
        spectrum = self.stft.analyse(signals)
        start = self.start_gains_db(ears) / _NEPER_DB
        features = self._features(spectrum, ears, start)
        features = self.encoder(features.contiguous(memory_format=torch.channels_last)).permute(
            0, 2, 3, 1
        )
        for block in self.blocks:
            features = block(features)
        features = features.permute(0, 3, 1, 2)
        size = (spectrum.shape[-2], spectrum.shape[-1])
        # log magnitude out = log magnitude in + gain, so that silence stays silent and needs no logarithm
        gain = start.unsqueeze(1) + self._correction(features, size)
        factor = (
            gain.exp()
            if self.phase_decoder is None
            else self.phase_decoder.factor(features, size, gain)
        )
        return self.stft.synthesise(spectrum * factor, signals.shape[-1])

    def _correction(self, features: Tensor, size: tuple[int, int]) -> Tensor:
        """Correction in nepers, smooth over time and frequency.

        Shape: (items, channels, ...) -> (items, frames, frequencies).
        """
        bands = self.config.bands, self.config.fft
        into, out_of = (
            constant_like(features, weights, *bands) for weights in (_into_bands, _out_of_bands)
        )
        levels = self.magnitude_decoder(features, size).squeeze(1) @ into
        smooth = _steady(torch.tanh(levels), self.config.stride[0])
        return smooth @ out_of * (self.config.reach_db / _NEPER_DB)

    def _features(self, spectrum: Tensor, ears: Tensor, start: Tensor) -> Tensor:
        """The input channels. Shape: (items, frames, frequencies), ... -> (items, 3 or 4, frames, frequencies)."""
        squared = power(spectrum)
        channels = [log_magnitude(squared)]
        if self.phase_decoder is not None:
            channels.append(sine_of_phase(spectrum, squared))
        channels += [self.audiogram_encoder(ears).unsqueeze(1), start.unsqueeze(1)]
        return torch.stack([channel.expand(squared.shape) for channel in channels], 1)


def _steady(levels: Tensor, stride: int) -> Tensor:
    """Twice the mean of ``stride`` frames: what the patches of a decoder have alike, with any steady input, goes.

    Shape: (items, frames, bands) -> the same.
    """
    padded = functional.pad(levels.mT, (stride - 1, stride - 1), mode="replicate")
    return functional.avg_pool1d(functional.avg_pool1d(padded, stride, 1), stride, 1).mT


def _out_of_bands(count: int, fft: int) -> NDArray[np.float64]:
    """Weights from bands to frequencies, by straight lines between the bands' centres. Returns (count, frequencies).

    The centres lie evenly on the ERB-number scale from 100 Hz to 8 kHz.
    """
    places = erb_number(np.arange(fft // 2 + 1) * NEURO_RATE / fft)
    lowest, highest = erb_number(np.array([100.0, NEURO_RATE / 2.0]))
    centres = np.linspace(lowest, highest, count)
    return np.stack([np.interp(places, centres, row) for row in np.eye(count)])


def _into_bands(count: int, fft: int) -> NDArray[np.float64]:
    """Weights from frequencies to bands, a mean of each. Returns (frequencies, count)."""
    out_of = _out_of_bands(count, fft)
    return (out_of / out_of.sum(1, keepdims=True).clip(1e-6)).T
