"""The whole model against pyclarity's ``Ear``, and the laws it keeps."""

import copy
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim import torchtools
from hlsim.audio import find_audio, read_audio
from hlsim.audiogram import STANDARD, Audiogram
from hlsim.calibration import gain_to_pascals, level_spl, set_level
from hlsim.msbg import MSBG
from hlsim.msbg.blocks import block_bounds
from hlsim.msbg.model import STRUCTURAL_DELAY, active_rescaling
from hlsim.msbg.resampling import to_inner
from hlsim.msbg.smearing import HOP
from hlsim.training.ears import draw_thresholds
from tests.pyclarity import STRIDE, PyclarityOutputs, msbg

EARS = {"none": "NH", "mild": "N1", "moderate": "N2", "severe": "N4"}  # one a severity
RATE = 44100

Wave = NDArray[np.float64]

fast_model = partial(MSBG, sample_rate=RATE)


@pytest.fixture(scope="module")
def recordings(speech_dir: Path) -> list[tuple[Wave, int]]:
    """All embedded speech: waveform and rate."""
    pairs = [read_audio(path) for path in find_audio(speech_dir)]
    return [(wave[0].double().numpy(), rate) for wave, rate in pairs]


@pytest.fixture(scope="module")
def ears() -> list[Audiogram]:
    """48: the standard ones that simulators take, and drawn ones of all severities."""
    standard = [Audiogram.standard(name) for name in STANDARD if name != "N7"]
    drawn = draw_thresholds(48 - len(standard), torch.Generator().manual_seed(1)).tolist()
    return standard + [Audiogram(tuple(levels)) for levels in drawn]


def clip(
    recordings: list[tuple[Wave, int]], rng: np.random.Generator, seconds: float, rate: int = RATE
) -> Wave:
    """Random piece of speech of 50 to 80 dB SPL where RMS 1.0 is 120 dB SPL, at ``rate``."""
    wave, own = recordings[rng.integers(len(recordings))]
    common = math.gcd(rate, own)
    wave = scipy.signal.resample_poly(wave, rate // common, own // common)
    start = rng.integers(len(wave) - round(seconds * rate))
    wave = wave[start : start + round(seconds * rate)]
    return wave / np.sqrt(np.mean(wave**2)) * 10 ** ((rng.uniform(50, 80) - 120) / 20)


def relative(ours: NDArray[Any], theirs: NDArray[Any]) -> float:
    return float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs))


def speech_at(speech: list[tuple[Tensor, int]], spl: float = 65.0, seconds: float = 0.5) -> Tensor:
    """Speech of an utterance at 44.1 kHz in pascals. Shape: (time,)."""
    wave, rate = speech[0]
    start = round(0.5 * rate)
    piece = wave[0, start : start + round(seconds * rate)].double().numpy()
    return set_level(
        torch.from_numpy(scipy.signal.resample(piece, round(seconds * RATE))).float(), spl
    )


def test_equals_pyclarity_sample_for_sample(
    recordings: list[tuple[Wave, int]], ears: list[Audiogram], pyclarity: PyclarityOutputs
) -> None:
    rng = np.random.default_rng(0)
    errors = []
    for number, ear in enumerate(ears):
        wave = clip(recordings, rng, rng.uniform(0.7, 0.9))
        theirs = pyclarity(f"msbg, ear {number}", msbg, ear, wave, STRIDE)
        model = MSBG(
            ear, sample_rate=RATE, full_scale_spl=120.0, aligned=False, rescale_active=True
        )
        ours = model(torch.tensor(wave, dtype=torch.float32))[::STRIDE]
        assert ours.shape == theirs.shape and ours.dtype == torch.float32
        errors.append(relative(ours.numpy(), theirs))
    assert len(errors) >= 40
    # measured: 2e-4 and 1.5e-3
    assert np.median(errors) < 5e-4
    assert max(errors) < 3e-3


def spectrum_of_reference(
    ear: Audiogram, wave: Wave, rate: int, highest: float
) -> NDArray[np.complex128]:
    """Resample to 44.1 kHz by a Fourier transform, process, take the delay off, and resample back."""
    fast = scipy.signal.resample(wave, len(wave) * RATE // rate)
    theirs = msbg(ear, fast)
    delay = 1047 + (192 if ear.severity != "none" else 0)
    theirs = theirs[delay : delay + len(fast)]
    theirs = scipy.signal.resample(np.pad(theirs, (0, len(fast) - len(theirs))), len(wave))
    return band_spectrum(theirs, rate, highest)


def band_spectrum(wave: Wave, rate: int, highest: float) -> NDArray[np.complex128]:
    """Some frequencies of the spectrum below ``highest``."""
    return np.fft.rfft(wave)[np.fft.rfftfreq(len(wave), 1 / rate) < highest][::STRIDE]


@pytest.mark.parametrize(
    ("rate", "count", "highest"),
    [
        (16000, 12, 7000.0),
        (22050, 3, 9500.0),
        (24000, 3, 10000.0),
        (32000, 3, 14000.0),
        (48000, 3, 16000.0),
    ],
)
def test_other_rates_equal_pyclarity_on_the_resampled_input(
    recordings: list[tuple[Wave, int]],
    ears: list[Audiogram],
    pyclarity: PyclarityOutputs,
    rate: int,
    count: int,
    highest: float,
) -> None:
    rng = np.random.default_rng(rate)
    errors = []
    for number in range(count):
        ear = ears[(7 * number + 3) % len(ears)]
        wave = clip(recordings, rng, 0.6, rate)
        wave[:200] *= np.linspace(0, 1, 200)
        wave[-200:] *= np.linspace(1, 0, 200)
        wave = np.pad(wave, (rate // 20, rate // 5 - len(wave) % (rate // 50)))
        key = f"msbg at {rate} Hz, ear {number}"
        theirs = pyclarity(key, spectrum_of_reference, ear, wave, rate, highest)
        model = MSBG(ear, sample_rate=rate, full_scale_spl=120.0, rescale_active=True)
        ours = model(torch.tensor(wave, dtype=torch.float32)).numpy()
        assert ours.shape == wave.shape
        errors.append(relative(band_spectrum(ours, rate, highest), theirs))
    assert np.median(errors) < 5e-4
    assert max(errors) < 5e-3


@pytest.mark.parametrize("severity", EARS)
def test_aligned_is_the_reference_without_its_delay(
    speech: list[tuple[Tensor, int]], severity: str
) -> None:
    ear = Audiogram.standard(EARS[severity])
    assert ear.severity == severity
    wave = speech_at(speech)
    aligned = fast_model(ear)
    delay = STRUCTURAL_DELAY + (0 if severity == "none" else 192)
    assert (STRUCTURAL_DELAY, aligned.delay(severity)) == (1047, delay)
    heard = aligned(wave)
    late = fast_model(ear, aligned=False)(torch.cat((wave, torch.zeros(9000))))
    late = late[delay : delay + len(wave)]
    assert heard.shape == wave.shape
    # where it ends, the aligned one has nothing to move channels ahead from
    assert relative(heard[:-500].numpy(), late[:-500].numpy()) < 3e-5
    assert relative(heard.numpy(), late.numpy()) < 5e-4


@pytest.mark.parametrize("time", [1, 63, 64, 441, 1000, 4410])
@pytest.mark.parametrize("severity", EARS)
def test_lengths(severity: str, time: int) -> None:
    ear = Audiogram.standard(EARS[severity])
    wave = 0.01 * torch.randn(time)
    for rescale in (False, True):
        heard = fast_model(ear, rescale_active=rescale)(wave)
        assert heard.shape == wave.shape and bool(torch.isfinite(heard).all())
    late = fast_model(ear, aligned=False)(wave)
    assert len(late) == (time if severity == "none" else HOP * (-(-time // HOP) + 3))
    slow = MSBG(ear, sample_rate=16000)(wave)
    assert slow.shape == wave.shape and bool(torch.isfinite(slow).all())


@pytest.mark.parametrize("spl", [38.0, 50.0, 65.0, 100.0])
def test_rescaling_is_measure_rms(recordings: list[tuple[Wave, int]], spl: float) -> None:
    measure_rms = pytest.importorskip("clarity.evaluator.msbg.msbg_utils").measure_rms
    rng = np.random.default_rng(5)
    for _ in range(6):
        wave = clip(recordings, rng, rng.uniform(0.3, 1.0))
        wave *= 10 ** ((spl - 120) / 20) / np.sqrt(np.mean(wave**2))
        expected = np.sqrt(np.mean(wave**2)) / measure_rms(wave, RATE, -12)[0]
        ours = active_rescaling(torch.from_numpy(wave * gain_to_pascals(120.0)))
        assert ours.shape == (1,)
        assert float(ours) == pytest.approx(expected, rel=1e-9)


def test_rescaling_leaves_silence_and_very_short_clips_alone() -> None:
    assert active_rescaling(torch.zeros(2, 3, 1000)).eq(1.0).all()
    # under 40 dB SPL no frame counts as active, of which the reference makes NaN
    faint = set_level(torch.randn(1000), 20.0)
    assert active_rescaling(faint).eq(1.0).all()
    assert active_rescaling(torch.ones(2, 10)).eq(1.0).all()


def mixed(count: int) -> Tensor:
    """Ears of all severities in turn. Shape: (count, 8)."""
    names = list(EARS.values())
    return torch.tensor([STANDARD[names[i % 4]] for i in range(count)], dtype=torch.float32)


@pytest.mark.parametrize(
    "options", [{}, {"aligned": False}, {"sample_rate": 16000}, {"rescale_active": True}]
)
def test_a_mixed_batch_equals_its_items(
    speech: list[tuple[Tensor, int]], options: dict[str, Any]
) -> None:
    ears = mixed(6).reshape(2, 3, 8)
    waves = torch.stack(
        [set_level(speech_at(speech, seconds=0.3).roll(500 * i), 50.0 + 6 * i) for i in range(6)]
    )
    waves = waves.reshape(2, 3, -1)
    model = fast_model(**options)
    together = model(waves, ears)
    assert together.shape[:2] == (2, 3)
    if options.get("aligned", True):
        assert together.shape == waves.shape
    for i in range(2):
        for j in range(3):
            alone = model(waves[i, j], Audiogram(tuple(ears[i, j].tolist())))
            assert relative(together[i, j, : len(alone)].numpy(), alone.numpy()) < 1e-5
            assert not bool(together[i, j, len(alone) :].any())


def test_ears_and_waveforms_broadcast(speech: list[tuple[Tensor, int]]) -> None:
    wave = speech_at(speech, seconds=0.1)
    ears = mixed(4)
    model = fast_model()
    each = model(wave, ears)
    assert each.shape == (4, len(wave))
    sequence = [Audiogram(tuple(levels)) for levels in ears.tolist()]
    torch.testing.assert_close(model(wave.expand(4, -1), sequence), each)
    grid = model(wave.expand(2, 4, -1), ears)
    torch.testing.assert_close(grid, each.expand(2, 4, -1))
    one = model(wave.expand(3, 2, -1), sequence[2])
    torch.testing.assert_close(one, each[2].expand(3, 2, -1))
    torch.testing.assert_close(model(wave.expand(2, 4, -1), ears.expand(2, 4, 8)), grid)


def test_the_ear_of_the_call_comes_before_the_stored_one(speech: list[tuple[Tensor, int]]) -> None:
    wave = speech_at(speech, seconds=0.1)
    n3, s1 = Audiogram.standard("N3"), Audiogram.standard("S1")
    torch.testing.assert_close(fast_model(n3)(wave, s1), fast_model(s1)(wave), atol=0, rtol=0)


@pytest.mark.parametrize("severity", EARS)
@pytest.mark.parametrize(
    "options", [{}, {"aligned": False}, {"sample_rate": 16000}, {"rescale_active": True}]
)
def test_gradcheck(severity: str, options: dict[str, Any]) -> None:
    model = fast_model(Audiogram.standard(EARS[severity]), **options)
    wave = 0.3 * torch.randn(1, 600, dtype=torch.float64)
    # what a severe loss leaves is faint: measured in its own unit, or nothing would be checked
    scale = 1.0 / float(model(wave).abs().max())
    assert torch.autograd.gradcheck(
        lambda w: scale * model(w),
        wave.requires_grad_(),
        eps=1e-7,
        atol=1e-3,
        rtol=1e-3,
        fast_mode=True,
    )


@pytest.mark.parametrize("severity", ["mild", "moderate", "severe"])
def test_a_loss_expands(speech: list[tuple[Tensor, int]], severity: str) -> None:
    """More gain in, more level out, and 1 dB in is more than 1 dB out."""
    model = fast_model(Audiogram.standard(EARS[severity]))
    wave = speech_at(speech)
    levels = torch.arange(45.0, 91.0, 5.0)
    heard = level_spl(model(torch.stack([set_level(wave, level) for level in levels])))
    steps = heard.diff()
    assert bool((steps > 5.0).all())
    assert bool((heard < levels).all())
    worse = level_spl(fast_model(Audiogram.standard("N6"))(wave))
    assert float(worse) < float(level_spl(model(wave)))


def test_no_loss_is_linear_and_close_to_the_input(speech: list[tuple[Tensor, int]]) -> None:
    model = fast_model(Audiogram.standard("NH"))
    wave = speech_at(speech).double()
    torch.testing.assert_close(model(10.0 * wave), 10.0 * model(wave))
    torch.testing.assert_close(model(wave + wave.flip(-1)), model(wave) + model(wave.flip(-1)))
    # not the input itself: the filter bank's ripple remains
    assert abs(float(level_spl(model(wave)) - level_spl(wave))) < 2.0


def test_full_scale_changes_the_unit_and_nothing_else(speech: list[tuple[Tensor, int]]) -> None:
    wave = speech_at(speech, seconds=0.2)
    ear = Audiogram.standard("N3")
    gain = gain_to_pascals(110.0)
    torch.testing.assert_close(
        fast_model(ear, full_scale_spl=110.0)(wave / gain) * gain, fast_model(ear)(wave)
    )


@pytest.mark.parametrize("severity", EARS)
@pytest.mark.parametrize("hops", [1, 7])
def test_a_later_signal_is_heard_later(
    speech: list[tuple[Tensor, int]], severity: str, hops: int
) -> None:
    """By whole hops of the smearing, 64 samples; its first frames are irregular, so that some silence comes first."""
    wave = torch.cat((torch.zeros(512), speech_at(speech, seconds=0.3), torch.zeros(3000)))
    model = fast_model(Audiogram.standard(EARS[severity]))
    shift = 64 * hops
    heard = model(torch.stack((wave, wave.roll(shift))))
    assert (
        relative(heard[1].roll(-shift)[1000:-shift].numpy(), heard[0][1000:-shift].numpy()) < 1e-4
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rate", [16000, 44100])
def test_silence_is_heard_as_silence_with_finite_gradients(rate: int, dtype: torch.dtype) -> None:
    for rescale in (False, True):
        waves = torch.zeros(4, 3000, dtype=dtype, requires_grad=True)
        heard = MSBG(sample_rate=rate, rescale_active=rescale)(waves, mixed(4))
        assert not bool(heard.any())
        heard.sum().backward()
        assert waves.grad is not None and bool(torch.isfinite(waves.grad).all())


def test_gradients_are_finite_from_faint_to_clipped(speech: list[tuple[Tensor, int]]) -> None:
    wave = speech_at(speech, seconds=0.2)
    levels = torch.tensor([-20.0, 20.0, 60.0, 100.0, 120.0])
    waves = torch.stack([set_level(wave, level) for level in levels])
    waves = torch.cat((waves, (1e3 * waves[-1:]).clamp(-1, 1)))
    waves = waves.unsqueeze(1).expand(-1, 4, -1).clone()
    waves[:, :, 2000:4000] = 0.0
    waves.requires_grad_()
    heard = fast_model()(waves, mixed(4))
    assert bool(torch.isfinite(heard).all())
    heard.square().sum().backward()
    assert waves.grad is not None and bool(torch.isfinite(waves.grad).all())
    assert bool((waves.grad.abs().amax(-1) > 0).all())


@pytest.mark.parametrize("severity", EARS)
def test_float32_is_float64_to_rounding(speech: list[tuple[Tensor, int]], severity: str) -> None:
    model = fast_model(Audiogram.standard(EARS[severity]))
    wave = speech_at(speech)
    wide = model(wave.double())
    assert wide.dtype == torch.float64
    assert relative(model(wave).double().numpy(), wide.numpy()) < 2e-5


def test_autocast_is_left(speech: list[tuple[Tensor, int]]) -> None:
    wave = speech_at(speech, seconds=0.2)
    model = fast_model(Audiogram.standard("N3"))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        heard = model(wave)
        half = model(wave.bfloat16())
    assert heard.dtype == torch.float32
    assert torch.equal(heard, model(wave))
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half, model(wave.bfloat16().float()).bfloat16())


@pytest.mark.slow
def test_compiled_it_is_called_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    # empty: what makes filters is called, too
    monkeypatch.setattr(torchtools, "_CACHE", torchtools._Cache(2**28))
    model, wave = MSBG(Audiogram.standard("N3"), sample_rate=16000), 0.03 * torch.randn(1, 1200)
    heard = torch.compile(model, backend="eager")(wave)
    assert torch.equal(heard, model(wave))


def test_nothing_is_trained_or_stored_and_copies_are_alike(
    speech: list[tuple[Tensor, int]],
) -> None:
    model = fast_model(Audiogram.standard("N3"))
    assert not model.state_dict() and not list(model.parameters())
    wave = speech_at(speech, seconds=0.1)
    assert torch.equal(copy.deepcopy(model)(wave), model(wave))
    assert "sample_rate=44100" in repr(model)


def test_an_ear_that_is_trained_is_followed_after_a_move() -> None:
    ear = torch.nn.Parameter(torch.full((8,), 40.0))
    model = MSBG(ear, sample_rate=16000).double()
    assert model.thresholds is ear and not list(model.parameters())
    wave = 0.03 * torch.randn(2000, dtype=torch.float64)
    before = model(wave)
    before.square().sum().backward()
    assert ear.grad is not None and bool(ear.grad.any())
    with torch.no_grad():
        ear += 10.0
    assert not torch.equal(model(wave), before)
    assert copy.deepcopy(model).thresholds is not ear
    with torch.no_grad():
        ear += 60.0
    with pytest.raises(ValueError):
        model(wave)


N3 = Audiogram.standard("N3")


@pytest.mark.parametrize(
    ("wave", "audiogram"),
    [
        (torch.zeros(100), None),
        (torch.zeros(100), torch.full((8,), 100.5)),
        (torch.zeros(100), torch.full((8,), -11.0)),
        (torch.zeros(100), Audiogram.standard("N7")),
        (torch.zeros(100), torch.full((8,), math.nan)),
        (torch.zeros(100), torch.zeros(7)),
        (torch.zeros(100), 3),
        (torch.zeros(100, dtype=torch.int16), N3),
        (torch.zeros(2, 0), N3),
        (torch.tensor(1.0), N3),
        (torch.zeros(3, 100), torch.zeros(2, 8)),
        (torch.zeros(3, 100), [N3, N3]),
    ],
    ids=str,
)
def test_bad_call_raises_value_error(wave: Any, audiogram: Any) -> None:
    with pytest.raises(ValueError):
        fast_model()(wave, audiogram)


@pytest.mark.parametrize(
    "options",
    [
        {"sample_rate": 8000},
        {"sample_rate": 96000},
        {"full_scale_spl": -1.0},
        {"full_scale_spl": math.nan},
        {"audiogram": Audiogram.standard("N7")},
        {"audiogram": torch.zeros(7)},
    ],
    ids=str,
)
def test_bad_setting_raises_value_error(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        fast_model(**options)


def test_an_unknown_severity_raises_value_error() -> None:
    with pytest.raises(ValueError):
        fast_model().delay("Severe")


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("rate", [16000, 44100])
@pytest.mark.parametrize("items", [1, 2])
def test_the_number_of_threads_changes_nothing_but_rounding(rate: int, items: int) -> None:
    model, wave = MSBG(Audiogram.standard("N3"), sample_rate=rate), 0.03 * torch.randn(items, rate)
    two = model(wave)
    torch.set_num_threads(1)
    one = model(wave)
    # MKL transforms a single long row in another order on several threads
    assert relative(two.numpy(), one.numpy()) <= (5e-6 if items == 1 else 0.0)


@pytest.mark.parametrize("rate", [16000, 16001, 22050, 48000])
def test_resampling_keeps_all_but_the_last_80_hz(rate: int) -> None:
    spectrum = torch.fft.rfft(torch.randn(rate, dtype=torch.float64))
    spectrum[min(rate, 44100) // 2 - 100 :] = 0.0  # one second: a bin a Hz
    # silent at the ends, for scipy takes it as periodic
    signal = torch.fft.irfft(spectrum, rate) * torch.hann_window(rate, dtype=torch.float64)
    truth = scipy.signal.resample(signal.numpy(), 44100)
    assert relative(to_inner(signal, rate).numpy(), truth) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("rate", [16000, 44100])
@pytest.mark.parametrize("aligned", [True, False])
def test_long_signals_go_by_blocks_that_equal_the_whole(
    monkeypatch: pytest.MonkeyPatch, rate: int, aligned: bool
) -> None:
    samples = 14 * rate
    place = torch.arange(samples) / rate
    # noise up to half the rate with the rhythm of syllables; in double precision, for single precision rounds by 1e-5 on
    # another FFT grid
    noise = torch.randn(samples, dtype=torch.float64)
    wave = set_level(noise * (8.0 * torch.pi * place).sin().clamp_min(0.02), 65.0)
    model = MSBG(Audiogram.standard("N2"), sample_rate=rate, aligned=aligned)
    with torch.no_grad():
        blocks = model(wave)
        assert len(block_bounds(samples, rate)) == 2
        monkeypatch.setattr("hlsim.msbg.blocks.block_bounds", lambda n, _: [(0, 0, n, n)])
        whole = model(wave)
    assert blocks.shape == whole.shape
    assert relative(blocks.numpy(), whole.numpy()) < 1e-5


@pytest.mark.slow
def test_blocks_of_a_rate_that_shares_little_keep_the_length() -> None:
    wave = 0.03 * torch.randn(10 * 16026)
    with torch.no_grad():
        assert MSBG(Audiogram.standard("N6"), sample_rate=16026)(wave).shape == wave.shape


@pytest.mark.parametrize("aligned", [True, False])
def test_gradients_through_blocks_are_those_of_the_whole(
    monkeypatch: pytest.MonkeyPatch, aligned: bool
) -> None:
    monkeypatch.setattr("hlsim.msbg.blocks._BLOCK_SECONDS", 1.0)
    wave = 0.03 * torch.randn(2 * 44100, dtype=torch.float64)
    model, gradients = fast_model(Audiogram.standard("N3"), aligned=aligned), []
    for _ in range(2):
        leaf = wave.clone().requires_grad_()
        model(leaf).square().sum().backward()
        assert leaf.grad is not None
        gradients.append(leaf.grad.numpy())
        monkeypatch.setattr("hlsim.msbg.blocks.block_bounds", lambda n, _: [(0, 0, n, n)])
    assert relative(gradients[0], gradients[1]) < 1e-4


def test_gradients_through_blocks_are_the_same_by_a_transform(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hlsim.msbg.blocks._BLOCK_SECONDS", 1.0)
    model, wave = MSBG(Audiogram.standard("N3"), sample_rate=16000), 0.03 * torch.randn(20000)
    assert len(block_bounds(20000, 16000)) > 1
    leaf = wave.clone().requires_grad_()
    model(leaf).square().sum().backward()
    slope = torch.func.grad(lambda signal: model(signal).square().sum())(wave)
    torch.testing.assert_close(slope, leaf.grad)


@pytest.mark.parametrize("rate", [16000, 17000, 18000, 20000])
# as slight as each bank is used for, where its skirts count most
@pytest.mark.parametrize(("level", "error"), [(16.0, 1e-3), (36.0, 2.5e-3), (57.0, 6e-3)])
def test_half_the_rate_inside_changes_little(
    monkeypatch: pytest.MonkeyPatch, rate: int, level: float, error: float
) -> None:
    noise = 0.02 * torch.randn(1, rate // 2, dtype=torch.float64)
    spectrum = torch.fft.rfft(noise)
    spectrum[:, : spectrum.shape[-1] * 88 // 100] = 0.0
    ear, model = torch.full((8,), level, dtype=torch.float64), MSBG(sample_rate=rate)
    for signal in (noise, torch.fft.irfft(spectrum, rate // 2))[: 1 if rate == 16000 else 2]:
        monkeypatch.undo()
        heard = model(signal, ear)
        monkeypatch.setattr("hlsim.msbg.model._HALF_RATE_HZ", 0)
        truth = model(signal, ear)
        assert 0.0 < float((heard - truth).norm()) < error * float(truth.norm())


@pytest.mark.parametrize("rate", [16000, 16001, 44100])
@pytest.mark.parametrize("ears", [["N3"], ["N1", "N3"], ["NH", "NH"]])
def test_outputs_hold_no_more_than_themselves(rate: int, ears: list[str]) -> None:
    model = MSBG([Audiogram.standard(name) for name in ears], sample_rate=rate)
    heard = model(0.01 * torch.randn(len(ears), 400))
    assert heard.is_contiguous()
    assert heard.untyped_storage().nbytes() == heard.nbytes
