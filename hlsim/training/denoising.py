"""What a hearing aid's noise reduction is trained for: gains near Wiener's first, then HASPI at equal level."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from compensators.filter_bank import FRAME, HISTORY, HOP, frame_power, shares
from compensators.hearing_aid import HearingAid
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.metrics.objective import missing_score
from hlsim.neuro.config import NEURO_RATE
from hlsim.torchtools import constant_like

_QUIET = 10.0 ** (-PASCAL_SPL / 10.0)  # power at 0 dB SPL, so that nothing is taken off silence
_SHARE = 0.6  # of the dB
_AHEAD = 1  # frames that the gain comes later than the frame that it is of


def attenuation_error(aid: HearingAid, signal: Tensor, clean: Tensor) -> Tensor:
    """Mean square difference, of the roots, of noise reduction's gains and those wanted.

    These are 0.6 of the dB of sqrt(speech / (speech + noise)) of powers, RNNoise's (Valin 2018, MMSP), no less than the
    aid takes off at most. What is estimated errs, and errors of a milder gain cost less: of networks that took off all
    of it, 0.6 with 12 dB at most had the highest HASPI in noise. It is dense, and needs no simulator and no ear.

    Shape: (items, time) twice, in pascals -> (items,).
    """
    whole = signal.shape[-1] // HOP * HOP
    signal, clean = signal[:, :whole], clean[:, :whole]
    gains = 10.0 ** (aid.attenuation(signal) / 20.0)
    with torch.no_grad():
        parts = functional.pad(torch.stack((clean, signal - clean)), (HISTORY, 0)).flatten(0, 1)
        speech, noise = (frame_power(parts) @ constant_like(parts, shares, aid.bands, FRAME)).chunk(
            2
        )
        wiener = ((speech + _QUIET) / (speech + noise + _QUIET)).sqrt()
        aim = (wiener**_SHARE).clamp_min(10.0 ** (-aid.config.reduction_db / 20.0))[:, _AHEAD:]
    return (gains[:, :-_AHEAD].sqrt() - aim.sqrt()).square().mean((-2, -1))


def missing_intelligibility(aid: HearingAid, signal: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    """What HASPI of the aid's output lacks of 1, at the level that the aid gives the clean speech.

    HASPI rewards gain, and noise reduction lowers the level; at equal level it can win only by what it takes off.
    Wiener's gains do not know that a syllable's onset matters more than the noise before it: a causal estimate of them
    comes late there, and loses much of what it won.

    Shape: (items, time) twice, in pascals, and (items, 8) dB HL -> (items,).
    """
    given = aid(signal, ears)
    with torch.no_grad():
        level = level_spl(aid(clean, ears, noise_reduction=0.0))
    lengths = [signal.shape[-1]] * len(signal)
    return missing_score("haspi", set_level(given, level), clean, ears, lengths, NEURO_RATE)
