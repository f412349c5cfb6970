"""The teacher: blocks against the whole, alignment, and other simulators."""

import logging

import pytest
import torch
from torch import Tensor

from hlsim import MSBG, Audiogram
from hlsim.calibration import set_level
from hlsim.data.teacher import Teacher
from hlsim.dsp.resample import resample
from hlsim.msbg import estimate_delay


@pytest.fixture
def long_speech(speech: list[tuple[Tensor, int]]) -> Tensor:
    """6.5 s at 16 kHz and 65 dB SPL: three blocks."""
    joined = torch.cat([resample(waveform[0], rate, 16000) for waveform, rate in speech])
    return set_level(joined[: round(6.5 * 16000)], 65.0)


@pytest.mark.parametrize("name", ["NH", "N1", "N3", "S3"])
def test_blocks_are_the_whole(long_speech: Tensor, name: str) -> None:
    ear = torch.tensor(Audiogram.standard(name).thresholds)
    whole = MSBG(sample_rate=16000)(long_speech, ear)
    heard = Teacher(16000)(long_speech[None], ear[None])[0]
    assert heard.shape == whole.shape
    assert float((heard - whole).norm() / whole.norm()) < 1e-4
    # nor are the places where blocks meet any worse
    assert float((heard - whole).abs().max() / whole.abs().max()) < 1e-4


def test_a_batch_is_its_items_and_padding_changes_nothing(long_speech: Tensor) -> None:
    teacher = Teacher(16000)
    ears = torch.tensor([Audiogram.standard(name).thresholds for name in ("N2", "N5")])
    short = torch.nn.functional.pad(long_speech[:20000], (0, len(long_speech) - 20000))
    together = teacher(torch.stack((long_speech, short)), ears)
    for i, signal in enumerate((long_speech, long_speech[:20000])):
        alone = teacher(signal[None], ears[i : i + 1])[0]
        assert float((together[i, : len(signal)] - alone).norm() / alone.norm()) < 1e-5


@pytest.mark.parametrize("name", ["NH", "N4"])
def test_the_impulse_method_takes_whole_samples(long_speech: Tensor, name: str) -> None:
    ear = Audiogram.standard(name)
    unaligned = MSBG(sample_rate=16000, aligned=False)
    delay = estimate_delay(unaligned, ear)
    signal, levels = long_speech[:40000], torch.tensor(ear.thresholds)
    teacher = Teacher(16000, alignment="impulse")
    assert teacher.delay(levels) == delay > 350
    late = unaligned(torch.nn.functional.pad(signal, (0, 2000)), ear)
    for blocks in (True, False):
        heard = teacher(signal[None], levels[None], blocks=blocks)[0]
        expected = late[delay : delay + len(signal)]
        assert float((heard - expected).norm() / expected.norm()) < 1e-4
    as_it_is = Teacher(16000, alignment="none")(signal[None], levels[None])[0]
    assert float((as_it_is - late[: len(signal)]).norm() / late.norm()) < 1e-4


def test_pyclarity_as_the_teacher(long_speech: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("clarity")
    from hlsim.metrics.reference import pyclarity_msbg

    ear = Audiogram.standard("N3")
    levels, signal = torch.tensor(ear.thresholds), long_speech[:16000]
    monkeypatch.setattr(logging.root.manager, "disable", logging.ERROR)
    reference = Teacher(16000, reference=pyclarity_msbg)(signal[None], levels[None])[0]
    assert logging.root.manager.disable == logging.ERROR  # as the host has it
    assert reference.dtype == torch.float32
    exact = Teacher(16000)(signal[None], levels[None])[0]
    assert float((reference - exact).norm() / exact.norm()) < 0.03  # its resampling is another
    shifted = Teacher(16000, alignment="impulse", reference=pyclarity_msbg)(
        signal[None], levels[None]
    )[0]
    own = Teacher(16000, alignment="impulse")(signal[None], levels[None])[0]
    places = range(-3, 4)
    errors = [float((shifted.roll(k) - own)[100:-100].norm()) for k in places]
    assert places[errors.index(min(errors))] in (
        -1,
        0,
        1,
    )  # half a sample of rounding on either side


@pytest.mark.parametrize(
    ("rate", "grid"), [(16000, 10240), (22050, 32), (44100, 64), (48000, 10240)]
)
def test_the_grid_of_rates(rate: int, grid: int) -> None:
    teacher = Teacher(rate)
    assert teacher.grid == grid and grid * 44100 % (64 * rate) == 0
    assert teacher.context % grid == 0 and teacher.body % grid == 0


def test_what_is_refused() -> None:
    with pytest.raises(ValueError, match="sample rate 16001 Hz for a teacher"):
        Teacher(16001)
    with pytest.raises(ValueError, match="alignment 'guess'; allowed: structural, impulse, none"):
        Teacher(16000, alignment="guess")
