"""The prior: an estimate of what MSBG does to a spectrogram, by MSBG's own formulae.

A network that starts from it has to learn corrections only. The steps are those of MSBG, on short
frames instead of single samples:

1. ``filter`` applies to the waveform the fixed filter that MSBG is where all gains are 1.
2. *Smearing* spreads the power of each frame over neighbouring frequencies, as the broad filters of
   an impaired ear do.
3. The power in each *channel* of MSBG's filter bank gives a level, and the level, smoothed over
   time, an *envelope*.
4. *Recruitment*, the fast growth of loudness of an impaired ear, turns the envelope into a gain.
5. The channels are added up with their gains. The ratio of this sum to the sum without gains is a
   complex factor at each frequency.

The *severity* of a loss is its degree, 0 (none) to 3 (severe). As in MSBG, it selects the filter
bank and the smearing.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES, SEVERITIES
from hlsim.calibration import NEURO_RATE, PASCAL_SPL
from hlsim.dsp.fir import filter_without_delay
from hlsim.dsp.interpolation import interpolation_weights
from hlsim.dsp.stft import STFT
from hlsim.msbg.ear import MSBG_RATE, ear_filter
from hlsim.msbg.envelope import envelope_filters
from hlsim.msbg.filter_bank import BANKS, FilterBank, gammatone_response
from hlsim.msbg.recruitment import CATCH_UP_SPL, expansion_ratios
from hlsim.msbg.response import fixed_response, half_length, impulse_responses
from hlsim.msbg.smearing import FFT, design_smearing
from hlsim.torchtools import constant

RESPONSE_HALF_LENGTH = half_length(NEURO_RATE)
"""Number of samples at 16 kHz of fixed impulse responses before time 0, and as many from it on."""

CHANNELS = max(bank.channels for bank in BANKS.values())
"""Number of channels of the largest filter bank. Smaller banks are padded with zeros."""

_ENVELOPE_HALF_LENGTH = 20
"""Number of frames before and after time 0 that the low-pass of the envelopes spans."""

_LOG_CATCH_UP = (CATCH_UP_SPL - PASCAL_SPL) / 20.0 * math.log(10.0)
"""Natural logarithm of the catch-up level in Pa."""

POWER_FLOOR = 1e-14
"""Power in Pa^2 that is added to powers before divisions and square roots."""

MIN_ENVELOPE = 1e-7
"""Smallest value of an envelope in Pa."""

MAX_POWER_RATIO = 1e16
"""Largest ratio of the smeared to the original power."""

_FLUCTUATION_DB = {"none": 0.0, "mild": 1.0, "moderate": 2.2, "severe": 3.3}
"""Difference in dB by which MSBG's envelope of speech is below that of a tone of the same power.

Speech fluctuates, and smeared frames partly cancel each other where they overlap. The values were
measured in the channels of 32 clips to about 0.5 dB.
"""

_GRID_RATIO = 160
"""Number of points of the frequency grid for responses per frequency of a transform at 16 kHz.

44.1 kHz is 441 / 160 times 16 kHz, so that both rates share this grid.
"""


class BandGains(nn.Module):
    """An estimate of MSBG's smearing and of its gains, on a spectrogram of sound in the cochlea.

    The constants of MSBG's formulae are computed for each severity. Each has a trainable
    correction, which has no effect before training.

    Args:
        stft: Transform whose window is about as short as MSBG's smearing frame, 5.8 ms.
        rate: Sample rate in Hz of the signals that are transformed.
        compute: Compute the constants. With False, they are NaN until a state dict is loaded.

    Attributes:
        receptive_field: Number of input samples at ``rate`` before and after an output sample that
            influence it, in addition to those of the transform.

    >>> gains = BandGains(STFT(192, 96, 24), rate=16537.5)
    >>> gains.channel_levels(torch.ones(1, 50, 97), torch.tensor([2])).shape
    torch.Size([1, 36, 50])
    """

    def __init__(self, stft: STFT, rate: float, compute: bool = True) -> None:
        super().__init__()
        self.receptive_field = _ENVELOPE_HALF_LENGTH * stft.hop
        severities = len(SEVERITIES)
        frequencies = stft.frequencies
        shapes = {
            "excitation": (severities, CHANNELS, frequencies),
            "relative": (2, severities, CHANNELS, frequencies),  # real and imaginary parts
            "smoothing": (severities, CHANNELS, 2 * _ENVELOPE_HALF_LENGTH + 1),
            "smearing": (severities - 1, frequencies, frequencies),
        }
        for name, shape in shapes.items():
            # A formula gives the known values. The correction, which is trained, starts at 0 and is
            # relative to them, because the spectrum of speech spans 60 dB: a small absolute change
            # would let loud frequencies leak everywhere.
            self._add_buffer(f"{name}_known", shape)
            self.register_parameter(f"{name}_learned", nn.Parameter(torch.zeros(shape)))
        if compute:
            for name, values in _msbg_constants(stft, rate).items():
                self.get_buffer(f"{name}_known").copy_(torch.from_numpy(values))

    def _add_buffer(self, name: str, shape: tuple[int, ...]) -> None:
        """Register a float32 buffer of NaN, which ``save_checkpoint`` rejects unless filled."""
        self.register_buffer(name, torch.full(shape, torch.nan, dtype=torch.float32))

    def _corrected(self, name: str) -> Tensor:
        """Return the buffer ``<name>_known`` with its learned correction, in the same shape.

        The correction is a factor: exp(learned), or for the complex responses ``"relative"``
        1 + learned.

        Args:
            name: ``"excitation"``, factors from powers at frequencies to powers of channels;
                ``"relative"``, responses of channels over their sum; ``"smoothing"``, low-passes of
                envelopes; or ``"smearing"``, matrices.
        """
        known = getattr(self, f"{name}_known")
        learned = getattr(self, f"{name}_learned")
        if name != "relative":
            return known * learned.exp()
        # The correction is a complex factor 1 + learned.
        real = known[0] * learned[0] - known[1] * learned[1]
        imaginary = known[0] * learned[1] + known[1] * learned[0]
        return known + torch.stack((real, imaginary))

    def smear_powers(self, powers: Tensor, severity: Tensor) -> Tensor:
        """Spread the power of each frame over neighbouring frequencies.

        Shape: (items, frames, frequencies), (items,) -> (items, frames, frequencies).

        Args:
            powers: Power at each point of a spectrogram in Pa^2.
            severity: Degree of loss of each ear, 0 (none) to 3 (severe).

        Returns:
            Smeared powers in Pa^2, which may be negative.
        """
        return powers @ self.smearing()[severity].mT

    def smearing(self) -> Tensor:
        """Return the matrices that smear power spectra, with their learned correction.

        Returns:
            Matrices, (severities, frequencies, frequencies). The first one, for the severity 0, is
            the identity.
        """
        smearing = self._corrected("smearing")
        identity = torch.eye(smearing.shape[-1], dtype=smearing.dtype, device=smearing.device)
        return torch.cat((identity.unsqueeze(0), smearing))

    def excitation(self) -> Tensor:
        """Return the weights of the powers at each frequency in the power of each channel.

        Returns:
            Weights, (severities, channels, frequencies).
        """
        return self._corrected("excitation")

    def channel_levels(self, smeared_powers: Tensor, severity: Tensor) -> Tensor:
        """Compute the level of each channel of MSBG's bank: its mean magnitude in each frame.

        Shape: (items, frames, frequencies), (items,) -> (items, channels, frames) in Pa.

        Args:
            smeared_powers: Power in Pa^2 at each point of a spectrogram, spread over neighbouring
                frequencies as ``smear_powers`` does. Negative values are treated as 0.
            severity: Degree of loss of each ear, 0 (none) to 3 (severe), which selects the bank.
        """
        # Unlike relu, threshold stores nothing for its gradient that is not stored anyway. The
        # gradient of clamp_min takes as long as ten multiplications.
        positive_powers = functional.threshold(smeared_powers, 0.0, 0.0)
        channel_powers = positive_powers @ self.excitation()[severity].mT
        return (channel_powers + POWER_FLOOR).sqrt().mT

    def smooth(self, levels: Tensor, severity: Tensor, step: int = 1) -> Tensor:
        """Smooth the levels of channels over time to their envelopes in Pa, 1e-7 or more.

        Shape: (items, channels, frames), (items,) -> (items, channels, ceil(frames / step)).

        Args:
            levels: Level of each channel in Pa.
            severity: Degree of loss of each ear, 0 (none) to 3 (severe), which selects the filters.
            step: Number of frames from one value of an envelope to the next.
        """
        items, channels, _ = levels.shape
        kernels = self._corrected("smoothing")[severity].reshape(items * channels, 1, -1)
        margin = (_ENVELOPE_HALF_LENGTH, _ENVELOPE_HALF_LENGTH)
        padded = functional.pad(levels, margin, mode="replicate")
        rows = padded.reshape(1, items * channels, -1)
        envelopes = functional.conv1d(rows, kernels, stride=step, groups=items * channels)
        envelopes = envelopes.reshape(items, channels, -1)
        return functional.threshold(envelopes, MIN_ENVELOPE, MIN_ENVELOPE)

    def log_gain(self, log_envelope: Tensor, thresholds: Tensor, severity: Tensor) -> Tensor:
        """Compute the gain that simulates recruitment in each channel, as a natural logarithm.

        Shape: (items, channels, steps), (items, 8), (items,) -> (items, channels, steps).

        Args:
            log_envelope: Natural logarithm of the envelopes in Pa.
            thresholds: Audiograms in dB HL at ``hlsim.audiogram.FREQUENCIES``.
            severity: Degree of loss of each ear, 0 (none) to 3 (severe).
        """
        weights = _threshold_weights(like=thresholds)[severity]
        exponents = (1.0 - expansion_ratios(thresholds, weights)).unsqueeze(-1)
        return functional.relu(_LOG_CATCH_UP - log_envelope) * exponents

    def factor_matrices(self, severity: Tensor) -> tuple[Tensor, Tensor]:
        """Return the matrices from gains of the channels to factors on the smeared spectrogram.

        A row of gains times the first matrix is the real part of the factor at each frequency. The
        second matrix is that of the imaginary part.

        Shape: (items,) -> (items, channels, frequencies) twice.

        Args:
            severity: Degree of loss of each ear, 0 (none) to 3 (severe).
        """
        real, imaginary = self._corrected("relative")[:, severity]
        return real, imaginary


class Prior(BandGains):
    """An estimate of the complex factors by which MSBG multiplies a spectrogram at 16 kHz.

    The fixed filters are applied to the waveform first (``filter``), so that smearing and channels
    take the outer and middle ear into account at each frequency.

    Args:
        stft: Transform at 16 kHz whose window is about as short as MSBG's smearing frame, 5.8 ms.
        compute: Compute the constants. With False, they are NaN until a state dict is loaded.

    >>> stft = STFT(128, 128, 32)
    >>> factor = Prior(stft)(torch.ones(1, 50, 65), torch.full((1, 8), 40.0), torch.tensor([2]))
    >>> factor.shape
    torch.Size([1, 50, 65])
    """

    response: Tensor
    ear_power: Tensor

    def __init__(self, stft: STFT, compute: bool = True) -> None:
        super().__init__(stft, NEURO_RATE, compute)
        self.receptive_field += RESPONSE_HALF_LENGTH
        self._add_buffer("ear_power", (stft.frequencies,))
        self._add_buffer("response", (len(SEVERITIES), 2 * RESPONSE_HALF_LENGTH))
        if compute:
            for name, values in _ear_constants(stft).items():
                self.get_buffer(name).copy_(torch.from_numpy(values))

    def filter(self, waveform: Tensor, severity: Tensor) -> Tensor:
        """Filter waveforms as MSBG does where the gain of all its channels is 1.

        These are its outer and middle ear, the sum of the channels of the filter bank, and the
        inverse of outer and middle ear, without delay.

        Shape: (items, time), (items,) -> (items, time).

        Args:
            waveform: Signals in pascals at 16 kHz.
            severity: Degree of loss of each ear, 0 (none) to 3 (severe), which selects the filter
                bank.
        """
        return filter_without_delay(waveform, self.response[severity].to(waveform))

    def forward(self, powers: Tensor, thresholds: Tensor, severity: Tensor) -> Tensor:
        """Estimate the complex factor by which MSBG multiplies each point of a spectrogram.

        Shape: (items, frames, frequencies), (items, 8), (items,) -> complex (items, frames,
            frequencies).

        Args:
            powers: Power at each point of the spectrogram of the output of ``filter``, in Pa^2.
            thresholds: Audiograms in dB HL at ``hlsim.audiogram.FREQUENCIES``.
            severity: Degree of loss of each ear, 0 (none) to 3 (severe).
        """
        smeared_powers = self.smear_powers(powers, severity)
        levels = self.channel_levels(smeared_powers, severity)
        log_envelope = self.smooth(levels, severity).log()
        gain = self.log_gain(log_envelope, thresholds, severity).exp().mT
        real, imaginary = self.factor_matrices(severity)
        factor = torch.complex(gain @ real, gain @ imaginary)
        return factor * _smearing_factor(smeared_powers, powers)

    def smearing(self) -> Tensor:
        # MSBG smears behind the outer and the middle ear, so the matrices apply the power response
        # of these filters, smear, and undo the response.
        return super().smearing() * (self.ear_power / self.ear_power.unsqueeze(-1))

    def excitation(self) -> Tensor:
        return super().excitation() * self.ear_power


def _smearing_factor(smeared_powers: Tensor, powers: Tensor) -> Tensor:
    """Compute the square root of the ratio of two powers in Pa^2, smeared to original.

    The root of a negative ratio is imaginary. The ratio is at most 1e16.

    Shape: (...), (...) -> complex (...).
    """
    magnitude = smeared_powers.abs() + POWER_FLOOR
    # The limit of the ratio keeps its gradient finite where a power is 0, as for a pure tone at
    # 200 dB SPL.
    divisor = torch.maximum(powers + POWER_FLOOR, magnitude / MAX_POWER_RATIO)
    root = (magnitude / divisor).sqrt()
    imaginary = root * (smeared_powers < 0.0)
    return torch.complex(root - imaginary, imaginary)


@lru_cache(maxsize=8)
def _msbg_constants(stft: STFT, rate: float) -> dict[str, NDArray[np.float64]]:
    """Compute the constants of MSBG's formulae at the frequencies of a transform, by name.

    The computation takes most of the time in which a network is built. The constants are stored,
    because they are the same for all networks with this transform and rate. Their shapes are those
    of the buffers of ``BandGains``.

    Args:
        stft: Transform of the signals.
        rate: Sample rate of the signals in Hz, 16000, or 3/8 of 44100.
    """
    # 44.1 kHz is 441 / 160 times 16 kHz and 8 / 3 times MSBG's frame rate.
    grid_ratio = _GRID_RATIO if rate == NEURO_RATE else 3
    points = grid_ratio * stft.fft
    model_points = round(points * MSBG_RATE / rate)
    excitation = []
    relative = []
    smoothing = []
    for severity in SEVERITIES:
        bank = BANKS[severity]
        fine_channels = gammatone_response(bank, model_points, bins=points // 2 + 1)
        channels = fine_channels[:, ::grid_ratio]
        # The power of a tone in a windowed frame, times this factor, is the square of the mean of
        # the rectified tone.
        scale = 32.0 / (3.0 * stft.window * stft.fft) * (2.0 / math.pi) ** 2
        scale *= 10.0 ** (-_FLUCTUATION_DB[severity] / 10.0)
        excitation.append(_pad_channels(np.abs(channels) ** 2 * scale))
        relative.append(_pad_channels(channels / channels.sum(0)))
        smoothing.append(_pad_channels(_smoothing_kernels(bank, rate / stft.hop)))
    factors = np.stack(relative)
    return {
        "excitation": np.stack(excitation),
        "relative": np.stack((factors.real, factors.imag)),
        "smoothing": np.stack(smoothing),
        "smearing": np.stack([_smearing_matrix(name, stft, rate) for name in SEVERITIES[1:]]),
    }


@lru_cache(maxsize=8)
def _ear_constants(stft: STFT) -> dict[str, NDArray[np.float64]]:
    """Compute the buffers of ``Prior`` that ``BandGains`` lacks, by name: its fixed filters."""
    ear_response = np.fft.rfft(ear_filter(), _GRID_RATIO * stft.fft * 441 // 160)
    points = _GRID_RATIO * 160
    responses = [fixed_response(BANKS[name], NEURO_RATE, points) for name in SEVERITIES]
    return {
        "ear_power": np.abs(ear_response[: _GRID_RATIO * stft.fft // 2 + 1 : _GRID_RATIO]) ** 2,
        "response": impulse_responses(np.stack(responses), points, NEURO_RATE),
    }


def _smoothing_kernels(bank: FilterBank, frame_rate: float) -> NDArray[np.float64]:
    """Compute the impulse responses of the envelopes' low-passes, without delay, at the frame rate.

    Args:
        bank: Filter bank of a severity.
        frame_rate: Number of frames per second.

    Returns:
        Kernels, (channels, 41), each with a sum of 1.
    """
    points = 4096
    length = 2 * _ENVELOPE_HALF_LENGTH + 1
    omega = 2.0 * np.pi * np.fft.rfftfreq(points) * frame_rate / MSBG_RATE
    delay = np.exp(-1j * omega)
    kernels = []
    for numerator, denominator in envelope_filters(bank):
        response = np.polyval(numerator[::-1], delay) / np.polyval(denominator[::-1], delay)
        impulse_response = np.fft.irfft(np.abs(response) ** 2, points)
        kernel = np.roll(impulse_response, _ENVELOPE_HALF_LENGTH)[:length]
        kernels.append(kernel / kernel.sum())
    return np.array(kernels)


def _smearing_matrix(severity: str, stft: STFT, rate: float) -> NDArray[np.float64]:
    """Compute MSBG's smearing matrix at the frequencies of a transform.

    Args:
        severity: ``"mild"``, ``"moderate"`` or ``"severe"``.
        stft: Transform at ``rate``.
        rate: Sample rate in Hz.

    Returns:
        Matrix that multiplies a power spectrum behind the middle ear from the left, with a row for
        each smeared frequency, (frequencies, frequencies).
    """
    spacing = rate / stft.fft
    count = FFT // 2
    if spacing != MSBG_RATE / FFT:
        # As MSBG's, the filters cover more than the frequencies of the transform, up to about 20
        # kHz.
        count = round(20000.0 / spacing / 4.0) * 4
    matrix = design_smearing(severity, count, spacing)
    return matrix[: stft.frequencies, : stft.frequencies]


@constant
def _threshold_weights() -> NDArray[np.float64]:
    """Compute the weights that interpolate thresholds to the centre frequencies of channels.

    They are 0 for channels that the bank of a severity does not have.

    Returns:
        Weights, (severities, 8, channels).
    """
    banks = [BANKS[severity] for severity in SEVERITIES]
    weights = [interpolation_weights(FREQUENCIES, bank.centre_frequencies) for bank in banks]
    return np.stack([_pad_channels(bank_weights.T).T for bank_weights in weights])


def _pad_channels(rows: NDArray[np.generic]) -> NDArray[np.generic]:
    """Add rows of zeros, (channels of a bank, n) -> (channels of the largest bank, n)."""
    return np.pad(rows, ((0, CHANNELS - len(rows)), (0, 0)))
