"""The factor of the phase decoder equals its formula and has exact gradients."""

import pytest
import torch
from torch import Tensor

from hlsim.neuro.decoders import PhaseDecoder

SIZE = (9, 17)


@pytest.fixture
def decoder() -> PhaseDecoder:
    model = PhaseDecoder(4, 0, (4, 3), False).double()
    for parameter in model.parameters():
        parameter.data.normal_(0.0, 0.3)
    return model


@pytest.fixture
def inputs() -> tuple[Tensor, Tensor]:
    """Feature maps and the logarithm of a gain."""
    shapes = (2, 4, 3, 6), (2, *SIZE)
    features, log_gain = (torch.randn(s, dtype=torch.float64, requires_grad=True) for s in shapes)
    return features, log_gain


def test_factor_has_the_gain_and_the_angle_of_two_maps_and_exact_gradients(
    decoder: PhaseDecoder, inputs: tuple[Tensor, Tensor]
) -> None:
    def factor(features: Tensor, log_gain: Tensor) -> Tensor:
        return decoder.factor(features, SIZE, log_gain)

    features, log_gain = inputs
    x, y = decoder(features, SIZE).unbind(1)
    expected = torch.polar(log_gain.exp(), torch.atan2(y, 1.0 + x))
    torch.testing.assert_close(factor(*inputs), expected, atol=1e-12, rtol=1e-12)
    assert torch.autograd.gradcheck(factor, inputs)
    assert torch.autograd.gradgradcheck(factor, inputs)


def test_gradients_are_finite_where_the_angle_is_undefined(inputs: tuple[Tensor, Tensor]) -> None:
    decoder, (features, log_gain) = PhaseDecoder(4, 0, (4, 3), False).double(), inputs
    decoder.leave.bias.data[:12] = -1.0  # the first map is -1, so that the angle is that of 0 + 0 j
    decoder.factor(features, SIZE, log_gain).abs().sum().backward()
    assert features.grad is not None and features.grad.isfinite().all()
