"""Thresholds as tensors: converted, validated, stored, and interpolated as numpy interpolates."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compensators import NALR, load_compensator
from hlsim import MSBG, load_pretrained
from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.audiogram.listener import Listener
from hlsim.audiogram.thresholds import as_thresholds
from hlsim.data.ears import draw_thresholds
from hlsim.dsp.interpolation import interpolate, interpolation_weights
from hlsim.metrics import haspi


def test_thresholds_for_a_simulator() -> None:
    n1, s1 = Audiogram.standard("N1"), Audiogram.standard("S1")
    assert as_thresholds(n1).tolist() == list(n1.levels)
    assert as_thresholds([n1, s1]).tolist() == [list(n1.levels), list(s1.levels)]
    assert as_thresholds((Audiogram((7.0,), (1000.0,)),)).tolist() == [[7.0] * 8]
    levels = torch.zeros(2, 3, 8, dtype=torch.float64)
    assert as_thresholds(levels) is levels
    assert as_thresholds(torch.full((8,), 100)).dtype == torch.float32
    assert as_thresholds(levels.requires_grad_()).requires_grad


A_DICTIONARY = r"for other frequencies .*\{500: 20, 4000: 50\}"
NO_EARS: list[tuple[Any, str]] = [
    (torch.tensor([0.0] * 6 + [torch.nan, 0.0]), "got nan at 6000 Hz"),
    ({500: 20.0, 4000: 130.0}, "got 130 at 4000 Hz"),
    ("N7", "got 105 at 1000 Hz"),
    (torch.tensor([[0.0] * 8, [-10.1] * 8]), "got -10.1 at 250 Hz"),
    *((ear, A_DICTIONARY) for ear in ([20.0] * 6, np.zeros(6), torch.zeros(2, 6))),
    *(([torch.zeros(size)] * 8, r"torch\.stack") for size in (3, 8)),
    *((ear, "audiogram") for ear in (torch.tensor(3.0), torch.zeros(0, 8), [], "loud", None)),
    *((ear, "expected") for ear in ([[0.0] * 7], {"hl_250": "20"})),
]


@pytest.mark.parametrize(("ear", "message"), NO_EARS)
def test_values_that_are_not_ears_for_a_simulator_are_rejected(ear: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        as_thresholds(ear)


def test_mono_items_have_one_ear_each() -> None:
    """Waveforms of shape (batch, 1, time) take thresholds of shape (batch, 8) everywhere."""
    waveform = 0.02 * torch.randn(2, 1, 16000)
    ears = torch.tensor([20.0, 60.0]).unsqueeze(-1).expand(2, 8)
    mono = waveform[:, 0]
    for module in (MSBG(), NALR(), load_compensator("hearing-aid"), load_pretrained("neuro-msbg")):
        output = module(waveform, ears)
        assert output.shape == waveform.shape
        torch.testing.assert_close(output[:, 0], module(mono, ears), atol=1e-6, rtol=1e-4)
    assert MSBG()(waveform, ears[:, None].expand(2, 3, 8)).shape == (2, 3, 16000)
    assert torch.equal(haspi(waveform, waveform, ears), haspi(mono, mono, ears)[:, None])
    with pytest.raises(ValueError):
        haspi(waveform, waveform, ears.expand(2, 2, 8))


@pytest.mark.parametrize("make", [MSBG, NALR])
def test_a_stored_ear_is_a_copy_that_may_be_trained(make: Any) -> None:
    levels = torch.full((8,), 40.0)
    with torch.inference_mode():
        module = make(levels)
    levels.fill_(105.0)
    assert torch.equal(module.thresholds, torch.full((8,), 40.0))
    assert not module.thresholds.is_inference()


def test_interpolation_is_linear_in_hz_and_flat_beyond() -> None:
    hz = (0.0, 250.0, 251.0, 750.0, 1000.0, 2500.0, 7000.0, 8000.0, 12000.0)
    levels = draw_thresholds(6).reshape(2, 3, 8)
    rows = levels.reshape(6, 8).double().numpy()
    expected = np.array([np.interp(hz, FREQUENCIES, ear) for ear in rows])
    for ears in (levels, levels.double()):
        interpolated = interpolate(ears, FREQUENCIES, hz)
        assert interpolated.shape == (2, 3, 9) and interpolated.dtype == ears.dtype
        np.testing.assert_allclose(interpolated.reshape(6, 9).numpy(), expected, rtol=1e-5)
    np.testing.assert_allclose(rows @ interpolation_weights(FREQUENCIES, hz), expected, rtol=1e-12)


def test_torch_loads_files_that_hold_ears(tmp_path: Path) -> None:
    ears = [Audiogram.standard("N3"), Audiogram([30, 40], [500, 4000]), Listener("N1", "N3")]
    torch.save(ears, tmp_path / "ears.pt")
    assert torch.load(tmp_path / "ears.pt", weights_only=True) == ears
