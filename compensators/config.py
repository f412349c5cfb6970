"""What a MappingCompensator is made of, as JSON can hold it."""

from __future__ import annotations

from dataclasses import dataclass

from hlsim.checks import is_finite
from hlsim.neuro.config import NetworkConfig


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
    phase: str = "input"
    bands: int = 20
    reach_db: float = 40.0
    limit_spl: float = 110.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.start != "nalr" and not (isinstance(self.start, float | int) and 0.0 <= self.start <= 1.0):
            raise ValueError(f"start is {self.start!r}; allowed: 'nalr', or a share of the loss from 0 to 1")
        if type(self.bands) is not int or not 4 <= self.bands <= 40:
            raise ValueError(f"bands is {self.bands!r}; allowed: whole numbers from 4 to 40")
        if not (is_finite(self.reach_db) and 0.0 < self.reach_db <= 60.0):
            raise ValueError(f"reach_db is {self.reach_db!r}; allowed: more than 0, to 60 dB")
        if not (is_finite(self.limit_spl) and 60.0 <= self.limit_spl <= 140.0):
            raise ValueError(f"limit_spl is {self.limit_spl!r}; allowed: 60 to 140 dB SPL")
