"""The paper's audiogram encoder."""

import torch
from torch import Tensor, nn


class AudiogramEncoder(nn.Module):
    """Thresholds to one value a frequency: linear(flatten(average pool(ReLU(conv)))) (Equation 1).

    Args:
        frequencies: F, the frequencies of the transform.
        channels: feature maps of the convolution.
    """

    def __init__(self, frequencies: int, channels: int = 16) -> None:
        super().__init__()
        self.conv = nn.Conv1d(1, channels, kernel_size=3, padding=1)
        self.pool = nn.AvgPool1d(2)
        self.project = nn.Linear(channels * 4, frequencies)

    def forward(self, thresholds: Tensor) -> Tensor:
        """Shape: (items, 8) dB HL -> (items, F)."""
        features = torch.relu(self.conv(thresholds.unsqueeze(1) / 100.0))
        encoded: Tensor = self.project(self.pool(features).flatten(1))
        return encoded
