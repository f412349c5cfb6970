"""Tests of directional microphones against the theory of arrays."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

import hlsim
from compensators import NALR, HearingAid, load_compensator, save_compensator
from compensators.beamformer import AdaptiveBeamformer, BeamformingAid
from compensators.config import BeamformerConfig
from compensators.directional import (
    AdaptiveDifferentialMicrophone,
    BinauralMVDR,
    DifferentialMicrophone,
    DirectionalAid,
    FilterAndSum,
)
from hlsim.calibration import level_spl
from hlsim.data.scenes import make_scene
from hlsim.dsp.resample import resample
from hlsim.dsp.sphere import SPEED_OF_SOUND, evenly_spread_directions, head_responses, unit_vectors

HERTZ = np.array([500.0, 1000.0, 2000.0, 4000.0])
FIXED_AND_ADAPTIVE = [DifferentialMicrophone, AdaptiveDifferentialMicrophone, BinauralMVDR]
FRONT_ENDS = [*FIXED_AND_ADAPTIVE, AdaptiveBeamformer]

# Directivity index in dB and angle of the null in degrees of the first-order patterns, for instance
# in Elko 2004: 10 log10(3) for dipole and cardioid, 10 log10(4) for the hypercardioid
PATTERNS = {
    "dipole": (4.77, 90.0),
    "cardioid": (4.77, 180.0),
    "supercardioid": (5.72, 125.0),
    "hypercardioid": (6.02, 109.5),
}


def filter_responses(front_end: FilterAndSum, hertz: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Compute the frequency responses. Returns: (ears, microphones, ears, frequencies)."""
    taps = front_end.taps.double().numpy()
    samples = np.arange(taps.shape[-1]) - front_end.latency
    return np.asarray(taps @ np.exp(-2j * np.pi * np.outer(samples, hertz) / 16000.0))


def free_field(directions: NDArray[np.float64], spacing: float) -> NDArray[np.complex128]:
    """Compute the responses of two microphones without a head, (directions, 2, frequencies)."""
    towards_front = directions[:, :1] * [0.0, -spacing]
    return np.asarray(np.exp(2j * np.pi * towards_front[..., None] / SPEED_OF_SOUND * HERTZ))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_patterns_have_the_directivity_and_the_null_of_theory(pattern: str) -> None:
    index, null = PATTERNS[pattern]
    weights = filter_responses(DifferentialMicrophone(pattern), HERTZ)[0, :, 0]

    def response(directions: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.abs((weights * free_field(directions, 0.01)).sum(1)) ** 2

    front = response(unit_vectors([0.0]))[0]
    diffuse = response(evenly_spread_directions(1000)).mean(0)
    np.testing.assert_allclose(10.0 * np.log10(front / diffuse), index, atol=0.5)
    np.testing.assert_allclose(10.0 * np.log10(front[1:]), 0.0, atol=0.2)
    assert (response(unit_vectors([null]))[0] / front).max() < 10.0**-2.5


def test_low_frequencies_fall_by_3_db_at_the_lowest() -> None:
    weights = filter_responses(DifferentialMicrophone(lowest=300.0), np.array([300.0]))[0, :, 0]
    spacing = 0.01 / SPEED_OF_SOUND
    waves = np.exp(-2j * np.pi * 300.0 * np.array([[0.0], [spacing]]))
    assert 20.0 * np.log10(abs((weights * waves).sum())) == pytest.approx(-3.0, abs=0.1)


def test_mvdr_reaches_the_directivity_that_its_microphones_allow() -> None:
    weights = filter_responses(BinauralMVDR(loading=1e-3), HERTZ)
    directions = evenly_spread_directions(500)
    noise, front = head_responses(directions, HERTZ), head_responses(unit_vectors([0.0]), HERTZ)[0]
    passed = (weights * front).sum((1, 2))
    np.testing.assert_allclose(passed, front[0], rtol=0.01)

    output = np.abs(np.einsum("emsf,dmsf->def", weights, noise)) ** 2
    gain = 10.0 * np.log10((np.abs(noise[:, 0]) ** 2).mean(0) / output.mean(0))
    flat = noise.reshape(len(directions), 4, -1)
    covariance = np.einsum("dif,djf->fij", flat, flat.conj()) / len(directions)
    steering = front.reshape(4, -1).T
    solved = np.linalg.solve(covariance + 1e-3 * np.eye(4), steering[..., None])[..., 0]
    best = (steering.conj() * solved).sum(-1).real * covariance[:, 0, 0].real
    best /= np.abs(steering[:, 0]) ** 2
    np.testing.assert_allclose(gain[0], 10.0 * np.log10(best), atol=0.5)
    assert (gain > 6.0).all()


@pytest.fixture(scope="module")
def speech() -> Tensor:
    return hlsim.example_speech()[8000:24000]


@pytest.fixture(scope="module")
def noise(speech: Tensor) -> Tensor:
    """Noise with the spectrum of the speech, (48000,)."""
    white = np.random.default_rng(0).normal(size=3 * len(speech))
    spectrum = np.fft.rfft(white) * abs(np.fft.rfft(speech.numpy(), len(white)))
    return torch.from_numpy(np.fft.irfft(spectrum)).float()


def benefit(
    front_end: FilterAndSum, snr: float = 0.0, **masker: Tensor | list[Tensor] | list[float]
) -> float:
    """Return by how much the SNR of both ears rises in dB (Hagerman and Olofsson 2004)."""
    target = hlsim.example_speech()[8000:24000]
    scene = make_scene(target, snr=snr, **masker)  # type: ignore[arg-type]  # by name
    noise = scene.input - scene.target
    plus, minus = front_end(scene.input), front_end(scene.target - noise)
    after = (plus + minus).square().mean() / (plus - minus).square().mean()
    before = scene.target[0].square().mean() / noise[0].square().mean()
    return float(10.0 * (after / before).log10())


def test_directional_microphones_reduce_noise_from_behind_and_diffuse_noise(noise: Tensor) -> None:
    for front_end in FRONT_ENDS:
        assert benefit(front_end(), diffuse=noise) > 3.0
        assert benefit(front_end(), maskers=[noise], azimuths=[135.0]) > 5.0


def test_the_null_of_the_adaptive_microphone_follows_the_noise(noise: Tensor) -> None:
    adaptive, cardioid = AdaptiveDifferentialMicrophone(), DifferentialMicrophone("cardioid")
    at_side: dict[str, list[Tensor] | list[float]] = {"maskers": [noise], "azimuths": [95.0]}
    assert benefit(adaptive, **at_side) > benefit(cardioid, **at_side) + 2.0
    behind: dict[str, list[Tensor] | list[float]] = {"maskers": [noise], "azimuths": [180.0]}
    assert benefit(adaptive, **behind) > benefit(cardioid, **behind) - 1.0


def test_the_beamformer_cancels_noise_and_keeps_the_target(noise: Tensor) -> None:
    beamformer, adaptive = AdaptiveBeamformer(), AdaptiveDifferentialMicrophone()
    behind: dict[str, list[Tensor] | list[float]] = {"maskers": [noise], "azimuths": [180.0]}
    assert benefit(beamformer, -15.0, **behind) > benefit(adaptive, -15.0, **behind) + 0.5
    scene = make_scene(hlsim.example_speech()[8000:24000], [noise], [180.0], snr=60.0)
    level = beamformer(scene.input).square().mean() / scene.reference.square().mean()
    assert abs(10.0 * float(level.detach().log10())) < 1.5


@pytest.mark.parametrize("build", FRONT_ENDS)
def test_stream_is_the_whole_signal_delayed(build: Callable[[], FilterAndSum]) -> None:
    front_end = build()
    signals = torch.from_numpy(np.random.default_rng(1).normal(size=(3, 2, 2, 3000)))
    stream = front_end.stream()
    output = torch.cat([stream(chunk) for chunk in signals.split([1, 700, 63, 64, 2172], -1)], -1)
    latency = front_end.latency
    assert 0 < latency <= 16
    whole = front_end(signals)
    torch.testing.assert_close(output[..., latency:], whole[..., :-latency])
    torch.testing.assert_close(stream.flush(), whole[..., -latency:])
    with pytest.raises(ValueError, match="expected a chunk before flush"):
        stream.flush()


def test_stream_without_look_ahead_ends_with_the_rest_of_the_aid() -> None:
    front_end = FilterAndSum(torch.eye(2).reshape(2, 1, 2, 1).repeat(1, 2, 1, 1) / 2)
    signals = torch.from_numpy(np.random.default_rng(1).normal(size=(2, 2, 1000))).float()
    stream = front_end.stream()
    stream(signals)
    assert stream.flush().shape == (2, 0)
    aid = DirectionalAid(front_end, HearingAid())
    stream = aid.stream(["N2", "N4"])
    output = torch.cat((stream(signals), stream.flush()), -1)[..., aid.latency :]
    torch.testing.assert_close(output, aid(signals, ["N2", "N4"]))


def test_a_directional_aid_has_a_stream_and_takes_arrays(noise: Tensor) -> None:
    aid = DirectionalAid(BinauralMVDR(), load_compensator("wdrc"))
    signals = 0.02 * noise[:8000].double().reshape(2, 2, 2000)
    stream = aid.stream(["N2", "N4"])
    chunks = [stream(chunk.numpy()) for chunk in signals.split([100, 1900], -1)]
    output = torch.cat((*map(torch.from_numpy, chunks), stream.flush()), -1)
    torch.testing.assert_close(output[..., aid.latency :], aid(signals, ["N2", "N4"]))
    assert aid.latency == 80
    assert isinstance(aid.front_end(signals.numpy()), np.ndarray)


def test_a_chunk_that_the_aid_rejects_does_not_change_the_front_end(noise: Tensor) -> None:
    aid = DirectionalAid(BinauralMVDR(), HearingAid())
    first, second = (0.02 * noise[:8000].reshape(2, 2, 2000)).split(1000, -1)
    stream, undisturbed = aid.stream(["N2", "N4"]), aid.stream(["N2", "N4"])
    for chunk in (first, second):
        stream.aid.set(noise_reduction=2.0)
        with pytest.raises(ValueError, match="noise_reduction"):
            stream(chunk)
        stream.aid.set(noise_reduction=0.5)
        assert torch.equal(stream(chunk), undisturbed(chunk))


def test_the_stream_of_the_shipped_aid_is_the_whole_signal_delayed(noise: Tensor) -> None:
    aid = load_compensator("hearing-aid-directional")
    scene = make_scene(hlsim.example_speech()[8000:24000], [noise], [120.0], snr=0.0)
    signals = scene.input.double()  # In float32, the network's rounding is 5e-6 of the peak.
    stream = aid.stream(["N2", "N4"], noise_reduction=0.0)
    parts = [stream(chunk) for chunk in signals.split([100, 7, 15893], -1)]
    output = torch.cat((*parts, stream.flush()), -1)[..., aid.latency :]
    whole = aid(signals, ["N2", "N4"], noise_reduction=0.0)
    assert float((output - whole).abs().max()) < 1e-6 * float(whole.abs().max())


def test_gains_change_at_the_same_times_at_every_rate(noise: Tensor) -> None:
    speech = hlsim.example_speech()[8000:24000]
    scene = make_scene(speech, [noise], [120.0], snr=0.0).input
    below_6_khz = torch.arange(8001) < 6000
    scene = torch.fft.irfft(torch.fft.rfft(scene) * below_6_khz)
    expected = load_compensator("hearing-aid-directional")(scene, ["N2", "N4"])
    fast = load_compensator("hearing-aid-directional", sample_rate=44100)
    output = resample(fast(resample(scene, 16000, 44100), ["N2", "N4"]), 44100, 16000)
    error = torch.fft.irfft(torch.fft.rfft(output - expected) * below_6_khz)
    assert float(error.norm() / expected.norm()) < 0.02


@pytest.mark.parametrize("build", FRONT_ENDS)
def test_gradients_reach_the_microphones(build: Callable[[], FilterAndSum]) -> None:
    signals = torch.from_numpy(np.random.default_rng(2).normal(size=(1, 2, 2, 200)))
    signals.requires_grad_()
    assert torch.autograd.gradcheck(build().double(), signals, fast_mode=True, nondet_tol=1e-10)


@pytest.mark.parametrize("build", FIXED_AND_ADAPTIVE)
def test_another_rate_passes_the_front(build: Callable[..., FilterAndSum]) -> None:
    rate = 22050
    time = rate // 4
    tone = torch.from_numpy(np.sin(2.0 * np.pi * 1000.0 * np.arange(time) / rate))
    scene = make_scene(tone, [tone.flip(-1)], [180.0], snr=100.0, sample_rate=rate)
    output = build(sample_rate=rate)(scene.target)
    middle = slice(time // 4, -time // 4)
    ratio = output[..., middle].square().mean() / scene.reference[..., middle].square().mean()
    assert abs(float(10.0 * ratio.log10())) < 1.0


def mirror_error(module: Callable[..., Tensor], waveform: Tensor, *ears: str) -> float:
    """Compute how far the output for a mirrored scene is from the mirrored output, relative RMS."""
    output = module(waveform, list(ears) or None)
    mirrored = module(waveform.flip(-2), list(reversed(ears)) or None).flip(-2)
    assert (level_spl(mirrored) - level_spl(output)).abs().max() < 0.2  # at each ear
    return float((mirrored - output).norm() / output.norm())


@torch.no_grad()
def test_a_mirrored_scene_has_the_mirrored_output(speech: Tensor, noise: Tensor) -> None:
    """An exchange of the ears anywhere in a front end would change the whole output.

    Directions of the model of diffuse noise are not exactly symmetric, nor are trained weights.
    """
    trained = load_compensator("hearing-aid-directional")
    for azimuth in (90.0, 135.0):
        scene = make_scene(speech, [noise], [azimuth], snr=0.0).input
        for build in (DifferentialMicrophone, AdaptiveDifferentialMicrophone):
            assert mirror_error(build(), scene) == 0.0
        for build in (BinauralMVDR, AdaptiveBeamformer):
            assert mirror_error(build(), scene) < 0.01
        assert mirror_error(trained.front_end, scene) < 0.05
        assert mirror_error(trained, scene, "N2", "N4") < 0.2


@torch.no_grad()
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_autocast_does_not_change_a_front_end(noise: Tensor, dtype: torch.dtype) -> None:
    signals = 0.02 * noise[:8000].reshape(2, 2, 2000)
    for front_end in (AdaptiveDifferentialMicrophone(), AdaptiveBeamformer()):
        whole, part = front_end(signals), front_end.stream()(signals)
        with torch.autocast("cpu", dtype):
            assert torch.equal(front_end(signals), whole)
            assert torch.equal(front_end.stream()(signals), part)
    fast = AdaptiveBeamformer(sample_rate=32000)
    whole = fast(signals)
    with torch.autocast("cpu", dtype):
        assert torch.equal(fast(signals), whole)


@torch.no_grad()
@pytest.mark.parametrize("build", FRONT_ENDS)
def test_half_precision_is_that_of_the_samples_alone(
    build: Callable[[], FilterAndSum], noise: Tensor
) -> None:
    samples = (1e-4 * noise[:8000].reshape(2, 2, 2000)).half()
    front_end = build()
    expected = front_end(samples.float()).half()
    assert torch.equal(front_end(samples), expected)
    stream = front_end.stream()
    output = torch.cat((stream(samples[..., :900]), stream(samples[..., 900:]), stream.flush()), -1)
    assert output.dtype == torch.float16
    torch.testing.assert_close(output[..., front_end.latency :], expected, rtol=2e-3, atol=1e-7)


def test_silence_gives_silence_and_finite_gradients() -> None:
    signals = torch.zeros(2, 2, 100, requires_grad=True)
    output = AdaptiveDifferentialMicrophone()(signals)
    output.sum().backward()
    assert not output.any()
    assert signals.grad is not None
    assert signals.grad.isfinite().all()


def test_directional_aid_is_a_front_end_and_an_aid(speech: Tensor, noise: Tensor) -> None:
    scene = make_scene(speech, [noise], [120.0], snr=0.0)
    signals = torch.nn.functional.pad(scene.input, (100, 0))  # The aid gets the look-ahead, too.
    front_end = DifferentialMicrophone()
    output = DirectionalAid(front_end, NALR())(signals, ["N2", "N4"])
    torch.testing.assert_close(output, NALR()(front_end(signals), ["N2", "N4"]))


def test_beamforming_aid_is_a_checkpoint_of_both_parts(tmp_path: Path, speech: Tensor) -> None:
    config = BeamformerConfig(hidden=8, aid={"inner": 8, "width": 8, "hidden": 8})
    aid = BeamformingAid(config=config).eval()
    assert sum(weights.numel() for weights in AdaptiveBeamformer().parameters()) <= 100_000
    save_compensator(aid, tmp_path / "mine")
    loaded = load_compensator(tmp_path / "mine", full_scale_spl=114.0, limit_to_ear=True)
    assert loaded.aid.limit_to_ear
    signals, ears = speech.expand(2, 2, -1), ["N2", "N4"]
    array = AdaptiveBeamformer(config)(signals.numpy())  # its network requires a gradient
    assert isinstance(array, np.ndarray)
    torch.testing.assert_close(loaded(0.1 * signals, ears), 0.1 * aid(signals, ears))
    fast = load_compensator(tmp_path / "mine", sample_rate=32000)
    expected = aid.front_end(signals).detach()
    error = resample(fast.front_end(resample(signals, 16000, 32000)), 32000, 16000) - expected
    assert float(error[..., 1000:-1000].norm() / expected.norm()) < 0.02
    assert fast(torch.zeros(2, 2, 4410), ears).shape == (2, 4410)
    with pytest.raises(ValueError, match="expected a sample rate of 16000 Hz for a stream"):
        fast.stream(ears)


def test_filters_can_be_trained_through_the_loss(speech: Tensor, noise: Tensor) -> None:
    scene = make_scene(speech, [noise], [120.0], snr=0.0)
    front_end = BinauralMVDR()
    front_end.taps = torch.nn.Parameter(front_end.taps)
    loss = hlsim.HearingLossLoss(["N2", "N3"], simulator="msbg")
    optimiser = torch.optim.SGD(front_end.parameters(), lr=1e-4)
    before = loss(front_end(scene.input), scene.reference)
    before.backward()
    optimiser.step()
    after = loss(front_end(scene.input), scene.reference)
    assert float(after.detach()) < float(before.detach())


def test_wrong_numbers_of_microphones_and_settings_raise_errors() -> None:
    front_end = DifferentialMicrophone()
    for shape in [(3, 2, 100), (2, 1, 100), (2, 100), (100,)]:
        with pytest.raises(ValueError, match="2 microphones at 2 ears"):
            front_end(torch.zeros(shape))
    with pytest.raises(ValueError, match="2 microphones at 2 ears"):
        front_end.stream()(torch.zeros(2, 100))
    stream = front_end.stream()
    stream(torch.zeros(2, 2, 100))
    with pytest.raises(ValueError, match="as before, got"):
        stream(torch.zeros(3, 2, 2, 100))
    with pytest.raises(ValueError, match="the chunk has samples that are NaN"):
        stream(torch.full((2, 2, 100), torch.nan))
    assert bool(stream(torch.zeros(2, 2, 100)).isfinite().all())
    with pytest.raises(ValueError, match="an aid with sample_rate=16000, got 44100"):
        DirectionalAid(front_end, NALR(sample_rate=44100))
    with pytest.raises(ValueError, match="an aid with full_scale_spl=100"):
        DirectionalAid(AdaptiveBeamformer(full_scale_spl=100.0), NALR())
    with pytest.raises(ValueError, match="load it by"):
        DirectionalAid(front_end, "nalr")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"write BinauralMVDR\(\)"):
        DirectionalAid(BinauralMVDR, NALR())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="unknown patterns: omni; expected some of dipole"):
        DifferentialMicrophone("omni")
    with pytest.raises(ValueError, match="spacing"):
        AdaptiveDifferentialMicrophone(spacing=1.0)
    with pytest.raises(ValueError, match="loading"):
        BinauralMVDR(loading=0.0)
    with pytest.raises(ValueError, match="full_scale_spl"):
        AdaptiveBeamformer(full_scale_spl=300.0)
