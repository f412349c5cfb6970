"""The compensator of the Neuro-MSBG paper, whose gains change over time and frequency."""

import math
import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from compensators.aid import Aid
from compensators.config import MappingConfig
from compensators.limiter import soft_limit
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.prescription import nalr_gains_db
from hlsim.audiogram.thresholds import AudiogramLike, check_two_channels
from hlsim.calibration import NEURO_RATE, PASCAL_SPL
from hlsim.checkpoint import HubModel
from hlsim.checks import check_settings, check_waveform
from hlsim.dsp.erb import erb_number
from hlsim.dsp.fft import power
from hlsim.dsp.interpolation import interpolate, interpolation_weights
from hlsim.neuro.blocks import DualPathBlock
from hlsim.neuro.decoders import Decoder, phase_factor
from hlsim.neuro.encoder import AudiogramEncoder, DenseEncoder, log_magnitude, sine_of_phase
from hlsim.neuro.network import EarNetwork
from hlsim.torchtools import built_in_float32, constant

NEPER_DB = 20.0 / math.log(10.0)
"""One neper in dB."""

PHASE_POWER_FLOOR = 1e-9
"""Power of a point of a spectrogram below which the phase between microphones fades."""

LOWEST_CENTRE = 100.0
"""Centre of the lowest band of the correction in Hz."""


class MappingCompensator(Aid, EarNetwork, HubModel):
    """A trainable aid for whole signals: a network that amplifies each point of the spectrogram.

    In dB, the gain at a time and a frequency is that of the prescription NAL-R plus a correction by
    the network, which is smooth over time and frequency. The network gets the log magnitude of the
    input (with a predicted phase also its phase), the audiogram and the prescribed gain. It has the
    encoder, dual-path blocks and decoder of Neuro-MSBG. Training needs the prescription: an
    inaudible band has almost no gradient, and without a prescription the trained network is worse
    than NAL-R.

    The output is time-aligned with the input, and has its phase, which a second decoder shifts if
    ``config.phase`` is "predicted". Gains depend on the level of the input, because nothing is
    normalised. The output is softly limited at ``config.limit_spl``.

    With several microphones per ear, the input has the shape (..., microphones, time) for one ear,
    or (..., microphones, 2, time) for two. The first microphone is the reference. A third decoder
    computes a complex weight for each other microphone, time and frequency, with which its signal
    is added to that of the reference (filter and sum). The network then also gets the levels and
    phases of these signals relative to the reference. Before training, the weights are 0.

    Args:
        audiogram: One or more ears, which are used by all calls that pass none.
        config: Sizes and choices, by default ``MappingConfig()``.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. Outputs contain the
            frequencies below 8 kHz only.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Attributes:
        highest_frequency: Highest frequency of outputs in Hz.
        takes_microphones: Whether there are several microphones.
        ears: Number of ears with several microphones.

    Raises:
        ValueError: A rate or level is out of range, an ear is not valid, or ``config`` is not a
            ``MappingConfig``.

    >>> import hlsim
    >>> model = MappingCompensator("N3", MappingConfig(channels=8, blocks=1))
    >>> model(hlsim.example_speech()).shape
    torch.Size([64320])
    """

    highest_frequency = NEURO_RATE / 2.0
    kind = "mapping-compensator"
    config_class = MappingConfig

    config: MappingConfig

    @check_settings
    @built_in_float32
    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        config: MappingConfig | None = None,
        *,
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
    ) -> None:
        EarNetwork.__init__(self, sample_rate, full_scale_spl)
        self.store_ears(audiogram)
        self.config = config = MappingConfig.resolve(config)
        self.stft = config.stft
        sizes = config.channels, config.dense_depth, config.stride
        is_predicted = config.phase == "predicted"
        self.microphones = config.microphones
        self.takes_microphones = config.microphones > 1
        self.ears = config.ears
        further_microphones = config.microphones - 1
        inputs = (4 if is_predicted else 3) + 3 * further_microphones
        self.audiogram_encoder = AudiogramEncoder(self.stft.frequencies)
        self.encoder = DenseEncoder(inputs, *sizes, normalise=False)
        self.blocks = nn.ModuleList(DualPathBlock(config) for _ in range(config.blocks))
        self.magnitude_decoder = Decoder(*sizes, outputs=1, normalise=False)
        self.phase_decoder = None
        if is_predicted:
            self.phase_decoder = Decoder(*sizes, outputs=2, normalise=False)
        self.weight_decoder = None
        if self.takes_microphones:
            self.weight_decoder = Decoder(*sizes, outputs=2 * further_microphones, normalise=False)
        # The gains are averaged over one point of the feature maps.
        self._additional_field = config.step - config.hop

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """Return the output for whole signals, see ``Aid.forward``.

        Raises:
            ValueError: See ``Aid.forward``; or there is another number of microphones or ears.

        Shape: (..., time) -> (..., time); with several microphones, (..., microphones, time) ->
            (..., time), or (..., microphones, 2, time) -> (..., 2, time).
        """
        if self.takes_microphones:
            waveform = self._arrange_microphones(waveform)
        elif audiogram is None and self._two_ears:
            check_two_channels(waveform)
        ears = self.thresholds if audiogram is None else audiogram
        return EarNetwork.forward(self, waveform, ears)

    def _arrange_microphones(self, waveform: Tensor) -> Tensor:
        """Validate the signals of several microphones, and move the microphones next to time.

        Shape: (..., microphones, time) -> the same; for two ears (..., microphones, 2, time) ->
            (..., 2, microphones, time).

        Raises:
            ValueError: See ``check_waveform``; or there is another number of microphones or ears.
        """
        check_waveform(waveform)
        expected = (self.microphones, 2)[: self.config.ears]
        if waveform.shape[-1 - len(expected) : -1] != expected:
            numbers = ", ".join(map(str, expected))
            raise ValueError(
                f"expected signals of {self.microphones} microphones per ear, (..., {numbers}, "
                f"time), got shape {tuple(waveform.shape)}; pass the microphones that the "
                "compensator was trained with, the reference first"
            )
        return waveform.transpose(-3, -2) if len(expected) == 2 else waveform

    def _finish(self, result: Tensor) -> Tensor:
        # The limit is the last step, because resampling can overshoot.
        return soft_limit(result, self.config.limit_spl)

    def process_items(self, signals: Tensor, ears: Tensor) -> Tensor:
        spectra = self.stft.analyse(signals.reshape(-1, signals.shape[-1]))
        spectra = spectra.unflatten(0, (-1, self.microphones))
        spectrum, other_spectra = spectra[:, 0], spectra[:, 1:]
        start = interpolate(nalr_gains_db(ears), FREQUENCIES, self.config.hz) / NEPER_DB
        features = self._features(spectrum, ears, start)
        if self.takes_microphones:
            features = torch.cat((features, _relative_features(spectrum, other_spectra)), 1)
        features = features.contiguous(memory_format=torch.channels_last)
        features = self.encoder(features).permute(0, 2, 3, 1)
        for block in self.blocks:
            features = block(features)
        features = features.permute(0, 3, 1, 2)
        size = (spectrum.shape[-2], spectrum.shape[-1])
        if self.weight_decoder is not None:
            real, imaginary = self.weight_decoder(features, size).chunk(2, 1)
            spectrum = spectrum + (torch.complex(real, imaginary) * other_spectra).sum(1)
        # The output is the input times a gain, so that silence stays silent and needs no logarithm.
        gain = start.unsqueeze(1) + self._correction(features, size)
        if self.phase_decoder is None:
            factor = gain.exp()
        else:
            factor = phase_factor(self.phase_decoder(features, size), gain)
        return self.stft.synthesise(spectrum * factor, signals.shape[-1])

    def _amplify(self, signals: Tensor, ears: Tensor) -> Tensor:
        if self.takes_microphones:
            warnings.warn(
                f"gains of an aid with {self.microphones} microphones are measured with the same "
                "signal at all of them; its gains for recordings depend on where sounds come from",
                stacklevel=4,  # the caller of ``gains``, which is decorated
            )
            signals = signals.unsqueeze(1).expand(-1, self.microphones, -1)
        return self.process_items(signals, ears)

    def _correction(self, features: Tensor, size: tuple[int, int]) -> Tensor:
        """Return the correction of NAL-R's gain in nepers, smooth over time and frequency.

        It lies between plus and minus ``config.reach_db`` dB.

        Args:
            features: Features after the last block, on the coarser grid of the encoder. Shape:
                (items, channels, times, frequencies).
            size: Number of frames and of frequencies of the spectrum.

        Returns:
            Correction. Shape: (items, frames, frequencies).
        """
        bands = self.config.bands, self.config.fft
        into_bands = _into_bands(*bands, like=features)
        out_of_bands = _out_of_bands(*bands, like=features)
        levels = self.magnitude_decoder(features, size).squeeze(1) @ into_bands
        smooth = _average_over_stride(torch.tanh(levels), self.config.stride[0])
        return smooth @ out_of_bands * (self.config.reach_db / NEPER_DB)

    def _features(self, spectrum: Tensor, ears: Tensor, start: Tensor) -> Tensor:
        """Return the input channels of the encoder.

        They are: log magnitude; with a predicted phase, the sine of the phase; encoded audiogram;
        and NAL-R's gain.

        Args:
            spectrum: Spectrum of the input.
            ears: Thresholds in dB HL.
            start: NAL-R's gain at each frequency in nepers.

        Shape: complex (items, frames, frequencies), (items, 8), (items, frequencies)
            -> (items, 3 or 4, frames, frequencies).
        """
        squared = power(spectrum)
        channels = [log_magnitude(squared)]
        if self.phase_decoder is not None:
            channels.append(sine_of_phase(spectrum, squared))
        channels += [self.audiogram_encoder(ears).unsqueeze(1), start.unsqueeze(1)]
        return torch.stack([channel.expand(squared.shape) for channel in channels], 1)


def _relative_features(reference: Tensor, signals: Tensor) -> Tensor:
    """Return features of signals relative to the reference: ratios, then cosines and sines.

    A ratio is half the natural logarithm of the ratio of magnitudes (``log_magnitude``). Cosines
    and sines are those of the difference in phase, and fade to 0 in silence.

    Shape: complex (items, frames, frequencies), complex (items, signals, frames, frequencies)
        -> (items, 3 * signals, frames, frequencies).
    """
    first, squared = power(reference).unsqueeze(1), power(signals)
    cross = signals * reference.unsqueeze(1).conj()
    phase = cross * (first * squared + PHASE_POWER_FLOOR**2).rsqrt()
    ratio = log_magnitude(squared) - log_magnitude(first)
    return torch.cat((ratio, phase.real, phase.imag), 1)


def _average_over_stride(levels: Tensor, stride: int) -> Tensor:
    """Average twice over ``stride`` frames, so that gains for steady input are steady.

    The decoder's output has a pattern that repeats every ``stride`` frames. Before the averages,
    the first and the last frame are repeated.

    Shape: (items, frames, bands) -> the same.
    """
    padded = functional.pad(levels.mT, (stride - 1, stride - 1), mode="replicate")
    return functional.avg_pool1d(functional.avg_pool1d(padded, stride, 1), stride, 1).mT


@constant
def _out_of_bands(count: int, fft: int) -> NDArray[np.float64]:
    """Return weights that interpolate from bands to frequencies, linearly over ERB number.

    The centres of the bands are evenly spaced in ERB numbers from 100 Hz to 8 kHz. Frequencies
    below 100 Hz get the value of the lowest band.

    Args:
        count: Number of bands.
        fft: Length of the Fourier transform at 16 kHz.

    Returns: Weights, (count, fft // 2 + 1).
    """
    positions = erb_number(np.arange(fft // 2 + 1) * NEURO_RATE / fft)
    lowest, highest = erb_number(np.array([LOWEST_CENTRE, NEURO_RATE / 2.0]))
    centres = np.linspace(lowest, highest, count)
    return interpolation_weights(centres, positions)


@constant
def _into_bands(count: int, fft: int) -> NDArray[np.float64]:
    """Return weights that average frequencies into bands. Shape: -> (fft // 2 + 1, count)."""
    weights = _out_of_bands(count, fft)
    return (weights / weights.sum(1, keepdims=True).clip(1e-6)).T
