"""Long signals through MSBG in overlapping blocks, computed again for gradients, so that memory does not grow."""

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from hlsim.dsp.overlap import Block, split_into_blocks
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import HALF_RATE_STEP, STEP
from hlsim.msbg.smearing import HOP

_BLOCK_SECONDS = 8.0
# what a block needs around it: filters, delay, and low-passes down to 1e-6
_LEAD_SECONDS, _LAG_SECONDS, _FADE_SECONDS = 0.75, 0.55, 0.2


def in_blocks(
    process: Callable[[Tensor, Tensor, bool], Tensor], signals: Tensor, ears: Tensor, rate: int
) -> Tensor:
    """``process`` of signals, ears and whether the signals end there, by blocks.

    Shape: (items, time), (items, 8) -> (items, time).
    """
    samples = signals.shape[-1]
    blocks = block_bounds(samples, rate)
    if len(blocks) == 1:
        return process(signals, ears, True)
    heard = []
    again = torch.is_grad_enabled() and _hooks_are_allowed()
    for block in blocks:
        last = block.input_stop == samples
        given = _faded(block.cut_input(signals), rate, block.input_start > 0, not last)
        if again and (given.requires_grad or ears.requires_grad):
            output = checkpoint(process, given, ears, last, use_reentrant=False)
        else:
            output = process(given, ears, last)
        heard.append(block.cut_output(output))
    return torch.cat(heard, -1)


def _hooks_are_allowed() -> bool:
    """Whether autograd takes the hooks by which checkpointing computes a block again; ``torch.func`` forbids them."""
    try:
        with torch.autograd.graph.saved_tensors_hooks(_identity, _identity):
            return True
    except RuntimeError:
        return False


def _identity(tensor: Tensor) -> Tensor:
    return tensor


def block_bounds(samples: int, rate: int) -> list[Block]:
    """Blocks begin where the smearing's frames and the envelopes' steps do, so that these are those of the whole."""
    common = math.lcm(HOP, STEP, round(2 * HALF_RATE_STEP))
    unit = (
        common * rate // math.gcd(common * rate, MSBG_RATE)
    )  # samples in a whole number of hops and of steps
    return split_into_blocks(
        samples, round(_BLOCK_SECONDS * rate), _LEAD_SECONDS * rate, _LAG_SECONDS * rate, unit
    )


def _faded(block: Tensor, rate: int, begin: bool, end: bool) -> Tensor:
    """A block's lead faded in and its lag out over 0.2 s: a sharp cut would ring wherever a band ends sharply.

    Shape: (items, time) -> (items, time).
    """
    time = round(_FADE_SECONDS * rate)
    place = torch.arange(1, time + 1, dtype=torch.float64, device=block.device) * (
        math.pi / (time + 1)
    )
    ramp = (0.5 - 0.5 * place.cos()).to(block.dtype)
    ones = block.new_ones(block.shape[-1] - 2 * time)
    edge = ramp.new_ones(time)
    return block * torch.cat((ramp if begin else edge, ones, ramp.flip(-1) if end else edge))
