"""Stages of Kates' ear equal pyclarity's, and shifts equal slices."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.metrics.ear import (
    alignment,
    ear_rate,
    envelope_modulation as envelopes,
    model as ear_model,
    recursions as recursions,
)
from hlsim.metrics.ear.extent import Extent

CHANNELS = (0, 9, 31)
SPL = 94.0


@pytest.fixture(scope="module")
def pair(speech_dir: Path) -> tuple[Tensor, Tensor]:
    """0.8 s of speech at 16 kHz between silences, and the same with noise, late, float64."""
    clean = read_audio(speech_dir / "valid" / "flite-rms-01.flac")[0][0, 8000:20800].double()
    clean = torch.cat((torch.zeros(300), clean, torch.zeros(200)))
    noise = torch.randn(
        clean.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    late = torch.cat((torch.zeros(77), clean[:-77]))
    return clean, late + 0.3 * clean.square().mean().sqrt() * noise


def blocks(signal: Tensor) -> Tensor:
    """A whole number of blocks of it. Shape: (time,) -> (1, padded)."""
    return signal[: len(signal) // recursions.BLOCK * recursions.BLOCK][None]


def of_clarity(name: str = "eb") -> object:
    return pytest.importorskip(f"clarity.evaluator.haspi.{name}")


@pytest.mark.parametrize("rate", [16000, 24000, 32000, 44000, 48000])
def test_rate_and_alignment_are_those_of_pyclarity(pair: tuple[Tensor, Tensor], rate: int) -> None:
    eb = of_clarity()
    extent = Extent((len(pair[0]),))
    clean, late = (ear_rate.to_ear_rate(signal[None], rate, extent) for signal in pair)
    before = [eb.resample_24khz(signal.numpy(), rate)[0] for signal in pair]
    np.testing.assert_allclose(clean[0].numpy(), before[0], rtol=0, atol=1e-12)
    expected = eb.input_align(*before)
    extent = ear_rate.at_ear_rate(extent, rate)
    spectrum = alignment.spectrum_for_alignment(clean, extent)
    delay = alignment.bulk_delays(spectrum, -late, extent)  # the sign does not count
    first, last = ear_rate.audible_ends(clean)
    length = int(last - first) + 1
    for signal, moved, wanted in ((clean, -first, expected[0]), (late, delay - first, expected[1])):
        part = alignment.shift(signal, moved, extent.ends, (length,), length)
        np.testing.assert_allclose(part[0].numpy(), wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("rate", [16000, 44100, 48000])
def test_padded_items_are_resampled_and_aligned_as_alone(rate: int) -> None:
    ends = (3000, 2001)
    extent = Extent(ends)
    signals = extent.cut(torch.randn(2, 3000, dtype=torch.float64))
    batch = ear_rate.to_ear_rate(signals, rate, extent)
    both = ear_rate.at_ear_rate(extent, rate)
    late = both.cut(batch.roll(40, -1))
    delays = alignment.bulk_delays(alignment.spectrum_for_alignment(batch, both), late, both)
    for item, end in enumerate(ends):
        alone = ear_rate.to_ear_rate(signals[item : item + 1, :end], rate, Extent((end,)))[0]
        torch.testing.assert_close(batch[item, : len(alone)], alone, rtol=0, atol=1e-13)
        assert not batch[item, len(alone) :].any()
    assert (delays + 40 == alignment.HEADROOM).all()


def test_middle_ear_and_adaptation(pair: tuple[Tensor, Tensor]) -> None:
    eb = of_clarity()
    signal = blocks(pair[0][:5000])
    expected_sound = eb.middle_ear(signal[0].numpy(), 24000.0)
    level = 60.0 * (signal.abs() / signal.abs().max())
    level[level < 10.0] = 0.0
    expected, _ = eb.inner_hair_cell_adaptation(level[0].numpy(), level[0].numpy(), 2.0, 24000.0)
    for dtype, error in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        sound = recursions.apply_filter(recursions.middle_ear, signal.to(dtype))[0]
        np.testing.assert_allclose(sound.double().numpy(), expected_sound, rtol=0, atol=error)
        adapted = recursions.apply_filter(recursions.adaptation, level.to(dtype)).clamp_min(0.0)
        ours = adapted[0].double().numpy()
        np.testing.assert_allclose(ours, expected, rtol=0, atol=100 * error)


@pytest.mark.parametrize(("dtype", "error"), [(torch.float64, 1e-7), (torch.float32, 3e-6)])
def test_gammatones(pair: tuple[Tensor, Tensor], dtype: torch.dtype, error: float) -> None:
    eb = of_clarity()
    signal = blocks(pair[1])
    centres = eb.center_frequency(32)
    np.testing.assert_allclose(ear_model.centre_frequencies(), centres, rtol=1e-12)
    width = np.linspace(1.0, 4.0, 32)
    decay = 2.0 * np.pi / 24000 * 1.019 * (24.7 + centres / 9.26449) * width
    angle = torch.from_numpy(2.0 * np.pi * centres / 24000)
    filters = recursions.gammatone(torch.from_numpy(decay), angle, 8192, dtype)
    real, imaginary = (part.double() for part in filters(signal.to(dtype)))
    for channel in CHANNELS:
        x = signal[0].numpy()
        envelope, motion, _, _ = eb.gammatone_basilar_membrane(
            x, width[channel], x, width[channel], 24000.0, centres[channel]
        )
        ours = torch.hypot(real, imaginary)[channel].flatten().numpy()
        np.testing.assert_allclose(ours, envelope, rtol=0, atol=error * envelope.max())
        np.testing.assert_allclose(
            real[channel].flatten().numpy(), motion, rtol=0, atol=error * envelope.max()
        )


@pytest.mark.parametrize("name", ["NH", "N1", "N4", "S3", "N7"])
def test_hair_cells(name: str) -> None:
    eb = of_clarity()
    ear = Audiogram.standard(name)
    six = np.array([ear.thresholds[i] for i in (0, 1, 2, 3, 5, 6)])
    expected = eb.loss_parameters(six, eb.center_frequency(32))
    ours = ear_model.hair_cells(torch.tensor(ear.thresholds))
    fields = (ours.outer, ours.bandwidth, ours.knee, ours.ratio, ours.inner)
    for field, wanted in zip(fields, expected, strict=True):
        np.testing.assert_allclose(field.numpy(), wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["N2", "S3"])
def test_the_ear_as_a_whole(pair: tuple[Tensor, Tensor], name: str) -> None:
    eb, ear = of_clarity(), Audiogram.standard(name)
    six = np.array([ear.thresholds[i] for i in (0, 1, 2, 3, 5, 6)])
    clean, late = (signal.numpy() for signal in pair)
    expected = eb.ear_model(clean, 24000, late, 24000, six, 0, SPL, shift=None)
    clean, late = eb.input_align(clean, late)
    extent = Extent((len(clean),))
    gain = 10.0 ** (SPL / 20.0)
    x, y = (torch.tensor(signal)[None] * gain for signal in (clean, late))
    x, y = (
        torch.nn.functional.pad(signal, (0, extent.padded - extent.longest)) for signal in (x, y)
    )
    x, y = (recursions.apply_filter(recursions.middle_ear, signal) for signal in (x, y))
    normal, ours = (
        ear_model.hair_cells(torch.tensor(a.thresholds)) for a in (Audiogram.standard("NH"), ear)
    )
    longest_delay = ear_model.longest_group_delay(x, normal, extent)
    for chosen in (slice(0, 3), slice(20, 22)):
        a = ear_model.simulate_cochlea(x, normal, chosen, extent, motion=True)
        b = ear_model.simulate_cochlea(y, ours, chosen, extent, motion=True)
        spectrum = alignment.lag_spectrum(a.power.sqrt(), extent)
        power = alignment.align_channels(b.power, b.power.sqrt(), spectrum, extent)
        delays = longest_delay - ear_model.group_delays(a.bandwidth, chosen)
        pairs = ((a.power, normal, expected[0]), (power, ours, expected[2]))
        for output, cells, wanted in pairs:
            level = ear_model.nerve_levels(output, cells.inner[chosen])
            level = alignment.shift(level, delays, extent.ends, extent.ends, extent.longest)
            np.testing.assert_allclose(level[0].numpy(), wanted[chosen], rtol=0, atol=1e-5)
        for output, wanted in ((a, expected[4]), (b, expected[5])):
            np.testing.assert_allclose(output.level[0].numpy(), wanted[chosen], rtol=0, atol=1e-5)


def test_frames_and_modulation() -> None:
    ebm = of_clarity("ebm")
    random = np.random.RandomState(0)
    levels = np.cumsum(random.standard_normal((32, 9000)), -1)
    extent = Extent((9000,))
    ours = envelopes.smooth_frames(
        torch.tensor(levels)[None], torch.zeros(1, 32, dtype=torch.int64), extent
    )[0]
    expected, _ = ebm.env_filter(levels, levels, 320.0, 2560.0, 24000.0)
    np.testing.assert_allclose(ours.numpy(), expected.T, rtol=0, atol=1e-10)
    y = ours + torch.from_numpy(random.standard_normal(ours.shape))
    x, y = (envelopes.cepstrum(signal) for signal in (ours, y))
    six = [
        np.concatenate((np.zeros((1, signal.shape[-1])), signal - signal.mean(-1, keepdims=True))).T
        for signal in (x.numpy(), y.numpy())
    ]
    before = ebm.fir_modulation_filter(*six, 2560.0)
    wanted = ebm.modulation_cross_correlation(before[0].copy(), before[1].copy())
    correlation = envelopes.correlation(x[None], y[None], Extent((x.shape[-1],)))
    np.testing.assert_allclose(correlation[0].numpy(), wanted, rtol=0, atol=1e-12)


def test_expected_noise_adds_what_noise_has_on_average() -> None:
    noise = torch.randn(300, 5, 900, dtype=torch.float64)
    extent = Extent((900,) * 300)
    energy = envelopes._modulation_covariance(noise, noise, extent).xx.mean((0, -1))
    torch.testing.assert_close(
        energy, torch.from_numpy(envelopes._noise_energy(900)), rtol=0.05, atol=0.0
    )


def test_shift_of_several_items_and_its_gradient() -> None:
    signal = torch.randn(2, 3, 50, dtype=torch.float64, requires_grad=True)
    delays = torch.tensor([[0, 7, -9], [60, -60, 3]])
    ends, stops = (50, 31), (40, 31)

    def shifted(values: Tensor) -> Tensor:
        return alignment.shift(values, delays, ends, stops, 45)

    output = shifted(signal)
    for i, c in np.ndindex(2, 3):
        for t in range(45):
            source = t - int(delays[i, c])
            inside = 0 <= source < ends[i] and t < stops[i]
            assert output[i, c, t] == (signal[i, c, source] if inside else 0.0)
    assert torch.autograd.gradcheck(shifted, (signal,))


@pytest.mark.parametrize("time", [3000, 20000])
def test_channels_are_aligned_where_the_whole_correlation_is_largest(time: int) -> None:
    extent, max_lag = Extent((time, time // 2)), min(alignment.MAX_LAG, time)
    clean = extent.cut(torch.randn(2, 3, extent.padded, dtype=torch.float64).abs())
    output = clean + extent.cut(torch.randn(clean.shape, dtype=torch.float64))
    for channel, delay in enumerate((-max_lag + 1, 7, max_lag)):
        output[:, channel] = output[:, channel].roll(-delay, -1)
    output = extent.cut(output)
    spectrum = alignment.lag_spectrum(clean, extent)
    aligned = alignment.align_channels(output, output, spectrum, extent)
    lags = np.arange(1 - max_lag, max_lag + 1)
    for item, channel in np.ndindex(2, 3):
        x, y = clean[item, channel].numpy(), output[item, channel].numpy()
        correlation = np.correlate(x, y, "full")[len(x) - 1 + lags]
        delay = torch.tensor([int(lags[correlation.argmax()])])
        ends = extent.ends[item : item + 1]
        expected = alignment.shift(output[item, channel][None], delay, ends, ends, time)
        torch.testing.assert_close(aligned[item, channel, :time], expected[0], rtol=0, atol=0)
