"""Settings of the two trainable compensators, which are stored as JSON."""

from __future__ import annotations

from dataclasses import dataclass

from hlsim.checks import check_number, describe, is_finite
from hlsim.neuro.config import ModelConfig, NetworkConfig, Phase


@dataclass(frozen=True)
class MappingConfig(NetworkConfig):
    """Settings of a ``MappingCompensator``, in addition to those of ``NetworkConfig``.

    Attributes:
        start: Gain before training: ``"nalr"``, or a share of the hearing loss from 0 to 1.
        phase: Phase of the output: ``input`` for that of the input, or ``predicted`` by the
            network, as in Neuro-MSBG. Do not combine ``predicted`` with a criterion that compares
            only levels, such as ``"bands"``. Training may then find phases that differ between
            overlapping frames, which cancels steady sounds.
        bands: Number of bands of the correction, evenly spaced on the ERB-number scale, 4 to 40.
        reach_db: Largest correction up or down in dB.
        limit_spl: Peak of the output in dB SPL that no sample exceeds.

    >>> MappingConfig(blocks=1, phase="predicted").phase
    'predicted'
    """

    start: str | float = "nalr"
    phase: Phase = "input"
    bands: int = 20
    reach_db: float = 40.0
    limit_spl: float = 110.0

    def __post_init__(self) -> None:
        super().__post_init__()
        is_share = is_finite(self.start) and 0.0 <= float(self.start) <= 1.0
        if self.start != "nalr" and not is_share:
            raise ValueError(
                "expected start to be 'nalr' or a share of the loss from 0 to 1, "
                f"got {describe(self.start)}"
            )
        check_number("bands", self.bands, 4, 40, whole=True)
        check_number("limit_spl", self.limit_spl, 60.0, 140.0)
        check_number("reach_db", self.reach_db, 0.1, 60.0)


@dataclass(frozen=True)
class HearingAidConfig(ModelConfig):
    """Settings of a ``HearingAid``.

    The gain of a band is a restoring gain, which brings the loudness of the band back to that of a
    normal ear, plus a correction by a small network.

    Attributes:
        bands: Number of bands with a gain, an equal number of ERBs but at least 125 Hz apart, 4 to
            40.
        bins: Number of frequencies of a frame, 62.5 Hz apart from the first, whose levels noise
            reduction sees in addition to those of the bands.
        width: Width of the layer before the recurrent one of noise reduction.
        hidden: Width of the recurrent layer.
        inner: Width of the three layers of the network that computes the correction.
        reach_db: Largest correction of the restoring gain up or down in dB.
        reduction_db: Largest attenuation of a band by noise reduction in dB.
        attack: Time constant in seconds with which the levels behind the gain rise.
        release: Time constant in seconds with which they fall.
        opening: Time constant in seconds with which noise reduction ends.
        closing: Time constant in seconds with which it begins.
        cap_db: Largest gain of a band in dB.
        quiet_spl: Level in dB SPL below which the gain fades, to none 15 dB lower.
        limit_spl: Peak of the output in dB SPL that no sample exceeds.

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
