"""Blocks make up the signal, and each has around it what it needs."""

import pytest
import torch

from hlsim.dsp.overlap import overlapping


@pytest.mark.parametrize("samples", [1, 149, 151, 1000, 1049, 1051])
@pytest.mark.parametrize("unit", [1, 7])
def test_what_is_kept_is_the_signal(samples: int, unit: int) -> None:
    signal = torch.arange(samples).expand(2, -1)
    blocks = overlapping(samples, 100, 20.5, 30, unit)
    assert torch.equal(torch.cat([block.kept(block.given(signal)) for block in blocks], -1), signal)
    assert (len(blocks) == 1) == (samples <= 1.5 * (100 // unit * unit))
    for block in blocks:
        assert block.begin % unit == 0 and block.start % unit == 0
        assert block.start - block.begin >= 20.5 or block.begin == 0
        assert block.end - block.stop >= 30 or block.end == samples


def test_a_hop_of_nothing_is_one_block() -> None:
    assert overlapping(1000, 6, 1, 1, unit=7) == [(0, 0, 1000, 1000)]
