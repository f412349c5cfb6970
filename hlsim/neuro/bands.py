"""A small network that corrects the prior's gains, at a lower cost than the paper's networks.

The prior (``hlsim.neuro.prior``) estimates the gain in each channel of MSBG's filter bank by MSBG's
formulae. The network works on channels, and on *steps* of a few frames of the spectrogram.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audiogram import SEVERITIES
from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.prior import CHANNELS, BandGains
from hlsim.neuro.smearing import Planes, power, smear_and_amplify

MAX_SLOPE = 6.0
"""Limit of the difference between the natural logarithms of envelopes of neighbouring channels."""


class BandCorrection(nn.Module):
    """Network that simulates MSBG on a spectrogram, by correcting the gains of the prior.

    The spectrogram is smeared and multiplied by the corrected gains of MSBG's channels. The inputs
    of the network are the fluctuation of each channel's log level about its log envelope (the
    smoothed level), and the difference between the log envelopes of neighbouring channels. Neither
    changes with the level of a signal far above silence. The network predicts a correction of each
    channel's envelope, and a factor for its gain.

    The degrees of hearing loss, or severities, have different filter banks in MSBG. Each severity
    has its own weights. Before training the last layer is 0, and the gains are those of the prior.

    Args:
        config: Settings of which these are used: ``channels``, the width of the network;
            ``blocks``, the number of its blocks; ``stride[0]``, the number of frames per step;
            ``kernel[0]``, the length of the convolutions in steps; and ``expansion``.

    >>> from hlsim.audiogram import severity_index
    >>> config = NeuroConfig(channels=8)
    >>> network = BandCorrection(config)
    >>> spectrum = torch.randn(2, 50, 97), torch.randn(2, 50, 97)
    >>> ears = torch.full((2, 8), 40.0)
    >>> gains = BandGains(config.stft, rate=16537.5)
    >>> real, imaginary = network(spectrum, ears, severity_index(ears), gains)
    >>> real.shape
    torch.Size([2, 50, 97])
    """

    def __init__(self, config: NeuroConfig) -> None:
        super().__init__()
        width = config.channels
        severities = len(SEVERITIES)
        self.step = config.stride[0]
        inputs = (self.step + 1) * CHANNELS
        self.enter = nn.Parameter(
            torch.randn(severities, width, inputs) / (2.0 * math.sqrt(inputs))
        )
        self.bias = nn.Parameter(torch.zeros(severities, width, 1))
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.blocks))
        self.leave = nn.Parameter(torch.zeros(severities, 2 * CHANNELS, width))

    def forward(self, spectrum: Planes, ears: Tensor, severity: Tensor, prior: BandGains) -> Planes:
        """Compute the spectrogram that ears perceive.

        Shape: (items, frames, frequencies) twice, (items, 8), (items,) -> (items, frames,
            frequencies) twice.

        Args:
            spectrum: Real and imaginary parts of the spectra of MSBG's frames in Pa, see
                ``hlsim.neuro.frame_grid``.
            ears: Thresholds in dB HL.
            severity: Degree of loss of each ear, 0 (none) to 3 (severe).
            prior: Estimate of MSBG's smearing and gains for these frames.
        """
        smeared_power = prior.smear_powers(power(*spectrum), severity)
        levels = prior.channel_levels(smeared_power, severity)
        log_envelope = prior.smooth(levels, severity, self.step).log()
        features = self._features(levels.log(), log_envelope)
        features = self.enter[severity] @ features
        features = features + self.bias[severity]
        for block in self.blocks:
            features = block(features, severity)

        outputs = self.leave[severity] @ features
        envelope_correction, gain_correction = outputs.split(CHANNELS, 1)
        log_gain = prior.log_gain(log_envelope + envelope_correction, ears, severity)
        gains = (log_gain + gain_correction).exp()
        # The last gains remain after the first frame of the last step.
        gains = torch.cat((gains, gains[..., -1:]), -1).mT.contiguous()
        matrices = prior.factor_matrices(severity)
        return smear_and_amplify(spectrum, smeared_power, gains, matrices, self.step)

    def _features(self, log_levels: Tensor, log_envelope: Tensor) -> Tensor:
        """Compute the input of the network: fluctuations, and differences of log envelopes.

        The last frame is repeated where the last step is incomplete.

        Shape: (items, channels, frames), (items, channels, steps) -> (items, (step + 1) * channels,
            steps).

        Args:
            log_levels: Natural logarithm of the levels of channels in Pa.
            log_envelope: Natural logarithm of the envelopes in Pa, one per step.
        """
        missing_frames = -log_levels.shape[-1] % self.step
        if missing_frames:
            log_levels = functional.pad(log_levels, (0, missing_frames), mode="replicate")
        frames = log_levels.unflatten(-1, (-1, self.step)).unbind(-1)
        slope = functional.pad(log_envelope.diff(dim=1), (0, 0, 0, 1))
        slope = functional.hardtanh(slope, -MAX_SLOPE, MAX_SLOPE)
        fluctuations = [frame - log_envelope for frame in frames]
        return torch.cat([*fluctuations, slope], 1)


class _Block(nn.Module):
    """A depthwise convolution over time and a two-layer network over features, each with a skip.

    Features are those of the network, not the channels of MSBG's filter bank. The convolution sees
    as much of the future as of the past. Each severity has its own weights.

    Shape: (items, features, steps), severities (items,) -> (items, features, steps).

    Args:
        config: Settings, see ``BandCorrection``.
    """

    def __init__(self, config: NeuroConfig) -> None:
        super().__init__()
        severities = len(SEVERITIES)
        width = config.channels
        inner = config.channels * config.expansion
        length = config.kernel[0]
        self.time = nn.Parameter(
            (2.0 * torch.rand(severities, width, length) - 1.0) / math.sqrt(length)
        )
        self.time_bias = nn.Parameter(torch.zeros(severities, width))
        # These are matrix products, because convolutions of length 1 take twice as long.
        self.widen = nn.Parameter(torch.randn(severities, inner, width) / math.sqrt(width))
        self.narrow = nn.Parameter(torch.randn(severities, width, inner) / (2.0 * math.sqrt(inner)))
        self.bias = nn.Parameter(torch.zeros(severities, inner, 1))

    def forward(self, features: Tensor, severity: Tensor) -> Tensor:
        items, width, _ = features.shape
        kernels = self.time[severity].flatten(0, 1).unsqueeze(1)
        rows = features.reshape(1, items * width, -1)
        smoothed = functional.conv1d(
            rows,
            kernels,
            self.time_bias[severity].flatten(),
            padding=kernels.shape[-1] // 2,
            groups=items * width,
        )
        features = features + functional.silu(smoothed.reshape(features.shape))
        hidden = functional.silu(self.widen[severity] @ features + self.bias[severity])
        return features + self.narrow[severity] @ hidden
