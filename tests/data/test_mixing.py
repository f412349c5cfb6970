"""Noisy speech has the signal-to-noise ratio that was asked for."""

from typing import Any

import numpy as np
import pytest
import torch

import hlsim
from hlsim.calibration import dbfs, level_spl
from hlsim.data.mixing import mix
from hlsim.dsp.active_level import active_level_db


def test_the_ratio_is_that_of_the_active_or_of_the_rms_level() -> None:
    speech, noise = 0.03 * torch.randn(2, 48000), 7.0 * torch.randn(2, 48000)
    speech[0, 16000:] = 0.0  # a third is speech, 4.8 dB
    snr = torch.tensor([-5.0, 20.0])
    added = mix(speech, noise, snr, sample_rate=None) - speech
    torch.testing.assert_close(level_spl(speech) - level_spl(added), snr, atol=0.01, rtol=0)
    torch.testing.assert_close(
        added / added.norm(dim=-1, keepdim=True), noise / noise.norm(dim=-1, keepdim=True)
    )
    active = mix(speech, noise, snr) - speech
    for item in range(2):
        level = active_level_db(speech[item], 16000)
        assert level - float(dbfs(active[item])) == pytest.approx(float(snr[item]), abs=0.01)
    assert float(level_spl(active[0]) - level_spl(added[0])) > 3.0


def test_bfloat16_is_mixed_like_its_values_in_float32() -> None:
    """NumPy, which computes the active level, has no bfloat16."""
    speech, noise = 0.03 * torch.randn(2, 16000, dtype=torch.bfloat16)
    mixed = mix(speech, noise, 5.0)
    assert mixed.dtype == torch.bfloat16
    expected = mix(speech.float(), noise.float(), 5.0)
    torch.testing.assert_close(mixed.float(), expected, atol=1e-3, rtol=0.02)


@pytest.mark.parametrize("rate", [16000, None])
def test_channels_of_a_recording_have_one_gain(rate: int | None) -> None:
    speech = torch.stack((hlsim.example_speech(), 0.1 * hlsim.example_speech()))
    noise = torch.stack((0.3 * torch.ones(64320), torch.ones(64320)))
    noisy = mix(speech.expand(3, 2, -1), noise.expand(3, 2, -1), 5.0, rate, channels=True)
    gains = (noisy - speech) / noise
    torch.testing.assert_close(gains, gains[:1, :1, :1].expand(3, 2, 64320), atol=1e-5, rtol=1e-3)
    added = (noisy - speech)[0]
    levels = [active_level_db(channel, 16000) for channel in speech] if rate else dbfs(speech)
    power = sum(10 ** (float(level) / 10) for level in levels)
    assert 10 * np.log10(power / float(added.square().mean(-1).sum())) == pytest.approx(5, abs=0.01)
    one_ear = mix(torch.stack((speech[0], 0 * speech[0])), noise, 5.0, rate, channels=True)
    assert bool(one_ear.isfinite().all())


def test_arrays_give_arrays_and_longer_noise_is_cut() -> None:
    speech, noise = hlsim.example_speech(), torch.randn(70000)
    noisy = hlsim.mix(speech.numpy(), noise.numpy(), 0)
    assert isinstance(noisy, np.ndarray)
    torch.testing.assert_close(torch.from_numpy(noisy), mix(speech, noise[:64320], 0.0))


STEREO = {"speech": torch.ones(2, 2, 1000), "noise": torch.ones(2, 2, 1000)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise": torch.ones(999)}, "repeat short noise"),
        ({"noise": torch.ones(2, 1000)}, "repeat short noise"),
        ({"channels": True}, "leave out channels for a single channel"),
        ({"noise": torch.zeros(1000)}, "expected noise, got silence"),
        ({"noise": torch.ones(1000, dtype=torch.complex64)}, "expected noise to be a floating"),
        ({"speech": torch.ones(1000, dtype=torch.int16)}, "expected speech to be a floating"),
        ({"noise": torch.full((1000,), torch.inf)}, "noise has samples that are NaN"),
        ({"speech": torch.full((1000,), torch.nan)}, "speech has samples that are NaN"),
        ({"snr": torch.tensor(float("nan"))}, "expected an SNR in dB"),
        ({"snr": float("nan")}, "expected snr to be a number, got nan"),
        ({"snr": "5"}, "expected snr to be a number, got '5'"),
        ({"snr": -1000.0}, "expected an SNR in dB, .* got -1000.0; choose a higher one"),
        ({"snr": torch.zeros(2)}, r"one per signal in the shape \(\), got the shape \(2,\)"),
        ({**STEREO, "snr": torch.zeros(2)}, r"one per signal in the shape \(2, 2\)"),
        (
            {**STEREO, "snr": torch.zeros(3), "channels": True},
            r"one per recording in the shape \(2",
        ),
        ({"sample_rate": 8000}, "8000"),
    ],
)
def test_what_cannot_be_mixed_is_rejected(changes: dict[str, Any], message: str) -> None:
    arguments = {"speech": torch.randn(1000), "noise": torch.randn(1000), "snr": 5.0} | changes
    with pytest.raises(ValueError, match=message):
        mix(**arguments)
