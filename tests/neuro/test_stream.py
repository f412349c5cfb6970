"""A simulator in blocks returns, later, what it returns for the whole signal."""

import numpy as np
import pytest
import torch

from hlsim import load_pretrained
from hlsim.neuro.stream import SimulatedStream
from tests.compensators.aids import EAR


def test_simulated_blocks_equal_the_whole_signal() -> None:
    simulator = load_pretrained("neuro-msbg")
    stream, signal = SimulatedStream(simulator, EAR), 0.03 * torch.randn(24 * 1024)
    assert (stream.latency, stream.block) == (3504, 48)
    perceived = torch.cat([stream(chunk) for chunk in signal.split(1536)])
    whole = simulator(signal, EAR)
    middle = slice(stream.latency, -2 * stream.latency)  # the stream begins with silence
    difference = perceived[stream.latency :][middle] - whole[: -stream.latency][middle]
    assert difference.abs().max() < 1e-4 * whole.abs().max()
    with pytest.raises(ValueError, match="finite receptive field"):
        SimulatedStream(load_pretrained("neuro-msbg-lstm"), EAR)


def test_chunks_are_waveforms_of_one_shape_or_arrays() -> None:
    stream = SimulatedStream(load_pretrained("neuro-msbg"), EAR)
    chunk = 0.03 * torch.ones(48, dtype=torch.float64)
    perceived = stream(chunk.numpy())
    assert isinstance(perceived, np.ndarray) and perceived.dtype == np.float64
    with pytest.raises(ValueError, match=r"shape \('time',\) as before, got \(2, 48\)"):
        stream(torch.zeros(2, 48))
    with pytest.raises(ValueError, match="divide 16-bit samples by 32768"):
        stream(torch.zeros(48, dtype=torch.int16))
