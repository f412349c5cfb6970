"""Expansion and gain against pyclarity's functions."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import gain_to_pascals
from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import STEP, envelope, envelope_lowpass
from hlsim.msbg.filterbank import BANKS, FilterBank
from hlsim.msbg.recruitment import (
    CATCH_UP_SPL,
    around,
    expand,
    expansion_ratios,
    interpolate,
    interpolation_kernel,
    threshold_weights,
)
from hlsim.training.ears import draw_thresholds

cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")
clarity_audiogram = pytest.importorskip("clarity.utils.audiogram")

TIME = 2 * STEP * 342
EDGE = 3000  # samples from each end that filtfilt treats its own way

BANK_NAMES = ["mild", "moderate", "severe"]
TO_PASCALS = gain_to_pascals(120.0)


@pytest.mark.parametrize("name", BANK_NAMES)
def test_expansion_ratios(name: str) -> None:
    bank = BANKS[name]
    ears = draw_thresholds(20, torch.Generator().manual_seed(0)).double()
    ours = expansion_ratios(ears.reshape(4, 5, 8), torch.from_numpy(threshold_weights(bank)))
    assert ours.shape == (4, 5, bank.channels)
    for levels, ratios in zip(ears, ours.reshape(20, -1), strict=True):
        ear = clarity_audiogram.Audiogram(levels=levels.numpy(), frequencies=np.array(FREQUENCIES))
        theirs, catch_up = cochlea.compute_recruitment_parameters(
            np.array(bank.centre_frequencies), ear, 105.0
        )
        assert np.all(catch_up == CATCH_UP_SPL)
        np.testing.assert_allclose(ratios.numpy(), theirs, rtol=1e-12)


class RoundsProducts(TorchFunctionMode):
    """Matrix products of what is rounded to ten bits, as TF32 has it."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in (torch.matmul, Tensor.matmul, Tensor.__matmul__):
            args = [
                ((factor.view(torch.int32) + 2**12) & -(2**13)).view(torch.float32)
                for factor in args
            ]
        return func(*args, **(kwargs or {}))


def test_expansion_ratios_are_exact_where_matrix_products_are_rounded() -> None:
    ears = torch.linspace(93.3, 99.9, 80).reshape(10, 8)
    weights = torch.from_numpy(threshold_weights(BANKS["severe"])).float()
    with RoundsProducts():
        ours = expansion_ratios(ears, weights)
    assert (ours / expansion_ratios(ears.double(), weights.double()) - 1.0).abs().max() < 1e-5


@pytest.mark.parametrize("name", BANK_NAMES)
def test_recruitment(name: str, band_noise: Callable[[FilterBank, int], np.ndarray]) -> None:
    """The gain of envelopes that pyclarity computed at the full rate, sampled a step apart."""
    bank = BANKS[name]
    channels = band_noise(bank, TIME)
    theirs = np.maximum(
        cochlea.compute_envelope(channels, erb(np.array(bank.centre_frequencies)), MSBG_RATE), 1e-7
    )
    ratios = expansion_ratios(
        torch.linspace(20.0, 70.0, 8, dtype=torch.float64),
        torch.from_numpy(threshold_weights(bank)),
    )
    expected = cochlea.recruitment(
        channels.copy(), theirs.copy(), 120.0, ratios.numpy(), np.full(bank.channels, 105.0)
    ).sum(0)
    ours = expand(
        TO_PASCALS * torch.from_numpy(channels),
        TO_PASCALS * torch.from_numpy(theirs[:, ::STEP]),
        ratios,
    )
    error = (ours.numpy() / TO_PASCALS - expected)[EDGE:-EDGE]
    assert np.sqrt((error**2).mean() / (expected[EDGE:-EDGE] ** 2).mean()) < 2e-4


@pytest.mark.parametrize("level", [1e-12, 1e-9, 1e-4, 10 ** (-15 / 20), 3.0])
def test_limits_of_the_envelope_are_the_references(level: float) -> None:
    """From its lowest, 1e-9 of its full scale, to the catch-up level, above which nothing is expanded."""
    channels = np.random.default_rng(2).standard_normal((2, 336))
    ratios = np.array([1.0, 1.6])
    theirs = cochlea.recruitment(
        channels.copy(), np.full((2, 336), level), 120.0, ratios, np.array([105.0, 105.0])
    ).sum(0)
    ours = expand(
        torch.from_numpy(channels),
        TO_PASCALS * torch.full((2, 336 // STEP), level, dtype=torch.float64),
        torch.from_numpy(ratios),
    )
    np.testing.assert_allclose(ours.numpy(), theirs, rtol=1e-9, atol=1e-12)


def test_one_db_in_is_the_ratio_of_db_out() -> None:
    tone = torch.cos(torch.arange(40 * STEP, dtype=torch.float64)).unsqueeze(0)
    ratio = torch.tensor([105.0 / (105.0 - 60.0)], dtype=torch.float64)
    heard = [
        expand(
            10 ** (db / 20) * tone, torch.full((1, 40), 10 ** (db / 20), dtype=torch.float64), ratio
        )
        for db in (-40.0, -39.0)
    ]
    gain_db = 20 * torch.log10(heard[1].norm() / heard[0].norm())
    assert float(gain_db) == pytest.approx(float(ratio), abs=1e-9)


def test_gradients() -> None:
    bank = BANKS["severe"]
    channels = torch.randn(bank.channels, 4 * STEP, dtype=torch.float64, requires_grad=True)
    response = torch.from_numpy(envelope_lowpass(bank, 4 * STEP))
    ratios = torch.linspace(1.0, 4.0, bank.channels, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c: envelope(c, response), channels, fast_mode=True)
    assert torch.autograd.gradcheck(
        lambda c, r: expand(c, envelope(c, response), r), (channels, ratios), fast_mode=True
    )


@pytest.mark.parametrize("steps", [16, 21, 40])
@pytest.mark.parametrize("each", [3, 5, 6, 24])
@pytest.mark.parametrize("together", [5, 8])
def test_interpolation_is_exact_for_polynomials_of_fifth_order(
    steps: int, each: int, together: int
) -> None:
    powers = torch.randn(6, dtype=torch.float64)

    def polynomial(place: torch.Tensor) -> torch.Tensor:
        return (powers * ((place - steps / 2) / steps).unsqueeze(-1) ** torch.arange(6)).sum(-1)

    places = torch.arange(steps * each, dtype=torch.float64) / each
    kernel = torch.from_numpy(interpolation_kernel(each, together=together))
    fine = interpolate(around(polynomial(torch.arange(steps, dtype=torch.float64))[None]), kernel)[
        0
    ]
    inside = slice(2 * each, (steps - 3) * each)  # it is taken as periodic
    torch.testing.assert_close(fine[inside], polynomial(places)[inside])


def test_interpolation_of_two_parts_gives_both_the_same() -> None:
    values = torch.randn(3, 24, dtype=torch.float64)
    once, twice = (
        interpolate(around(values), torch.from_numpy(interpolation_kernel(6, parts)))
        for parts in (1, 2)
    )
    torch.testing.assert_close(twice, once.repeat_interleave(2, -1))
