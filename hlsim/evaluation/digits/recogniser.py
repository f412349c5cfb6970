"""The simulated listener of the digits-in-noise test: a small network that recognises digits."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from hlsim.calibration import NEURO_RATE
from hlsim.checkpoint import DIGIT_LISTENER, HubModel, read_checkpoint, read_record
from hlsim.data.bundled import SLOT_SAMPLES
from hlsim.dsp.erb import erb_frequency, erb_number
from hlsim.dsp.fft import power
from hlsim.dsp.stft import STFT
from hlsim.evaluation.digits.material import DIGITS_PER_TRIPLET, LEAD_SAMPLES
from hlsim.neuro.config import ModelConfig, number

_LOWEST_HZ, _HIGHEST_HZ = 80.0, 7800.0
"""Lower edge of the lowest band and upper edge of the highest one in Hz."""

_MARGIN_FRAMES = 5
"""Number of frames of 10 ms that the network gets before and after the slot of a digit."""

_POWER_FLOOR = 1e-14
"""Power in the units of the spectrum that is added before the logarithm.

It is at least 70 dB below that of the internal noise of a normal ear in each band.
"""


@dataclass(frozen=True)
class DigitListenerConfig(ModelConfig):
    """Sizes of a ``DigitListener``.

    Attributes:
        bands: Number of frequency bands, 8 to 80, evenly spaced on the ERB-number scale.
        channels: Number of feature maps of each convolution, 1 to 256.

    Raises:
        ValueError: A value is out of range.

    >>> DigitListenerConfig(channels=8).to_dict()["channels"]
    8
    """

    bands: int = number(40, 8, 80)
    channels: int = number(32, 1, 256)


class DigitListener(nn.Module, HubModel):
    """Recogniser of digits in what an ear perceives, which knows when each digit begins.

    It computes the level every 10 ms in frequency bands. The part of each digit, a picture of bands
    by frames, loses its mean, so that the overall level has hardly any influence. Three
    convolutions and a linear layer compute from a picture one score for each of the ten digits.

    Args:
        config: Sizes of the network; by default ``DigitListenerConfig()``.

    Raises:
        ValueError: The argument ``config`` is not a ``DigitListenerConfig``.

    >>> DigitListener()(torch.randn(2, 48000)).shape
    torch.Size([2, 3, 10])
    """

    kind = DIGIT_LISTENER
    config_class = DigitListenerConfig
    bands: Tensor

    def __init__(self, config: DigitListenerConfig | None = None) -> None:
        super().__init__()
        self.config = config = DigitListenerConfig.resolve(config)
        self.stft = STFT(fft=512, window=400, hop=NEURO_RATE // 100)
        self.register_buffer("bands", self._band_weights(), persistent=False)
        slot_frames = SLOT_SAMPLES // self.stft.hop
        starts = LEAD_SAMPLES // self.stft.hop + slot_frames * np.arange(DIGITS_PER_TRIPLET)
        self.slots = [
            slice(start - _MARGIN_FRAMES, start + slot_frames + _MARGIN_FRAMES)
            for start in starts.tolist()
        ]
        layers: list[nn.Module] = []
        channels = 1
        height, width = config.bands, slot_frames + 2 * _MARGIN_FRAMES
        for kernel in (5, 5, 3):
            convolution = nn.Conv2d(
                channels, config.channels, kernel, stride=2, padding=kernel // 2
            )
            layers += [convolution, nn.BatchNorm2d(config.channels), nn.ReLU()]
            channels, height, width = config.channels, (height + 1) // 2, (width + 1) // 2
        size = channels * height * width
        self.network = nn.Sequential(*layers, nn.Flatten(), nn.Dropout(0.2), nn.Linear(size, 10))

    def forward(self, perceived: Tensor) -> Tensor:
        """Compute ten scores for each spoken digit, whose softmax are probabilities of 0 to 9.

        Shape: (triplets, time) -> (triplets, 3, 10).

        Args:
            perceived: Perceived triplets in pascals at 16 kHz, of 3 s each: 48000 samples.
        """
        powers = power(self.stft.analyse(perceived)) @ self.bands
        levels = (powers + _POWER_FLOOR).log10().mT
        pictures = torch.stack([levels[..., slot] for slot in self.slots], 1)
        pictures = pictures - pictures.mean((-2, -1), keepdim=True)
        scores = self.network(pictures.flatten(0, 1).unsqueeze(1))
        return scores.reshape(-1, DIGITS_PER_TRIPLET, 10)

    def _band_weights(self) -> Tensor:
        """Compute the weights that turn the powers of a spectrum into powers in triangular bands.

        The spectrum has 257 frequencies, 0 to 8 kHz. Shape: (257, bands).
        """
        count = self.config.bands
        lowest, highest = erb_number(np.array([_LOWEST_HZ, _HIGHEST_HZ]))
        edges = erb_frequency(np.linspace(lowest, highest, count + 2))
        hertz = np.linspace(0.0, NEURO_RATE / 2.0, self.stft.frequencies)
        weights = [np.interp(hertz, edges[i : i + 3], (0.0, 1.0, 0.0)) for i in range(count)]
        return torch.from_numpy(np.stack(weights, 1).astype(np.float32))


def load_listener(name: str | Path = DIGIT_LISTENER) -> DigitListener:
    """Load a trained listener, in evaluation mode and without gradients of its weights.

    Later calls with the same argument return the same object, until the checkpoint changes.

    Args:
        name: Name of a checkpoint that ships with hlsim, or the folder of a checkpoint.

    Raises:
        ValueError: There is no such checkpoint, or it is damaged or of another kind.

    >>> load_listener().config.bands
    40
    """
    record = read_record(name)
    return _load_listener(name, record.get("sha256"), record.get("config_sha256"))


@cache
def _load_listener(name: str | Path, *hashes: str | None) -> DigitListener:
    return read_checkpoint(name, [DigitListener])
