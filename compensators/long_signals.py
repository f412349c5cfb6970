"""Wearable hearing aids on signals that are too long for the memory: block by block.

Each block continues with the state in which the block before has left the aid.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence

from torch import Tensor

from compensators.filter_bank import HOP, RATE
from compensators.wearable import Slider, State, Wearable
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.dsp.overlap import Block, split_into_blocks

_BLOCK_SECONDS = 10.0
"""Duration in seconds of the output of one block."""

_MARGIN_SECONDS = 0.01
"""Duration in seconds of one part of the context of a block, which has two on each side.

It covers the kernels of resampling (4.3 ms) and the delay of an aid (4 ms).
"""


def process_blocks(
    aid: Wearable,
    read: Callable[[Sequence[Block]], Iterable[Tensor]],
    samples: int,
    audiogram: AudiogramLike,
    **sliders: Slider,
) -> Iterator[Tensor]:
    """Yield the time-aligned output of an aid for a long signal, one part after the other.

    The parts together are the output for the whole signal, to about 1e-6 of its peak. The memory
    does not depend on the length of the signal.

    Args:
        aid: Hearing aid at the sample rate of the signal.
        read: Function from a list of blocks to an iterable of their inputs, tensors with shape
            (..., time). See ``Block.cut_input`` for the samples of a block.
        samples: Length of the signal in samples.
        audiogram: One ear for all signals, or ears whose shape (..., 8) broadcasts over the leading
            dimensions of the signal.
        sliders: Value from 0 to 1 under each slider's name; by default those of ``SLIDERS``.

    Yields:
        Parts of the output, (..., time), of about 10 s, the last one of 5 to 15 s. A signal of up
        to 15 s is one part.

    Raises:
        ValueError: The signal, the audiogram or a slider is not valid.

    >>> from compensators import WDRC
    >>> import torch
    >>> speech = torch.randn(2, 400000)  # 25 s
    >>> read = lambda blocks: (block.cut_input(speech) for block in blocks)
    >>> [part.shape for part in process_blocks(WDRC(), read, 400000, "N3")]
    [torch.Size([2, 160000]), torch.Size([2, 240000])]
    """
    rate = aid.sample_rate
    # the smallest number of samples that lasts a whole number of hops and of samples at 16 kHz
    unit = math.lcm(HOP, RATE // math.gcd(rate, RATE)) * rate // RATE
    margin = math.ceil(_MARGIN_SECONDS * rate / unit) * unit
    blocks = split_into_blocks(samples, round(_BLOCK_SECONDS * rate), 2 * margin, 2 * margin, unit)
    state: State | None = None
    # Where a block is cut, resampling lacks context. The aid starts one margin later, with the
    # state that the block before had reached there.
    starts = [0, *(block.input_start + margin for block in blocks[1:])]
    for block, waveform, start, next_start in zip(
        blocks, read(blocks), starts, [*starts[1:], None], strict=True
    ):
        output, state = aid.process_block(
            waveform,
            audiogram,
            sliders,
            state,
            lead=start - block.input_start,
            lag=margin if next_start else 0,
            state_time=(next_start - start) * RATE // (rate * HOP) * HOP if next_start else None,
        )
        yield output[..., block.output_start - start : block.output_stop - start]
