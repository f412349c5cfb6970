"""Wide dynamic range compression by a prescription, without trained parameters."""

from typing import Any, Literal

import torch
from torch import Tensor

from compensators.filter_bank import (
    filter_centres,
    filter_powers,
    level_db,
    speech_band_levels,
)
from compensators.smoothing import follow_peaks
from compensators.wearable import State, Wearable
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.prescription import (
    CAMFIT_LIMIT_SPL,
    SPEECH_RANGE_DB,
    CompressiveGains,
    camfit_gains,
    compressed_gains_db,
    nalr_gains_db,
    nalrp_gains_db,
)
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import check_choice, check_number, check_settings
from hlsim.dsp.interpolation import interpolate

KNEE_DB = 20.0
"""Distance in dB below average speech in a band from which on softer sounds get no more gain.

With CAMFIT it is ``SPEECH_RANGE_DB``.
"""

Prescription = Literal["nalr", "nalrp", "camfit"]
"""Prescription of the gains of ``WDRC``."""


class WDRC(Wearable):
    """A hearing aid that amplifies loud sounds less than soft ones, without trained parameters.

    Each band of average speech at 65 dB SPL gets the gain that a prescription gives it, by default
    NAL-R. The gain is smaller if the band is louder, and larger if it is softer, down to 20 dB
    below average speech: the output changes by 1 dB if the input changes by as many dB as the
    compression ratio. The ratio is 1 up to a loss of 10 dB HL, rises by 1 per 40 dB of loss, and is
    3 at most. With CAMFIT, ratio and range are those of ``CAMFIT``. Gains are 0 dB or more,
    unless ``limit_to_ear`` lowers them. The delay of a stream is 4 ms.

    Args:
        audiogram: One or more ears, which are used by all calls that pass none.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. Streams need 16000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.
        attack: Time constant in seconds with which the measured level of a band rises, 0 to 1.
        release: Time constant in seconds with which this level falls, 0.01 to 2.
        limit_spl: Peak of the output in dB SPL, 60 to 140, that no sample exceeds. A band is not
            amplified beyond this level, and with CAMFIT not beyond 100 dB SPL.
        linked: Give two ears, (..., 2, time), gains from their mean power, so that the differences
            in level between them stay if their audiograms are equal.
        prescription: ``"nalr"``, ``"nalrp"`` or ``"camfit"``.
        limit_to_ear: Limit the level of the output in each band to 4 dB below the uncomfortable
            level of the ear if one was measured, and otherwise to 4 dB below a predicted level with
            a margin (``hlsim.audiogram.discomfort.predict_limits``). A tensor of thresholds has
            predicted levels. The limit of the peaks stays.

    Raises:
        ValueError: A value is out of range, a flag is neither True nor False, the prescription is
            unknown, or an ear is not valid.

    >>> import hlsim
    >>> WDRC("N3")(hlsim.example_speech()).shape
    torch.Size([64320])
    """

    bands = 20

    @check_settings
    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        attack: float = 0.005,
        release: float = 0.1,
        limit_spl: float = 110.0,
        linked: bool = False,
        prescription: Prescription = "nalr",
        limit_to_ear: bool = False,
    ) -> None:
        super().__init__(audiogram, sample_rate, full_scale_spl, linked, limit_to_ear)
        check_number("attack", attack, 0.0, 1.0)
        check_number("release", release, 0.01, 2.0)
        check_number("limit_spl", limit_spl, 60.0, 140.0)
        check_choice("prescription", prescription, Prescription)
        self.attack = attack
        self.release = release
        self.limit_spl = limit_spl
        self.prescription = prescription
        self.state_shapes = {"levels": (3, self.bands)}

    def fit(self, thresholds: Tensor) -> Tensor:
        """Compute the gain of each band for average speech in dB, followed by the slope of each.

        The slope is the change of the gain in dB per dB of the band's level, 0 or less.

        Shape: (items, 8) in dB HL -> (items, 2 * bands).
        """
        centres = filter_centres(self.bands)
        if self.prescription == "camfit":
            speech_levels = speech_band_levels(self.bands, like=thresholds)
            return torch.cat(camfit_gains(thresholds, speech_levels, centres), -1)
        prescribe = nalr_gains_db if self.prescription == "nalr" else nalrp_gains_db
        prescribed = interpolate(prescribe(thresholds), FREQUENCIES, centres)
        loss = interpolate(thresholds, FREQUENCIES, centres)
        ratios = 1.0 + ((loss - 10.0) / 40.0).clamp(0.0, 2.0)
        return torch.cat((prescribed, 1.0 / ratios - 1.0), -1)

    def compute_gains(
        self, powers: Tensor, fitted: Tensor, sliders: Tensor, state: State
    ) -> tuple[Tensor, dict[str, Tensor]]:
        levels, memory = follow_peaks(
            level_db(filter_powers(powers, self.bands)), state["levels"], self.attack, self.release
        )
        line = CompressiveGains(*fitted.unsqueeze(1).chunk(2, -1))
        speech_levels = speech_band_levels(self.bands, like=levels)
        knee, limit_spl = KNEE_DB, self.limit_spl
        if self.prescription == "camfit":
            knee, limit_spl = SPEECH_RANGE_DB, min(limit_spl, CAMFIT_LIMIT_SPL)
        gains = compressed_gains_db(line, levels, speech_levels, knee, limit_spl)
        return gains, {"levels": memory}


class CAMFIT(WDRC):
    """The compressive prescription CAMFIT, in the bands of ``WDRC``.

    See ``hlsim.audiogram.prescription.camfit_gains`` for the rule and its sources. The attack and
    release times, which the prescription leaves open, are those of ``WDRC``, whose arguments
    except ``prescription``, and whose errors it has.

    The rule is published for 125 to 6000 Hz. As in openMHA, it continues above, with high gains,
    because normal thresholds rise there and speech has little power. For the ears N4 to N6, S2 and
    S3, the gain in a pause reaches 90 to 100 dB at 8 kHz. At the onset of a sound, the limit of the
    peaks then distorts the output, which is heard at lower frequencies.

    In equal bands, the prescribed gains for levels of 40 to 90 dB SPL are openMHA's within 0.1 dB.
    They differ beyond: openMHA's gain rises without end towards soft sounds, while here a band that
    is more than 38 dB softer than in average speech gets no more gain, because no part of speech is
    softer; and openMHA attenuates a band above 100 dB SPL to this level, while here such a band
    passes unchanged up to ``limit_spl``.

    >>> CAMFIT().gains("N3").round()
    tensor([ 9.,  8., 17., 23., 25., 29., 44., 53.])
    """

    def __init__(self, audiogram: AudiogramLike | None = None, **options: Any) -> None:
        if "prescription" in options:
            raise ValueError(
                "CAMFIT is a prescription; leave prescription out, or write "
                f"WDRC(prescription={options['prescription']!r})"
            )
        super().__init__(audiogram, prescription="camfit", **options)
