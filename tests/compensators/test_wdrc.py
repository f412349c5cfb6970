"""WDRC against its static curve, and how fast it follows."""

from typing import Any

import pytest
import torch

from compensators import NALR, WDRC, load_compensator
from compensators.filter_bank import centres, shares, speech_levels
from compensators.nalr import nalr_gains_db
from hlsim import Audiogram
from hlsim.audiogram.thresholds import interpolate
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.resample import resample

BANDS = 20


def tone(hertz: float, spl: float, seconds: float = 1.0) -> torch.Tensor:
    time = torch.arange(round(16000 * seconds)) / 16000.0
    return set_level(torch.sin(2.0 * torch.pi * hertz * time), spl)


def test_static_curve() -> None:
    """In each band NAL-R's gain at the level of average speech, and about it a dB of output for every ratio dB of input,
    down to the knee and up to the limit."""
    aid, ears = (
        WDRC().double(),
        torch.tensor([[20.0 * i] * 8 for i in range(6)], dtype=torch.float64),
    )
    powers = torch.rand(6, 1, 129, dtype=torch.float64) * 10.0 ** torch.linspace(
        -9.0, 1.0, 129, dtype=torch.float64
    )
    steady = powers.expand(-1, 1000, -1)
    gains = aid.control(steady, aid.fit(ears), torch.zeros(6, 1000, 0), aid.start(6, powers))[0][
        :, -1
    ]
    levels = 10.0 * (powers[:, 0] @ torch.tensor(shares(BANDS, 256))).log10() + 94.0
    above = levels - torch.tensor(speech_levels(BANDS))
    assert (above < -25.0).any() and (above > 40.0).any()
    ratios = (1.0 + (ears[:, :1] - 10.0) / 40.0).clamp(1.0, 3.0)
    expected = interpolate(nalr_gains_db(ears), centres(BANDS)) + (
        1.0 / ratios - 1.0
    ) * above.clamp(min=-20.0)
    expected = torch.minimum(expected.clamp(min=0.0), (110.0 - levels).clamp(min=0.0))
    assert (gains - expected).abs().max() < 0.01


@pytest.mark.parametrize(("loss", "ratio"), [(0.0, 1.0), (30.0, 1.5), (50.0, 2.0), (80.0, 2.75)])
@pytest.mark.parametrize("hertz", [500.0, 2030.0, 4083.0])
def test_a_louder_tone_comes_out_louder_by_the_ratio(
    loss: float, ratio: float, hertz: float
) -> None:
    ear = torch.full((8,), loss)
    aid = WDRC(limit_spl=140.0)
    soft, loud = (level_spl(aid(tone(hertz, spl), ear)[8000:12000]) for spl in (60.0, 66.0))
    assert abs(float(loud - soft) - 6.0 / ratio) < 0.2


def test_speech_at_65_db_comes_out_as_from_nalr(speech: list[tuple[torch.Tensor, int]]) -> None:
    ear = Audiogram.standard("N3")
    spoken = set_level(resample(*speech[0], 16000)[0, 8000:40000], 65.0)
    assert (level_spl(WDRC()(spoken, ear)) - level_spl(NALR(ear)(spoken))).abs() < 4.0


@pytest.mark.parametrize(("attack", "release"), [(0.005, 0.1), (0.05, 0.4)])
def test_attack_and_release(attack: float, release: float) -> None:
    """Of the gain's way after a step of 30 dB, 1 / e is left after the time constant and what a frame of 16 ms takes."""
    aid: Any = WDRC(attack=attack, release=release)
    ear = torch.full((8,), 60.0)
    stepped = torch.cat((tone(1000.0, 50.0), tone(1000.0, 80.0), tone(1000.0, 50.0, 3.0)))
    envelope = aid(stepped, ear).abs().unfold(-1, 16, 16).amax(-1)
    gain = 20.0 * torch.log10(envelope / stepped.abs().unfold(-1, 16, 16).amax(-1).clamp_min(1e-9))
    soft, loud = gain[800:990].mean(), gain[1800:1990].mean()

    def milliseconds(after: torch.Tensor, settled: torch.Tensor, first: torch.Tensor) -> int:
        return int(((after - settled).abs() < (first - settled).abs() / torch.e).nonzero()[0])

    assert abs(milliseconds(gain[1000:], loud, soft) - 1000.0 * attack) < 12.0
    assert (
        abs(milliseconds(gain[2010:], soft, loud) + 10.0 - 1000.0 * release)
        < 0.2 * 1000.0 * release + 12.0
    )


def test_by_name() -> None:
    assert isinstance(load_compensator("wdrc", full_scale_spl=100.0), WDRC)


@pytest.mark.parametrize(
    "setting",
    [{"bands": 2}, {"attack": -1.0}, {"release": 0.0}, {"knee": 99.0}, {"limit_spl": 200.0}],
)
def test_bad_setting_raises_value_error(setting: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        WDRC(**setting)
