"""Neuro-MSBG, a neural network that emulates MSBG, and a function that loads trained networks."""

import math
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES, SEVERITIES, severity_index
from hlsim.calibration import NEURO_RATE, PASCAL_SPL
from hlsim.checkpoint import SIMULATOR, HubModel, read_checkpoint, read_record
from hlsim.checks import check_rate
from hlsim.dsp.fft import power
from hlsim.dsp.interpolation import interpolate
from hlsim.msbg.recruitment import CATCH_UP_SPL
from hlsim.neuro.bands import BandCorrection
from hlsim.neuro.blocks import DualPathBlock
from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.decoders import Decoder, phase_factor
from hlsim.neuro.encoder import (
    AudiogramEncoder,
    DenseEncoder,
    log_magnitude,
    sine_of_phase,
)
from hlsim.neuro.family.frames import FrameEncoder
from hlsim.neuro.frame_grid import (
    FILTERS_FIELD,
    FRAME_PERIOD,
    FRAME_RATE,
    FRAMES_PER_PERIOD,
    analyse_frames,
    from_frame_rate,
    synthesise_frames,
    to_frame_rate,
)
from hlsim.neuro.network import EarNetwork
from hlsim.neuro.prior import BandGains, Prior
from hlsim.torchtools import built_in_float32

POWER_FLOOR = 1e-11
"""Number that is added to powers before square roots, so that gradients are finite."""

MIN_LOG_MASK = -12.0
"""Smallest natural logarithm of the network's factor on a magnitude."""

MAX_LOG_MASK = 4.0
"""Largest natural logarithm of the network's factor on a magnitude."""


class NeuroMSBG(EarNetwork, HubModel):
    """Simulator of an impaired ear: a neural network that emulates MSBG, but faster.

    MSBG is the simulation of hearing loss by Moore, Stone, Baer and Glasberg. The output is the
    sound that the ear perceives, time-aligned with the input. The network multiplies the
    spectrogram of the input by a complex factor at each point. A call takes a waveform and an
    audiogram, see ``forward``.

    With the default structure, ``bands``, MSBG's own formulae estimate the gains in its frequency
    channels, and a small network corrects them. With the structures of the paper, the input
    channels are magnitude, phase and the encoded audiogram. An encoder and dual-path blocks (layers
    along time, then along frequency) follow, and two decoders predict the magnitude and the phase
    of the factor. With ``config.prior``, they predict a correction, by which the estimate of MSBG's
    gains is multiplied. The estimate is then an additional input channel.

    ``torch.func.grad`` works with all networks. First derivatives are exact, and so are second
    derivatives with ``cnn`` blocks and, on a CPU, with ``lstm`` blocks. Where there is no second
    derivative, computing one raises RuntimeError.

    Source: the Neuro-MSBG paper, Section II-A and Equation 1.

    Args:
        config: Sizes and choices, by default ``NeuroConfig()``.
        sample_rate: Sample rate of inputs and outputs in Hz, from 16000 to 48000. Outputs contain
            the frequencies below 8 kHz only.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.
        compute_prior: Compute the constants of MSBG's formulae, which takes 0.2 s for the first
            default network, and up to 2 s with a longer transform. With False, they are NaN until a
            state dict is loaded.

    Attributes:
        emulates_msbg: True, because the simulator emulates MSBG.
        highest_frequency: Highest frequency of outputs in Hz, 8000.
        needs_exact_lengths: True, because silence after the end of a signal changes its output.
        teacher: Name of the simulator from which a loaded network has learned, if it is recorded.

    Raises:
        ValueError: The rate or the level is out of range, or ``config`` is not a ``NeuroConfig``.

    >>> simulator = NeuroMSBG(NeuroConfig(channels=8, blocks=1))
    >>> simulator(torch.randn(2, 16000), "N3").shape
    torch.Size([2, 16000])
    """

    emulates_msbg = True
    highest_frequency = NEURO_RATE / 2.0
    needs_exact_lengths = True
    teacher = ""
    kind = SIMULATOR
    config_class = NeuroConfig
    build_options: ClassVar = {"compute_prior": False}

    config: NeuroConfig

    def __new__(cls, config: NeuroConfig | None = None, **options: Any) -> Self:
        # ``NeuroMSBG(config)`` is an object of the subclass for the structure of the configuration.
        kind: type = cls
        if cls is NeuroMSBG:
            is_bands = NeuroConfig.resolve(config).structure == "bands"
            kind = BandNeuroMSBG if is_bands else DualPathNeuroMSBG
        return super().__new__(kind)

    def __init__(
        self,
        config: NeuroConfig | None = None,
        *,
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
        compute_prior: bool = True,
    ) -> None:
        super().__init__(sample_rate, full_scale_spl)
        self.config = config = NeuroConfig.resolve(config)
        self.stft = config.stft
        # Training may run the network in bfloat16, but not the prior and the transforms.
        self.autocast_dtype: torch.dtype | None = None
        self.prior = self._build_prior(compute_prior)
        if self.prior is not None:
            self._additional_field = self.prior.receptive_field

    def _build_prior(self, compute: bool) -> BandGains | None:
        """Build the estimate of MSBG's gains, if the settings have a prior.

        Args:
            compute: Compute its constants. With False, they are NaN until a state dict is loaded.
        """
        return Prior(self.stft, compute) if self.config.prior else None


class BandNeuroMSBG(NeuroMSBG):
    """Neuro-MSBG of the structure ``bands``, which corrects the gains in MSBG's channels.

    Args:
        config: Sizes and choices, by default ``NeuroConfig()``.
        options: Keyword arguments of ``NeuroMSBG``.

    >>> BandNeuroMSBG(NeuroConfig(channels=8))(torch.randn(1600), "N3").shape
    torch.Size([1600])
    """

    prior: BandGains

    @built_in_float32
    def __init__(self, config: NeuroConfig | None = None, **options: Any) -> None:
        super().__init__(config, **options)
        self.bands = BandCorrection(self.config)
        self._additional_field += FILTERS_FIELD

    @property
    def receptive_field(self) -> tuple[int, int] | None:
        field = super().receptive_field
        # A part of a signal begins with a step of the network, not only with a frame.
        frames = self.config.stride[0]
        periods = frames // math.gcd(frames, FRAMES_PER_PERIOD)
        return field and (periods * FRAME_PERIOD, field[1])

    def _build_prior(self, compute: bool) -> BandGains:
        return BandGains(self.stft, FRAME_RATE, compute)

    def process_items(self, signals: Tensor, ears: Tensor) -> Tensor:
        severity = severity_index(ears)
        cochlear = to_frame_rate(signals)
        spectrum = analyse_frames(cochlear)
        real, imaginary = self.bands(spectrum, ears, severity, self.prior)
        perceived = synthesise_frames(real, imaginary, cochlear.shape[-1])
        return from_frame_rate(perceived, severity, signals.shape[-1])


class DualPathNeuroMSBG(NeuroMSBG):
    """Neuro-MSBG of the structures ``dual-path`` and ``monolithic``: encoder, blocks and decoders.

    Args:
        config: Sizes and choices, with one of these structures.
        options: Keyword arguments of ``NeuroMSBG``.

    >>> config = NeuroConfig(structure="dual-path", channels=8)
    >>> DualPathNeuroMSBG(config)(torch.randn(1600), "N3").shape
    torch.Size([1600])
    """

    prior: Prior | None

    @built_in_float32
    def __init__(self, config: NeuroConfig | None = None, **options: Any) -> None:
        super().__init__(config, **options)
        config = self.config
        frequencies = self.stft.frequencies
        channels = config.channels
        is_monolithic = config.structure == "monolithic"
        normalise = not config.level_aware
        encodes_audiogram = config.audiogram == "channel"
        rows = frequencies if encodes_audiogram else frequencies + len(FREQUENCIES)
        inputs = 2 + encodes_audiogram + config.prior
        depth = 0 if is_monolithic else config.dense_depth
        stride = (1, rows) if is_monolithic else config.stride
        self.audiogram_encoder = AudiogramEncoder(frequencies) if encodes_audiogram else None
        self.encoder: nn.Module
        if is_monolithic:
            self.encoder = FrameEncoder(inputs, rows, channels)
        else:
            self.encoder = DenseEncoder(inputs, channels, depth, stride, normalise)
        blocks = (DualPathBlock(config, time_alone=is_monolithic) for _ in range(config.blocks))
        self.blocks = nn.ModuleList(blocks)
        sizes = channels, depth, stride
        self.mask_decoder = Decoder(*sizes, 1 + config.prior, normalise)
        is_predicted = config.phase == "predicted"
        self.phase_decoder = Decoder(*sizes, 2, normalise) if is_predicted else None
        self.severity = nn.Embedding(len(SEVERITIES), channels) if config.prior else None
        if self.severity is not None:
            nn.init.zeros_(self.severity.weight)

    def process_items(self, signals: Tensor, ears: Tensor) -> Tensor:
        if self.config.level_aware:
            return self._simulate(signals, ears)
        rms = signals.square().mean(-1, keepdim=True).add(POWER_FLOOR).sqrt()
        return self._simulate(signals / rms, ears) * rms

    def _simulate(self, signals: Tensor, ears: Tensor) -> Tensor:
        """Compute what ears perceive. The output has the scale of the input.

        Shape: (items, time), (items, 8) -> (items, time).

        Args:
            signals: Signals in pascals, or scaled to an RMS of 1 unless the network is level-aware.
            ears: Thresholds in dB HL.
        """
        samples = signals.shape[-1]
        severity = severity_index(ears)
        if self.prior is not None:
            signals = self.prior.filter(signals, severity)
        spectrum = self.stft.analyse(signals)
        powers = power(spectrum)
        prior_factor = self.prior(powers, ears, severity) if self.prior is not None else None
        features = self._features(spectrum, powers, ears, prior_factor)
        factor = self._correction(features, ears, severity)
        if prior_factor is not None:
            factor = prior_factor * factor
        return self.stft.synthesise(spectrum * factor, samples)

    def _features(
        self, spectrum: Tensor, powers: Tensor, ears: Tensor, prior_factor: Tensor | None
    ) -> Tensor:
        """Compute the input channels of the encoder.

        Args:
            spectrum: Complex spectrogram. Shape: (items, frames, frequencies).
            powers: Squared magnitude of the spectrogram. Shape: (items, frames, frequencies).
            ears: Thresholds in dB HL. Shape: (items, 8).
            prior_factor: Complex factor of the prior, (items, frames, frequencies), or None.

        Returns:
            Log magnitude and sine of the phase (magnitude and phase unless ``config.level_aware``)
            and, depending on the configuration, encoded audiogram and log gain of the prior. Shape:
            (items, 2 to 4, frames, rows), where rows are the frequencies, followed by the eight
            thresholds in units of 100 dB HL if ``config.audiogram`` is ``"concatenated"``.
        """
        if self.config.level_aware:
            channels = [log_magnitude(powers), sine_of_phase(spectrum, powers)]
        else:
            channels = [(powers + POWER_FLOOR).sqrt(), torch.angle(spectrum)]
        if self.audiogram_encoder is not None:
            channels.append(self.audiogram_encoder(ears).unsqueeze(1).expand(powers.shape))
        if prior_factor is not None:
            channels.append((power(prior_factor) + 1e-12).log() / 4.0)
        features = torch.stack(channels, 1)
        if self.audiogram_encoder is not None:
            return features
        levels = (ears / 100.0)[:, None, None].expand(*features.shape[:3], -1)
        return torch.cat((features, levels), -1)

    def _correction(self, features: Tensor, ears: Tensor, severity: Tensor) -> Tensor:
        """Predict the factor by which the spectrogram is multiplied, besides that of the prior.

        Shape: (items, 2 to 4, frames, rows), (items, 8), (items,) -> complex (items, frames,
            frequencies), or real if ``config.phase`` is ``"input"``.

        Args:
            features: Input channels from ``_features``.
            ears: Thresholds in dB HL.
            severity: Degree of loss of each ear, 0 (none) to 3 (severe).
        """
        size = features.shape[2], self.stft.frequencies
        device = features.device.type
        enabled = self.autocast_dtype is not None
        with torch.autocast(device, self.autocast_dtype, enabled=enabled):
            encoded = self.encoder(features.contiguous(memory_format=torch.channels_last))
            hidden = encoded.permute(0, 2, 3, 1)
            if self.severity is not None:
                hidden = hidden + self.severity(severity)[:, None, None]
            for block in self.blocks:
                hidden = block(hidden)
            hidden = hidden.permute(0, 3, 1, 2)
            maps = self.mask_decoder(hidden, size).to(ears.dtype)
            log_mask = maps[:, -1]
            if self.prior is not None:
                # Errors of the prior's envelope are in proportion to the recruitment of the ear.
                ratios = CATCH_UP_SPL / (
                    CATCH_UP_SPL - interpolate(ears, FREQUENCIES, self.config.hz)
                )
                log_mask = maps[:, 0] * (ratios - 1.0).unsqueeze(1) + log_mask
            log_mask = log_mask.clamp(MIN_LOG_MASK, MAX_LOG_MASK)
            if self.phase_decoder is None:
                return log_mask.exp()
            return phase_factor(self.phase_decoder(hidden, size), log_mask)


def load_pretrained(
    name: str | Path, *, sample_rate: int = NEURO_RATE, full_scale_spl: float = PASCAL_SPL
) -> NeuroMSBG:
    """Load a trained Neuro-MSBG in evaluation mode, whose weights do not require a gradient.

    Nothing is downloaded.

    Args:
        name: Name of a checkpoint that ships with hlsim, such as ``"neuro-msbg"``, or the folder of
            a checkpoint or of a training run. ``hlsim.list_pretrained`` lists the names.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Raises:
        ValueError: There is no such checkpoint, it is damaged, it is no simulator, or the rate or
            the level is out of range.

    >>> import torch
    >>> load_pretrained("neuro-msbg")(torch.randn(2, 16000), "N3").shape
    torch.Size([2, 16000])
    """
    check_rate(sample_rate)
    levels: dict[str, Any] = {"sample_rate": sample_rate, "full_scale_spl": full_scale_spl}
    model: NeuroMSBG = read_checkpoint(name, [NeuroMSBG], **levels)
    record = read_record(name).get("about") or {}
    model.teacher = str(record.get("teacher", ""))
    return model
