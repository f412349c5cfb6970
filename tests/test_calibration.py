"""Levels in dB SPL and dB relative to full scale, and scales of samples."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from hlsim.calibration import check_full_scale, dbfs, gain_to_pascals, level_spl, set_level


def test_rms_1_is_full_scale_and_20_db_are_a_factor_of_10() -> None:
    wave = torch.tensor([1.0, -1.0, 1.0, -1.0])
    assert float(level_spl(wave)) == pytest.approx(94.0)
    assert float(level_spl(0.1 * wave)) == pytest.approx(74.0)
    assert float(level_spl(wave, 120.0)) == pytest.approx(120.0)
    sine = torch.sin(2 * math.pi * 100 * torch.arange(16000, dtype=torch.float64) / 16000)
    assert float(dbfs(sine)) == pytest.approx(10 * math.log10(0.5))
    assert float(level_spl(sine, 110.0)) == pytest.approx(110 + 10 * math.log10(0.5))


def test_gain_to_pascals_is_26_db_at_pyclaritys_full_scale() -> None:
    # RMS 1.0 is 100 + 20 dB SPL in pyclarity.
    assert gain_to_pascals(120.0) == pytest.approx(10 ** (26 / 20))
    assert gain_to_pascals(94.0) == 1.0
    wave = torch.randn(3, 500)
    torch.testing.assert_close(level_spl(wave * gain_to_pascals(107.0)), level_spl(wave, 107.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_set_level_gives_each_item_its_level(dtype: torch.dtype) -> None:
    gains = 10 ** torch.linspace(-3, 2, 6, dtype=dtype).reshape(2, 3, 1)
    wave = gains * torch.randn(2, 3, 400, dtype=dtype)
    levels = torch.tensor([[40.0, 55.0, 60.0], [75.0, 90.0, 115.0]])
    scaled = set_level(wave, levels, 107.0)
    assert scaled.dtype == dtype
    torch.testing.assert_close(level_spl(scaled, 107.0), levels.to(dtype), atol=1e-3, rtol=0)
    scaled_shape = scaled / scaled.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(scaled_shape, wave / wave.norm(dim=-1, keepdim=True))
    assert float(level_spl(set_level(wave, 65), 94.0).sub(65).abs().max()) < 1e-3


def test_silence_has_a_finite_level_and_stays_silent() -> None:
    silence = torch.zeros(2, 100, requires_grad=True)
    assert level_spl(silence).tolist() == pytest.approx([-106.0, -106.0])
    louder = set_level(silence, 80.0)
    assert not bool(louder.any())
    (louder.sum() + level_spl(silence).sum()).backward()
    assert silence.grad is not None and bool(torch.isfinite(silence.grad).all())


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_has_exact_levels(dtype: torch.dtype) -> None:
    # The power of this noise is too small for half precision.
    wave = 1e-5 * torch.randn(4000).to(dtype)
    level = level_spl(wave)
    assert level.dtype == dtype and float(level) == pytest.approx(-6.0, abs=0.5)
    assert float(level_spl(torch.zeros(10, dtype=dtype))) == -106.0
    louder = set_level(wave, 65.0)
    assert louder.dtype == dtype
    assert float(level_spl(louder.float())) == pytest.approx(65.0, abs=0.05)
    assert not bool(set_level(torch.zeros(10, dtype=dtype), 65.0).any())


def test_level_and_gain_are_differentiable() -> None:
    wave = torch.randn(2, 50, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: level_spl(w, 100.0), wave)
    assert torch.autograd.gradcheck(lambda w: set_level(w, 70.0), wave)


NO_NUMBERS = [math.nan, math.inf, -math.inf, None, "a", "65", True, [65.0, 70.0], 94 + 0j]
BAD_LEVELS = [-300.0, -1e9, 141.0, 1e9, *(torch.tensor(x) for x in (math.nan, math.inf, 141.0))]
BAD_SHAPES = [torch.zeros(3, 1), torch.zeros(3), torch.zeros(2, 100)]
NO_WAVEFORMS: list[Any] = [torch.zeros(8, dtype=torch.int16), [0.0, 1.0]]
BAD_CALLS: list[tuple[Callable[..., Any], Any]] = [
    *((check_full_scale, (value,)) for value in [*NO_NUMBERS, -0.1, 200.1]),
    *((set_level, (torch.randn(2, 100), spl)) for spl in [*NO_NUMBERS, *BAD_LEVELS, *BAD_SHAPES]),
    *((level_spl, (waveform,)) for waveform in NO_WAVEFORMS),
    *((set_level, (waveform, 65.0)) for waveform in NO_WAVEFORMS),
]


@pytest.mark.parametrize(("function", "arguments"), BAD_CALLS)
def test_bad_arguments_raise_value_error(function: Callable[..., Any], arguments: Any) -> None:
    with pytest.raises(ValueError):
        function(*arguments)


def test_double_precision_reaches_levels_that_single_precision_rounds() -> None:
    wave = torch.randn(1000, dtype=torch.float64)
    assert float(level_spl(set_level(wave, 65.3))) == pytest.approx(65.3, abs=1e-12)


def test_a_signal_may_be_given_the_level_of_silence() -> None:
    wave, silence = torch.randn(2, 100), torch.zeros(2, 100)
    for full_scale in (60.0, 94.0, 120.0):
        quiet = set_level(wave, level_spl(silence, full_scale), full_scale)
        assert float(quiet.abs().max()) < 1e-9
