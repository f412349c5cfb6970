"""A listener's two ears, read and written, and as whatever takes an audiogram takes them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hlsim.audiogram import Audiogram
from hlsim.audiogram.conversion import as_audiogram
from hlsim.audiogram.plot import draw_png
from hlsim.audiogram.table import numbered_audiograms

EARS = ("left", "right")


@dataclass(frozen=True)
class Listener:
    """Hearing thresholds of two ears, for waveforms (..., 2, time), left first.

    Whatever takes an audiogram takes a listener as its thresholds, (2, 8): ``simulator(waveform, listener)``,
    ``HearingLossLoss(listener)``, ``aid(waveform, listener)``, ``haspi(processed, clean, listener)``, which gives a score
    an ear, and the better ear's with ``.amax(-1)``. A sequence of listeners is one an item, (items, 2, 8).

    Args:
        left, right: None where nothing is known of an ear. Losses and ``hlsim.metrics.HASPI`` and ``HASQI`` leave it out;
            whatever else takes a listener refuses one without both.

    Raises:
        ValueError: There is no ear, or one is not valid; ``as_audiogram`` says what an ear may be.
    """

    left: Audiogram | None
    right: Audiogram | None

    def __post_init__(self) -> None:
        for name in EARS:
            ear = getattr(self, name)
            if ear is not None:
                object.__setattr__(self, name, as_audiogram(ear))
        if self.left is None and self.right is None:
            raise ValueError("a listener without ears; allowed: one Audiogram or two")

    def _repr_png_(self) -> bytes | None:
        """Return the drawn audiograms for a notebook, or ``None`` without matplotlib."""
        return draw_png(self.plot)

    def plot(self, axes: Any = None, **style: Any) -> Any:
        """Both ears as audiologists draw them, left with blue crosses, right with red circles; as ``Audiogram.plot``."""
        for name, look in zip(EARS, (("x", "tab:blue"), ("o", "tab:red")), strict=True):
            if (ear := getattr(self, name)) is not None:
                marked = dict(zip(("marker", "color"), look, strict=True)) | {
                    "fillstyle": "none",
                    "label": name,
                }
                axes = ear.plot(axes, **marked | style)
        axes.legend()
        return axes

    def to_dict(self) -> dict[str, Any]:
        """``from_dict``'s input, as JSON holds it."""
        ears = {name: getattr(self, name) for name in EARS}
        return {name: ear and ear.to_dict() for name, ear in ears.items()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Listener:
        """Raises ValueError unless it has ``left`` and ``right``, each an audiogram's ``to_dict`` or None."""
        if not isinstance(data, Mapping) or set(data) != set(EARS):
            raise ValueError(
                "no listener; allowed: left and right, each an audiogram's to_dict, or None"
            )
        return cls(
            *(None if data[name] is None else Audiogram.from_dict(data[name]) for name in EARS)
        )

    def to_rows(self, name: str) -> list[dict[str, str]]:
        """A row an ear of the CSV file that ``read_listeners`` takes, under this name of the listener."""
        ears = {ear: getattr(self, ear) for ear in EARS}
        return [{"listener": name, "ear": ear, **own.to_row()} for ear, own in ears.items() if own]

    @classmethod
    def from_clarity(cls, given: Any) -> Listener:
        """From pyclarity's ``Listener`` or an entry of Clarity's ``listeners.json``. Raises ValueError of all else."""
        return cls(*(Audiogram.from_clarity(given, ear) for ear in EARS))


def read_listeners(path: str | Path) -> dict[str, Listener]:
    """The listeners of a file by name: of Clarity's ``listeners.json``, or of a CSV file as ``read_audiograms`` takes.

    The CSV file has the columns ``listener`` and ``ear`` (left or right, l or r) too.

    Raises:
        ValueError: the file is missing or broken, an ear is neither left nor right, or given twice; the message names
            file, and line or listener.
    """
    if str(path).lower().endswith(".json"):
        try:
            entries = json.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, RecursionError, json.JSONDecodeError) as error:
            raise ValueError(f"{path}: cannot read listeners: {error}") from error
        if not isinstance(entries, Mapping) or not entries:
            raise ValueError(
                f"{path}: no listeners; allowed: an entry a listener, as in Clarity's listeners.json"
            )
        read = {}
        for name, entry in entries.items():
            try:
                read[name] = Listener.from_clarity(entry)
            except ValueError as error:
                raise ValueError(f"{path}, listener {name}: {error}") from error
        return read
    found: dict[str, dict[str, Audiogram]] = {}
    for number, row, audiogram in numbered_audiograms(path):
        name, given = row.get("listener", ""), row.get("ear", "").lower()
        ear = next((ear for ear in EARS if given and ear.startswith(given)), None)
        if not name or ear is None:
            raise ValueError(
                f"{path}, line {number}: listener {name!r}, ear {given!r}; allowed: a name, left or right"
            )
        if ear in found.setdefault(name, {}):
            raise ValueError(
                f"{path}, line {number}: the {ear} ear of {name} is there twice; allowed: once"
            )
        found[name][ear] = audiogram
    return {name: Listener(ears.get("left"), ears.get("right")) for name, ears in found.items()}
