"""The factor of the phase decoder equals its formula and has exact gradients."""

import torch

from hlsim.neuro.decoders import PhaseDecoder

SIZE = (9, 17)


def random_decoder() -> PhaseDecoder:
    model = PhaseDecoder(4, 0, (4, 3), False).double()
    for parameter in model.parameters():
        parameter.data.normal_(0.0, 0.3)
    return model


def random_inputs() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.randn(2, 4, 3, 6, dtype=torch.float64), torch.randn(2, *SIZE, dtype=torch.float64)


def test_factor_has_the_gain_and_the_angle_of_two_maps() -> None:
    model = random_decoder()
    features, log_gain = random_inputs()
    x, y = model(features, SIZE).unbind(1)
    expected = torch.polar(log_gain.exp(), torch.atan2(y, 1.0 + x))
    factor = model.factor(features, SIZE, log_gain)
    torch.testing.assert_close(factor, expected, atol=1e-12, rtol=1e-12)


def test_gradients_are_exact() -> None:
    model = random_decoder()
    inputs = tuple(tensor.requires_grad_() for tensor in random_inputs())

    def factor(features: torch.Tensor, log_gain: torch.Tensor) -> torch.Tensor:
        return model.factor(features, SIZE, log_gain)

    assert torch.autograd.gradcheck(factor, inputs)
    assert torch.autograd.gradgradcheck(factor, inputs)


def test_gradients_are_finite_where_the_angle_is_undefined() -> None:
    model = PhaseDecoder(4, 0, (4, 3), False).double()
    features, log_gain = random_inputs()
    model.leave.bias.data[:12] = -1.0  # the first map is -1, so that the angle is that of 0 + 0 j
    features.requires_grad_()
    model.factor(features, SIZE, log_gain).abs().sum().backward()
    assert features.grad is not None and features.grad.isfinite().all()
