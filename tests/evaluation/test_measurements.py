"""What a compensator makes of steady tones, and how it would be worn: filters pass, and what is at fault is caught."""

import math

import pytest
import torch
from torch import Tensor, nn

from compensators import NALR
from hlsim import MSBG, Audiogram
from hlsim.calibration import level_spl
from hlsim.evaluation.aids import Unaided
from hlsim.evaluation.measurements import TONES, steady_tones, tones, wearing
from hlsim.evaluation.measures import NORMAL

N3 = Audiogram.standard("N3")


class Modulating(nn.Module):
    """The waveform times 1 + depth cos(2 pi 80 t)."""

    def __init__(self, depth: float) -> None:
        super().__init__()
        self.depth = depth

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        turns = 80 * torch.arange(waveform.shape[-1]) % 16000 / 16000
        return waveform * (1.0 + self.depth * (2.0 * torch.pi * turns).cos())


class Muting(nn.Module):
    """40 dB less of a sound whose level stays the same from one 32 ms to the next."""

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        levels = level_spl(waveform[: len(waveform) // 512 * 512].unflatten(-1, (-1, 512)))
        return 0.01 * waveform if float(levels.std()) < 1.0 else waveform


class Unable(nn.Module):
    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        return waveform * math.nan


def test_tones() -> None:
    # the levels of each tone, in the order of the tones
    sound = tones((250, 1000), (50.0, 65.0, 80.0))
    torch.testing.assert_close(level_spl(sound), torch.tensor([50.0, 65.0, 80.0, 50.0, 65.0, 80.0]))
    assert (torch.fft.rfft(sound).abs().argmax(-1) / 2).tolist() == [250.0] * 3 + [1000.0] * 3


def test_unaided_is_what_the_exact_model_gives() -> None:
    (found,) = steady_tones({"unaided": Unaided()}, {"N3": N3}, (50.0, 65.0))
    assert (found["aid"], found["ear"], found["levels"]) == ("unaided", "N3", [50.0, 65.0])
    time = torch.arange(32000, dtype=torch.float64) / 16000
    for row, level in enumerate((50.0, 65.0)):
        tone = 2**0.5 * 10.0 ** ((level - 94.0) / 20.0) * (2.0 * torch.pi * 1000.0 * time).sin()
        heard, normal = (
            level_spl(MSBG(ear, sample_rate=16000)(tone)[8000:24000]) for ear in (N3, NORMAL)
        )
        off = found["loudness_error_db"][row][TONES.index(1000)]
        assert off == pytest.approx(float(heard - normal), abs=0.01) and off < -20.0


def test_a_filter_adds_nothing() -> None:
    (found,) = steady_tones({"NAL-R": NALR()}, {"N3": N3}, (50.0, 80.0))
    assert max(map(max, found["sidebands_db"])) < -60.0


@pytest.mark.parametrize("depth", [0.1, 1.0])
def test_modulation_is_caught(depth: float) -> None:
    (found,) = steady_tones({"own": Modulating(depth)}, {"NH": NORMAL}, (65.0,))
    # two sidebands of depth / 2
    (sidebands,) = found["sidebands_db"]
    assert sidebands == pytest.approx([10.0 * math.log10(depth**2 / 2.0)] * len(TONES), abs=0.01)
    # a linear ear hears them too
    assert found["loudness_error_db"][0][2] == pytest.approx(
        10.0 * math.log10(1.0 + depth**2 / 2.0), abs=0.1
    )


def test_muting_of_steady_sounds_is_caught() -> None:
    # with no loss all is linear: 0 dB off unaided, and what was taken away
    unaided, muted = steady_tones(
        {"unaided": Unaided(), "own": Muting()}, {"NH": NORMAL}, (50.0, 80.0)
    )
    for level in range(2):
        assert unaided["loudness_error_db"][level] == pytest.approx([0.0] * len(TONES), abs=1e-3)
        assert muted["loudness_error_db"][level] == pytest.approx([-40.0] * len(TONES), abs=1e-3)


class LookingAhead(nn.Module):
    """The sound of so many samples later, twice as loud; soft sounds ten times as loud."""

    def __init__(self, samples: int) -> None:
        super().__init__()
        self.samples = samples

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        gain = 2.0 if float(level_spl(waveform)) > 50.0 else 10.0
        return gain * torch.cat((waveform[self.samples :], waveform[: self.samples]))


def test_what_wearing_it_would_be_like() -> None:
    speech = torch.randn(48000, generator=torch.Generator().manual_seed(1))
    aids = {"own": LookingAhead(80), "none": Unaided(), "NAL-R": NALR()}
    own, none, prescribed = wearing(aids, {"N3": N3}, speech)
    assert own["look_ahead_ms"] == pytest.approx(5.0) and none["look_ahead_ms"] == 0.0
    assert own["quiet_gain_db"] == pytest.approx([20.0, 20.0], abs=0.1)
    assert none["quiet_gain_db"] == [0.0, 0.0]
    # its filter has 110 samples before the middle, the first of them small
    assert 3.0 < prescribed["look_ahead_ms"] <= 1000.0 * 110 / 16000
    assert all(found["cpu_ms"] > 0.0 for found in (own, prescribed))
    with pytest.raises(
        ValueError, match="own, ear N3, changed speech: the output has samples that are NaN"
    ):
        wearing({"own": Unable()}, {"N3": N3}, speech)


def test_silence_has_figures() -> None:
    silent = {"own": lambda waveform, ear: 0.0 * waveform}
    (found,) = steady_tones(silent, {"NH": NORMAL}, (65.0,))  # type: ignore[arg-type]
    assert (
        found["sidebands_db"] == [[-200.0] * len(TONES)]
        and found["loudness_error_db"][0][2] < -140.0
    )
    noise = torch.randn(48000, generator=torch.Generator().manual_seed(0))
    (worn,) = wearing(silent, {"NH": NORMAL}, noise)  # type: ignore[arg-type]
    assert worn["look_ahead_ms"] == 0.0 and max(worn["quiet_gain_db"]) < -100.0


def test_samples_that_are_not_numbers() -> None:
    with pytest.raises(
        ValueError, match="own, ear N3, steady tones: the output has samples that are NaN"
    ):
        steady_tones({"own": Unable()}, {"N3": N3}, (65.0,))
