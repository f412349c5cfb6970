"""Criteria of a hearing aid's noise reduction: gains near Wiener's at first, then HASPI at equal level."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from compensators.filter_bank import FRAME, HISTORY, HOP, frame_power, shares
from compensators.hearing_aid import HearingAid
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.metrics.objective import score_loss
from hlsim.neuro.config import NEURO_RATE
from hlsim.torchtools import constant_like

POWER_FLOOR = 10.0 ** (-PASCAL_SPL / 10.0)
"""Power at 0 dB SPL in pascals squared, so that silence is not attenuated."""

WIENER_EXPONENT = 0.6
"""Share of the dB of Wiener's gain that the wanted gain has."""

GAIN_DELAY = 1
"""Number of frames by which a gain is applied later than the frame from which it is estimated."""


def attenuation_error(aid: HearingAid, signal: Tensor, clean: Tensor) -> Tensor:
    """Compute the mean square difference between the square roots of the gains of noise reduction and of wanted gains.

    The wanted gains have 0.6 of the dB of sqrt(speech / (speech + noise)), in powers, RNNoise's (Valin 2018, MMSP), and
    are not below the largest attenuation of the aid. An estimate has errors, and those of a milder gain cost less: of
    networks trained towards all of the dB or a part of them, those with 0.6 and at most 12 dB had the highest HASPI in
    noise. The criterion needs neither a simulator nor an ear.

    Shape: (items, time) twice, in pascals -> (items,).
    """
    samples = signal.shape[-1] // HOP * HOP
    signal, clean = signal[:, :samples], clean[:, :samples]
    gains = 10.0 ** (aid.attenuation(signal) / 20.0)
    with torch.no_grad():
        parts = torch.stack((clean, signal - clean))
        frames = frame_power(functional.pad(parts, (HISTORY, 0)).flatten(0, 1))
        band_shares = constant_like(parts, shares, aid.bands, FRAME)
        speech, noise = (frames @ band_shares).chunk(2)
        wiener = ((speech + POWER_FLOOR) / (speech + noise + POWER_FLOOR)).sqrt()
        lowest_gain = 10.0 ** (-aid.config.reduction_db / 20.0)
        wanted = (wiener**WIENER_EXPONENT).clamp_min(lowest_gain)[:, GAIN_DELAY:]
    return (gains[:, :-GAIN_DELAY].sqrt() - wanted.sqrt()).square().mean((-2, -1))


def missing_intelligibility(aid: HearingAid, signal: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    """Compute 1 minus HASPI of the aid's output, scaled to the level that the aid gives to the clean speech.

    HASPI rewards gain, and noise reduction lowers the level; at equal level it can win only by the noise it removes.
    Wiener's gains ignore that the onset of a syllable matters more than the noise before it: a causal estimate of them is
    late at onsets and loses much of what it has won.

    Shape: (items, time) twice, in pascals, and (items, 8) dB HL -> (items,).
    """
    output = aid(signal, ears)
    with torch.no_grad():
        level = level_spl(aid(clean, ears, noise_reduction=0.0))
    lengths = [signal.shape[-1]] * len(signal)
    return score_loss("haspi", set_level(output, level), clean, ears, lengths, NEURO_RATE)
