"""Base class of aids, which may store an ear and measure their insertion gains.

The insertion gain is the level of an aid's output minus that of its input in dB, in a third of an
octave around a frequency. Aids whose gains depend on the signal measure it with noise that has the
spectrum of average speech.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from compensators.filter_bank import RATE, SPEECH_SPL, speech_density
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike, StoredEars, as_thresholds
from hlsim.calibration import PASCAL_SPL, check_full_scale
from hlsim.checks import check_device, check_number, check_rate, check_settings
from hlsim.dsp.fft import power
from hlsim.torchtools import constant


class Aid(StoredEars, nn.Module):
    """Base class of aids without a front end: it stores ears, and measures the gains of an aid.

    Subclasses implement ``forward``, and ``_amplify`` or ``gains``.

    Args:
        audiogram: One or more ears, which are used by all calls that pass none.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Attributes:
        highest_level: Highest hearing threshold that the aid accepts, in dB HL.
        thresholds: Thresholds in dB HL of the ears that calls without an audiogram use, (..., 8);
            None if there are none.

    Raises:
        ValueError: A rate or level is out of range, or an ear is not valid.

    >>> from compensators import WDRC
    >>> isinstance(WDRC(), Aid)
    True
    """

    @check_settings
    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        sample_rate: int = RATE,
        full_scale_spl: float = PASCAL_SPL,
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.store_ears(audiogram)

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """Return the output for whole signals, time-aligned with the input.

        Args:
            waveform: Input of the aid.
            audiogram: One ear for all signals, or ears whose shape (..., 8) broadcasts over the
                leading dimensions of the waveform; by default those of the constructor.

        Shape: (..., time) -> (..., time), with the leading dimensions of waveform and ears
            broadcast.

        Raises:
            ValueError: There is no audiogram, a threshold is outside -10 to 100 dB HL (120 for
                NAL-R and NAL-RP), shapes do not fit, or the waveform is not a floating-point tensor
                with time last, has no samples or one above 1e9 in magnitude, or is on another
                device than the weights.
        """
        raise NotImplementedError

    def stream(self, audiogram: AudiogramLike | None = None, **sliders: Any) -> Any:
        """Raise ValueError, because the aid processes whole signals; see ``Wearable.stream``."""
        raise ValueError(
            f"{type(self).__name__} processes whole signals only; load wdrc or hearing-aid for a "
            "signal that arrives in chunks"
        )

    @torch.no_grad()
    def gains(self, audiogram: AudiogramLike | None = None, level: float = 65.0) -> Tensor:
        """Measure the insertion gains for noise with the spectrum of average speech.

        Neither the limit of the peaks nor that of ``limit_to_ear`` is applied, and noise reduction
        is off in aids that have a slider for it.

        Args:
            audiogram: One or more ears, by default those of the constructor.
            level: Presentation level in dB SPL, 0 to 120.

        Returns:
            Gains in dB at the eight ``FREQUENCIES``, (8,) for one ear, else (..., 8).

        Raises:
            ValueError: There is no ear, or an ear or the level is not valid.

        >>> from compensators import WDRC
        >>> WDRC().gains("N3", level=65.0).round()
        tensor([ 1.,  8., 18., 20., 21., 22., 23., 24.])
        """
        check_number("level", level, 0.0, 120.0)
        check_device(self)
        thresholds = self.find_thresholds(audiogram)
        thresholds = thresholds.to(next(self.parameters(), thresholds))
        ears = thresholds.reshape(-1, len(FREQUENCIES))
        noise = _speech_noise(like=ears) * 10.0 ** ((level - SPEECH_SPL) / 20.0)
        in_third = thirds_of_octave(like=ears)
        with torch.autocast(ears.device.type, enabled=False):
            # The first second, in which gains settle, is left out.
            output = self._amplify(noise.repeat(len(ears), 2), ears)[:, RATE:]
            output_power, noise_power = (
                power(torch.fft.rfft(signal)) @ in_third for signal in (output, noise)
            )
        return (10.0 * (output_power / noise_power).log10()).reshape(thresholds.shape)

    def find_thresholds(self, audiogram: AudiogramLike | None) -> Tensor:
        """Return the thresholds in dB HL of the passed ears, or else of the stored ones, (..., 8).

        Args:
            audiogram: Ears that were passed with the call, or None.

        Raises:
            ValueError: There are no ears, or an ear is not valid.
        """
        ears = self.thresholds if audiogram is None else audiogram
        return as_thresholds(ears, highest=self.highest_level)

    def _amplify(self, signals: Tensor, ears: Tensor) -> Tensor:
        """Return the output in pascals for signals in pascals at 16 kHz.

        It is neither limited to a peak nor to the ear, and noise reduction is off in aids that have
        a slider for it. The output may be late by the delay of the aid's filters.

        Shape: (items, time), (items, 8) in dB HL -> (items, time).
        """
        raise NotImplementedError


@constant
def _speech_noise() -> NDArray[np.float64]:
    """Return one second of noise with the spectrum of average speech at 65 dB SPL.

    Samples are in pascals at 16 kHz, with shape (16000,). The noise can be repeated without a jump.
    """
    spectrum = np.zeros(RATE // 2 + 1, dtype=complex)
    phases = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, RATE // 2)
    spectrum[1:] = np.sqrt(speech_density(RATE)) * np.exp(1j * phases)
    noise = np.fft.irfft(spectrum)
    rms = 10.0 ** ((SPEECH_SPL - PASCAL_SPL) / 20.0)
    return noise * rms / np.sqrt(np.square(noise).mean())


@constant
def thirds_of_octave() -> NDArray[np.float64]:
    """Return the thirds of an octave around ``FREQUENCIES`` as weights of 0, 1, ..., 8000 Hz.

    Shape: -> (8001, 8), 1 where a frequency lies in a third of an octave, else 0.

    >>> print(thirds_of_octave().sum(0))
    [  58.  116.  232.  463.  695.  926. 1389.  873.]
    """
    ratio = np.arange(RATE // 2 + 1)[:, None] / np.array(FREQUENCIES)
    return ((ratio > 2.0 ** (-1.0 / 6.0)) & (ratio < 2.0 ** (1.0 / 6.0))).astype(float)
