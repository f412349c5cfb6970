"""What is known of MSBG, as the starting point of a network: smearing, band envelopes and gains on short frames.

One set of weights a severity, computed from MSBG's formulae; what is trained is a correction to them.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audiogram import SEVERITIES
from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.fir import filter_without_delay
from hlsim.dsp.stft import STFT
from hlsim.msbg.ear import MSBG_RATE, ear_filter
from hlsim.msbg.envelope import envelope_filters
from hlsim.msbg.filterbank import BANKS, FilterBank, gammatone_response
from hlsim.msbg.recruitment import CATCH_UP_SPL, expansion_ratios, threshold_weights
from hlsim.msbg.response import fixed_response, half_length, impulse_responses
from hlsim.msbg.smearing import BROADENING, roex_filters, smear_spectrum, smearing_from_filters
from hlsim.neuro.config import NEURO_RATE
from hlsim.torchtools import constant_like

RESPONSE_HALF_LENGTH = half_length(NEURO_RATE)
"""Samples at 16 kHz of the fixed responses to either side of zero."""

CHANNELS = max(bank.channels for bank in BANKS.values())
_ENVELOPE_HALF_LENGTH = 20  # frames
_LOG_CATCH_UP = (CATCH_UP_SPL - PASCAL_SPL) / 20.0 * math.log(10.0)
_TINY = 1e-14
_LEAST = 1e-4  # 40 dB by which smearing changes a power at most, for its gradient
_WIDEST = 1e16  # of powers, by smearing

# By how much MSBG's envelope of speech is lower than a sinusoid's of the same power, since it fluctuates and smeared
# frames partly cancel where they overlap: dB, read off the channels of 32 clips to about 0.5 dB.
_FLUCTUATION_DB = {"none": 0.0, "mild": 1.0, "moderate": 2.2, "severe": 3.3}


class Prior(nn.Module):
    """MSBG's gains, estimated on the frames of a short transform.

    Power is smeared by a matrix, summed into the bank's channels, its root smoothed over time, and expanded; the gains
    weigh the channels' complex responses relative to their sum, which is a fixed filter and applied beforehand.

    Args:
        stft: the transform; its window should be about as short as MSBG's smearing frame, 5.8 ms.
        compute: whether to compute the buffers. With False they are undefined until a state dict is loaded.

    Attributes:
        receptive_field: samples to either side on which one depends, besides those of the transform.
    """

    response: Tensor
    ear_power: Tensor

    def __init__(self, stft: STFT, compute: bool = True) -> None:
        super().__init__()
        self.receptive_field = RESPONSE_HALF_LENGTH + _ENVELOPE_HALF_LENGTH * stft.hop
        severities, frequencies = len(SEVERITIES), stft.frequencies
        shapes = {
            "excitation": (severities, CHANNELS, frequencies),
            "relative": (2, severities, CHANNELS, frequencies),  # real and imaginary parts
            "smoothing": (severities, CHANNELS, 2 * _ENVELOPE_HALF_LENGTH + 1),
            "smearing": (severities - 1, frequencies, frequencies),
        }
        self._add_buffer("ear_power", (frequencies,))
        self._add_buffer("response", (severities, 2 * RESPONSE_HALF_LENGTH))
        for name, shape in shapes.items():
            # A formula gives the known values. The correction, which is trained, starts at 0 and is relative to them,
            # because the spectrum of speech spans 60 dB: a small absolute change would let loud frequencies leak
            # everywhere.
            self._add_buffer(f"{name}_known", shape)
            self.register_parameter(f"{name}_learned", nn.Parameter(torch.zeros(shape)))
        if compute:
            for name, values in _known_values(stft).items():
                buffer = self.get_buffer(f"{name}_known" if name in shapes else name)
                buffer.copy_(torch.from_numpy(values))

    def _add_buffer(self, name: str, shape: tuple[int, ...]) -> None:
        self.register_buffer(name, torch.empty(shape, dtype=torch.float32))

    def _corrected(self, name: str) -> Tensor:
        known, learned = getattr(self, f"{name}_known"), getattr(self, f"{name}_learned")
        if name == "relative":  # a complex factor 1 + learned
            real = known[0] * learned[0] - known[1] * learned[1]
            imaginary = known[0] * learned[1] + known[1] * learned[0]
            return known + torch.stack((real, imaginary))
        return known * learned.exp()

    def filter(self, waveform: Tensor, severity: Tensor) -> Tensor:
        """Apply the fixed response of each item's bank. Shape: (items, time), (items,) -> (items, time)."""
        return filter_without_delay(waveform, self.response[severity].to(waveform))

    def forward(self, powers: Tensor, thresholds: Tensor, severity: Tensor) -> Tensor:
        """Complex factor on the filtered signal's spectrum, of its powers.

        Shape: (items, frames, frequencies), (items, 8), (items,) -> complex (items, frames, frequencies).
        """
        smeared = powers @ self._smearing()[severity].mT
        level = self.smooth(self.levels(smeared, severity), severity).log()
        gain = self.log_gain(level, thresholds, severity).exp().mT
        relative = self._corrected("relative")[:, severity]
        return torch.complex(gain @ relative[0], gain @ relative[1]) * _widening(smeared, powers)

    def spread(self, spectrum: Tensor, severity: Tensor) -> tuple[Tensor, Tensor]:
        """The filtered signal's spectrum, smeared, and its power.

        Shape: complex (items, frames, frequencies), (items,) -> the same, real (items, frames, frequencies).
        """
        return smear_spectrum(spectrum, self._smearing()[severity], _LEAST)

    def levels(self, smeared: Tensor, severity: Tensor) -> Tensor:
        """Root of the power in each channel. Shape: (items, frames, frequencies) -> (items, channels, frames)."""
        excitation = self._corrected("excitation") * self.ear_power
        return ((smeared.relu() @ excitation[severity].mT) + _TINY).sqrt().mT

    def smooth(self, level: Tensor, severity: Tensor, step: int = 1) -> Tensor:
        """Envelopes at every ``step``-th frame. Shape: (items, channels, frames) -> (items, channels, frames / step)."""
        items, channels, _ = level.shape
        kernels = self._corrected("smoothing")[severity].reshape(items * channels, 1, -1)
        level = functional.pad(
            level, (_ENVELOPE_HALF_LENGTH, _ENVELOPE_HALF_LENGTH), mode="replicate"
        )
        level = functional.conv1d(
            level.reshape(1, items * channels, -1), kernels, stride=step, groups=items * channels
        )
        return level.reshape(items, channels, -1).clamp_min(1e-7)

    def log_gain(self, log_level: Tensor, thresholds: Tensor, severity: Tensor) -> Tensor:
        """Recruitment's, of envelopes. Shape: (items, channels, steps), (items, 8), (items,) -> as the first."""
        # 0 where a bank has fewer channels
        weights = constant_like(thresholds, _threshold_weights)[severity]
        exponents = (expansion_ratios(thresholds, weights) - 1.0).unsqueeze(-1)
        return (log_level - _LOG_CATCH_UP).clamp_max(0.0) * exponents

    def weigh(self, gain: Tensor, severity: Tensor) -> Tensor:
        """Factor on the smeared spectrum.

        Shape: real and imaginary (items, 2 channels, steps) -> (items, steps, frequencies, 2), real and imaginary.
        """
        real, imaginary = self._corrected("relative")[:, severity]
        # as one product, whose columns are real and imaginary in turn
        rows = torch.cat(
            (torch.stack((real, imaginary), -1), torch.stack((-imaginary, real), -1)), 1
        )
        return (gain.mT @ rows.flatten(-2)).unflatten(-1, (-1, 2))

    def _smearing(self) -> Tensor:
        """Of powers before the way into the ear, which weighs them and is taken off again.

        Shape: -> (severities, frequencies, frequencies).
        """
        smearing = self._corrected("smearing") * (self.ear_power / self.ear_power.unsqueeze(-1))
        identity = torch.eye(smearing.shape[-1], dtype=smearing.dtype, device=smearing.device)
        return torch.cat((identity.unsqueeze(0), smearing))


def _widening(smeared: Tensor, given: Tensor) -> Tensor:
    """Square root of the quotient of two powers, imaginary where the first is negative, as in MSBG."""
    size = smeared.abs() + _TINY
    # of a constant or a pure tone at 200 dB SPL some powers are 0, and the gradient of such a quotient infinite
    root = (size / torch.maximum(given + _TINY, size / _WIDEST)).sqrt()
    imaginary = root * (smeared < 0.0)
    return torch.complex(root - imaginary, imaginary)


@lru_cache(maxsize=8)
def _known_values(stft: STFT) -> dict[str, NDArray[np.float64]]:
    """MSBG's formulae on the frequencies of a transform, by the name of the buffer that holds them.

    They take most of the time in which a network is built, and are the same for each.
    """
    points = 160 * stft.fft  # a fine grid that 44.1 kHz shares
    coarse = slice(None, points // 2 + 1, 160)
    banks = [BANKS[severity] for severity in SEVERITIES]
    ear_response = np.fft.rfft(ear_filter(), points * 441 // 160)[coarse]
    fine = 160 * 160  # points of a grid that 44.1 kHz shares, at 16 kHz
    responses = np.stack([fixed_response(bank, NEURO_RATE, fine) for bank in banks])

    excitation, relative, smoothing = [], [], []
    for severity, bank in zip(SEVERITIES, banks, strict=True):
        channels = gammatone_response(bank, points * 441 // 160, bins=points // 2 + 1)[:, coarse]
        scale = 32.0 / (3.0 * stft.window * stft.fft) * (2.0 / math.pi) ** 2
        scale *= 10.0 ** (-_FLUCTUATION_DB[severity] / 10.0)
        excitation.append(_padded(np.abs(channels) ** 2 * scale))
        relative.append(_padded(channels / channels.sum(0)))
        smoothing.append(_padded(_smoothing(bank, stft.hop)))
    factors = np.stack(relative)
    return {
        "ear_power": np.abs(ear_response) ** 2,
        "response": impulse_responses(responses, fine, NEURO_RATE),
        "excitation": np.stack(excitation),
        "relative": np.stack((factors.real, factors.imag)),
        "smoothing": np.stack(smoothing),
        "smearing": np.stack([_smearing(severity, stft) for severity in SEVERITIES[1:]]),
    }


def _smoothing(bank: FilterBank, hop: int) -> NDArray[np.float64]:
    """The envelope's low-pass at the frame rate. Returns (channels, 2 half lengths + 1)."""
    points = 4096
    omega = 2.0 * np.pi * np.fft.rfftfreq(points) * (NEURO_RATE / hop) / MSBG_RATE
    delay = np.exp(-1j * omega)
    rows = []
    for numerator, denominator in envelope_filters(bank):
        response = np.polyval(numerator[::-1], delay) / np.polyval(denominator[::-1], delay)
        impulse = np.fft.irfft(np.abs(response) ** 2, points)
        row = np.roll(impulse, _ENVELOPE_HALF_LENGTH)[: 2 * _ENVELOPE_HALF_LENGTH + 1]
        rows.append(row / row.sum())
    return np.array(rows)


def _smearing(severity: str, stft: STFT) -> NDArray[np.float64]:
    """MSBG's smearing matrix on the transform's frequencies."""
    spacing = NEURO_RATE / stft.fft
    count = round(20000.0 / spacing / 4.0) * 4
    filters = (roex_filters(*sides, count, spacing) for sides in ((1.0, 1.0), BROADENING[severity]))
    matrix = smearing_from_filters(*filters)
    return matrix[: stft.frequencies, : stft.frequencies]


def _threshold_weights() -> NDArray[np.float64]:
    """Of every severity's bank. Returns (severities, 8, channels)."""
    return np.stack([_padded(threshold_weights(BANKS[severity]).T).T for severity in SEVERITIES])


def _padded(rows: NDArray[np.generic]) -> NDArray[np.generic]:
    return np.pad(rows, ((0, CHANNELS - len(rows)), (0, 0)))
