"""NAL-R equals pyclarity's, and is a linear filter without delay."""

import numpy as np
import pytest
import torch
from torch import Tensor

from compensators import NALR
from hlsim import Audiogram
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.prescription import nalr_gains_db
from hlsim.data.ears import draw_thresholds


def pyclarity_nalr(waveform: Tensor, ear: Audiogram, rate: int) -> np.ndarray:
    """Compute the output of pyclarity's filter without its delay."""
    module = pytest.importorskip("clarity.enhancer.nalr")
    model = module.NALR(220, rate)
    taps, _ = model.build(ear.to_clarity())
    output = model.apply(taps, waveform.double().numpy())
    return output[110 : 110 + len(waveform)]


@pytest.mark.parametrize("rate", [16000, 22050, 44100])
def test_equals_pyclarity(rate: int) -> None:
    waveform = torch.randn(2000, dtype=torch.float64)
    drawn = draw_thresholds(12, torch.Generator().manual_seed(3)).tolist()
    ears = [Audiogram.standard(name) for name in ("NH", "N1", "N3", "N6", "N7", "S1", "S3")]
    ears += [Audiogram(tuple(levels)) for levels in drawn]
    ears.append(Audiogram((10.0, 20.0, 35.0, 60.0, 75.0), (125.0, 500.0, 1500.0, 3000.0, 7000.0)))
    for ear in ears:
        levels = torch.tensor(ear.thresholds, dtype=torch.float64)
        output = NALR(sample_rate=rate)(waveform, levels).numpy()
        expected = pyclarity_nalr(waveform, ear, rate)
        tolerance = 1e-9 if ear.frequencies == FREQUENCIES else 1e-4
        assert np.abs(output - expected).max() < tolerance * np.abs(expected).max()


def test_an_ear_without_loss_changes_nothing() -> None:
    waveform = torch.randn(2, 500, dtype=torch.float64)
    for ear in (Audiogram.standard("NH"), Audiogram((-10.0,) * 8)):
        torch.testing.assert_close(NALR(ear)(waveform), waveform)
        assert not nalr_gains_db(torch.tensor(ear.thresholds)).any()


def test_ears_of_the_constructor_serve_all_calls_and_gradients_pass() -> None:
    ears = torch.tensor([Audiogram.standard(name).thresholds for name in ("N1", "S3")])
    waveform = torch.randn(2, 300, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(NALR(ears)(waveform), NALR()(waveform, ears))
    assert torch.autograd.gradcheck(NALR("N3"), (waveform[0],))
