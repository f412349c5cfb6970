"""Checks: values of another kind are refused in both recipes, and the message says what to write; rates and waveforms."""

import math
from typing import Any

import pytest

pytest.importorskip("lightning")

import numpy as np
import torch
import yaml

from hlsim.checks import check_rate, check_waveform
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe


@pytest.mark.parametrize("recipe", [SimulatorRecipe, CompensatorRecipe])
@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "learning_rate: 1e-3",
            r"learning_rate '1e-3' in the recipe; allowed: a number \(.*; write 1.0e-3\)",
        ),
        ("learning_rate: -1.0", "learning_rate -1.0 in the recipe; allowed: .* above 0"),
        ("learning_rate: .nan", "learning_rate nan in the recipe; allowed: a number"),
        ("learning_rate: true", "learning_rate True in the recipe; allowed: a number"),
        ("batch: two", "batch 'two' in the recipe; allowed: a whole number"),
        ("batch: '4'", "batch '4' in the recipe; allowed: a whole number$"),
        ("batch: 2.5", "batch 2.5 in the recipe; allowed: a whole number"),
        ("batch:", "batch None in the recipe; allowed: a whole number"),
        ("seconds: .inf", "seconds inf"),
        ("levels: 65", r"levels 65 in the recipe; allowed: a lowest and a highest, as \[0, 20\]"),
        ("levels: [50, loud]", "levels 'loud' in the recipe; allowed: a number"),
        (
            "levels: [80, 50]",
            r"levels \[80, 50\] in the recipe; allowed: a lowest and a highest, ascending",
        ),
        ("weights:", "weights None in the recipe; allowed: 'name: value' lines below it"),
        ("weights: 1.0", "weights 1.0 in the recipe; allowed: 'name: value' lines"),
        ("weights: {}", r"weights \{\} in the recipe; allowed: 0 or more, one or more above 0"),
        ("model: small", "model 'small' in the recipe; allowed: 'name: value' lines"),
        ("1: 2", "unknown settings 1 in the recipe"),
        ("seed: x", "seed 'x'"),
    ],
)
def test_values_that_are_not_allowed(recipe: Any, text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        recipe.from_dict(yaml.safe_load(text))


@pytest.mark.parametrize(
    ("recipe", "criterion"), [(SimulatorRecipe, "snr"), (CompensatorRecipe, "bands")]
)
def test_weights(recipe: Any, criterion: str) -> None:
    for value in (-1.0, 0.0, 0):
        with pytest.raises(ValueError, match="allowed: 0 or more, one or more above 0"):
            recipe(weights={criterion: value})
    for value in ("1", None, float("inf")):
        with pytest.raises(ValueError, match=f"weights: {criterion} .* in the recipe; "):
            recipe(weights={criterion: value})
    with pytest.raises(ValueError, match="unknown criteria loudness in the recipe; allowed: "):
        recipe(weights={"loudness": 1.0})
    assert recipe(weights={criterion: 2}, learning_rate=1, levels=[50, 60]).levels == (50, 60)


def test_other_names() -> None:
    with pytest.raises(ValueError, match=r"snr 5 in the recipe; allowed: a lowest and a highest"):
        CompensatorRecipe.from_dict({"snr": 5})
    with pytest.raises(ValueError, match=r"treated 'no way' in the recipe; allowed: true or false"):
        SimulatorRecipe.from_dict({"treated": "no way"})
    with pytest.raises(ValueError, match=r"precision 16 in the recipe; allowed: float32, bfloat16"):
        SimulatorRecipe.from_dict({"precision": 16})


@pytest.mark.parametrize(
    "rate",
    [
        15999,
        48001,
        16000.5,
        -16000,
        0,
        math.nan,
        math.inf,
        10**400,
        None,
        "16k",
        "16000",
        True,
        [16000],
    ],
)
def test_rates_out_of_range(rate: Any) -> None:
    with pytest.raises(ValueError, match=r"sample rate .* Hz; allowed: 16000 to 48000"):
        check_rate(rate)


@pytest.mark.parametrize("rate", [16000, 44100.0, 48000, np.int64(16000), np.float32(16000)])
def test_rates_in_range_come_back_whole(rate: int) -> None:
    assert check_rate(rate) == rate and type(check_rate(rate)) is int


@pytest.mark.parametrize(
    "wave",
    [torch.zeros(10, dtype=torch.int16), np.zeros(10), None, torch.tensor(1.0), torch.zeros(2, 0)],
)
def test_what_is_no_waveform(wave: Any) -> None:
    with pytest.raises(ValueError, match=r"heard (is|has shape) .*; allowed: .*\(\.\.\., time\)"):
        check_waveform(wave, "heard")


@pytest.mark.parametrize("sample", [1.1e9, -1e18, 1e38])
@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_a_sample_too_large(sample: float, kind: torch.dtype) -> None:
    wave = torch.zeros(2, 10, dtype=kind).index_fill(1, torch.tensor([3]), sample)
    with pytest.raises(
        ValueError, match=r"heard has a sample of (1.1e\+09|1e\+18|1e\+38); allowed: up to 1e\+09"
    ):
        check_waveform(wave, "heard")


def test_samples_up_to_the_highest_and_nan_pass() -> None:
    for sample in (1e9, -1e9, float("nan"), float("inf")):
        check_waveform(torch.full((10,), sample))
    wave = torch.full((2, 10), 1e18)
    assert torch.equal(torch.compile(check_waveform, backend="eager", fullgraph=True)(wave), wave)
