"""Dilated convolutions equal torch's, whichever way they are computed."""

import pytest
import torch
from torch.nn import functional

from hlsim.neuro.encoder import DilatedConv


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("dilation", [1, 2, 8])
@pytest.mark.parametrize("time", [1, 8, 21])
def test_dilated_convolution_equals_torchs(time: int, dilation: int, frozen: bool) -> None:
    conv = DilatedConv(3, 4, dilation).double().requires_grad_(not frozen)
    features = torch.randn(2, 3, time, 5, dtype=torch.float64, requires_grad=True)
    expected = functional.conv2d(
        features, conv.weight, conv.bias, padding=(dilation, 1), dilation=(dilation, 1)
    )
    output = conv(features)
    torch.testing.assert_close(output, expected, atol=1e-12, rtol=1e-12)
    inputs = [features, *(weight for weight in conv.parameters() if weight.requires_grad)]
    direction = torch.randn_like(expected)
    gradients = torch.autograd.grad(output, inputs, direction)
    expected_gradients = torch.autograd.grad(expected, inputs, direction)
    torch.testing.assert_close(gradients, expected_gradients, atol=1e-12, rtol=1e-12)
