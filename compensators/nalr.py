"""NAL-R and NAL-RP, prescriptions of gains that depend on the audiogram and not on the level."""

from typing import ClassVar

import scipy
import torch
from torch import Tensor

from compensators.aid import Aid
from hlsim.audiogram import FREQUENCIES, HIGHEST_LEVEL
from hlsim.audiogram.prescription import NALRP_END, NALRP_FREQUENCIES, nalr_gains_db, nalrp_gains_db
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.checks import check_waveform
from hlsim.dsp.fir import filters_with_gains

ORDER = 220
"""Order of the filter, which has 221 taps."""


class NALR(Aid):
    """The simplest aid: a filter with the gains that NAL-R prescribes for an audiogram.

    NAL-R is the revised prescription of the National Acoustic Laboratories: Byrne and Dillon 1986,
    Ear and Hearing 7(4), and for severe losses Byrne, Parkinson and Newall 1990, Ear and Hearing
    11(1). The filter has linear phase, and is that of pyclarity 0.9.0 without its delay of 110
    samples. It amplifies loud sounds as much as soft ones, and the output is not limited.

    Args:
        audiogram: Audiogram of one ear, or of several, which is used by all calls that pass none.
            The thresholds at 250, 500, 1000, 2000, 4000 and 6000 Hz are used, interpolated over log
            frequency where they were not measured.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200, for the warning
            about loud signals. It does not change the output.

    Raises:
        ValueError: A rate or level is out of range, or an ear is not valid.

    >>> import hlsim
    >>> from hlsim.calibration import level_spl
    >>> output = NALR("N3")(hlsim.example_speech())
    >>> level_spl(output).round()
    tensor(78.)
    """

    highest_level = HIGHEST_LEVEL
    grid: ClassVar[tuple[float, ...]] = FREQUENCIES
    """Frequencies in Hz between which the gains of the filter are straight lines."""
    reach = ORDER // 2
    """Number of samples before and after an output sample that influence it."""

    def prescribe(self, thresholds: Tensor, points: tuple[float, ...]) -> Tensor:
        """Compute the prescribed gains in dB.

        Args:
            thresholds: Thresholds in dB HL at ``FREQUENCIES``.
            points: Frequencies in Hz of the gains: ``FREQUENCIES`` or ``grid``.

        Shape: (..., 8) -> (..., number of points).
        """
        return nalr_gains_db(thresholds)

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """Return the amplified signals, see ``Aid.forward``."""
        check_waveform(waveform, full_scale_spl=self.full_scale_spl)
        thresholds = self.resolve_thresholds(waveform, audiogram)
        with torch.autocast(waveform.device.type, enabled=False):
            signal = waveform.to(torch.promote_types(waveform.dtype, torch.float32))
            time = signal.shape[-1]
            points = scipy.fft.next_fast_len(time + ORDER, real=True)
            gains = self.prescribe(thresholds.double(), self.grid)
            taps = filters_with_gains(gains, self.grid, self.sample_rate, ORDER).to(signal.dtype)
            spectrum = torch.fft.rfft(signal, points) * torch.fft.rfft(taps, points)
            output = torch.fft.irfft(spectrum, points)[..., self.reach : self.reach + time]
            return output.to(waveform.dtype)

    def gains(self, audiogram: AudiogramLike | None = None, level: float = 65.0) -> Tensor:
        """Compute the insertion gains, which are the prescribed gains and need no measurement.

        Args:
            audiogram: One or more ears, by default those of the constructor.
            level: Presentation level in dB SPL, which changes nothing here. All aids accept it.

        Returns:
            Gains in dB at the eight ``FREQUENCIES``, (8,) for one ear, else (..., 8).

        Raises:
            ValueError: There is no ear, an ear is not valid, or a threshold is outside -10 to 120
                dB HL.

        >>> NALR().gains("N3").round()
        tensor([ 0.,  9., 20., 21., 22., 23., 24., 24.])
        """
        return self.prescribe(self.find_thresholds(audiogram), FREQUENCIES)


class NALRP(NALR):
    """The prescription NAL-RP, NAL-R for severe and profound losses, as a filter.

    Where the threshold at 2 kHz is above 90 dB HL, NAL-RP gives low frequencies more gain and high
    ones less than ``NALR``. For other ears, the two differ only between 1 and 4 kHz, because NAL-RP
    also prescribes gains at 1.5 and 3 kHz, and above 6 kHz, where its gain falls to 0 at 10 kHz.
    See ``hlsim.audiogram.prescription.nalrp_gains_db`` for the formula and its sources. The filter
    and its errors are those of ``NALR``.

    The prescribed gains are openMHA's within 0.01 dB.

    >>> import hlsim
    >>> NALRP("N6").gains().round()
    tensor([24., 34., 45., 45., 45., 47., 47., 20.])
    """

    grid = (*NALRP_FREQUENCIES, 8000.0, NALRP_END)

    def prescribe(self, thresholds: Tensor, points: tuple[float, ...]) -> Tensor:
        return nalrp_gains_db(thresholds, points)
