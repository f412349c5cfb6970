"""What a Neuro-MSBG is made of, as JSON can hold it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from hlsim.settings import refuse_unknown
from hlsim.spectrum import STFT

NEURO_RATE = 16000
"""The sample rate in Hz at which the networks work."""


@dataclass(frozen=True)
class NeuroConfig:
    """Sizes and choices of a network of this family.

    Attributes:
        fft, window, hop: of the transform at 16 kHz, in samples.
        channels: feature maps of the network.
        dense_depth: dilated convolutions of the encoder and of each decoder, 0 for none.
        stride: (time, frequency) steps of the encoder; the decoders undo them.
        blocks: dual-path blocks.
        kernel: (time, frequency) lengths of a block's one-dimensional convolutions, odd.
        expansion: channels inside a block over ``channels``.
        prior: start from what is known of MSBG (``hlsim.neuro.prior``) and let the network correct it. Without it the
            network is on its own, as in the paper.
        level_aware: log magnitude and no normalisation. Otherwise instance normalisation, as in MP-SENet.
    """

    fft: int = 256
    window: int = 96
    hop: int = 24
    channels: int = 32
    dense_depth: int = 0
    stride: tuple[int, int] = (4, 3)
    blocks: int = 3
    kernel: tuple[int, int] = (7, 7)
    expansion: int = 2
    prior: bool = True
    level_aware: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "stride", tuple(self.stride))
        object.__setattr__(self, "kernel", tuple(self.kernel))
        _ = self.stft
        counts = (
            self.channels,
            self.dense_depth + 1,
            self.blocks,
            self.expansion,
            *self.stride,
            *self.kernel,
        )
        if any(not isinstance(count, int) or count < 1 for count in counts) or any(
            k % 2 == 0 for k in self.kernel
        ):
            raise ValueError(f"{self}; allowed: whole numbers of 1 or more, kernels odd")

    @property
    def stft(self) -> STFT:
        return STFT(self.fft, self.window, self.hop)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> NeuroConfig:
        """Read what ``to_dict`` wrote. Raises ValueError where a name is unknown."""
        refuse_unknown(data, (field.name for field in fields(cls)), "network settings")
        return cls(**dict(data))
