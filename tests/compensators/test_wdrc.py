"""Compression has its static curve and its time constants."""

import pytest
import torch

from compensators import WDRC
from compensators.filter_bank import filter_centres, filter_powers, speech_band_levels
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.prescription import nalr_gains_db
from hlsim.dsp.interpolation import interpolate
from tests.compensators.aids import tone

BANDS = 20


def test_the_static_curve_is_nalrs_gain_with_a_ratio_above_the_knee_up_to_the_limit() -> None:
    aid = WDRC().double()
    ears = torch.tensor([[20.0 * i] * 8 for i in range(6)]).double()
    slope = 10.0 ** torch.linspace(-9.0, 1.0, 129).double()
    powers = torch.rand(6, 1, 129).double() * slope
    sliders = torch.zeros(6, 1000, 0).double()
    steady = powers.expand(-1, 1000, -1)
    gains, _ = aid.compute_gains(steady, aid.fit(ears), sliders, aid.initial_state(sliders[:, 0]))
    levels = 10.0 * filter_powers(powers[:, 0], BANDS).log10() + 94.0
    above_speech = levels - torch.tensor(speech_band_levels(BANDS))
    assert (above_speech < -25.0).any()
    assert (above_speech > 40.0).any()
    ratios = (1.0 + (ears[:, :1] - 10.0) / 40.0).clamp(1.0, 3.0)
    prescribed = interpolate(nalr_gains_db(ears), FREQUENCIES, filter_centres(BANDS))
    expected = prescribed + (1.0 / ratios - 1.0) * above_speech.clamp(min=-20.0)
    expected = torch.minimum(expected.clamp(min=0.0), (110.0 - levels).clamp(min=0.0))
    assert (gains[:, -1] - expected).abs().max() < 0.01


@pytest.mark.parametrize(("attack", "release"), [(0.005, 0.1), (0.05, 0.4)])
def test_the_gain_settles_with_the_time_constants(attack: float, release: float) -> None:
    """After a step of 30 dB, 1 / e of the change is left after the time constant and one frame."""
    aid = WDRC(attack=attack, release=release)
    steps = torch.cat((tone(1000.0, 50.0), tone(1000.0, 80.0), tone(1000.0, 50.0, 3.0)))
    output = aid(steps, torch.full((8,), 60.0))
    envelopes = [signal.abs().unfold(-1, 16, 16).amax(-1) for signal in (output, steps)]
    gain = 20.0 * torch.log10(envelopes[0] / envelopes[1].clamp_min(1e-9))
    soft, loud = gain[800:990].mean(), gain[1800:1990].mean()

    def milliseconds(gain: torch.Tensor, target: torch.Tensor) -> int:
        is_settled = (gain - target).abs() < (soft - loud).abs() / torch.e
        return int(is_settled.nonzero()[0])

    assert milliseconds(gain[1000:], loud) == pytest.approx(1000.0 * attack, abs=12.0)
    fall = milliseconds(gain[2010:], soft) + 10.0
    assert fall == pytest.approx(1000.0 * release, abs=200.0 * release + 12.0)
