"""Blocks cover the signal, and each has the context that it needs."""

import pytest
import torch

from hlsim.dsp.overlap import split_into_blocks


@pytest.mark.parametrize("samples", [1, 149, 172, 1000, 1049, 1051])
@pytest.mark.parametrize("unit", [1, 7])
def test_outputs_of_all_blocks_make_up_the_signal(samples: int, unit: int) -> None:
    signal = torch.arange(samples).expand(2, -1)
    blocks = split_into_blocks(samples, 100, 20.5, 30, unit)
    outputs = [block.cut_output(block.cut_input(signal)) for block in blocks]
    assert torch.equal(torch.cat(outputs, -1), signal)
    assert (len(blocks) == 1) == (samples < 172)
    for block in blocks:
        length = block.input_stop - block.input_start
        assert len(split_into_blocks(length, 100, 20.5, 30, unit)) == 1
        assert block.input_start % unit == 0 and block.output_start % unit == 0
        assert block.output_start - block.input_start >= 20.5 or block.input_start == 0
        assert block.input_stop - block.output_stop >= 30 or block.input_stop == samples
