"""Division of long signals into overlapping blocks, which bounds the memory for processing them.

Results near the ends of a block lack context and are discarded. The *input* of a block is the part
of the signal that is processed, and its *output* the shorter part of the result that is used.
"""

import math
from typing import NamedTuple

from torch import Tensor


class Block(NamedTuple):
    """Part of a signal that is processed at once, and the shorter part of the result that is used.

    Attributes:
        input_start: Index of the first sample that is processed.
        output_start: Index of the first sample of which the result is used.
        output_stop: Index after the last sample of which the result is used.
        input_stop: Index after the last sample that is processed.

    >>> import torch
    >>> block = Block(input_start=2, output_start=4, output_stop=6, input_stop=8)
    >>> signal = torch.arange(10)
    >>> block.cut_input(signal)
    tensor([2, 3, 4, 5, 6, 7])
    >>> block.cut_output(block.cut_input(signal))
    tensor([4, 5])
    """

    input_start: int
    output_start: int
    output_stop: int
    input_stop: int

    def cut_input(self, signals: Tensor) -> Tensor:
        """Cut the samples to process out of whole signals.

        Shape: (..., time) -> (..., input_stop - input_start).
        """
        return signals[..., self.input_start : self.input_stop]

    def cut_output(self, output: Tensor) -> Tensor:
        """Cut the part that is used out of the result for the samples from ``cut_input``.

        Nothing is cut off the end of a block without context after its output, such as the last
        one, whose result may be longer than its input.

        Shape: (..., time) -> (..., output_stop - output_start), or longer for such a block.
        """
        is_last = self.output_stop == self.input_stop
        stop = None if is_last else self.output_stop - self.input_start
        return output[..., self.output_start - self.input_start : stop]


def split_into_blocks(
    samples: int, hop: int, lead: float, lag: float, unit: int = 1
) -> list[Block]:
    """Divide a signal into overlapping blocks, whose outputs together are as long as the signal.

    A signal of up to one and a half hops and the lead is one block, and so is any signal if the hop
    is 0. The output of the last block covers half a hop to one and a half hops. So the input of a
    block is not divided again if it is passed as a signal, unless the lag is above half a hop.

    Args:
        samples: Length of the signal.
        hop: Samples from the start of one output to the start of the next.
        lead: Samples of context that the processing needs before an output.
        lag: Samples of context that the processing needs after an output.
        unit: Number of samples of which all inputs and outputs start at multiples. The hop is
            rounded down to a multiple of it, lead and lag are rounded up.

    >>> split_into_blocks(100, hop=50, lead=10, lag=5)[1]
    Block(input_start=40, output_start=50, output_stop=100, input_stop=100)
    """
    hop = hop // unit * unit
    lead_samples = math.ceil(lead / unit) * unit
    if hop == 0 or samples <= 1.5 * hop + lead_samples:
        return [Block(0, 0, samples, samples)]
    lag_samples = math.ceil(lag / unit) * unit
    starts = list(range(0, samples - hop // 2, hop))
    stops = [*starts[1:], samples]
    return [
        Block(max(0, start - lead_samples), start, stop, min(samples, stop + lag_samples))
        for start, stop in zip(starts, stops, strict=True)
    ]
