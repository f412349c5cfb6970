"""Settings of the three trainable compensators, which a checkpoint stores as JSON."""

from dataclasses import dataclass, field
from typing import Any, Literal

from hlsim.checks import check_number
from hlsim.neuro.config import ModelConfig, NetworkConfig, Phase


@dataclass(frozen=True)
class MappingConfig(NetworkConfig):
    """Settings of a ``MappingCompensator``, in addition to the sizes in ``NetworkConfig``.

    Attributes:
        start: Prescription that gives the gain before training, to which the network adds a
            correction. There is only ``"nalr"``.
        phase: Phase of the output: ``input`` for that of the input, or ``predicted`` by the
            network, as in Neuro-MSBG. Do not combine ``predicted`` with a criterion that compares
            only levels, such as ``"bands"``. Training may then find phases that differ between
            overlapping frames, which cancels steady sounds.
        bands: Number of bands, 4 to 40, in each of which the correction is computed. The centres
            are evenly spaced on the ERB-number scale, on which the ear's bandwidth is constant.
        reach_db: Largest correction up or down in dB.
        limit_spl: Peak of the output in dB SPL that no sample exceeds.
        microphones: Number of microphones per ear, 1 to 16. With more than 1, the network filters
            and adds their signals before it amplifies them.
        ears: Number of ears with several microphones each, 1 or 2. With one microphone it is 1, and
            the compensator takes any number of ears.

    Raises:
        ValueError: A value is out of range.

    >>> MappingConfig(blocks=1, phase="predicted").phase
    'predicted'
    """

    start: Literal["nalr"] = "nalr"
    phase: Phase = "input"
    bands: int = 20
    reach_db: float = 40.0
    limit_spl: float = 110.0
    microphones: int = 1
    ears: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("microphones", self.microphones, 1, 16, whole=True)
        check_number("ears", self.ears, 1, min(2, self.microphones), whole=True)
        check_number("bands", self.bands, 4, 40, whole=True)
        check_number("limit_spl", self.limit_spl, 60.0, 140.0)
        check_number("reach_db", self.reach_db, 0.1, 60.0)


@dataclass(frozen=True)
class HearingAidConfig(ModelConfig):
    """Settings of a ``HearingAid``, which amplifies bands and attenuates noise in them.

    The amplification of a band is a restoring gain, which makes the band as loud as for a normal
    ear, plus a correction by a small network. A second, recurrent network reduces noise.

    Attributes:
        bands: Number of bands, 4 to 40. Their centres are an equal number of ERBs (bandwidths of
            the normal ear), but at least 125 Hz, apart.
        bins: Number of single frequencies (62.5, 125, 187.5, ... Hz) whose levels are inputs of
            noise reduction, in addition to the levels of the bands.
        width: Width of the layer before the recurrent one of noise reduction.
        hidden: Width of the recurrent layer.
        inner: Width of the three layers of the network that computes the correction.
        reach_db: Largest correction of the restoring gain up or down in dB.
        reduction_db: Largest attenuation of a band by noise reduction in dB.
        attack: Time constant in seconds with which the level that sets the amplification rises.
        release: Time constant in seconds with which this level falls.
        opening: Time constant in seconds with which the attenuation of noise decreases.
        closing: Time constant in seconds with which the attenuation of noise increases.
        cap_db: Largest amplification of a band in dB.
        quiet_spl: Level of a frame in dB SPL below which the amplification fades. Frames that are
            15 dB softer than this level are not amplified.
        limit_spl: Peak of the output in dB SPL that no sample exceeds.

    Raises:
        ValueError: A value is out of range.

    >>> HearingAidConfig(bands=12).cap_db
    45.0
    """

    bands: int = 20
    bins: int = 40
    width: int = 96
    hidden: int = 256
    inner: int = 192
    reach_db: float = 20.0
    reduction_db: float = 12.0
    attack: float = 0.005
    release: float = 0.1
    opening: float = 0.0
    closing: float = 0.03
    cap_db: float = 45.0
    quiet_spl: float = 40.0
    limit_spl: float = 110.0

    def __post_init__(self) -> None:
        check_number("bands", self.bands, 4, 40, whole=True)
        check_number("bins", self.bins, 0, 128, whole=True)
        for name in ("width", "hidden", "inner"):
            check_number(name, getattr(self, name), 1, 4096, whole=True)
        for name in ("reach_db", "reduction_db", "cap_db", "quiet_spl"):
            check_number(name, getattr(self, name), 0.0, 80.0)
        for name in ("attack", "opening"):
            check_number(name, getattr(self, name), 0.0, 1.0)
        for name in ("release", "closing"):
            check_number(name, getattr(self, name), 0.01, 2.0)
        check_number("limit_spl", self.limit_spl, 60.0, 140.0)


@dataclass(frozen=True)
class BeamformerConfig(ModelConfig):
    """Settings of a ``BeamformingAid``, an ``AdaptiveBeamformer`` before a ``HearingAid``.

    Attributes:
        bands: Number of bands, 4 to 40, as in ``HearingAidConfig``.
        hidden: Width of the two layers of the network.
        seconds: Time constant of the averages in seconds.
        loading: Loading of the fixed beams, see ``BinauralMVDR``.
        spacing: Distance between the two microphones of a side in m.
        aid: Settings of the hearing aid, by the names of ``HearingAidConfig``.

    Raises:
        ValueError: A value is out of range.

    >>> BeamformerConfig(bands=12).hidden
    64
    """

    bands: int = 20
    hidden: int = 64
    seconds: float = 0.06
    loading: float = 1e-4
    spacing: float = 0.01
    aid: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_number("bands", self.bands, 4, 40, whole=True)
        check_number("hidden", self.hidden, 1, 512, whole=True)
        check_number("seconds", self.seconds, 0.01, 2.0)
        check_number("loading", self.loading, 1e-6, 1.0)
        check_number("spacing", self.spacing, 0.002, 0.1)
