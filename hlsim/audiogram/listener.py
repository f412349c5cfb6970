"""The two ears of a listener."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hlsim.audiogram.value import Audiogram

EARS = ("left", "right")


@dataclass(frozen=True)
class Listener:
    """Hearing thresholds of two ears, for waveforms (..., 2, time) with the left ear first.

    A listener is accepted wherever an audiogram is, as thresholds of shape (2, 8):
    ``simulator(waveform, listener)``, ``HearingLossLoss(listener)``, ``aid(waveform, listener)``,
    ``haspi(processed, clean, listener)``. Scores have one value per ear; ``.amax(-1)`` gives that of
    the better ear. A sequence of listeners holds one per item, (items, 2, 8).

    Args:
        left: left ear, or None if it is not known. Losses and ``hlsim.metrics.HASPI`` and ``HASQI``
            leave an unknown ear out; everything else rejects a listener without both ears.
        right: right ear, or None.

    Raises:
        ValueError: both ears are None, or one is neither an ``Audiogram`` nor None.
    """

    left: Audiogram | None
    right: Audiogram | None

    def __post_init__(self) -> None:
        for name, ear in self._ears().items():
            if not isinstance(ear, Audiogram | None):
                raise ValueError(
                    f"expected the {name} ear to be an Audiogram or None, got {type(ear).__name__}"
                )
        if self.left is None and self.right is None:
            raise ValueError("expected an Audiogram for one ear at least, got None for both")

    def plot(self, axes: Any = None, **style: Any) -> Any:
        """Draw both ears as audiologists do: left with blue crosses, right with red circles.

        Args:
            axes: matplotlib axes; by default those of a new figure.
            style: properties of both lines.

        Returns: the axes.

        Raises:
            MissingExtraError: matplotlib is not installed.
        """
        looks = {
            "left": {"marker": "x", "color": "tab:blue"},
            "right": {"marker": "o", "color": "tab:red"},
        }
        for name, ear in self._ears().items():
            if ear is not None:
                look = {**looks[name], "fillstyle": "none", "label": name}
                axes = ear.plot(axes, **look | style)
        axes.legend()
        return axes

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary that JSON can hold."""
        return {name: ear and ear.to_dict() for name, ear in self._ears().items()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Listener:
        """Return the listener of a dictionary that ``to_dict`` made.

        Raises:
            ValueError: the value is not a mapping with ``left`` and ``right``.
        """
        if not isinstance(data, Mapping) or set(data) != set(EARS):
            raise ValueError(
                "expected a dictionary with 'left' and 'right', each the dictionary of an "
                f"audiogram or None, got {data!r}"
            )
        ears = {name: data[name] and Audiogram.from_dict(data[name]) for name in EARS}
        return cls(**ears)

    def to_rows(self, name: str) -> list[dict[str, str]]:
        """Return one row per ear for a CSV file that ``read_listeners`` reads.

        Args:
            name: name of the listener in the file.
        """
        rows = []
        for side, ear in self._ears().items():
            if ear is not None:
                rows.append({"listener": name, "ear": side, **ear.to_row()})
        return rows

    @classmethod
    def from_clarity(cls, source: Any) -> Listener:
        """Return the listener of pyclarity's ``Listener`` or of an entry of ``listeners.json``.

        Raises:
            ValueError: the source is neither.
        """
        return cls(Audiogram.from_clarity(source, "left"), Audiogram.from_clarity(source, "right"))

    def _ears(self) -> dict[str, Audiogram | None]:
        return {"left": self.left, "right": self.right}
