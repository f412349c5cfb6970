"""Enhancers of your own: called with signal and rate, and rejected if they delay."""

from pathlib import Path

import pytest
import torch

from hlsim.evaluation.aids import load_enhancers

CODE = """
def softer(waveform, sample_rate):
    return waveform / sample_rate

def late(waveform, sample_rate):
    return waveform.roll(320, -1)
"""


def test_enhancers_are_named_by_what_follows_the_colon(tmp_path: Path) -> None:
    (tmp_path / "plugin.py").write_text(CODE)
    (name, enhancer) = load_enhancers([f"{tmp_path}/plugin.py:softer"]).popitem()
    assert name == "softer"
    assert torch.equal(enhancer(torch.ones(2, 100), 16000), torch.ones(2, 100) / 16000)


def test_delays_and_equal_names_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "plugin.py").write_text(CODE)
    with pytest.raises(ValueError, match="delays by 20"):
        load_enhancers([f"{tmp_path}/plugin.py:late"])
    with pytest.raises(ValueError, match="the same name"):
        load_enhancers([f"{tmp_path}/plugin.py:softer"] * 2)
