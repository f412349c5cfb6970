"""The teacher: the exact MSBG, or another simulator."""

import pytest
import torch

from hlsim import MSBG, Audiogram
from hlsim.training.teacher import Teacher, find_teacher, name_of

EARS = torch.tensor([Audiogram.standard(name).thresholds for name in ("N2", "N5")])


def test_the_teacher_is_the_exact_msbg() -> None:
    signals = 0.02 * torch.randn(2, 8000)
    assert torch.equal(Teacher(16000)(signals, EARS), MSBG(sample_rate=16000)(signals, EARS))
    assert find_teacher("msbg") is None and name_of(None) == "msbg"


def test_another_simulator_is_asked_item_by_item() -> None:
    def attenuate(signal: torch.Tensor, ear: Audiogram, sample_rate: int) -> torch.Tensor:
        return signal * 10.0 ** (-ear.thresholds[0] / 20.0) * sample_rate

    signals = torch.ones(2, 100)
    expected = signals * 10.0 ** (-EARS[:, :1] / 20.0) * 16000
    torch.testing.assert_close(Teacher(16000, attenuate)(signals, EARS), expected)
    assert name_of(attenuate) == "attenuate"


def test_unknown_teachers_are_rejected() -> None:
    with pytest.raises(ValueError, match="pyclarty"):
        find_teacher("pyclarty")
