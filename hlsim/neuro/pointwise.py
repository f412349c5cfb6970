"""A transposed convolution with a kernel of length 1, computed as a matrix product."""

from torch import Tensor, nn
from torch.nn import functional


class Pointwise(nn.ConvTranspose1d):
    """Linear layer across channels, with the parameters of a transposed convolution of length 1.

    Checkpoints store the parameters of the convolution, but a matrix product is faster.

    Shape: (..., inputs) -> (..., outputs).

    Args:
        inputs: Number of channels of the input.
        outputs: Number of channels of the output.

    >>> import torch
    >>> Pointwise(8, 4)(torch.randn(2, 20, 8)).shape
    torch.Size([2, 20, 4])
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 1)

    def forward(self, features: Tensor, output_size: list[int] | None = None) -> Tensor:
        return functional.linear(features, self.weight.squeeze(-1).T, self.bias)
