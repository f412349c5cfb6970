"""Spectrograms: levels in dB SPL, one scale, differences where something is heard."""

import math

import pytest
import torch

from hlsim.report.spectrograms import RANGE_DB, panels, pictures

pytest.importorskip("matplotlib")


def test_a_tone_has_its_level_and_a_difference_is_in_db() -> None:
    times = torch.arange(8000) / 16000
    tone = math.sqrt(2.0) * 10 ** ((80 - 94) / 20) * torch.sin(2 * math.pi * 1000 * times)
    found = panels({"one": tone, "other": 2 * tone}, 16000, {"less": ("other", "one")})
    assert list(found) == ["one", "other", "less"]
    one, other, less = (draw.keywords for draw in found.values())
    assert float(one["image"][20].median()) == pytest.approx(80.0, abs=0.1)  # bins of 50 Hz
    assert one["scale"] == other["scale"]
    top = one["scale"]["vmax"]
    assert 80.0 < top < 100.0 and one["scale"]["vmin"] == top - RANGE_DB
    difference = less["image"]
    assert float(difference[20].nanmedian()) == pytest.approx(6.02, abs=0.01)
    loud = torch.maximum(one["image"], other["image"]) >= top - RANGE_DB
    assert bool((difference.isfinite() == loud).all()) and not bool(loud.all())


def test_each_panel_is_a_picture() -> None:
    found = panels({"a$b": torch.randn(1600), "silent": torch.zeros(1600)}, 16000)
    assert [picture.alt for picture in pictures(found)] == [
        "Spectrogram: a$b",
        "Spectrogram: silent",
    ]
    assert all(b"<svg" in picture.data for picture in pictures(found))
