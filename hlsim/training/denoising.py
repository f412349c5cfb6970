"""Training criteria for a hearing aid's noise reduction: the error of its gains, and HASPI."""

import torch
from torch import Tensor
from torch.nn import functional

from compensators.filter_bank import HISTORY, HOP, POWER_FLOOR, filter_powers, frame_power
from compensators.hearing_aid import HearingAid
from hlsim.calibration import NEURO_RATE, level_spl, set_level
from hlsim.losses.score_loss import score_loss

_WIENER_EXPONENT = 0.6
"""Ratio of the target gain in dB to Wiener's gain in dB."""

_GAIN_DELAY = 1
"""Number of frames between the frame from which a gain is estimated and that to which it
applies."""


def attenuation_error(aid: HearingAid, signal: Tensor, clean: Tensor) -> Tensor:
    """Compute the error of the gains with which a hearing aid reduces noise in each band.

    The target is Wiener's gain sqrt(speech / (speech + noise)) of the powers in a band, raised to
    the power 0.6, and at least the lowest gain of the aid. The error is the mean square difference
    between the square roots of the gains, as in RNNoise (Valin 2018, MMSP).

    Estimates have errors, which cost less if the gains are milder. Among networks that were trained
    with other exponents and largest attenuations, those with 0.6 and 12 dB had the highest HASPI in
    noise. The criterion requires neither a simulator nor an ear.

    Args:
        aid: Hearing aid at 16 kHz.
        signal: Noisy speech in pascals with shape (items, time).
        clean: The same speech without noise, in pascals with shape (items, time).

    Returns:
        The error of each item, with shape (items,), from 0 to 1.

    >>> clean = 0.02 * torch.randn(2, 8000)
    >>> attenuation_error(HearingAid(), clean + 0.01 * torch.randn(2, 8000), clean).shape
    torch.Size([2])
    """
    samples = signal.shape[-1] // HOP * HOP
    signal, clean = signal[:, :samples], clean[:, :samples]
    gains = 10.0 ** (aid.attenuation(signal) / 20.0)
    with torch.no_grad():
        parts = torch.stack((clean, signal - clean))
        frames = frame_power(functional.pad(parts, (HISTORY, 0)).flatten(0, 1))
        speech, noise = filter_powers(frames, aid.bands).chunk(2)
        # The floor of the levels of the aid is added to speech, so that silence is not attenuated.
        wiener = ((speech + POWER_FLOOR) / (speech + noise + POWER_FLOOR)).sqrt()
        lowest_gain = 10.0 ** (-aid.config.reduction_db / 20.0)
        target = (wiener**_WIENER_EXPONENT).clamp_min(lowest_gain)[:, _GAIN_DELAY:]
    return (gains[:, :-_GAIN_DELAY].sqrt() - target.sqrt()).square().mean((-2, -1))


def missing_intelligibility(aid: HearingAid, signal: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    """Compute how much intelligibility an aid with noise reduction leaves missing: 1 - HASPI.

    HASPI (0 to 1) rewards gain, and noise reduction lowers the level. The output is therefore
    scored at the level that the aid gives to the clean speech, so that noise reduction improves the
    score only by removing noise. Unlike Wiener's gains, this criterion accounts for the onsets of
    syllables, at which a causal estimate of the gains is late.

    Args:
        aid: Hearing aid at 16 kHz.
        signal: Noisy speech in pascals with shape (items, time).
        clean: The same speech without noise, in pascals with shape (items, time).
        ears: Hearing thresholds in dB HL at ``FREQUENCIES``, with shape (items, 8).

    Returns:
        1 - HASPI of each item, with shape (items,); 0 without a gradient for clean speech that has
        no score, see ``score_loss``.

    Raises:
        ValueError: The signals are shorter than 0.7 s.

    >>> clean, ears = 0.02 * torch.randn(1, 16000), torch.full((1, 8), 40.0)
    >>> missing_intelligibility(HearingAid(), clean, clean, ears).shape
    torch.Size([1])
    """
    output = aid(signal, ears, noise_reduction=1.0)
    with torch.no_grad():
        level = level_spl(aid(clean, ears, noise_reduction=0.0))
    lengths = [signal.shape[-1]] * len(signal)
    return score_loss("haspi", set_level(output, level), clean, ears, lengths, NEURO_RATE)
