"""The decoders' factor: what it is, and its gradient."""

import torch

from hlsim.neuro.decoders import PhaseDecoder

SIZE = (9, 17)


def trained() -> PhaseDecoder:
    model = PhaseDecoder(4, 0, (4, 3), False).double()
    for parameter in model.parameters():
        parameter.data.normal_(0.0, 0.3)
    return model


def given() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.randn(2, 4, 3, 6, dtype=torch.float64), torch.randn(2, *SIZE, dtype=torch.float64)


def test_factor_is_the_gain_and_the_angle_of_the_two_maps() -> None:
    model = trained()
    features, log_gain = given()
    right, up = model(features, SIZE).unbind(1)
    expected = torch.polar(log_gain.exp(), torch.atan2(up, 1.0 + right))
    torch.testing.assert_close(
        model.factor(features, SIZE, log_gain), expected, atol=1e-12, rtol=1e-12
    )


def test_untrained_there_is_no_shift() -> None:
    features, log_gain = given()
    model = PhaseDecoder(4, 0, (4, 3), False).double()
    factor = model.factor(features, SIZE, log_gain)
    torch.testing.assert_close(factor.real, log_gain.exp(), atol=1e-12, rtol=1e-12)
    assert not factor.imag.any()


def test_gradients_are_those_of_differences() -> None:
    model = trained()
    inputs = tuple(tensor.requires_grad_() for tensor in given())

    def factor(features: torch.Tensor, log_gain: torch.Tensor) -> torch.Tensor:
        return model.factor(features, SIZE, log_gain)

    assert torch.autograd.gradcheck(factor, inputs)
    assert torch.autograd.gradgradcheck(factor, inputs)


def test_gradients_stay_finite_where_both_maps_vanish() -> None:
    model = PhaseDecoder(4, 0, (4, 3), False).double()
    features, log_gain = given()
    model.leave.bias.data[:12] = -1.0  # of the first map: the angle of 0 + 0 j
    features.requires_grad_()
    model.factor(features, SIZE, log_gain).abs().sum().backward()
    assert features.grad is not None and features.grad.isfinite().all()
