"""NAL-R against pyclarity's, and what holds for any linear filter."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from compensators import NALR
from compensators.nalr import nalr_gains_db
from hlsim import Audiogram
from hlsim.audiogram import FREQUENCIES
from hlsim.training.ears import draw_thresholds

EARS = ["NH", "N1", "N3", "N6", "S1", "S3"]


def reference(waveform: Tensor, ear: Audiogram, rate: int, order: int = 220) -> np.ndarray:
    """pyclarity's filter with its delay taken off."""
    enhancer = pytest.importorskip("clarity.enhancer.nalr")
    model = enhancer.NALR(order, rate)
    taps, _ = model.build(ear.to_clarity())
    return model.apply(taps, waveform.double().numpy())[order // 2 : order // 2 + len(waveform)]


@pytest.mark.parametrize("rate", [16000, 22050, 44100])
@pytest.mark.parametrize("name", [*EARS, "N7"])
def test_equals_pyclarity(name: str, rate: int) -> None:
    ear = Audiogram.standard(name)
    waveform = torch.randn(4001)
    ours = NALR(sample_rate=rate)(waveform, ear).double().numpy()
    theirs = reference(waveform, ear, rate)
    assert ours.shape == theirs.shape
    assert np.abs(ours - theirs).max() < 1e-4 * np.abs(theirs).max()


def test_equals_pyclarity_on_drawn_ears_and_other_orders() -> None:
    ears = draw_thresholds(12, torch.Generator().manual_seed(3))
    waveform = torch.randn(12, 2000, dtype=torch.float64)
    for order in (64, 220):
        ours = NALR(ears, order=order)(waveform).numpy()
        for ear, signal, result in zip(ears.tolist(), waveform, ours, strict=True):
            theirs = reference(signal, Audiogram(tuple(ear)), 16000, order)
            assert np.abs(result - theirs).max() < 1e-9 * np.abs(theirs).max()


def test_equals_pyclarity_on_another_grid_of_frequencies() -> None:
    ear = Audiogram((10.0, 20.0, 35.0, 60.0, 75.0), (125.0, 500.0, 1500.0, 3000.0, 7000.0))
    waveform = torch.randn(3000)
    theirs = reference(waveform, ear, 16000)
    assert np.abs(NALR(ear)(waveform).numpy() - theirs).max() < 1e-4 * np.abs(theirs).max()


def test_gains_are_the_published_formula() -> None:
    # N3 by hand: X = 0.05 (35 + 40 + 50) = 6.25; 0.31 of 35, 35, 40, 50, 60, 65; constants -17, -8, 1, -1, -2, -2
    gains = nalr_gains_db(torch.tensor(Audiogram.standard("N3").thresholds))
    by_hand = [0.1, 9.1, 19.65, 20.75, (20.75 + 22.85) / 2, 22.85, 24.4, 24.4]
    assert gains.tolist() == pytest.approx(by_hand, abs=1e-4)


def test_gain_of_a_tone_is_the_prescribed_one() -> None:
    ear = Audiogram.standard("N4")
    hz = torch.tensor(FREQUENCIES[1:-1])
    tones = torch.sin(2.0 * torch.pi * hz[:, None] * torch.arange(16000) / 16000.0)
    middle = slice(4000, 12000)
    gains = 20.0 * torch.log10(
        NALR(ear)(tones)[:, middle].norm(dim=-1) / tones[:, middle].norm(dim=-1)
    )
    prescribed = nalr_gains_db(torch.tensor(ear.thresholds))[1:-1]
    assert (gains - prescribed).abs().max() < 0.6  # the window of 221 samples rounds the corners


def test_no_loss_changes_nothing() -> None:
    waveform = torch.randn(2, 500, dtype=torch.float64)
    for ear in (Audiogram.standard("NH"), Audiogram((-10.0,) * 8)):
        torch.testing.assert_close(NALR(ear)(waveform), waveform)
        assert not nalr_gains_db(torch.tensor(ear.thresholds)).any()


def test_aligned_with_the_input() -> None:
    impulse = torch.zeros(1000)
    impulse[400] = 1.0
    response = NALR(Audiogram.standard("N5"))(impulse)
    assert int(response.abs().argmax()) == 400
    torch.testing.assert_close(response[290:401], response[400:511].flip(0))


def test_batch_equals_its_items_and_broadcasts() -> None:
    ears = torch.stack([torch.tensor(Audiogram.standard(name).thresholds) for name in EARS])
    waveform = torch.randn(6, 3000)
    nalr = NALR()
    together = nalr(waveform, ears)
    for item, ear, result in zip(waveform, ears, together, strict=True):
        torch.testing.assert_close(nalr(item, ear), result, rtol=1e-5, atol=1e-5)
    assert nalr(waveform[0], ears).shape == (6, 3000)
    assert nalr(waveform.reshape(2, 3, 3000), ears[:3]).shape == (2, 3, 3000)
    torch.testing.assert_close(NALR(ears)(waveform), together)


def test_gradient_is_the_filter_run_backwards_and_finite_on_silence() -> None:
    nalr = NALR(Audiogram.standard("N3"))
    waveform = torch.randn(300, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(nalr, (waveform,))
    silence = torch.zeros(1, 800, requires_grad=True)
    out = nalr(silence)
    assert not out.any()
    (gradient,) = torch.autograd.grad(out.sum(), silence)
    assert bool(torch.isfinite(gradient).all()) and bool(gradient.any())


@pytest.mark.parametrize(
    "options",
    [
        {"audiogram": torch.zeros(8, requires_grad=True)},
        {"audiogram": torch.full((8,), 121.0)},
        {"sample_rate": 8000},
        *({"order": order} for order in (221, 2.0, "220", True, 0, 1024)),
    ],
)
def test_bad_setting_raises_value_error(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        NALR(**options)


@pytest.mark.parametrize(
    ("samples", "audiogram"),
    [((100,), None), ((3, 100), torch.zeros(2, 8)), ((100,), torch.full((8,), 121.0))],
)
def test_bad_call_raises_value_error(samples: tuple[int, ...], audiogram: Any) -> None:
    with pytest.raises(ValueError):
        NALR()(torch.randn(samples), audiogram)
