"""Listeners, people with a left and a right ear."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hlsim.audiogram.scale import EARS, EarName
from hlsim.audiogram.value import Audiogram, EarLike, as_audiogram


@dataclass(frozen=True)
class Listener:
    """The audiograms of both ears of a person, for waveforms (..., 2, time), left ear first.

    Models, losses and metrics accept a listener in place of an audiogram, and a sequence with one
    listener per item. ``haspi`` and ``hasqi`` return one score per ear; ``.amax(-1)`` is that of
    the better ear.

    Args:
        left: Audiogram of the left ear, in any form in which an ear is accepted (a name such as
            ``"N3"``, thresholds, a dict), or ``None`` if it is unknown, as in some files. Models,
            losses and metrics need both ears.
        right: Audiogram of the right ear, in the same forms.

    Raises:
        ValueError: Both ears are ``None``, or one is not valid.

    Example:
        >>> from hlsim import Listener
        >>> Listener(left="N2", right=[20, 25, 30, 40, 50, 55, 60, 60]).left.pta
        31.25
    """

    left: Audiogram | None
    right: Audiogram | None

    if TYPE_CHECKING:

        def __init__(self, left: EarLike | None, right: EarLike | None) -> None: ...

    def __post_init__(self) -> None:
        for name, ear in self.ears().items():
            object.__setattr__(self, name, as_audiogram(ear))
        if not self.ears():
            raise ValueError("expected an audiogram of at least one ear of the listener, got none")

    def ears(self) -> dict[EarName, Audiogram]:
        """Return the audiograms that are not None, under the keys ``"left"`` and ``"right"``."""
        ears = zip(EARS, (self.left, self.right), strict=True)
        return {name: ear for name, ear in ears if ear is not None}

    def to(self, *args: Any, **kwargs: Any) -> Listener:
        """Return the listener itself, see ``Audiogram.to``."""
        return self

    def plot(self, axes: Any = None) -> Any:
        """Draw the audiograms of the known ears, the left one blue and the right one red.

        Args:
            axes: Matplotlib axes to draw on; by default new axes.

        Returns:
            The axes.

        Raises:
            MissingExtraError: matplotlib is not installed.
        """
        for name, ear in self.ears().items():
            axes = ear.plot(axes, ear=name)
        return axes

    @classmethod
    def from_clarity(cls, source: Any) -> Listener:
        """Convert a listener of pyclarity.

        Args:
            source: pyclarity's ``Listener``, or an entry of Clarity's ``listeners.json``.

        Raises:
            ValueError: An entry lacks an ear, no ear is found, or an ear is not valid.
        """
        if isinstance(source, Mapping):
            frequencies: Any = source.get("audiogram_cfs")
            levels: list[Any] = [source.get(f"audiogram_levels_{side}") for side in ("l", "r")]
            if frequencies is None or None in levels:
                names = ", ".join(map(str, source)) or "none"
                raise ValueError(
                    "expected an entry with audiogram_cfs, audiogram_levels_l and "
                    f"audiogram_levels_r, got {names}; add both ears"
                )
            return cls(*(Audiogram(ear_levels, frequencies) for ear_levels in levels))
        return cls(*(getattr(source, f"audiogram_{name}", None) for name in EARS))
