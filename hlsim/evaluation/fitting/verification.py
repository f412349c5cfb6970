"""Verification of a hearing aid from two recordings, its input and its output.

A clinic measures the same at a person's ear: percentiles of the level of speech in third octaves
(IEC 60118-15), insertion gains beside their targets, and the audible share of speech (ANSI S3.5).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from compensators import load_compensator
from compensators.aid import Aid
from compensators.filter_bank import SPEECH_SPECTRUM
from hlsim.audiogram import FREQUENCIES, Audiogram, as_audiogram
from hlsim.audiogram.prescription import FREE_FIELD_THRESHOLD_SPL
from hlsim.audiogram.scale import interpolate_over_log
from hlsim.calibration import PASCAL_SPL, POWER_FLOOR, gain_to_pascals
from hlsim.checks import check_finite, check_rate, check_waveform
from hlsim.dsp.fft import correlate
from hlsim.evaluation.measures import CORRELATION_FLOOR
from hlsim.metrics.sii import SII_BANDS, sii

Array = NDArray[np.float64]

PERCENTILES = (30, 65, 99)
"""Percentiles of the levels of speech sections: the valleys, the middle and the peaks of speech."""

SECTION_SECONDS = 0.125
"""Duration of the sections in which levels are measured. They overlap by half."""

MIN_SECONDS = 1.0
"""Shortest recording in seconds, whose 99 % percentile is nearly the loudest section."""

TARGET_STEP = 5.0
"""Largest distance in dB between levels of speech at which a prescription's gains are computed."""

SIMILARITY_FLOOR = 0.4
"""Correlation of input and output, by waveforms or levels, below which they are other sounds.

Of the bundled recordings, two different ones reach 0.3. Outputs of the bundled aids, also in noise,
have at least 0.6, but those of CAMFIT for steep losses (S2, S3) as little as 0.1: its gain of up to
100 dB is so high at onsets that the limit of the peaks distorts them, and distortion lies in other
bands.
"""


@dataclass(frozen=True)
class Verification:
    """Levels, gains and targets of an aid in third octaves, and audible shares of speech.

    There are 18 bands, 160 to 8000 Hz. Percentiles are those of the levels in sections of 125 ms.
    Thresholds and uncomfortable levels are converted from dB HL as in a free field.

    Attributes:
        hertz: Centres of the third octaves in Hz, (18,).
        input_levels: Levels of the input in dB SPL at the ``PERCENTILES``, (3, 18).
        output_levels: Levels of the output in dB SPL at the ``PERCENTILES``, (3, 18).
        targets: Insertion gains in dB that the prescription gives at each percentile of the input,
            (3, 18); equal at all three if the prescription is linear.
        thresholds: Hearing thresholds of the ear in dB SPL, (18,).
        uncomfortable: Levels in dB SPL from which a tone is uncomfortable, (18,), as measured (see
            ``Audiogram.uncomfortable_levels``), or else predicted.
        unaided_sii: Speech intelligibility index of the input: its audible share, 0 to 1.
        aided_sii: Speech intelligibility index of the output.

    >>> import hlsim
    >>> speech = hlsim.example_speech()
    >>> print(verify(speech, 10.0 * speech, "N3", 16000).gains[:, 8].round())  # at 1 kHz
    [20. 20. 20.]
    """

    hertz: Array
    input_levels: Array
    output_levels: Array
    targets: Array
    thresholds: Array
    uncomfortable: Array
    unaided_sii: float
    aided_sii: float

    @property
    def gains(self) -> Array:
        """Insertion gains in dB, (3, 18): each percentile of the output minus that of the input."""
        return self.output_levels - self.input_levels

    def rows(self) -> list[dict[str, float]]:
        """Return one dict per third octave, with values by column, rounded to 0.1.

        The columns are ``hertz``; ``input``, ``output``, ``gain`` and ``target`` at each
        percentile, such as ``input_30``; ``threshold``; and ``uncomfortable``. Levels are in dB
        SPL, gains and targets in dB.
        """
        columns: dict[str, Array] = {"hertz": self.hertz}
        tables = {
            "input": self.input_levels,
            "output": self.output_levels,
            "gain": self.gains,
            "target": self.targets,
        }
        for name, table in tables.items():
            columns |= {
                f"{name}_{share}": line for share, line in zip(PERCENTILES, table, strict=True)
            }
        columns["threshold"] = self.thresholds
        columns["uncomfortable"] = self.uncomfortable
        table = np.stack([*columns.values()], 1).round(1).tolist()
        return [dict(zip(columns, row, strict=True)) for row in table]


def verify(
    input_: Tensor,
    output: Tensor,
    ear: Any,
    sample_rate: int,
    *,
    full_scale_spl: float = PASCAL_SPL,
    prescription: str = "nalr",
) -> Verification:
    """Measure the gains of an aid from its input and output, beside the targets for an ear.

    Both recordings are cut to the sound that they share, so that results do not depend on a delay,
    or on silence before or after the sound of one recording. If the coefficient of their
    cross-correlation is 0.2 or less, the delay is unknown, and 0 is assumed. The input should be at
    least 15 s of speech without noise; in shorter ones, the levels of valleys and peaks are less
    certain.

    Args:
        input_: Recorded input of the aid, (time,), 1 s or more.
        output: Recorded output at the same scale, (time,), which may be up to 1 s longer or
            shorter, and up to 1 s later or earlier.
        ear: Audiogram of the ear.
        sample_rate: Sample rate of both in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.
        prescription: Aid whose gains are the targets: ``nalr``, ``nalrp``, ``wdrc``,
            ``camfit``, or a checkpoint.

    Raises:
        ValueError: A signal has several channels, NaN or infinity, or is too short; one of them is
            silent; the two are not recordings of the same sound; the lengths do not fit; or an
            argument is not valid.

    >>> import hlsim
    >>> speech = hlsim.example_speech()
    >>> result = verify(speech, hlsim.NALR("N3")(speech), "N3", 16000)
    >>> print(round(result.unaided_sii, 2), round(result.aided_sii, 2))
    0.19 0.65
    """
    audiogram = as_audiogram(ear)
    rate = check_rate(sample_rate)
    if input_.ndim != 1 or output.ndim != 1:
        raise ValueError(
            f"expected one channel each, got shapes {tuple(input_.shape)} and "
            f"{tuple(output.shape)}; save the channel of the ear as a mono file"
        )
    for name, signal in (("input_", input_), ("output", output)):
        check_finite(check_waveform(signal, name, full_scale_spl=full_scale_spl), name)
        if not bool(signal.any()):
            raise ValueError(f"{name} is silent; pass the input and the output of the aid")
    if abs(len(input_) - len(output)) > rate:
        raise ValueError(
            f"input and output differ in length by more than 1 s, {len(input_)} and "
            f"{len(output)} samples; expected recordings of the same sound"
        )
    input_, output, correlation = _cut_to_common_sound(input_, output, rate)
    hertz = np.array(SII_BANDS, dtype=float)
    gain = gain_to_pascals(full_scale_spl)
    powers = [section_powers(gain * signal, rate) for signal in (input_, output)]
    _check_related(correlation, *powers)
    input_levels, output_levels = (
        np.percentile(_level(power), PERCENTILES, axis=0) for power in powers
    )
    losses = interpolate_over_log(SII_BANDS, audiogram.frequencies, audiogram.levels)
    normal = np.array([FREE_FIELD_THRESHOLD_SPL[band] for band in SII_BANDS])
    uncomfortable = np.array(audiogram.uncomfortable_levels(hertz.tolist()))
    unaided_sii, aided_sii = (
        sii(_level(power.mean(0)) - _bandwidth_db(), thresholds=losses) for power in powers
    )
    target_aid: Any = load_compensator(prescription)
    return Verification(
        hertz=hertz,
        input_levels=input_levels,
        output_levels=output_levels,
        targets=prescribed_gains(target_aid, audiogram, input_levels),
        thresholds=losses + normal,
        uncomfortable=uncomfortable + normal,
        unaided_sii=unaided_sii,
        aided_sii=aided_sii,
    )


def _cut_to_common_sound(input_: Tensor, output: Tensor, rate: int) -> tuple[Tensor, Tensor, float]:
    """Cut two recordings to the sound that both have, in CPU memory and without a gradient.

    If they are not similar enough to find the lag of the output, a lag of 0 is assumed.

    Returns:
        The input and the output, (samples,) each, and the coefficient of their cross-correlation at
        the best lag.

    Raises:
        ValueError: The output is later or earlier by more than 1 s, or less than 1 s is common.
    """
    input_, output = input_.detach().cpu(), output.detach().cpu()
    best_lag, correlation = correlate(output, input_)
    lag = best_lag if correlation > CORRELATION_FLOOR else 0
    if abs(lag) > rate:
        raise ValueError(
            f"the output is {lag / rate:.1f} s later than the input (earlier, if negative); cut "
            "the recordings so that they begin together"
        )
    input_, output = input_[max(0, -lag) :], output[max(0, lag) :]
    samples = min(len(input_), len(output))
    if samples < MIN_SECONDS * rate:
        raise ValueError(
            f"expected at least 1 s of sound that input and output have in common, got "
            f"{samples / rate:.2g} s; 15 s of speech and more are better"
        )
    return input_[:samples], output[:samples], correlation


def _check_related(correlation: float, input_powers: Array, output_powers: Array) -> None:
    """Raise ValueError if two recordings are not those of the same sound.

    They are if the waveforms correlate, or if the levels of their sections do. An aid may remove
    one of these similarities, but not both.

    Args:
        correlation: Coefficient of the cross-correlation of the waveforms at the best lag.
        input_powers: Powers of the input in sections and third octaves, (sections, 18).
        output_powers: Powers of the output in the same sections, (sections, 18).
    """
    levels = [_level(powers) for powers in (input_powers, output_powers)]
    changes = [(level - level.mean(0)).ravel() for level in levels]
    scale = np.linalg.norm(changes[0]) * np.linalg.norm(changes[1])
    similarity = max(correlation, float(np.dot(*changes) / scale) if scale else 0.0)
    if similarity < SIMILARITY_FLOOR:
        raise ValueError(
            f"input and output are not similar (correlation {similarity:.2f}, expected "
            f"{SIMILARITY_FLOOR} or more); pass two recordings of the same sound, with an output "
            "that no limiter of peaks has distorted"
        )


def prescribed_gains(aid: Aid, audiogram: Audiogram, band_levels: Array) -> Array:
    """Compute the insertion gains of an aid for levels of speech in third octaves.

    Bands are independent: the gain of a band is the aid's gain for average speech, at the overall
    level of speech whose level in this band is that of ``band_levels``. Overall levels are limited
    to 0 to 120 dB SPL. These are gains for speech of a constant level. In speech whose level
    changes, an aid that adapts slowly gives soft and loud sections more similar gains.

    Args:
        aid: Aid, linear or compressive.
        audiogram: Audiogram of the ear.
        band_levels: Levels in dB SPL in the third octaves ``SII_BANDS``, (..., 18).

    Returns:
        Gains in dB, (..., 18).

    Raises:
        ValueError: The aid does not accept the ear.

    >>> import hlsim
    >>> from hlsim import Audiogram, NALR, WDRC
    >>> levels = np.full((3, 18), 20.0) + np.array([[0.0], [15.0], [30.0]])
    >>> prescribed_gains(NALR(), Audiogram.standard("N3"), levels)[:, 8].round()  # at 1 kHz
    array([20., 20., 20.])
    >>> prescribed_gains(WDRC(), Audiogram.standard("N3"), levels)[:, 8].round()
    array([27., 23., 17.])
    """
    spectrum = np.array([*SPEECH_SPECTRUM.values()])
    total = 10.0 * np.log10((10.0 ** (spectrum / 10.0)).sum())
    speech_levels = band_levels - [SPEECH_SPECTRUM[band] for band in SII_BANDS] + total
    speech_levels = speech_levels.clip(0.0, 120.0)
    first, last = speech_levels.min(), speech_levels.max()
    steps = np.linspace(first, last, 1 + int(np.ceil((last - first) / TARGET_STEP)))
    gains = np.stack(
        [
            interpolate_over_log(SII_BANDS, FREQUENCIES, aid.gains(audiogram, level).tolist())
            for level in steps
        ]
    )
    bands = range(len(SII_BANDS))
    return np.stack(
        [np.interp(speech_levels[..., band], steps, gains[:, band]) for band in bands], -1
    )


def section_powers(signal: Tensor, sample_rate: int) -> Array:
    """Compute the power of a signal in third octaves, in each section of 125 ms.

    Sections overlap by half, and have a Hann window whose loss of power is compensated. Samples
    after the last whole section are left out. If a band ends above the Nyquist frequency, the power
    of its part below this frequency is scaled to the whole width of the band.

    Args:
        signal: Samples in pascals, (time,), of 125 ms or more.
        sample_rate: Sample rate in Hz, 16000 or more. At lower ones, which are not rejected, the
            bands above the Nyquist frequency have no power.

    Returns:
        Powers in Pa^2 in the third octaves ``SII_BANDS``, (sections, 18).

    Raises:
        RuntimeError: The signal is shorter than 125 ms.

    >>> import torch
    >>> tone = (2.0 * torch.pi * 1000.0 * torch.arange(16000) / 16000).sin()
    >>> powers = section_powers(tone, 16000)
    >>> powers.shape, round(float(powers[0, 8]), 3)
    ((15, 18), 0.5)
    """
    length = round(SECTION_SECONDS * sample_rate)
    sections = signal.detach().double().cpu().unfold(0, length, length // 2).numpy()
    window = np.hanning(length + 1)[:-1]
    points = 4 * length  # so that frequencies are 2 Hz apart, less than a tenth of a band
    scale = 2.0 / (points * np.square(window).sum())
    spectrum = scale * np.abs(np.fft.rfft(sections * window, points)) ** 2
    hertz = np.fft.rfftfreq(points, 1.0 / sample_rate)[:, None]
    centres = np.array(SII_BANDS)
    lower, upper = centres * 2.0 ** (-1.0 / 6.0), centres * 2.0 ** (1.0 / 6.0)
    in_band = (hertz >= lower) & (hertz < upper)
    covered = (np.minimum(upper, sample_rate / 2.0) - lower) / (upper - lower)
    return spectrum @ in_band / covered


def _bandwidth_db() -> Array:
    """Return by how many dB the level of a third octave exceeds its level per Hz, (18,)."""
    width = 2.0 ** (1.0 / 6.0) - 2.0 ** (-1.0 / 6.0)
    return 10.0 * np.log10(width * np.array(SII_BANDS))


def _level(power: Array) -> Array:
    """Convert powers in Pa^2 to levels in dB SPL, element by element."""
    return PASCAL_SPL + 10.0 * np.log10(np.maximum(power, POWER_FLOOR))
