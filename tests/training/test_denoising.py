"""What noise reduction is trained to be."""

import torch

from compensators import HearingAid, HearingAidConfig
from hlsim.audiogram import draw_thresholds
from hlsim.calibration import set_level
from hlsim.training.denoising import attenuation_error


def test_nothing_taken_off_is_right_where_there_is_no_noise_and_wrong_elsewhere() -> None:
    aid, ears = HearingAid(HearingAidConfig(width=8, hidden=8)), draw_thresholds(2)
    with torch.no_grad():
        aid.leave.bias.fill_(-60.0)
        aid.leave.weight.zero_()
    clean = set_level(torch.randn(2, 9000), 65.0)
    silent = torch.zeros(2, 9000)
    assert (attenuation_error(aid, clean, clean, ears) < 1e-9).all()
    assert (attenuation_error(aid, silent, silent, ears) < 1e-9).all()
    # noise alone is to be 12 dB down
    alone = attenuation_error(aid, clean, silent, ears)
    assert ((alone - (1.0 - 10.0 ** (-12.0 / 40.0)) ** 2).abs() < 0.005).all()
    with torch.no_grad():
        aid.leave.bias.fill_(60.0)
    assert (attenuation_error(aid, clean, silent, ears) < 0.02).all()
    assert (attenuation_error(aid, clean, clean, ears) > 0.2).all()


def test_it_learns_to_tell_a_tone_from_noise() -> None:
    aid = HearingAid(HearingAidConfig(width=16, hidden=16))
    optimiser = torch.optim.Adam(aid.parameters(), lr=0.02)
    turns = 1000.0 * torch.arange(8000) / 16000.0
    tone = set_level(torch.sin(2.0 * torch.pi * turns), 60.0).repeat(4, 1)
    errors = []
    for _ in range(30):
        noise = set_level(torch.randn(4, 8000), 60.0)
        error = attenuation_error(aid, tone + noise, tone, draw_thresholds(4)).mean()
        optimiser.zero_grad()
        error.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        errors.append(error.item())
    assert errors[-1] < 0.3 * errors[0]
