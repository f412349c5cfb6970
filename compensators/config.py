"""What trained compensators are made of, as JSON can hold it."""

from __future__ import annotations

from dataclasses import dataclass

from hlsim.checks import check_number, is_finite
from hlsim.neuro.config import ModelConfig, NetworkConfig, Phase


@dataclass(frozen=True)
class MappingConfig(NetworkConfig):
    """Sizes and choices of a ``MappingCompensator``: those of ``NetworkConfig``, and

    Attributes:
        start: gain before training: ``"nalr"``, or a share of the loss from 0 to 1, as 0.4.
        phase: of the output: the ``input``'s, or ``predicted``, as the paper's is. A criterion of levels alone, as
            ``bands``, teaches a predicted phase to take away what is steady, with a different shift in every frame.
        bands: of the correction to it, evenly spaced on the ERB-number scale, 4 to 40.
        reach_db: largest correction up or down.
        limit_spl: peak of the output in dB SPL that no sample passes.
    """

    start: str | float = "nalr"
    phase: Phase = "input"
    bands: int = 20
    reach_db: float = 40.0
    limit_spl: float = 110.0

    def __post_init__(self) -> None:
        super().__post_init__()
        share = (
            isinstance(self.start, float | int)
            and is_finite(self.start)
            and 0.0 <= self.start <= 1.0
        )
        if self.start != "nalr" and not share:
            raise ValueError(
                f"start is {self.start!r}; allowed: 'nalr', or a share of the loss from 0 to 1"
            )
        check_number("bands", self.bands, 4, 40, whole=True)
        check_number("limit_spl", self.limit_spl, 60.0, 140.0)
        if not (is_finite(self.reach_db) and 0.0 < self.reach_db <= 60.0):
            raise ValueError(f"reach_db is {self.reach_db!r}; allowed: more than 0, to 60 dB")


@dataclass(frozen=True)
class HearingAidConfig(ModelConfig):
    """Sizes and choices of a ``HearingAid``.

    Attributes:
        bands: whose gains it sets, an equal number of ERBs apart but no less than 125 Hz, 4 to 40.
        bins: frequencies of a frame, 62.5 Hz apart from the first, whose levels noise reduction sees beside the bands'.
        width: of the layer before noise reduction's recurrent one.
        hidden: of the recurrent layer.
        inner: width of the correction's three layers.
        reach_db: largest correction of the restoring gain up or down.
        reduction_db: most that noise reduction takes off a band.
        attack, release: of the levels that the gain follows, time constants in seconds.
        opening, closing: of noise reduction.
        cap_db: most gain of a band.
        quiet_spl: level under which the gain fades, to none 15 dB lower.
        limit_spl: peak of the output in dB SPL that no sample passes.
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
        ranges: dict[str, tuple[float, float]] = {
            "bands": (4, 40),
            "bins": (0, 128),
            "width": (1, 4096),
            "hidden": (1, 4096),
            "inner": (1, 4096),
            "reach_db": (0.0, 60.0),
            "reduction_db": (0.0, 60.0),
            "attack": (0.0, 1.0),
            "release": (0.01, 2.0),
            "opening": (0.0, 1.0),
            "closing": (0.01, 2.0),
            "cap_db": (0.0, 80.0),
            "quiet_spl": (0.0, 80.0),
            "limit_spl": (60.0, 140.0),
        }
        for name, (lowest, highest) in ranges.items():
            check_number(name, getattr(self, name), lowest, highest, whole=isinstance(lowest, int))
