"""Processing of long signals in overlapping blocks of about 8 s, which bounds the memory.

Gradients of long signals use gradient checkpointing: each block is computed again in the backward
pass, and its activations are not stored (except inside transforms such as ``torch.func.grad``).
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from hlsim.dsp.overlap import Block, split_into_blocks
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import HALF_RATE_STEP, STEP
from hlsim.msbg.smearing import HOP
from hlsim.torchtools import checkpointed

_BLOCK_SECONDS = 8.0
"""Approximate duration of the output of a block."""

# The output of a block depends on samples around it by the filters, the delay, and the low-pass
# filters down to 1e-6.
_LEAD_SECONDS = 0.75
"""Duration before a block on which its output depends."""

_LAG_SECONDS = 0.55
"""Duration after a block on which its output depends."""


def in_blocks(
    process: Callable[[Tensor, Tensor, bool], Tensor],
    signals: Tensor,
    ears: Tensor,
    rate: int,
    *,
    checkpoints_short: bool = False,
) -> Tensor:
    """Apply a function to overlapping blocks of long signals, and join its outputs.

    The overlap, 0.75 s before and 0.55 s after each block, covers the memory of MSBG, so the joined
    output equals that for the whole signal to about 1e-6. If a gradient is needed, blocks of long
    signals use gradient checkpointing, except inside transforms such as ``torch.func.grad``.

    Args:
        process: Function of the signals of a block, of the ears, and of whether the signals end
            with this block. It returns the output of the block.
        signals: Signals of all items.
        ears: Thresholds of all items in dB HL.
        rate: Sample rate in Hz.
        checkpoints_short: Whether to use gradient checkpointing even for signals that fit in one
            block.

    Shape: (items, time), (items, levels) -> (items, time), or longer if ``process`` returns more
        samples for the last block, as MSBG does with ``aligned=False``.

    >>> speech, ear = torch.randn(1, 320000), torch.zeros(1, 8)  # 20 s
    >>> output = in_blocks(lambda signals, ears, is_last: 0.5 * signals, speech, ear, rate=16000)
    >>> torch.equal(output, 0.5 * speech)
    True
    """
    samples = signals.shape[-1]
    blocks = block_bounds(samples, rate)
    is_differentiated = torch.is_grad_enabled() and (signals.requires_grad or ears.requires_grad)
    if is_differentiated and (checkpoints_short or len(blocks) > 1) and _hooks_are_allowed():
        process = checkpointed(process)
    if len(blocks) == 1:
        return process(signals, ears, True)
    outputs = []
    for block in blocks:
        is_last = block.input_stop == samples
        outputs.append(block.cut_output(process(block.cut_input(signals), ears, is_last)))
    return torch.cat(outputs, -1)


def block_bounds(samples: int, rate: int, seconds: float | None = None) -> list[Block]:
    """Divide the samples of a signal into overlapping blocks.

    Each block contributes about ``seconds`` to the output, and the last one half to one and a half
    times as much. The exact duration is a multiple of 16 s / gcd(rate, 75), and at least once this
    value, which is 0.64 s at 16 kHz and 16 s at 16384 Hz. Inside the signal, the input of a block
    begins at least 0.75 s earlier than its output and ends at least 0.55 s later, because MSBG's
    filters make the output depend on these margins; the result for the margins is discarded. A
    signal of up to one and a half blocks and the first margin is not divided. Each block begins
    where the frames of smearing and the steps of envelopes lie at the same samples as in the whole
    signal.

    Args:
        samples: Length of the signal in samples.
        rate: Sample rate in Hz.
        seconds: Approximate duration of the output of a block, by default 8 s.

    Returns:
        Bounds of the input and the output of each block, as indices of half-open ranges.

    >>> [(block.input_start, block.input_stop) for block in block_bounds(320000, rate=16000)]
    [(0, 133120), (102400, 256000), (225280, 320000)]
    """
    common = math.lcm(HOP, STEP, round(2 * HALF_RATE_STEP))
    # the smallest number of samples that is a whole number of hops and of steps
    unit = common * rate // math.gcd(common * rate, MSBG_RATE)
    hop = max(unit, round((seconds or _BLOCK_SECONDS) * rate))
    return split_into_blocks(samples, hop, _LEAD_SECONDS * rate, _LAG_SECONDS * rate, unit)


def _hooks_are_allowed() -> bool:
    """Return whether autograd accepts the hooks of gradient checkpointing.

    Inside transforms such as ``torch.func.grad``, it does not.
    """
    try:
        with torch.autograd.graph.saved_tensors_hooks(torch.clone, torch.clone):
            return True
    except RuntimeError:
        return False
