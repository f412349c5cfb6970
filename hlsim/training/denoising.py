"""What a hearing aid's noise reduction is to be: for each band and frame, the share of speech in what is there."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from compensators.aid import HearingAid
from compensators.bands import FRAME, HISTORY, HOP, frame_power, shares
from hlsim.calibration import PASCAL_SPL
from hlsim.torchtools import constant_like

_QUIET = 10.0 ** (-PASCAL_SPL / 10.0)  # power at 0 dB SPL, so that nothing is taken off silence
_SHARE = 0.6  # of the dB
_AHEAD = 1  # frames that the gain comes later than the frame that it is of


def attenuation_error(aid: HearingAid, signal: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    """Mean square difference, of the roots, of the bands' gains without amplification and those wanted.

    These are 0.6 of the dB of sqrt(speech / (speech + noise)) of powers, RNNoise's (Valin 2018, MMSP), no less than the
    aid takes off at most. What is estimated errs, and errors of a milder gain cost less: of networks that took off all
    of it, 0.6 with 12 dB at most had the highest HASPI in noise. It is dense, and needs no simulator.

    Shape: (items, time) twice, in pascals, and (items, 8) dB HL -> (items,).
    """
    whole = signal.shape[-1] // HOP * HOP
    signal, clean = signal[:, :whole], clean[:, :whole]
    sliders = signal.new_tensor([1.0, 0.0]).expand(len(signal), -1)
    gains = aid.advance(signal, aid.fit(ears), sliders, aid.initial(sliders))["gains"][:, 2:] + 1.0
    with torch.no_grad():
        parts = functional.pad(torch.stack((clean, signal - clean)), (HISTORY, 0)).flatten(0, 1)
        speech, noise = (frame_power(parts) @ constant_like(parts, shares, aid.bands, FRAME)).chunk(2)
        wiener = ((speech + _QUIET) / (speech + noise + _QUIET)).sqrt()
        aim = (wiener**_SHARE).clamp_min(10.0 ** (-aid.config.reduction_db / 20.0))[:, _AHEAD:]
    return (gains[:, :-_AHEAD].sqrt() - aim.sqrt()).square().mean((-2, -1))
