"""What HASPILoss promises: that of its score, of the level beside it, and of its gradient."""

from typing import Any

import pytest
import torch
from torch import Tensor

from compensators import NALR
from hlsim import Audiogram, HASPILoss, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.metrics import haspi, hasqi

N3, N4 = Audiogram.standard("N3"), Audiogram.standard("N4")
TIME = 12000


@pytest.fixture
def clean(speech: list[tuple[Tensor, int]]) -> Tensor:
    """0.75 s of two voices at 65 dB SPL. Shape: (2, time)."""
    return set_level(
        torch.cat([waveform[:, 10000 : 10000 + TIME] for waveform, _ in speech[:2]]), 65.0
    )


def at_snr(clean: Tensor, snr: float) -> Tensor:
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(2))
    return clean + set_level(noise, 65.0 - snr)


def test_it_is_1_less_the_scores_beside_the_level(clean: Tensor) -> None:
    given = NALR(N3)(at_snr(clean, 5.0))
    loss = HASPILoss(N3, quality=0.5, reduction="none")
    parts = loss.parts(given, clean)
    assert set(parts) >= {"haspi", "hasqi", "levels", "louder", "peaks"}
    torch.testing.assert_close(parts["haspi"], 1.0 - haspi(given, clean, N3))
    torch.testing.assert_close(parts["hasqi"], 1.0 - hasqi(given, clean, N3))
    expected = parts["haspi"] + 0.5 * parts["hasqi"]
    expected = expected + sum(
        loss.weights[name] * parts[name] for name in ("levels", "louder", "peaks")
    )
    torch.testing.assert_close(loss(given, clean), expected)
    assert set(HASPILoss(N3, level=0.0).weights) == {"haspi"}
    torch.testing.assert_close(
        HASPILoss(N3)(given, clean), HASPILoss(N3, reduction="none")(given, clean).mean()
    )


def test_haspi_joins_other_criteria(clean: Tensor) -> None:
    given = NALR(N3)(at_snr(clean, 5.0))
    loss = HearingLossLoss(N3, criterion={"coherent-bands": 1.0, "haspi": 0.3}, reduction="none")
    expected = HearingLossLoss(N3, reduction="none")(given, clean) + 0.3 * (
        1.0 - haspi(given, clean, N3)
    )
    torch.testing.assert_close(loss(given, clean), expected)


def test_a_better_score_costs_less_at_one_level(clean: Tensor) -> None:
    loss, scores, values = HASPILoss(N3), [], []
    for snr in (-5.0, 5.0, 15.0):
        given = NALR(N3)(set_level(at_snr(clean, snr), 65.0))
        scores.append(float(haspi(given, clean, N3).mean()))
        values.append(float(loss(given, clean)))
    assert scores == sorted(scores) and values == sorted(values, reverse=True)


def test_gain_beyond_a_normal_ears_level_costs_though_the_score_rises(clean: Tensor) -> None:
    quiet, fitting, loud = (gain * NALR(N4)(at_snr(clean, 10.0)) for gain in (0.1, 2.0, 40.0))
    alone, whole = (
        [float(HASPILoss(N4, level=level)(given, clean)) for given in (quiet, fitting, loud)]
        for level in (0.0, 1.0)
    )
    assert alone[2] < alone[0] and alone[2] < alone[1] + 0.02
    assert whole[1] < whole[0] and whole[1] < whole[2] - 0.5


def test_shapes_ears_and_lengths(clean: Tensor) -> None:
    loss = HASPILoss(reduction="none")
    ears = [N3, N4]
    given = 5.0 * at_snr(clean, 10.0)
    each = torch.stack([loss(given[0], clean[0], N3), loss(given[1, :11500], clean[1, :11500], N4)])
    values = loss(given, clean, ears, [TIME, 11500])
    torch.testing.assert_close(values, each, rtol=1e-3, atol=1e-4)
    channel = loss(given.unsqueeze(1), clean.unsqueeze(1), ears, [TIME, 11500])
    torch.testing.assert_close(channel, values.unsqueeze(1))
    noisier = given.clone()
    noisier[1, 11500:] = 1.0
    torch.testing.assert_close(loss(noisier, clean, ears, [TIME, 11500]), values)


def test_short_speech_raises_value_error(clean: Tensor) -> None:
    with pytest.raises(ValueError):
        HASPILoss(N3)(clean[:, :8000], clean[:, :8000])


@pytest.mark.parametrize("options", [{"quality": -1.0}, {"level": float("nan")}, {"quality": "a"}])
def test_a_bad_weight_raises_value_error(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        HASPILoss(N3, **options)


# Gradients


def test_hard_inputs_give_finite_values_and_gradients(clean: Tensor) -> None:
    silence, square = (
        torch.zeros(TIME),
        30.0 * torch.sign(torch.sin(torch.arange(TIME) * 0.3 + 0.1)),
    )
    truth = torch.stack((silence, clean[0], silence, clean[0], clean[0], square))
    given = torch.stack(
        (silence, silence, clean[0], 1e-9 * clean[0], 1e4 * clean[0], square)
    ).requires_grad_()
    values = HASPILoss(N4, reduction="none")(given, truth)
    (slope,) = torch.autograd.grad(values.sum(), given)
    assert bool(values.isfinite().all()) and bool(slope.isfinite().all())
    assert float(values[0].detach()) == 0.0 and not bool(slope[0].any())


def test_ears_and_levels_count_alike(clean: Tensor) -> None:
    """The gradient on eight band gains, from no gain: HASPI's own is 500 times as large in one ear as in another."""
    hz = torch.fft.rfftfreq(TIME, 1.0 / 16000)
    bands = torch.bucketize(
        hz, torch.tensor([354.0, 707.0, 1414.0, 2449.0, 3464.0, 4899.0, 6928.0])
    )
    slopes, loss = [], HASPILoss()
    for ear, spl in [(f"N{i}", 65.0) for i in range(1, 6)] + [("N3", 50.0), ("N3", 80.0)]:
        gains = torch.zeros(8, requires_grad=True)
        speech = set_level(clean[:1], spl)
        aided = torch.fft.irfft(torch.fft.rfft(speech) * 10.0 ** (gains[bands] / 20.0), TIME)
        (slope,) = torch.autograd.grad(loss(aided, speech, Audiogram.standard(ear)), gains)
        slopes.append(float(slope.norm()))
    assert max(slopes) < 10.0 * min(slopes)
