"""Settings of the networks: dataclasses that a checkpoint stores as JSON."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, Self, get_origin

from hlsim.calibration import NEURO_RATE
from hlsim.checks import check_choice, check_flag, check_names, check_number, describe
from hlsim.dsp.stft import STFT

Block = Literal["cnn", "mamba", "lstm", "transformer"]
Structure = Literal["dual-path", "monolithic", "bands"]
AudiogramInput = Literal["channel", "concatenated"]
Phase = Literal["predicted", "input"]

MAX_SIZE = 1024
"""Largest accepted value of each size. It protects from mistakes and from exhausted memory."""


def number(default: float, lowest: float, highest: float) -> Any:
    """Return the dataclass field for a setting of a ``ModelConfig``, a number in a range.

    Args:
        default: Default value.
        lowest: Smallest accepted value.
        highest: Largest accepted value.

    >>> number(20, 4, 40).default
    20
    """
    return field(default=default, metadata={"range": (lowest, highest)})


@dataclass(frozen=True)
class ModelConfig:
    """Base class of the settings of a model, which can be converted to JSON and back.

    Numbers, flags and settings of type ``Literal`` are validated. The range of a number is that of
    ``number``, or from 1 to ``MAX_SIZE``.

    Raises:
        ValueError: A value is not accepted.

    >>> NeuroConfig.from_dict({"channels": 32}).to_dict()["channels"]
    32
    """

    def __post_init__(self) -> None:
        for setting in fields(self):
            name, kind, value = setting.name, setting.type, getattr(self, setting.name)
            if kind in (int, float):
                limits = setting.metadata.get("range", (1, MAX_SIZE))
                check_number(name, value, *limits, whole=kind is int)
            elif kind is bool:
                check_flag(name, value)
            elif get_origin(kind) is Literal:
                check_choice(name, value, kind)

    def to_dict(self) -> dict[str, Any]:
        """Convert the settings to a dict that ``json.dumps`` accepts."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Build settings from a dict, for example one that ``to_dict`` returned.

        Args:
            data: Values under the names of settings. Missing settings have their default values.

        Raises:
            ValueError: The data are no dict, a name is unknown, or a value is not accepted.
        """
        if not isinstance(data, Mapping):
            raise ValueError(
                f"expected a dict from the names of network settings to values, got "
                f"{describe(data)}"
            )
        check_names(data, (field.name for field in fields(cls)), "network settings")
        return cls(**data)

    @classmethod
    def resolve(cls, config: Any) -> Self:
        """Return a configuration of this class, or the default one in place of None.

        Args:
            config: Argument ``config`` of a model.

        Raises:
            ValueError: The argument is neither None nor a configuration of this class.

        >>> NeuroConfig.resolve(None) == NeuroConfig()
        True
        """
        if config is None:
            return cls()
        if not isinstance(config, cls):
            fix = f"; write {cls.__name__}.from_dict({{...}})" if isinstance(config, dict) else ""
            raise ValueError(f"expected config to be a {cls.__name__}, got {describe(config)}{fix}")
        return config


@dataclass(frozen=True)
class NetworkConfig(ModelConfig):
    """Sizes of the networks on spectrograms: Neuro-MSBG and ``MappingCompensator``.

    Such a network, unless ``NeuroConfig.structure`` is another one, encodes the spectrogram of its
    input on a coarser grid, processes it in *dual-path blocks* (layers along time, then layers
    along frequency), and decodes it again. All numbers are from 1 to 1024; ``dense_depth`` may also
    be 0.

    Attributes:
        fft: Length of the Fourier transform in samples at 16 kHz, an even number.
        window: Length of the Hann window in samples at 16 kHz, at most ``fft``.
        hop: Samples at 16 kHz from one frame to the next, at most a quarter of ``window``.
        channels: Number of feature maps of the network.
        dense_depth: Number of dilated convolutions of the encoder and of each decoder.
        stride: Number of frames and of frequencies of the spectrogram per point of the feature
            maps.
        block: Kind of the layers in the blocks: ``cnn``, ``mamba``, ``lstm`` or ``transformer``.
        blocks: Number of dual-path blocks.
        kernel: Lengths of a ``cnn`` block's convolutions along time and frequency, odd numbers.
        expansion: Width inside a block relative to ``channels``. It applies to the pointwise layers
            of a ``cnn`` block, the scan of a ``mamba`` block, the state of an ``lstm`` block in
            each direction, and the feed-forward layer of a ``transformer`` block.
        states: Number of states per channel of a ``mamba`` block's scan.
        heads: Number of attention heads of a ``transformer`` block, a divisor of ``channels``.

    Raises:
        ValueError: A value is out of range, or values do not fit together.

    >>> NetworkConfig(fft=400, hop=100, stride=(2, 3)).step
    200
    """

    fft: int = 400
    window: int = 400
    hop: int = 100
    channels: int = 24
    dense_depth: int = number(0, 0, MAX_SIZE)
    stride: tuple[int, int] = (2, 3)
    block: Block = "cnn"
    blocks: int = 2
    kernel: tuple[int, int] = (7, 7)
    expansion: int = 2
    states: int = 16
    heads: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("stride", "kernel"):
            sizes = getattr(self, name)
            if not isinstance(sizes, list | tuple) or len(sizes) != 2:
                raise ValueError(
                    f"expected {name} to be two whole numbers, for time and frequency, "
                    f"got {describe(sizes)}"
                )
            for size in sizes:
                check_number(name, size, 1, MAX_SIZE, whole=True)
            object.__setattr__(self, name, tuple(sizes))
        if any(length % 2 == 0 for length in self.kernel):
            raise ValueError(f"expected odd lengths of kernel, got {self.kernel}")
        if self.block == "transformer" and self.channels % self.heads:
            raise ValueError(
                f"expected heads to divide the {self.channels} channels, got heads={self.heads}"
            )
        STFT(self.fft, self.window, self.hop)  # raises ValueError unless these fit together
        # With longer hops, the last samples may lie where the only window is close to 0, by which
        # the inverse transform divides.
        if 4 * self.hop > self.window:
            raise ValueError(
                f"expected a hop of at most a quarter of the window, got hop={self.hop}, "
                f"window={self.window}"
            )

    @property
    def stft(self) -> STFT:
        """Transform (``fft``, ``window``, ``hop``) by which spectrograms are computed."""
        return STFT(self.fft, self.window, self.hop)

    @property
    def hz(self) -> tuple[float, ...]:
        """The ``fft // 2 + 1`` frequencies in Hz of a spectrogram at 16 kHz."""
        return tuple(NEURO_RATE * k / self.fft for k in range(self.fft // 2 + 1))

    @property
    def step(self) -> int:
        """Samples at 16 kHz from one point of the feature maps to the next."""
        return self.hop * self.stride[0]

    @property
    def receptive_field(self) -> int | None:
        """Number of input samples at 16 kHz on each side of an output sample that can influence it.

        None if the output depends on the whole signal, as with layers other than convolutions.
        ``EarNetwork.receptive_field`` includes the prior.
        """
        if self.block != "cnn":
            return None
        block_steps = self.blocks * (self.kernel[0] // 2)
        dense_steps = 2 * (2**self.dense_depth - 1)
        # The strides of the encoder and of the decoders cut time into patches.
        patch_steps = 2
        return self.step * (block_steps + dense_steps + patch_steps) + self.window


@dataclass(frozen=True)
class NeuroConfig(NetworkConfig):
    """Sizes and choices of a Neuro-MSBG, by default those of ``neuro-msbg``.

    The other sizes, such as ``fft`` and ``channels``, are described in ``NetworkConfig``, which has
    other defaults.

    Attributes:
        structure: ``bands``, ``dual-path`` or ``monolithic``. ``bands`` is a network along time
            that corrects the gains in MSBG's frequency channels (``hlsim.neuro.bands``), at a lower
            cost than the paper's ``dual-path`` networks. It needs ``block="cnn"``,
            ``phase="predicted"``, ``prior``, ``level_aware``, and the default ``fft``, ``window``
            and ``hop``, here in samples at 16537.5 Hz. It ignores ``audiogram``, ``dense_depth``
            and the second numbers of ``stride`` and ``kernel``. The ``monolithic`` baselines of the
            paper have a linear encoder and no frequency axis: each frame is a vector of
            ``channels`` values, and the blocks run along time only.
        audiogram: ``channel`` for an encoded audiogram as an input channel (the paper's Equation
            1), or ``concatenated`` for eight thresholds next to magnitude and phase along frequency
            (its Table IV).
        phase: ``predicted``, or ``input`` for a network that changes the magnitude only (Table
            III).
        prior: Estimate MSBG's gains by its formulae (``hlsim.neuro.prior``); the network corrects
            them. Otherwise the network learns everything, as in the paper.
        level_aware: Use the log magnitude and no normalisation, so that the gain depends on the
            level as it does in an ear. Otherwise the gain does not depend on the level, as in
            MP-SENet: each signal is scaled to an RMS of 1 and back, and instance normalisation
            follows the convolutions of encoder and decoders.

    Raises:
        ValueError: A value is out of range, or values do not fit together.

    >>> NeuroConfig(structure="dual-path", block="lstm").hop
    24
    """

    fft: int = 192
    window: int = 96
    hop: int = 24
    channels: int = 48
    stride: tuple[int, int] = (2, 1)
    blocks: int = 1
    kernel: tuple[int, int] = (13, 1)
    structure: Structure = "bands"
    audiogram: AudiogramInput = "channel"
    phase: Phase = "predicted"
    prior: bool = True
    level_aware: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        supports_bands = self.prior and self.level_aware and self.phase == "predicted"
        if self.structure == "bands" and not (supports_bands and self.block == "cnn"):
            raise ValueError(
                "expected structure='dual-path' or 'monolithic', or block='cnn', "
                "phase='predicted', prior=True and level_aware=True with structure='bands', "
                f"got {self}"
            )
        frames = self.fft, self.window, self.hop
        if self.structure == "bands" and frames != (192, 96, 24):
            raise ValueError(
                "expected fft=192, window=96 and hop=24 with structure='bands', which works on "
                f"MSBG's frames, got fft={self.fft}, window={self.window}, hop={self.hop}; leave "
                "these settings out, and train the network of an older checkpoint again"
            )

    @property
    def receptive_field(self) -> int | None:
        """Receptive field in samples, see ``NetworkConfig``; None if ``level_aware`` is False."""
        # The scale of a normalised network depends on the whole signal.
        return super().receptive_field if self.level_aware else None
