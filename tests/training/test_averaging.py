"""The average of weights."""

import pytest
import torch
from torch import nn

from hlsim.training.averaging import average_of


def follow(decay: float, values: list[float]) -> float:
    model = nn.Linear(1, 1, bias=False)
    nn.init.constant_(model.weight, 5.0)
    average = average_of(model, decay)
    for value in values:
        nn.init.constant_(model.weight, value)
        average.update_parameters(model)
    return float(average.module.weight)


def test_is_an_exponential_average_that_forgets_its_start() -> None:
    expected, values = 0.0, [1.0, 4.0, 2.0, 8.0]
    for count, value in enumerate(values):
        weight = 0.0 if count == 0 else min(0.2, (1.0 + count) / (10.0 + count))
        expected = weight * expected + (1.0 - weight) * value
    assert follow(0.2, values) == pytest.approx(expected, rel=1e-6)
    assert follow(0.0, values) == 8.0
    assert follow(0.99, [3.0] * 50) == pytest.approx(3.0)


def test_asks_for_no_gradient_and_leaves_the_model_s() -> None:
    model = nn.Linear(2, 2)
    average = average_of(model, 0.9)
    assert not any(parameter.requires_grad for parameter in average.parameters())
    assert all(parameter.requires_grad for parameter in model.parameters())
    assert torch.equal(average(torch.ones(2)), model(torch.ones(2)))
