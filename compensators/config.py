"""Settings of the three trainable compensators, which a checkpoint stores as JSON."""

from dataclasses import dataclass, field
from typing import Any, Literal

from hlsim.checks import check_number
from hlsim.dsp.sphere import SPACINGS
from hlsim.neuro.config import ModelConfig, NetworkConfig, Phase, number


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
        reach_db: Largest correction up or down in dB, 0.1 to 60.
        limit_spl: Peak of the output in dB SPL, 60 to 140, that no sample exceeds.
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
    bands: int = number(20, 4, 40)
    reach_db: float = number(40.0, 0.1, 60.0)
    limit_spl: float = number(110.0, 60.0, 140.0)
    microphones: int = number(1, 1, 16)
    ears: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("ears", self.ears, 1, min(2, self.microphones), whole=True)


@dataclass(frozen=True)
class HearingAidConfig(ModelConfig):
    """Settings of a ``HearingAid``, which amplifies bands and attenuates noise in them.

    The amplification of a band is a restoring gain, which makes the band as loud as for a normal
    ear, plus a correction by a small network. A second, recurrent network reduces noise.

    Attributes:
        bands: Number of bands, 4 to 40. Their centres are an equal number of ERBs (bandwidths of
            the normal ear), but at least 125 Hz, apart.
        bins: Number of single frequencies (62.5, 125, 187.5, ... Hz) whose levels are inputs of
            noise reduction, in addition to the levels of the bands, 0 to 128.
        width: Width of the layer before the recurrent one of noise reduction, 1 to 4096, as for
            both other widths.
        hidden: Width of the recurrent layer.
        inner: Width of the three layers of the network that computes the correction.
        reach_db: Largest correction of the restoring gain up or down in dB, 0 to 80. A band with a
            loss of 10 dB HL has half of it, one with a severe loss nearly all.
        reduction_db: Largest attenuation of a band by noise reduction in dB, 0 to 80.
        attack: Time constant in seconds, 0 to 1, with which the level that sets the amplification
            rises.
        release: Time constant in seconds, 0.01 to 2, with which this level falls.
        opening: Time constant in seconds, 0 to 1, with which the attenuation of noise decreases.
        closing: Time constant in seconds, 0.01 to 2, with which the attenuation of noise increases.
        cap_db: Largest amplification of a band in dB, 0 to 80.
        quiet_spl: Level of the whole frame in dB SPL, smoothed by ``attack`` and ``release``, 0 to
            80, below which the amplification fades. At 15 dB below it, there is none.
        limit_spl: Peak of the output in dB SPL, 60 to 140, that no sample exceeds.

    Raises:
        ValueError: A value is out of range.

    >>> HearingAidConfig(bands=12).cap_db
    45.0
    """

    bands: int = number(20, 4, 40)
    bins: int = number(40, 0, 128)
    width: int = number(96, 1, 4096)
    hidden: int = number(256, 1, 4096)
    inner: int = number(192, 1, 4096)
    reach_db: float = number(20.0, 0.0, 80.0)
    reduction_db: float = number(12.0, 0.0, 80.0)
    attack: float = number(0.005, 0.0, 1.0)
    release: float = number(0.1, 0.01, 2.0)
    opening: float = number(0.0, 0.0, 1.0)
    closing: float = number(0.03, 0.01, 2.0)
    cap_db: float = number(45.0, 0.0, 80.0)
    quiet_spl: float = number(40.0, 0.0, 80.0)
    limit_spl: float = number(110.0, 60.0, 140.0)


@dataclass(frozen=True)
class BeamformerConfig(ModelConfig):
    """Settings of a ``BeamformingAid``, an ``AdaptiveBeamformer`` before a ``HearingAid``.

    Attributes:
        bands: Number of bands, 4 to 40, as in ``HearingAidConfig``.
        hidden: Width of the two hidden layers of the network, 1 to 512.
        seconds: Time constant in seconds, 0.01 to 2, of the averages over the recent past from
            which the weights of the microphones are computed.
        loading: Loading of the fixed beams, 1e-6 to 1, see ``BinauralMVDR``.
        spacing: Distance between the two microphones of a side in m, 0.002 to 0.1.
        aid: Settings of the hearing aid, by the names of ``HearingAidConfig``. ``BeamformingAid``
            validates them.

    Raises:
        ValueError: A value other than those in ``aid`` is out of range.

    >>> BeamformerConfig(bands=12).hidden
    64
    """

    bands: int = number(20, 4, 40)
    hidden: int = number(64, 1, 512)
    seconds: float = number(0.06, 0.01, 2.0)
    loading: float = number(1e-4, 1e-6, 1.0)
    spacing: float = number(0.01, *SPACINGS)
    aid: dict[str, Any] = field(default_factory=dict)
