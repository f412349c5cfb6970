"""A teacher of your own is called at its rate, and rejected if it cannot be learned."""

from pathlib import Path

import pytest
import torch

from hlsim.calibration import set_level
from hlsim.training.teacher import PluginTeacher, find_teacher

PLUGIN = """
class Quieter:
    sample_rate = 44100
    def __call__(self, waveform, audiogram):
        return 0.5 * waveform * 10 ** (-audiogram[:, :1] / 20)

def late(waveform, audiogram):
    return waveform.roll(320, -1)
"""


def test_a_plug_in_is_called_at_its_own_rate(tmp_path: Path) -> None:
    (tmp_path / "plugin.py").write_text(PLUGIN)
    teacher = find_teacher(f"{tmp_path}/plugin.py:Quieter")
    speech = set_level(torch.randn(2, 16000), 65.0)
    # the band that both rates hold
    low = torch.fft.irfft(torch.fft.rfft(speech) * (torch.arange(8001) < 6000), 16000)
    assert teacher is not None
    perceived = teacher(low, torch.tensor([[0.0] * 8, [20.0] * 8]))
    expected = low * torch.tensor([[0.5], [0.05]])
    assert float((perceived - expected)[:, 400:-400].norm() / expected.norm()) < 1e-3
    assert str(teacher) == f"{tmp_path}/plugin.py:Quieter"


def test_unknown_and_late_teachers_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "plugin.py").write_text(PLUGIN)
    with pytest.raises(ValueError, match="pyclarty"):
        find_teacher("pyclarty")
    for name, words in (("late", "delays by"), ("nobody", "nobody")):
        with pytest.raises(ValueError, match=words):
            PluginTeacher(f"{tmp_path}/plugin.py:{name}")
