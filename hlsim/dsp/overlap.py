"""Long signals in overlapping blocks, so that memory does not grow with them."""

import math
from typing import NamedTuple

from torch import Tensor


class Block(NamedTuple):
    """Samples ``begin`` to ``end`` go in; of what comes out, ``start`` to ``stop`` are kept."""

    begin: int
    start: int
    stop: int
    end: int

    def given(self, signals: Tensor) -> Tensor:
        """Shape: (..., time) -> (..., end - begin)."""
        return signals[..., self.begin : self.end]

    def kept(self, output: Tensor) -> Tensor:
        """Shape: (..., end - begin or more) -> (..., stop - start); of the last block all that follows."""
        return output[
            ..., self.start - self.begin : None if self.stop == self.end else self.stop - self.begin
        ]


def overlapping(samples: int, hop: int, lead: float, lag: float, unit: int = 1) -> list[Block]:
    """Blocks that together make up a signal.

    Args:
        samples: of the signal; up to one and a half ``hop``, or with a ``hop`` of 0, it is one block.
        hop: samples from the start of one block to that of the next; the last has from half to one and a half of it.
        lead, lag: samples that a block needs before its start and behind its stop.
        unit: blocks begin and start at multiples of it: the hop is rounded down, lead and lag are rounded up.
    """
    hop = hop // unit * unit
    before, behind = (math.ceil(side / unit) * unit for side in (lead, lag))
    if hop == 0 or samples <= 1.5 * hop:
        return [Block(0, 0, samples, samples)]
    starts = list(range(0, samples - hop // 2, hop))
    stops = [*starts[1:], samples]
    return [
        Block(max(0, start - before), start, stop, min(samples, stop + behind))
        for start, stop in zip(starts, stops, strict=True)
    ]
