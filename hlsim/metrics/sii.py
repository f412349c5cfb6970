"""The speech intelligibility index (SII) of ANSI S3.5-1997, by third octaves.

The index is the audible share of speech, 0 to 1, with a weight for the importance of each band.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hlsim.audiogram.published import SII_TABLE

SII_BANDS = tuple(SII_TABLE)
"""Centres of the 18 third octaves in Hz."""

_IMPORTANCE, _NORMAL_SPEECH, INTERNAL_NOISE = zip(*SII_TABLE.values(), strict=True)
"""Importance of each band, and levels of speech and of a normal ear's noise, see ``SII_TABLE``."""

SILENCE = -50.0
"""Spectrum level in dB SPL per Hz that means no noise."""


def sii(
    speech: ArrayLike, noise: ArrayLike = (SILENCE,) * 18, thresholds: ArrayLike = (0.0,) * 18
) -> float:
    """Compute the speech intelligibility index, 0 to 1.

    Source: ANSI S3.5-1997, section 4, with the third-octave procedure and table 3.

    Args:
        speech: Spectrum levels of the speech at the ear, as in a free field, in dB SPL per Hz at
            ``SII_BANDS``, (18,).
        noise: Spectrum levels of noise, in the same unit, (18,); by default none.
        thresholds: Thresholds of the ear in dB HL at ``SII_BANDS``, (18,); by default 0 dB HL.

    Raises:
        ValueError: An argument does not have 18 levels.

    Example C.2 of the standard, for which a published implementation gives 0.851:

    >>> round(sii([54.0] * 18, [40.0, 30.0, 20.0] + [0.0] * 15), 3)
    0.851
    """
    speech_level, noise_level, loss = map(_as_levels, (speech, noise, thresholds))
    hertz = np.array(SII_BANDS, dtype=float)
    disturbance = np.maximum(
        _masking(speech_level, noise_level, hertz), np.array(INTERNAL_NOISE) + loss
    )
    # Loud speech is distorted: from 10 dB above normal effort on, 1/160 is lost per dB.
    distortion = 1.0 - (speech_level - np.array(_NORMAL_SPEECH) - 10.0) / 160.0
    audible = ((speech_level - disturbance + 15.0) / 30.0).clip(0.0, 1.0)
    return float((np.array(_IMPORTANCE) * distortion.clip(0.0, 1.0) * audible).sum())


def _masking(speech: NDArray[np.float64], noise: NDArray[np.float64], hertz: NDArray) -> NDArray:
    """Compute the level of noise and of the masking that spreads from lower to higher bands.

    Args:
        speech: Spectrum levels of speech in dB SPL per Hz. Shape: (18,).
        noise: Spectrum levels of noise in dB SPL per Hz. Shape: (18,).
        hertz: Centres of the bands in Hz. Shape: (18,).

    Returns:
        Spectrum levels in dB SPL per Hz. Shape: (18,).
    """
    # Speech masks itself by a level 24 dB below its own.
    masker = np.maximum(noise, speech - 24.0)
    slope = -80.0 + 0.6 * (masker + 10.0 * np.log10(hertz) - 6.353)  # dB per octave
    decades = np.log10(0.89 * hertz[:, None] / hertz)  # from the upper edge of the masker
    spread = 10.0 ** (0.1 * (masker + 3.32 * slope * decades))
    from_lower_bands = np.tril(spread, -1).sum(1)
    total = 10.0 * np.log10(10.0 ** (0.1 * noise) + from_lower_bands)
    total[0] = masker[0]
    return total


def _as_levels(levels: ArrayLike) -> NDArray[np.float64]:
    """Convert levels to a float64 array of shape (18,).

    Raises:
        ValueError: The levels have another shape.
    """
    array = np.asarray(levels, dtype=float)
    if array.shape != (len(SII_BANDS),):
        raise ValueError(
            f"expected {len(SII_BANDS)} levels, one per third octave from 160 to 8000 Hz, got "
            f"shape {array.shape}"
        )
    return array
