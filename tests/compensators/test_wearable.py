"""Both wearable aids: look-ahead, streams, blocks, other rates, recovery and linked ears."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim import Audiogram, Listener
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.resample import resample
from hlsim.metrics.interaural import interaural_change
from tests.compensators.aids import (
    EAR,
    WEARABLES,
    assert_close,
    build_wearable,
    tone,
    varied_hearing_aid,
)

both_aids = pytest.mark.parametrize("name", WEARABLES)


@pytest.fixture
def noise() -> Tensor:
    """Noise whose level changes between 20 and 90 dB SPL. Shape: (2, 12345) at 16 kHz."""
    levels = torch.tensor([20.0, 70.0, 50.0, 90.0, 60.0]).repeat_interleave(2469)
    return torch.randn(2, 12345) * 10.0 ** ((levels - 94.0) / 20.0)


@both_aids
@pytest.mark.parametrize(("rate", "latency", "rounding"), [(16000, 64, 0.0), (44100, 552, 1e-9)])
def test_the_look_ahead_is_the_latency(
    name: str, noise: Tensor, rate: int, latency: int, rounding: float
) -> None:
    aid, signal = build_wearable(name, sample_rate=rate), noise[0, 2000:6000]
    output = aid(signal, EAR)
    for place in torch.linspace(100, 3900, 24).long().tolist():
        other = torch.cat((signal[:place], 0.3 * torch.randn(len(signal) - place)))
        is_changed = (aid(other, EAR) - output).abs() > rounding
        assert 0 < place - int(is_changed.nonzero()[0]) <= latency


@both_aids
@pytest.mark.parametrize("sizes", [[1], [7], [64], [1000], [299, 3, 64, 130, 1, 77]])
def test_chunks_of_any_size_equal_the_whole_signal(
    name: str, noise: Tensor, sizes: list[int]
) -> None:
    aid: Any = build_wearable(name)
    ears = torch.tensor([EAR.thresholds, Audiogram.standard("S2").thresholds])
    signal = noise[:, : 300 * max(sizes)]
    stream = aid.stream(ears)
    outputs, place = [], 0
    while place < signal.shape[-1]:
        chunk = signal[:, place : place + sizes[len(outputs) % len(sizes)]]
        outputs.append(stream(chunk))
        assert outputs[-1].shape == chunk.shape
        place += chunk.shape[-1]
        if len(outputs) == 1:
            for bad_chunk in (torch.full((2, 10), torch.nan), noise[:, :0], torch.randn(3, 100)):
                with pytest.raises(ValueError):
                    stream(bad_chunk)  # which changes nothing
    whole = aid(signal, ears)
    assert_close(torch.cat([*outputs, stream.flush()], -1)[:, aid.latency :], whole)
    assert_close(stream(signal)[:, 64:], whole[:, :-64])  # flush begins again


def test_a_rejected_first_chunk_leaves_the_stream_as_it_was(noise: Tensor) -> None:
    stream = varied_hearing_aid().stream(EAR, noise_reduction=2.0)
    with pytest.raises(ValueError, match="noise_reduction"):
        stream(noise)
    stream.set(noise_reduction=0.5)
    assert stream.flush().shape == (64,)


@both_aids
def test_a_stream_uses_the_ear_of_the_aid(name: str, noise: Tensor) -> None:
    aid = build_wearable(name, audiogram=EAR)
    assert torch.equal(aid.stream()(noise), aid.stream(EAR)(noise))
    with pytest.raises(ValueError, match="expected an audiogram"):
        build_wearable(name).stream()


@both_aids
def test_a_stream_of_arrays_returns_arrays(name: str, noise: Tensor) -> None:
    """An audio library hands over arrays, which may be read-only and not contiguous."""
    aid = build_wearable(name)
    chunks = noise[:, :1000].T.numpy().T
    chunks.setflags(write=False)
    stream, of_arrays = aid.stream(EAR), aid.stream(EAR)
    for start in (0, 300):
        output = of_arrays(chunks[:, start : start + 300])
        assert isinstance(output, np.ndarray) and output.dtype == np.float32
        assert torch.equal(torch.from_numpy(output), stream(noise[:, start : start + 300]))
    with pytest.raises(ValueError, match="expected a tensor or an array of floating-point samples"):
        of_arrays(np.zeros((2, 64), np.int16))


@both_aids
def test_blocks_of_a_long_signal_equal_the_whole(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    aid, signal = build_wearable(name), 0.03 * torch.randn(1, 9000)
    whole = aid(signal, EAR)
    monkeypatch.setattr("compensators.wearable.BLOCK_SAMPLES", 1000)
    assert_close(aid(signal, EAR), whole)


@both_aids
@pytest.mark.parametrize("rate", [44100, 48000])
def test_sound_above_8_khz_gets_the_gain_of_the_highest_band(name: str, rate: int) -> None:
    aid: Any = build_wearable(name, sample_rate=rate)
    with pytest.raises(ValueError):
        aid.stream(EAR)
    low, high = tone(1000.0, 65.0, rate=rate), tone(12000.0, 50.0, rate=rate)
    outputs = [aid(signal, EAR) for signal in (low, low + high)]
    at_16_khz = build_wearable(name)
    low_at_16_khz = resample(low, rate, 16000)
    expected = resample(at_16_khz(low_at_16_khz, EAR), 16000, rate)
    middle = slice(rate // 4, -rate // 4)
    assert level_spl((outputs[0] - expected)[middle]) < level_spl(expected[middle]) - 60.0
    batch, fitted = at_16_khz.prepare(low, EAR)
    settings = at_16_khz.stack_sliders({}, batch, fitted)
    hops = low_at_16_khz[: 240 * 64].reshape(1, -1)
    _, gains, _ = at_16_khz.process_hops(hops, fitted, settings, at_16_khz.initial_state(settings))
    gain_db = float(20.0 * torch.log10(1.0 + gains[0, -1]))
    added = (outputs[1] - outputs[0])[middle]
    assert float(level_spl(added) - 50.0) == pytest.approx(gain_db, abs=0.1)


@pytest.mark.parametrize("rate", [17000, 44100])
def test_sliders_at_0_return_all_frequencies(rate: int) -> None:
    signal = set_level(torch.randn(2, rate + 37), 65.0)
    aid = varied_hearing_aid(sample_rate=rate)
    assert_close(aid(signal, EAR, noise_reduction=0.0, amplification=0.0), signal, 1e-6)


@both_aids
@pytest.mark.parametrize(
    "sound", [set_level(tone(1000.0, 65.0, 0.05).sign(), 115.0), torch.tensor([20.0])], ids=len
)
def test_the_gain_recovers_from_a_loud_sound_within_300_ms(name: str, sound: Tensor) -> None:
    steady = set_level(torch.randn(24000), 60.0)
    struck = steady.clone()
    struck[8000 : 8000 + len(sound)] = sound
    aid, end = build_wearable(name), 8000 + len(sound) + 4800
    levels = [level_spl(aid(signal, EAR)[end : end + 1600]) for signal in (steady, struck)]
    assert (levels[0] - levels[1]).abs() < 3.0


@both_aids
def test_linked_gains_keep_the_level_difference_between_the_ears(name: str, noise: Tensor) -> None:
    scene = torch.stack((0.06 * noise[0], 0.02 * noise[0]))  # below the limit of the output
    alone, linked = build_wearable(name), build_wearable(name, linked=True)
    pair, unlike = Listener(EAR, EAR), Listener(EAR, Audiogram.standard("N4"))

    changes = [interaural_change(scene, aid(scene, pair)).level.abs() for aid in (linked, alone)]
    assert bool((changes[0] < 0.1).all()) and not bool((changes[1] < 0.1).all())
    equal = scene[:1].expand(2, -1)  # the mean power of equal signals is that of each
    torch.testing.assert_close(linked(equal, unlike), alone(equal, unlike))
    outputs = linked(torch.stack((scene, equal)), [pair, unlike])
    torch.testing.assert_close(outputs[1], linked(equal, unlike), atol=1e-5, rtol=0.0)
    stream = linked.stream(pair)
    output = torch.cat((stream(scene[:, :4001]), stream(scene[:, 4001:]), stream.flush()), -1)
    torch.testing.assert_close(output[:, linked.latency :], outputs[0], atol=1e-5, rtol=0.0)
    with pytest.raises(ValueError):
        linked(noise[0], EAR)


@both_aids
def test_a_compiled_program_runs_the_aid_eagerly(name: str) -> None:
    # Tracing would unroll the loops over hops.
    graphs = []

    def count(graph: torch.fx.GraphModule, inputs: list[Tensor]) -> Callable[..., Any]:
        graphs.append(graph)
        return graph.forward

    aid, signal = build_wearable(name), 0.02 * torch.randn(1, 4000)
    torch.testing.assert_close(torch.compile(aid, backend=count)(signal, EAR), aid(signal, EAR))
    assert not graphs
