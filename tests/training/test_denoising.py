"""Training criteria of noise reduction have their defining properties."""

import torch

from compensators import HearingAid, HearingAidConfig
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.resample import resample
from hlsim.metrics import haspi
from hlsim.training.denoising import attenuation_error, missing_intelligibility


def test_no_attenuation_is_right_without_noise_and_wrong_in_noise() -> None:
    aid = HearingAid(config=HearingAidConfig(width=8, hidden=8))
    with torch.no_grad():
        aid.leave.bias.fill_(-60.0)
        aid.leave.weight.zero_()
    clean = set_level(torch.randn(2, 9000), 65.0)
    silent = torch.zeros(2, 9000)
    assert (attenuation_error(aid, clean, clean) < 1e-9).all()
    assert (attenuation_error(aid, silent, silent) < 1e-9).all()
    # The target for noise alone is 12 dB of attenuation.
    alone = attenuation_error(aid, clean, silent)
    assert ((alone - (1.0 - 10.0 ** (-12.0 / 40.0)) ** 2).abs() < 0.005).all()
    with torch.no_grad():
        aid.leave.bias.fill_(60.0)
    assert (attenuation_error(aid, clean, silent) < 0.02).all()
    assert (attenuation_error(aid, clean, clean) > 0.2).all()


def test_intelligibility_is_haspi_at_the_level_of_amplified_clean_speech(
    speech: list[tuple[torch.Tensor, int]],
) -> None:
    aid, ears = (
        HearingAid(config=HearingAidConfig(width=8, hidden=8)).eval(),
        torch.full((2, 8), 50.0),
    )
    clean = set_level(resample(*speech[0], 16000)[:, :16000], 65.0).expand(2, -1)
    signal = clean + set_level(torch.randn(2, 16000), 60.0)
    missing = missing_intelligibility(aid, signal, clean, ears)
    level = level_spl(aid(clean, ears, 0.0))
    expected = 1.0 - haspi(set_level(aid(signal, ears, 1.0), level), clean, ears)
    torch.testing.assert_close(missing, expected)
