"""What both wearable aids must do: 5 ms, chunks as the whole, batches as items, limits, and silence."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from compensators import WDRC, HearingAid
from compensators.wearable import Wearable
from hlsim import Audiogram, Listener
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.resample import resample
from hlsim.metrics.interaural import interaural_change
from hlsim.training.ears import draw_thresholds

EAR = Audiogram.standard("N3")
FIVE_MS = 80


def trained(**options: Any) -> HearingAid:
    """An aid whose gains move: the heads' weights are not small."""
    torch.manual_seed(5)
    aid = HearingAid(**options)
    for last in (aid.leave, aid.correct[-1]):
        torch.nn.init.normal_(last.weight, std=0.05)
    return aid.eval().requires_grad_(False)


AIDS = pytest.mark.parametrize("make", [trained, WDRC], ids=["aid", "wdrc"])
Make = Callable[..., Wearable]


@pytest.fixture
def noise() -> torch.Tensor:
    """Steps of level from 20 to 90 dB SPL. Shape: (2, 12345) at 16 kHz."""
    steps = torch.tensor([20.0, 70.0, 50.0, 90.0, 60.0]).repeat_interleave(2469)
    return torch.randn(2, 12345) * 10.0 ** ((steps - 94.0) / 20.0)


@AIDS
@pytest.mark.parametrize(("rate", "most", "rounding"), [(16000, FIVE_MS, 0.0), (44100, 553, 1e-9)])
def test_looks_as_far_ahead_as_it_says(
    make: Make, noise: torch.Tensor, rate: int, most: int, rounding: float
) -> None:
    aid, signal = make(sample_rate=rate), noise[0, 2000:6000]
    before, nearest = aid(signal, EAR), []
    for place in (
        torch.linspace(100, 3900, 60).long().tolist()
    ):  # one by one, for a batch rounds in its own way
        moved = torch.cat((signal[:place], 0.3 * torch.randn(len(signal) - place)))
        nearest.append(place - int(((aid(moved, EAR) - before).abs() > rounding).nonzero()[0]))
    assert max(nearest) <= aid.latency < most and min(nearest) > 0


@AIDS
@pytest.mark.parametrize("sizes", [[1], [7], [64], [1000], None])
def test_chunks_give_what_the_whole_gives(
    make: Make, noise: torch.Tensor, sizes: list[int] | None
) -> None:
    aid: Any = make()
    ears = torch.tensor([EAR.thresholds, Audiogram.standard("S2").thresholds])
    signal = noise[:, :1500] if sizes == [1] else noise
    sizes = sizes or torch.randint(1, 300, (20,)).tolist()
    stream, outputs, place = aid.stream(ears), [], 0
    while place < signal.shape[-1]:
        chunk = signal[:, place : place + sizes[len(outputs) % len(sizes)]]
        outputs.append(stream(chunk))
        assert outputs[-1].shape == chunk.shape
        place += chunk.shape[-1]
    found = torch.cat([*outputs, stream.flush()], -1)[:, aid.latency :]
    whole = aid(signal, ears)
    assert (found - whole).abs().max() < 1e-5 * whole.abs().max()
    # and then begins anew
    assert (stream(signal)[:, 64:] - whole[:, :-64]).abs().max() < 1e-5 * whole.abs().max()


@AIDS
def test_a_batch_is_its_items(make: Make, noise: torch.Tensor) -> None:
    aid, ears = make(), draw_thresholds(3)
    signals = noise[0, :6000] * torch.tensor([[0.1], [1.0], [3.0]])
    together = aid(signals, ears)
    for item in range(3):
        alone = aid(signals[item], ears[item])
        assert (
            alone.shape == (6000,)
            and (together[item] - alone).abs().max() < 1e-5 * alone.abs().max()
        )
    assert torch.equal(aid(signals.unsqueeze(1), ears.unsqueeze(1)), together.unsqueeze(1))
    assert aid(signals[0], ears).shape == (3, 6000)


@AIDS
def test_blocks_of_a_long_signal_are_the_whole(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    aid, signal = make(), 0.03 * torch.randn(1, 9000)
    whole = aid(signal, EAR)
    monkeypatch.setattr("compensators.wearable.BLOCK_SAMPLES", 1000)
    assert (aid(signal, EAR) - whole).abs().max() < 1e-5 * whole.abs().max()


@AIDS
def test_level_and_precision_of_the_caller(make: Make, noise: torch.Tensor) -> None:
    aid, signal = make(), noise[:1, :5000]
    whole = aid(signal, EAR)
    quieter = make(full_scale_spl=114.0)
    assert (quieter(signal / 10.0, EAR) * 10.0 - whole).abs().max() < 1e-5 * whole.abs().max()
    assert aid(signal.half(), EAR).dtype == torch.float16
    exact = make().double()(signal.double(), EAR)
    assert (exact - whole).abs().max() < 1e-4 * whole.abs().max()


def tone(hz: float, spl: float, rate: int) -> torch.Tensor:
    """A second of it."""
    wave = torch.sin(2.0 * torch.pi * hz * torch.arange(rate, dtype=torch.float64) / rate)
    return set_level(wave, spl).float()


@AIDS
@pytest.mark.parametrize("rate", [44100, 48000])
def test_what_lies_above_8_khz_gets_the_gain_of_the_highest_band(make: Make, rate: int) -> None:
    aid, low, high = make(sample_rate=rate), tone(1000.0, 65.0, rate), tone(12000.0, 50.0, rate)
    alone, both = (aid(signal, EAR) for signal in (low, low + high))
    slow = make()
    expected = resample(slow(resample(low, rate, 16000), EAR), 16000, rate)
    middle = slice(rate // 4, -rate // 4)
    assert level_spl((alone - expected)[middle]) < level_spl(expected[middle]) - 60.0
    added = (both - alone)[middle]
    _, fitted, sliders = slow.prepare(low, EAR, slow.DEFAULT_SLIDERS)
    hops = resample(low, rate, 16000)[: 240 * 64].reshape(1, -1)
    gain = slow.advance(hops, fitted, sliders, slow.initial(sliders))["gains"][0, -1, -1]
    assert float(gain) > 1.0
    found = level_spl(added) - 50.0
    assert found == pytest.approx(float(20.0 * torch.log10(1.0 + gain)), abs=0.1)
    # nothing of it comes below
    assert level_spl(resample(added, rate, 16000)[2000:-2000]) < level_spl(both[middle]) - 60.0


@pytest.mark.parametrize("rate", [17000, 22050, 44100, 48000])
def test_sliders_at_0_return_the_whole_band(rate: int) -> None:
    signal = set_level(torch.randn(2, rate + 37), 65.0)
    same = trained(sample_rate=rate)(signal, EAR, noise_reduction=0.0, amplification=0.0)
    assert (same - signal).abs().max() < 1e-6 * signal.abs().max()


@AIDS
def test_other_rates_go_through_whole_and_say_what_they_cost(make: Make) -> None:
    fast: Any = make(sample_rate=44100)
    levels = [level_spl(aid(tone(1000.0, 60.0, aid.sample_rate), EAR)) for aid in (fast, make())]
    assert (levels[0] - levels[1]).abs() < 0.1
    assert fast.latency == 552  # 12.5 ms, of which resampling takes 8.5
    with pytest.raises(ValueError):
        fast.stream(EAR)


@AIDS
def test_a_silent_room_stays_silent(make: Make) -> None:
    aid = make()
    assert not aid(torch.zeros(8000), EAR).any()
    room = set_level(torch.randn(32000), 25.0)
    gain = float(level_spl(aid(room, EAR)[8000:]) - 25.0)
    assert gain < (3.0 if isinstance(aid, HearingAid) else 50.0)


@AIDS
def test_no_sample_passes_the_limit(make: Make) -> None:
    slam = set_level(torch.randn(16000), 115.0)
    for ear in ("N2", "N5"):
        loud = make()(slam, Audiogram.standard(ear))
        assert float(loud.abs().max()) <= 1.000001 * 10.0 ** (16.0 / 20.0) and loud.isfinite().all()


@AIDS
@pytest.mark.parametrize("what", ["slam", "click"])
def test_recovers_within_three_tenths_of_a_second(make: Make, what: str) -> None:
    """The gain is back within 3 dB of what it is without."""
    aid: Any = make()
    steady = set_level(torch.randn(24000), 60.0)
    struck = steady.clone()
    if what == "slam":
        struck[8000:8800] = set_level(torch.randn(800), 115.0)
    else:
        struck[8000] = 20.0
    end = (8800 if what == "slam" else 8001) + 4800
    levels = [level_spl(aid(signal, EAR)[end : end + 1600]) for signal in (steady, struck)]
    assert (levels[0] - levels[1]).abs() < 3.0


@AIDS
def test_linked_gains_keep_levels_between_the_ears(make: Make, noise: torch.Tensor) -> None:
    scene = torch.stack((0.06 * noise[0], 0.02 * noise[0]))  # under the limit of the output
    alone, aid = make(), make(linked=True)
    for module, kept in ((alone, False), (aid, True)):
        change = interaural_change(scene, module(scene, Listener(EAR, EAR))).level
        assert bool((change.abs() < 0.1).all()) is kept
    same = scene[:1].expand(2, -1)  # of equal signals the mean is each one's own
    uneven = Listener(EAR, Audiogram.standard("N4"))
    torch.testing.assert_close(aid(same, uneven), alone(same, uneven))
    items = torch.stack((scene, same))
    together = aid(items, [Listener(EAR, EAR), uneven])
    torch.testing.assert_close(
        together, torch.stack((aid(scene, EAR), aid(same, uneven))), atol=1e-5, rtol=0
    )
    stream = aid.stream(Listener(EAR, EAR))
    late = torch.cat((stream(scene[:, :4001]), stream(scene[:, 4001:]), stream.flush()), -1)[
        :, aid.latency :
    ]
    torch.testing.assert_close(late, aid(scene, EAR), atol=1e-5, rtol=0)
    for mono in (noise[0], noise[:1]):
        with pytest.raises(ValueError):
            aid(mono, EAR)


@pytest.mark.parametrize(
    ("samples", "audiogram"),
    [
        ((100,), None),
        ((100,), Audiogram.standard("N7")),
        ((3, 100), torch.zeros(2, 8)),
    ],
)
def test_bad_call_raises_value_error(samples: tuple[int, ...], audiogram: Any) -> None:
    with pytest.raises(ValueError):
        WDRC()(torch.randn(samples), audiogram)


@AIDS
def test_bad_use_of_a_stream_raises_value_error(make: Make) -> None:
    stream: Any = make().stream(EAR)
    with pytest.raises(ValueError):
        stream.flush()  # before the first chunk
    stream(torch.randn(2, 100))
    for shape in ((3, 100), (2, 0)):
        with pytest.raises(ValueError):
            stream(torch.randn(shape))
