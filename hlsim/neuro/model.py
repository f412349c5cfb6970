"""Neuro-MSBG: the network that learned MSBG."""

import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES, SEVERITIES, severity_index
from hlsim.audiogram.thresholds import interpolate
from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.fft import power
from hlsim.msbg.recruitment import CATCH_UP_SPL
from hlsim.neuro.bands import BandCorrection
from hlsim.neuro.blocks import DualPathBlock
from hlsim.neuro.config import NEURO_RATE, NeuroConfig
from hlsim.neuro.decoders import MaskDecoder, PhaseDecoder
from hlsim.neuro.encoder import (
    AudiogramEncoder,
    DenseEncoder,
    FrameEncoder,
    log_magnitude,
    sine_of_phase,
)
from hlsim.neuro.network import EarNetwork
from hlsim.neuro.prior import Prior

_TINY = 1e-11


class NeuroMSBG(EarNetwork):
    """Waveform and audiogram to what the impaired ear hears, time-aligned.

    Magnitude, phase and encoded audiogram (Equation 1) enter as three channels, a dense encoder and dual-path blocks
    follow, and two decoders give a mask for the magnitude and a phase; the inverse transform makes a waveform. With
    ``config.prior``, MSBG's known gains come first and enter as a fourth channel, and the decoders correct them; with the
    structure ``bands`` a smaller network corrects them before they become a mask.

    ``torch.func.grad`` works with all blocks, and on a CPU second derivatives work with ``cnn`` and ``lstm`` blocks.

    Args:
        config: sizes and choices.
        sample_rate, full_scale_spl: as ``EarNetwork``.
        compute_prior: whether to compute MSBG's known gains, which takes half a second. With False they are undefined
            until a state dict is loaded.

    Raises:
        ValueError: a rate or level out of range, or a configuration of another kind.
    """

    emulates_msbg = True
    highest_frequency = NEURO_RATE / 2.0
    needs_exact_lengths = True

    config: NeuroConfig

    def __init__(
        self,
        config: NeuroConfig | None = None,
        *,
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
        compute_prior: bool = True,
    ) -> None:
        super().__init__(sample_rate, full_scale_spl)
        self.config = config = NeuroConfig.given(config)
        self.stft = config.stft
        # training may run the network, not the physics around it, in bfloat16
        self.autocast_dtype: torch.dtype | None = None
        self.prior = Prior(self.stft, compute_prior) if config.prior else None
        self.bands = BandCorrection(config) if config.structure == "bands" else None
        if self.bands is not None:
            return
        frequencies, channels = self.stft.frequencies, config.channels
        monolithic, normalise = config.structure == "monolithic", not config.level_aware
        encoded = config.audiogram == "channel"
        rows = frequencies + (0 if encoded else len(FREQUENCIES))
        inputs = 2 + encoded + config.prior
        depth = 0 if monolithic else config.dense_depth
        stride = (1, rows) if monolithic else config.stride
        self.audiogram_encoder = AudiogramEncoder(frequencies) if encoded else None
        self.encoder: nn.Module
        if monolithic:
            self.encoder = FrameEncoder(inputs, rows, channels)
        else:
            self.encoder = DenseEncoder(inputs, channels, depth, stride, normalise)
        blocks = (DualPathBlock(config, time_alone=monolithic) for _ in range(config.blocks))
        self.blocks = nn.ModuleList(blocks)
        self.mask_decoder = MaskDecoder(channels, depth, stride, normalise, config.prior)
        predicted = config.phase == "predicted"
        self.phase_decoder = PhaseDecoder(channels, depth, stride, normalise) if predicted else None
        self.severity = nn.Embedding(len(SEVERITIES), channels) if config.prior else None
        if self.severity is not None:
            nn.init.zeros_(self.severity.weight)

    @property
    def _receptive_field(self) -> tuple[int, int] | None:
        if self.config.receptive_field is None or not self.config.level_aware:
            return None
        known = self.prior.receptive_field if self.prior is not None else 0
        return self.config.step, self.config.receptive_field + known

    @property
    def _dtype(self) -> torch.dtype:
        return (self.mask_decoder.leave.weight if self.bands is None else self.bands.enter).dtype

    def _process(self, signals: Tensor, ears: Tensor) -> Tensor:
        scale = None
        if not self.config.level_aware:
            scale = signals.square().mean(-1, keepdim=True).add(_TINY).sqrt()
            signals = signals / scale
        severity = severity_index(ears)
        if self.prior is not None:
            signals = self.prior.filter(signals, severity)
        spectrum = self.stft.analyse(signals)
        if self.bands is not None and self.prior is not None:
            return self.stft.synthesise(
                self.bands(spectrum, ears, severity, self.prior), signals.shape[-1]
            )
        squared = power(spectrum)
        factor = self.prior(squared, ears, severity) if self.prior is not None else None
        features = self._features(spectrum, squared, ears, factor)
        size = (spectrum.shape[-2], spectrum.shape[-1])
        # of recruitment, ratio - 1, at the transform's frequencies
        exponents = CATCH_UP_SPL / (CATCH_UP_SPL - interpolate(ears, self.config.hz)) - 1.0
        lower = self.autocast_dtype
        with torch.autocast(
            signals.device.type, lower or torch.bfloat16, enabled=lower is not None
        ):
            features = self.encoder(features.contiguous(memory_format=torch.channels_last)).permute(
                0, 2, 3, 1
            )
            if self.severity is not None:
                features = features + self.severity(severity)[:, None, None]
            for block in self.blocks:
                features = block(features)
            features = features.permute(0, 3, 1, 2)
            log_mask = self.mask_decoder.log_mask(features, size, exponents).clamp(-12.0, 4.0)
            if self.phase_decoder is None:
                correction = log_mask.exp()
            else:
                correction = self.phase_decoder.factor(features, size, log_mask)
        if factor is not None:
            correction = factor * correction
        heard = self.stft.synthesise(spectrum * correction, signals.shape[-1])
        return heard if scale is None else heard * scale

    def _features(
        self, spectrum: Tensor, squared: Tensor, ears: Tensor, factor: Tensor | None
    ) -> Tensor:
        """The input channels.

        Shape: (items, frames, frequencies) twice, (items, 8) -> (items, 2 to 4, frames, rows).
        """
        if self.config.level_aware:
            channels = [log_magnitude(squared), sine_of_phase(spectrum, squared)]
        else:
            channels = [(squared + _TINY).sqrt(), torch.angle(spectrum)]
        if self.audiogram_encoder is not None:
            channels.append(self.audiogram_encoder(ears).unsqueeze(1).expand(squared.shape))
        if factor is not None:
            channels.append((power(factor) + 1e-12).log() / 4.0)
        features = torch.stack(channels, 1)
        if self.audiogram_encoder is not None:
            return features
        levels = (ears / 100.0)[:, None, None].expand(*features.shape[:3], -1)
        return torch.cat((features, levels), -1)
