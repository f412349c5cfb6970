"""Tests of scenes with several microphones on a spherical head."""

import numpy as np
import pytest
import torch
from torch import Tensor

import hlsim
from hlsim.calibration import dbfs
from hlsim.data.scenes import draw_scenes, make_scene
from hlsim.dsp.active_level import active_level_db

TIME = 16000


@pytest.fixture(scope="module")
def speech() -> Tensor:
    return hlsim.example_speech()[:TIME]


@pytest.fixture(scope="module")
def noise() -> Tensor:
    return torch.from_numpy(np.random.default_rng(0).normal(size=3 * TIME)).float()


def test_scene_has_the_ratio_that_was_asked_for(speech: Tensor, noise: Tensor) -> None:
    scene = make_scene(speech, [noise], [60.0], diffuse=noise, snr=5.0)
    rest = (scene.input - scene.target).flatten(0, 1)
    noise_power = rest.square().mean().log10() * 10.0
    levels = [active_level_db(channel, 16000) for channel in scene.target.flatten(0, 1)]
    speech_power = 10.0 * np.log10(np.mean(10.0 ** (np.array(levels) / 10.0)))
    assert float(speech_power - noise_power) == pytest.approx(5.0, abs=0.01)


def test_sound_from_the_front_is_the_same_at_both_ears_and_not_delayed(
    speech: Tensor, noise: Tensor
) -> None:
    reference = make_scene(speech, diffuse=noise, snr=0.0).reference
    torch.testing.assert_close(reference[0], reference[1])
    lags = range(-20, 21)
    match = [float((reference[0].roll(-lag) * speech).sum()) for lag in lags]
    # The ear lies behind the centre of the sphere's front, but as far away as its centre.
    assert abs(lags[int(np.argmax(match))]) <= 4


def test_sound_from_the_left_is_louder_and_earlier_at_the_left(noise: Tensor) -> None:
    # Noise, because the head hardly changes the level of low frequencies
    scene = make_scene(noise[:TIME], diffuse=noise, snr=0.0, target_azimuth=60.0)
    left, right = scene.reference
    assert dbfs(left) > dbfs(right) + 1.0
    lags = range(-20, 21)
    match = [float((right.roll(-lag) * left).sum()) for lag in lags]
    assert 6 <= lags[int(np.argmax(match))] <= 12  # .4 to .75 ms


def test_sound_from_the_front_arrives_first_at_the_front_microphone(
    speech: Tensor, noise: Tensor
) -> None:
    target = make_scene(speech, diffuse=noise, snr=0.0).target.double()
    spectra = torch.fft.rfft(target[:, 0])
    cross = (spectra[0] * spectra[1].conj())[1000:2000]  # 1 to 2 kHz
    hertz = torch.arange(1000, 2000)
    delay = float((cross.angle() / (2.0 * np.pi * hertz)).median())
    assert 20e-6 < delay < 45e-6  # 29 microseconds in the free field


def test_same_seed_gives_the_same_scene(speech: Tensor, noise: Tensor) -> None:
    first, again, other = (
        make_scene(speech, diffuse=noise, snr=0.0, seed=seed).input for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("has_noise", [False, True])
def test_random_scenes_have_their_ratio_and_depend_on_the_seed(
    speech: Tensor, noise: Tensor, has_noise: bool
) -> None:
    voices = torch.stack((speech, speech.flip(-1)))
    recordings = noise[: 2 * TIME].reshape(2, TIME) if has_noise else None

    def draw(seed: int, mismatch: float = 0.0) -> tuple[Tensor, Tensor]:
        generator = torch.Generator().manual_seed(seed)
        snr = torch.tensor([-5.0, 10.0])
        return draw_scenes(voices, voices, recordings, snr, generator, mismatch=mismatch)

    signals, targets = draw(0)
    assert torch.equal(signals, draw(0)[0])
    assert not torch.equal(signals, draw(1)[0])
    powers = [values.square().mean((1, 2, 3)) for values in (targets, signals - targets)]
    ratios = 10.0 * (powers[0] / powers[1]).log10()
    assert 13.0 < float(ratios[1] - ratios[0]) < 17.0
    mismatched, same_targets = draw(0, mismatch=1.0)
    gains = 10.0 * (mismatched.square().mean(-1) / signals.square().mean(-1)).log10()
    assert torch.equal(targets, same_targets)
    assert 0.3 < float(gains.std()) < 3.0


def test_wrong_arguments_raise_errors(speech: Tensor, noise: Tensor) -> None:
    with pytest.raises(ValueError, match="one azimuth for each of 1 maskers, got 0"):
        make_scene(speech, [noise], snr=0.0)
    with pytest.raises(ValueError, match="expected a masker or diffuse noise"):
        make_scene(speech, snr=0.0)
    with pytest.raises(ValueError, match="at least 16000 samples"):
        make_scene(speech, [noise[:100]], [0.0], snr=0.0)
    with pytest.raises(ValueError, match=r"expected diffuse of shape \(time,\)"):
        make_scene(speech, diffuse=noise.repeat(2, 1), snr=0.0)
    with pytest.raises(ValueError, match="a target of shape"):
        make_scene(speech.repeat(2, 1), diffuse=noise, snr=0.0)
    with pytest.raises(ValueError, match=r"write \[masker\]"):
        make_scene(speech, noise, [0.0], snr=0.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"write \[masker\]"):
        make_scene(speech, [noise], 120.0, snr=0.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="spacing"):
        make_scene(speech, [noise], [0.0], snr=0.0, spacing=10.0)
    with pytest.raises(ValueError, match="an azimuth"):
        make_scene(speech, [noise], [500.0], snr=0.0)
    with pytest.raises(ValueError, match="snr"):
        make_scene(speech, diffuse=noise, snr=float("nan"))


def test_wrong_arguments_of_random_scenes_raise_errors() -> None:
    voices = torch.randn(2, 8000)
    for other, ratios in ((voices[:1], torch.zeros(2)), (voices, torch.zeros(1))):
        with pytest.raises(ValueError, match="one SNR per item, got the shapes"):
            draw_scenes(voices, other, None, ratios, torch.Generator())
    with pytest.raises(ValueError, match="mismatch"):
        draw_scenes(voices, voices, None, torch.zeros(2), torch.Generator(), mismatch=float("nan"))


def test_a_scene_needs_another_voice() -> None:
    voices = torch.randn(1, 8000)
    with pytest.raises(ValueError, match="expected two or more items"):
        draw_scenes(voices, voices, None, torch.zeros(1), torch.Generator())
