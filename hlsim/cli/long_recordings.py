"""Simulators and aids on recordings of any length: block by block, with one block in memory."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

from torch import Tensor, nn

from compensators import NALR
from compensators.filter_bank import HOP, RATE
from compensators.wearable import State, Wearable
from hlsim.audio import AudioInfo, read_parts
from hlsim.audiogram.listener import Listener
from hlsim.calibration import NEURO_RATE
from hlsim.dsp.overlap import Block, split_into_blocks
from hlsim.dsp.resample import ROLLOFF, ZERO_CROSSINGS
from hlsim.msbg import MSBG
from hlsim.msbg.model import HALF_RATE_HZ
from hlsim.msbg.overlapping_blocks import block_bounds
from hlsim.neuro.network import EarNetwork
from hlsim.simulators import Attenuation

_BLOCK_SECONDS = 8.0
"""Duration in seconds of the output of a block, and of the parts that ``read_all`` yields."""

_MARGIN_SECONDS = 0.01
"""Duration in seconds of one part of the context of a wearable aid's block, with two on each side.

It covers the kernels of resampling (4.3 ms) and the delay of an aid (4 ms).
"""


class Meter:
    """Mean square and peak of a signal, measured while its parts pass through ``measure``.

    Args:
        limit: Magnitude above which samples count in ``share_above``.

    Attributes:
        power: Mean square of all samples of all channels.
        peak: Largest magnitude of a sample.
        share_above: Share of the samples whose magnitude is above the limit, 0 to 1.

    They are final once all parts have passed. A meter measures one signal.

    >>> import torch
    >>> meter = Meter()
    >>> parts = list(meter.measure([torch.ones(1, 2), -torch.ones(1, 2)], 4, print))
    0.5
    1.0
    >>> meter.power, meter.peak
    (1.0, 1.0)
    """

    def __init__(self, limit: float = math.inf) -> None:
        self.limit = limit
        self.power = 0.0
        self.peak = 0.0
        self.share_above = 0.0

    def measure(
        self, parts: Iterable[Tensor], samples: int, show: Callable[[float], None]
    ) -> Iterator[Tensor]:
        """Yield all parts unchanged, and update the attributes.

        Args:
            parts: Parts of the signal, (channels, time).
            samples: Number of samples per channel of all parts together.
            show: Function that is called after each part with the share of the signal that has
                passed, 0 to 1.
        """
        passed = 0
        for part in parts:
            yield part
            passed += part.shape[-1]
            self.power += float(part.double().square().sum()) / (len(part) * samples)
            self.peak = max(self.peak, float(part.abs().max()))
            self.share_above += int((part.abs() > self.limit).sum()) / (len(part) * samples)
            show(passed / samples)


def process_recording(
    model: nn.Module, recording: AudioInfo, gain: float, ears: Any, **sliders: float
) -> Iterator[Tensor]:
    """Yield the output of a simulator or an aid for a recording, one part after the other.

    The parts together are the output for the whole recording: to 5e-4 of the peak for MSBG, where
    frames that smearing leaves nearly empty amplify rounding, otherwise to 2e-5. The memory does
    not depend on the length, except for directional aids, simulators of your own, and networks with
    layers other than convolutions or with ``level_aware=False``, which get the whole recording.

    Args:
        model: Simulator or aid at the sample rate of the recording.
        recording: Description of the file, from ``scan_audio``.
        gain: Factor by which the input is multiplied, and the output divided again.
        ears: Audiogram, or listener for a stereo recording, or for one with several microphones.
        sliders: Further arguments of an aid, each under its name.

    Yields:
        Consecutive parts at the scale of the file, (channels, time). An aid with
        ``takes_microphones`` returns one channel per ear.

    Raises:
        ValueError: The file cannot be read, or the model rejects the ears or the channels.
    """

    def read(blocks: Sequence[Block]) -> Iterable[Tensor]:
        bounds = [(block.input_start, block.input_stop) for block in blocks]
        return (part * gain for part in read_parts(recording, bounds))

    if isinstance(model, Wearable):
        outputs = _process_with_state(model, read, recording.samples, ears, sliders)
    else:
        blocks = divide_recording(model, recording.samples, recording.sample_rate)
        process: Callable[..., Tensor] = model
        if getattr(model, "takes_microphones", False):
            process = partial(_process_microphones, model)
        outputs = (
            block.cut_output(process(part, ears, **sliders))
            for block, part in zip(blocks, read(blocks), strict=True)
        )
    return (output / gain for output in outputs)


def _process_with_state(
    aid: Wearable,
    read: Callable[[Sequence[Block]], Iterable[Tensor]],
    samples: int,
    ears: Any,
    sliders: dict[str, float],
) -> Iterator[Tensor]:
    """Yield the output of a wearable aid, whose blocks continue with the state of those before.

    Args:
        aid: Hearing aid at the sample rate of the recording.
        read: Function from a list of blocks to an iterable of their inputs, (channels, time).
        samples: Length of the recording in samples.
        ears: Audiogram, or listener for a stereo recording.
        sliders: Value from 0 to 1 under each slider's name.

    Yields:
        Consecutive parts of the output, (channels, time).
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
    for block, part, start, next_start in zip(
        blocks, read(blocks), starts, [*starts[1:], None], strict=True
    ):
        output, state = aid.process_block(
            part,
            ears,
            sliders,
            state,
            lead=start - block.input_start,
            lag=margin if next_start else 0,
            state_time=(next_start - start) * RATE // (rate * HOP) * HOP if next_start else None,
        )
        yield output[..., block.output_start - start : block.output_stop - start]


def _process_microphones(aid: Any, part: Tensor, ears: Any, **sliders: float) -> Tensor:
    """Return the output of a model whose microphones are the channels of a recording.

    For an aid of two ears, the channels are left and right in turn, from front to rear; for an aid
    of one ear, they are the microphones of this ear, from front to rear.

    Shape: (channels, time) -> (ears, time).

    Raises:
        ValueError: The number of channels is not that of the aid's microphones, or an aid of one
            ear gets a listener.
    """
    if aid.ears == 1 and isinstance(ears, Listener):
        raise ValueError(
            "the aid has microphones at one ear, got a listener with two ears (--listener); pass "
            "the ear by --audiogram"
        )
    signals = part if aid.ears == 1 or len(part) % 2 else part.unflatten(0, (-1, 2))
    output: Tensor = aid(signals, ears, **sliders)
    return output.reshape(aid.ears, -1)


def read_all(recording: AudioInfo) -> Iterator[Tensor]:
    """Yield consecutive parts of a recording, (channels, time), of about 8 s each."""
    hop = round(_BLOCK_SECONDS * recording.sample_rate)
    blocks = split_into_blocks(recording.samples, hop, 0, 0)
    return read_parts(recording, [(block.input_start, block.input_stop) for block in blocks])


def divide_recording(model: nn.Module, samples: int, rate: int) -> list[Block]:
    """Divide a recording into overlapping blocks that a model can process one by one.

    Args:
        model: ``MSBG``, ``Attenuation``, ``NALR`` or a network of ``cnn`` blocks; for any other,
            the recording is one block.
        samples: Length of the recording in samples.
        rate: Sample rate in Hz.

    Returns:
        Blocks with bounds in samples, each with about 8 s of output (4 s for MSBG above 20 kHz).

    >>> [block.output_start for block in divide_recording(NALR(), 320000, 16000)]
    [0, 128000]
    """
    if isinstance(model, MSBG):
        # At high rates, MSBG works at 44.1 instead of 22.05 kHz, and takes twice the memory.
        return block_bounds(samples, rate, None if rate <= HALF_RATE_HZ else _BLOCK_SECONDS / 2)
    hop = round(_BLOCK_SECONDS * rate)
    if isinstance(model, NALR | Attenuation):
        return split_into_blocks(samples, hop, model.reach, model.reach)
    field = model.receptive_field if isinstance(model, EarNetwork) else None
    if field is None:
        return [Block(0, 0, samples, samples)]
    step, reach = field
    if rate == NEURO_RATE:
        return split_into_blocks(samples, hop, reach, reach, step)
    # Resampling to 16 kHz and back adds the reach of its kernel twice.
    reach += 2 * math.ceil(ZERO_CROSSINGS / ROLLOFF + 1)
    common = math.gcd(rate, NEURO_RATE)
    unit = math.lcm(step, NEURO_RATE // common) * rate // NEURO_RATE
    margin = reach * rate / NEURO_RATE
    return split_into_blocks(samples, hop, margin, margin, unit)
