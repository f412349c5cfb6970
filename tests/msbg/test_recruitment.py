"""Expansion ratios and gains equal those of pyclarity's functions."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import gain_to_pascals
from hlsim.data.ears import draw_thresholds
from hlsim.dsp.erb import erb
from hlsim.dsp.interpolation import interpolation_weights
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import STEP
from hlsim.msbg.filter_bank import BANKS
from hlsim.msbg.recruitment import (
    CATCH_UP_SPL,
    expand,
    expansion_ratios,
    interpolate,
    interpolation_kernel,
)

cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")
clarity_audiogram = pytest.importorskip("clarity.utils.audiogram")

TIME = 2 * STEP * 342
EDGE = 3000
"""Samples at each end that depend on the padding of ``filtfilt``."""

BANK_NAMES = ["mild", "moderate", "severe"]
TO_PASCALS = gain_to_pascals(120.0)


@pytest.mark.parametrize("name", BANK_NAMES)
def test_expansion_ratios_equal_pyclaritys(name: str) -> None:
    bank = BANKS[name]
    ears = draw_thresholds(20, torch.Generator().manual_seed(0)).double()
    ours = expansion_ratios(
        ears.reshape(4, 5, 8),
        torch.from_numpy(interpolation_weights(FREQUENCIES, bank.centre_frequencies)),
    )
    assert ours.shape == (4, 5, bank.channels)
    for levels, ratios in zip(ears, ours.reshape(20, -1), strict=True):
        ear = clarity_audiogram.Audiogram(levels=levels.numpy(), frequencies=np.array(FREQUENCIES))
        theirs, catch_up = cochlea.compute_recruitment_parameters(
            np.array(bank.centre_frequencies), ear, 105.0
        )
        assert np.all(catch_up == CATCH_UP_SPL)
        np.testing.assert_allclose(ratios.numpy(), theirs, rtol=1e-12)


class RoundedProducts(TorchFunctionMode):
    """Mode that rounds the factors of matrix products to ten bits, as GPUs do with TF32."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in (torch.matmul, Tensor.matmul, Tensor.__matmul__):
            bits = [(factor.view(torch.int32) + 2**12) & -(2**13) for factor in args]
            args = [rounded.view(torch.float32) for rounded in bits]
        return func(*args, **(kwargs or {}))


def test_expansion_ratios_are_exact_where_matrix_products_are_rounded() -> None:
    ears = torch.linspace(93.3, 99.9, 80).reshape(10, 8)
    weights = torch.from_numpy(
        interpolation_weights(FREQUENCIES, BANKS["severe"].centre_frequencies)
    ).float()
    with RoundedProducts():
        ours = expansion_ratios(ears, weights)
    expected = expansion_ratios(ears.double(), weights.double())
    assert (ours / expected - 1.0).abs().max() < 1e-5


@pytest.mark.parametrize("name", BANK_NAMES)
def test_recruitment_equals_pyclaritys(name: str) -> None:
    """Our gains follow every 24th value of the envelopes that pyclarity computes."""
    bank = BANKS[name]
    channels = 0.03 * np.random.default_rng(1).standard_normal((bank.channels, TIME))
    bandwidths = erb(np.array(bank.centre_frequencies))
    envelopes = np.maximum(cochlea.compute_envelope(channels, bandwidths, MSBG_RATE), 1e-7)
    levels = torch.linspace(20.0, 70.0, 8, dtype=torch.float64)
    ratios = expansion_ratios(
        levels, torch.from_numpy(interpolation_weights(FREQUENCIES, bank.centre_frequencies))
    )
    catch_up = np.full(bank.channels, 105.0)
    expected = cochlea.recruitment(
        channels.copy(), envelopes.copy(), 120.0, ratios.numpy(), catch_up
    ).sum(0)
    in_pascals = [TO_PASCALS * torch.from_numpy(array) for array in (channels, envelopes)]
    ours = expand(in_pascals[0], in_pascals[1][:, ::STEP], ratios)
    inner = slice(EDGE, -EDGE)
    error = (ours.numpy() / TO_PASCALS - expected)[inner]
    assert np.sqrt((error**2).mean() / (expected[inner] ** 2).mean()) < 2e-4


@pytest.mark.parametrize("level", [1e-12, 1e-9, 1e-4, 10 ** (-15 / 20), 3.0])
def test_limits_of_the_envelope_equal_pyclaritys(level: float) -> None:
    """The lower limit is 1e-9 of full scale, and the upper one is the catch-up level."""
    channels = np.random.default_rng(2).standard_normal((2, 336))
    ratios = np.array([1.0, 1.6])
    theirs = cochlea.recruitment(
        channels.copy(), np.full((2, 336), level), 120.0, ratios, np.array([105.0, 105.0])
    ).sum(0)
    envelopes = TO_PASCALS * torch.full((2, 336 // STEP), level, dtype=torch.float64)
    ours = expand(torch.from_numpy(channels), envelopes, torch.from_numpy(ratios))
    np.testing.assert_allclose(ours.numpy(), theirs, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("samples", [3, 24])
@pytest.mark.parametrize("steps", [16, 21])
def test_interpolation_is_exact_for_polynomials_of_fifth_order(steps: int, samples: int) -> None:
    coefficients = np.random.default_rng(0).standard_normal(6)
    position = np.arange(steps * samples) / samples / steps - 0.5
    expected = torch.from_numpy(np.polynomial.Polynomial(coefficients)(position))
    for steps_per_window in (5, 8):
        kernel = torch.from_numpy(interpolation_kernel(samples, steps_per_window=steps_per_window))
        interpolated = interpolate(expected[None, ::samples], kernel)[0]
        # The polynomial is not periodic, so that the values at the ends differ.
        inner = slice(2 * samples, (steps - 3) * samples)
        torch.testing.assert_close(interpolated[inner], expected[inner])
