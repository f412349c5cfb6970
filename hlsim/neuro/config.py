"""What a network of this family is made of, as JSON can hold it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, Self, get_origin, get_type_hints

from hlsim.checks import check_choice, check_names
from hlsim.dsp.stft import STFT

NEURO_RATE = 16000
"""The sample rate in Hz at which the networks work."""

Block = Literal["cnn", "mamba", "lstm", "transformer"]
Structure = Literal["dual-path", "monolithic", "bands"]
AudiogramInput = Literal["channel", "concatenated"]
Phase = Literal["predicted", "input"]

_COUNTS = {
    "fft": 1024,
    "window": 1024,
    "hop": 1024,
    "channels": 1024,
    "dense_depth": 8,
    "blocks": 64,
    "expansion": 16,
}
_COUNTS |= {"states": 256, "heads": 64, "stride": 64, "kernel": 127}
"""The most of each: beyond, a configuration is a mistake, or is to fill the memory."""


@dataclass(frozen=True)
class ModelConfig:
    """What a model is made of, as a dataclass that JSON can hold."""

    @classmethod
    def given(cls, config: Self | None) -> Self:
        """What a network was given, or the default. Raises ValueError where it is of another kind."""
        if config is not None and not isinstance(config, cls):
            raise ValueError(f"config is {type(config).__name__}; allowed: a {cls.__name__}")
        return config or cls()

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Read what ``to_dict`` wrote. Raises ValueError where a name is unknown, or a value none that is allowed."""
        if not isinstance(data, Mapping):
            raise ValueError(f"network settings {data!r}; allowed: names with values")
        check_names(data, (field.name for field in fields(cls)), "network settings")
        return cls(**dict(data))


@dataclass(frozen=True)
class NetworkConfig(ModelConfig):
    """Sizes that simulators and compensators share.

    Attributes:
        fft, window, hop: of the transform at 16 kHz, in samples; ``hop`` is at most a quarter of ``window``.
        channels: feature maps of the network.
        dense_depth: dilated convolutions of the encoder and of each decoder, 0 for none.
        stride: (time, frequency) steps of the encoder; the decoders undo them.
        block: what runs along each axis: ``cnn``, ``mamba``, ``lstm`` or ``transformer``.
        blocks: how many of them.
        kernel: (time, frequency) lengths of a cnn block's convolutions, odd.
        expansion: width inside a block over ``channels``: of the pointwise layers (cnn), of the scan (mamba), of an
            LSTM's state in each direction, of a transformer's feed-forward layer.
        states: a channel of mamba's scan.
        heads: of a transformer's attention; they divide ``channels``.
    """

    fft: int = 400
    window: int = 400
    hop: int = 100
    channels: int = 24
    dense_depth: int = 0
    stride: tuple[int, int] = (2, 3)
    block: Block = "cnn"
    blocks: int = 2
    kernel: tuple[int, int] = (7, 7)
    expansion: int = 2
    states: int = 16
    heads: int = 4

    def __post_init__(self) -> None:
        for name in ("stride", "kernel"):
            pair = getattr(self, name)
            if not isinstance(pair, list | tuple) or len(pair) != 2:
                raise ValueError(
                    f"{name} {pair!r}; allowed: two whole numbers, of time and of frequency"
                )
            object.__setattr__(self, name, tuple(pair))
        for name, most in _COUNTS.items():
            values, least = getattr(self, name), 0 if name == "dense_depth" else 1
            for value in values if isinstance(values, tuple) else (values,):
                if (
                    not isinstance(value, int)
                    or isinstance(value, bool)
                    or not least <= value <= most
                ):
                    raise ValueError(
                        f"{name} {values!r}; allowed: whole numbers from {least} to {most}"
                    )
        uneven = self.block == "transformer" and self.channels % self.heads
        if any(k % 2 == 0 for k in self.kernel) or uneven:
            raise ValueError(
                f"kernel {self.kernel}, {self.heads} heads of {self.channels} channels; allowed: odd kernels, heads that "
                "divide the channels"
            )
        _ = self.stft
        # with longer hops the last samples may lie where the only window is almost zero, which the inverse divides by
        if 4 * self.hop > self.window:
            raise ValueError(f"hop {self.hop}, window {self.window}; allowed: 4 hop <= window")
        for name, kind in get_type_hints(type(self)).items():
            if get_origin(kind) is Literal:
                check_choice(name, getattr(self, name), kind)

    @property
    def stft(self) -> STFT:
        return STFT(self.fft, self.window, self.hop)

    @property
    def hz(self) -> tuple[float, ...]:
        """The transform's frequencies."""
        return tuple(NEURO_RATE * k / self.fft for k in range(self.fft // 2 + 1))

    @property
    def step(self) -> int:
        """Samples from one place of the feature maps to the next."""
        return self.hop * self.stride[0]

    @property
    def density(self) -> float:
        """Values of the widest feature map a sample."""
        rows = -(-self.stft.frequencies // self.stride[1])
        return self.channels * self.expansion * rows / self.step

    @property
    def receptive_field(self) -> int | None:
        """Samples to either side on which one depends by transform and network; None where it is all of them."""
        if self.block != "cnn":
            return None
        # by blocks, dense encoder and decoder, and the patches into which the encoder's and the decoders' strides cut
        steps = self.blocks * (self.kernel[0] // 2) + 2 * (2**self.dense_depth - 1) + 2
        return self.step * steps + self.window


@dataclass(frozen=True)
class NeuroConfig(NetworkConfig):
    """Sizes and choices of a Neuro-MSBG.

    Attributes:
        structure: ``dual-path``, or ``monolithic``: no encoder and no frequency axis, each frame one vector of
            ``channels``, blocks along time only (the paper's baselines); or ``bands``: a network along time that
            corrects the prior's gains (``hlsim.neuro.bands``), at a third of the cost.
        audiogram: encoded as an input ``channel`` (Equation 1), or its eight levels ``concatenated`` to magnitude and
            phase along frequency (the paper's Table IV).
        phase: ``predicted``, or the ``input``'s reused: magnitude only (the paper's Table III).
        prior: start from what is known of MSBG (``hlsim.neuro.prior``) and let the network correct it. Without it the
            network learns everything, as in the paper.
        level_aware: log magnitude and no normalisation. Otherwise each utterance is scaled to unit RMS and back, and
            instance normalisation follows the convolutions, as in MP-SENet: a level is then invisible.
    """

    fft: int = 128
    window: int = 128
    hop: int = 32
    channels: int = 24
    stride: tuple[int, int] = (4, 3)
    blocks: int = 3
    structure: Structure = "dual-path"
    audiogram: AudiogramInput = "channel"
    phase: Phase = "predicted"
    prior: bool = True
    level_aware: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("prior", "level_aware"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} {getattr(self, name)!r}; allowed: true or false")
        if self.structure == "bands" and not (
            self.prior and self.level_aware and self.block == "cnn"
        ):
            raise ValueError(
                f"structure 'bands' with prior {self.prior}, level_aware {self.level_aware}, block {self.block!r}; "
                "allowed: true, true, 'cnn'"
            )

    @property
    def density(self) -> float:
        return (
            2.0 * self.stft.frequencies / self.hop if self.structure == "bands" else super().density
        )
