"""What a MappingCompensator is made of, as JSON can hold it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from hlsim.settings import refuse_unknown
from hlsim.spectrum import STFT


@dataclass(frozen=True)
class MappingConfig:
    """Sizes and choices of a ``MappingCompensator``.

    Attributes:
        fft, window, hop: of the transform at 16 kHz, in samples; the paper's by default.
        channels: feature maps of the network.
        dense_depth: dilated convolutions of the encoder and of each decoder, 0 for none.
        stride: (time, frequency) steps of the encoder; the decoders undo them.
        blocks: dual-path blocks.
        kernel: (time, frequency) lengths of a block's one-dimensional convolutions, odd.
        expansion: channels inside a block over ``channels``.
        start: gain before training: ``"nalr"``, or a share of the loss from 0 to 1, as 0.4.
        bands: of the correction to it, evenly spaced on the ERB-number scale, 4 to 40.
        reach_db: largest correction up or down.
        limit_spl: peak of the output in dB SPL that no sample passes.
    """

    fft: int = 400
    window: int = 400
    hop: int = 100
    channels: int = 24
    dense_depth: int = 0
    stride: tuple[int, int] = (2, 3)
    blocks: int = 2
    kernel: tuple[int, int] = (7, 7)
    expansion: int = 2
    start: str | float = "nalr"
    bands: int = 20
    reach_db: float = 40.0
    limit_spl: float = 110.0

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
            length % 2 == 0 for length in self.kernel
        ):
            raise ValueError(f"{self}; allowed: whole numbers of 1 or more, kernels odd")
        if self.start != "nalr" and not (isinstance(self.start, float | int) and 0.0 <= self.start <= 1.0):
            raise ValueError(f"start is {self.start!r}; allowed: 'nalr', or a share of the loss from 0 to 1")
        if not 4 <= self.bands <= 40:
            raise ValueError(f"bands is {self.bands}; allowed: 4 to 40")
        if not 0.0 < self.reach_db <= 60.0:
            raise ValueError(f"reach_db is {self.reach_db}; allowed: more than 0, to 60 dB")
        if not 60.0 <= self.limit_spl <= 140.0:
            raise ValueError(f"limit_spl is {self.limit_spl}; allowed: 60 to 140 dB SPL")

    @property
    def stft(self) -> STFT:
        return STFT(self.fft, self.window, self.hop)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> MappingConfig:
        """Read what ``to_dict`` wrote. Raises ValueError where a name is unknown."""
        refuse_unknown(data, (field.name for field in fields(cls)), "compensator settings")
        return cls(**data)
