"""Echoes in a rectangular room, found by pyroomacoustics as image sources."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hlsim.checks import check_number
from hlsim.dsp.sphere import HEAD_RADIUS, SPEED_OF_SOUND, unit_vectors
from hlsim.extras import require

REVERBERATION_TIMES = (0.2, 1.5)
"""Shortest and longest reverberation time of rooms in s.

A large room does not reach shorter ones. The number of echoes grows with the third power of the
time.
"""


@dataclass(frozen=True)
class Room:
    """Rectangular room with a listener, who faces along its length.

    All walls, the floor and the ceiling absorb the same share of the sound at all frequencies. The
    sound of a room of 6 x 5 x 2.7 m decays as fast as Sabine's equation predicts for 0.2 and 0.3 s,
    and in 0.6 and 1.0 s for 0.5 and 0.8 s, because echoes between parallel walls last.

    Attributes:
        size: Length, width and height in m, 2 to 30.
        reverberation_time: Time in s in which sound decays by 60 dB, by Sabine's equation, 0.2 to
            1.5. Later echoes are left out. A source takes about a second to compute for 0.5 s, and
            up to half a minute for 1.5 s.
        head: Position of the centre of the head in m, on the axes of ``size``: from the wall behind
            the listener, from the wall on the right, and above the floor; 0.0875 m, the radius of
            the head, or more from each surface.
        distance: Distance of all talkers and maskers from the centre of the head in m, 0.175 to 30.

    Raises:
        ValueError: There are not three numbers for size or head, or a number is out of range.

    >>> Room(reverberation_time=0.5).size
    (6.0, 5.0, 2.7)
    """

    size: tuple[float, float, float] = (6.0, 5.0, 2.7)
    reverberation_time: float = 0.3
    head: tuple[float, float, float] = (2.5, 2.2, 1.2)
    distance: float = 1.0

    def __post_init__(self) -> None:
        for name in ("size", "head"):
            values = getattr(self, name)
            if not isinstance(values, Sequence | np.ndarray) or len(values) != 3:
                raise ValueError(
                    f"expected three numbers for {name}, got {values!r}; write (6.0, 5.0, 2.7)"
                )
        for side in self.size:
            check_number("a side of the room", side, 2.0, 30.0)
        for side, place in zip(self.size, self.head, strict=True):
            check_number("the position of the head", place, HEAD_RADIUS, side - HEAD_RADIUS)
        for name in ("size", "head"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        check_number("reverberation_time", self.reverberation_time, *REVERBERATION_TIMES)
        check_number("distance", self.distance, 2.0 * HEAD_RADIUS, 30.0)


class Arrivals(NamedTuple):
    """Direct sound of a source, and its echoes, as plane waves at the centre of the head.

    Attributes:
        delays: Delays in s after the direct sound, (arrivals,).
        amplitudes: Amplitudes relative to that of the direct sound, (arrivals,).
        directions: Unit vectors (front, left, up) from which they come, (arrivals, 3).

    >>> Arrivals._fields
    ('delays', 'amplitudes', 'directions')
    """

    delays: NDArray[np.float64]
    amplitudes: NDArray[np.float64]
    directions: NDArray[np.float64]


def find_arrivals(room: Room, azimuth: float) -> Arrivals:
    """Find the direct sound and the echoes of a source in a room, by image sources.

    Args:
        room: Room with the listener.
        azimuth: Azimuth of the source in degrees, -360 to 360, 0 in front, 90 on the left.

    Returns:
        The direct sound and the echoes within the reverberation time, in no order. The weakest
        echoes, of high orders, are missing; they have less than a millionth of the energy.

    Raises:
        MissingExtraError: pyroomacoustics is not installed.
        ValueError: The azimuth is out of range, the source is outside the room, or the walls cannot
            absorb as much sound as the reverberation time requires.

    >>> arrivals = find_arrivals(Room(), 0.0)
    >>> arrivals.directions[arrivals.delays.argmin()].round(3) + 0.0
    array([1., 0., 0.])
    """
    check_number("azimuth", azimuth, -360.0, 360.0)
    acoustics: Any = require("pyroomacoustics", extra="scenes")
    head = np.array(room.head)
    source = head + room.distance * unit_vectors(azimuth)
    if not np.all((source > 0.0) & (source < room.size)):
        raise ValueError(
            f"expected a source inside the room of {room.size} m, got one at {source.round(2)} m "
            f"(azimuth {azimuth:g} degrees); choose a shorter distance or another place of the head"
        )
    try:
        absorption, order = acoustics.inverse_sabine(room.reverberation_time, room.size)
    except ValueError as error:
        raise ValueError(
            f"walls that absorb all sound have a longer reverberation time than "
            f"{room.reverberation_time:g} s in a room of {room.size} m; choose a longer time or a "
            "smaller room"
        ) from error
    box = acoustics.ShoeBox(room.size, materials=acoustics.Material(absorption), max_order=order)
    box.add_source(source).add_microphone(head)
    box.image_source_model()
    images = box.sources[0]
    vectors = images.images.T - head
    distances = np.linalg.norm(vectors, axis=-1)
    delays = (distances - room.distance) / SPEED_OF_SOUND
    amplitudes = images.damping[0] * room.distance / distances
    in_time = delays <= room.reverberation_time
    return Arrivals(
        delays[in_time], amplitudes[in_time], vectors[in_time] / distances[in_time, None]
    )


def draw_room(longest: float, generator: torch.Generator) -> Room:
    """Draw a random room in which every source is at least 0.2 m from the walls.

    Args:
        longest: Longest reverberation time in s; the shortest one is 0.2.
        generator: Source of the random numbers.

    Returns:
        Room of 4 x 3.5 x 2.4 m to 8 x 6 x 3 m; sources are 0.7 to 1.3 m away from the head.

    >>> 0.2 <= draw_room(0.5, torch.Generator().manual_seed(0)).reverberation_time <= 0.5
    True
    """

    def draw(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    length, width, height = draw(4.0, 8.0), draw(3.5, 6.0), draw(2.4, 3.0)
    distance = draw(0.7, 1.3)
    margin = distance + 0.2
    return Room(
        (length, width, height),
        draw(REVERBERATION_TIMES[0], longest),
        (draw(margin, length - margin), draw(margin, width - margin), draw(1.1, 1.7)),
        distance,
    )
