"""Situations that users of other audio libraries reported give the right result, or say what to do.

Tests of files are in ``test_audio.py``, of tables in ``audiogram/test_table.py``, and of arrays
with time first in ``test_checks.py``.
"""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

import hlsim
from compensators import NALR, WDRC
from hlsim.audio import read_audio, write_audio
from hlsim.dsp.resample import resample
from hlsim.metrics import haspi

SPEECH = hlsim.example_speech()[8000:24000].clone()
ARRAY = SPEECH.numpy()


ARRAYS = {
    "reversed twice": ARRAY[::-1].copy()[::-1],
    "one reversed row": ARRAY[None][::-1],
    "big-endian, as in AIFF files": ARRAY.astype(">f4"),
    "read-only, as from np.load": np.frombuffer(ARRAY.tobytes(), dtype="f4"),
    "every other sample of a longer array": np.repeat(ARRAY, 2)[::2],
    "a list": ARRAY.tolist(),
    "80-bit floats": ARRAY.astype(np.longdouble),
    "masked": np.ma.masked_invalid(ARRAY),
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_every_kind_of_array_is_the_same_signal(kind: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        output = hlsim.compensate(ARRAYS[kind], "N3", compensator="nalr")
    expected = hlsim.compensate(ARRAY, "N3", compensator="nalr")
    np.testing.assert_allclose(output.reshape(-1), expected, atol=1e-6)


@pytest.mark.parametrize(
    "ear",
    [
        np.array([20, np.nan, 30, 40, 50, 55, 60, 60]),
        np.array([20, None, 30, 40, 50, 55, 60, 60], dtype=object),
        [20, None, 30, 40, 50, 55, 60, 60],
        {250: 20, 1000: 30, 2000: 40, 3000: 50, 4000: 55, 6000: 60, 8000: 60},
    ],
)
def test_a_threshold_that_was_not_measured_is_interpolated(ear: Any) -> None:
    expected = NALR()(SPEECH, [20, 25, 30, 40, 50, 55, 60, 60])
    torch.testing.assert_close(NALR()(SPEECH, ear), expected)


@pytest.mark.parametrize("dtype", [">f8", "i4", object])
def test_a_batch_of_ears_may_be_any_array(dtype: Any) -> None:
    ears = np.array([[20, 25, 30, 40, 50, 55, 60, 60], [10] * 8])
    batch = torch.stack([SPEECH, SPEECH])
    assert torch.equal(NALR()(batch, ears.astype(dtype)), NALR()(batch, torch.tensor(ears)))


def test_an_integer_rate_of_few_bits_does_not_overflow() -> None:
    faster = resample(SPEECH, np.uint16(16000), np.uint16(44100))
    assert torch.equal(faster, resample(SPEECH, 16000, 44100))


def test_stereo_is_resampled_along_time(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", np.stack([ARRAY, 0.5 * ARRAY], 1), 48000, subtype="FLOAT")
    channels, rate = hlsim.load_audio(tmp_path / "a.wav", spl=None, sample_rate=16000)
    assert rate == 16000
    torch.testing.assert_close(channels[0], resample(SPEECH, 48000, 16000))
    torch.testing.assert_close(channels[1], 0.5 * channels[0])


def test_a_stream_reads_a_buffer_that_is_filled_again() -> None:
    stream, buffer, outputs = WDRC().stream("N3"), torch.zeros(100), []
    for chunk in SPEECH[:2000].split(100):
        outputs.append(stream(buffer.copy_(chunk)))
    expected = WDRC().stream("N3")(SPEECH[:2000])
    torch.testing.assert_close(torch.cat(outputs), expected, atol=1e-6, rtol=0.0)


REJECTED: dict[str, tuple[Callable[[Path], object], str]] = {
    "samples as object": (lambda _: hlsim.simulate(np.array([None, 1.0]), "N3"), "floating-point"),
    "no samples": (lambda _: hlsim.simulate(None, "N3"), "expected a tensor or an array"),
    "16-bit integers": (lambda _: hlsim.simulate([1, 2], "N3"), "divide 16-bit samples by 32768"),
    "path": (lambda path: hlsim.simulate(path, "N3"), "got the path .*load_audio"),
    "samples with their rate": (
        lambda path: hlsim.simulate(hlsim.load_audio(path), "N3"),  # type: ignore[type-var]
        "got a tuple; write: speech, rate = hlsim.load_audio",
    ),
    "NaN": (
        lambda _: hlsim.compensate(SPEECH * torch.nan, "N3"),
        "audio has samples that are NaN or infinite",
    ),
    "infinity": (lambda _: hlsim.simulate(SPEECH / 0.0, "N3"), "audio has samples that are NaN"),
    "no player": (lambda _: hlsim.listen(), "pass signals by name"),
    "a batch to play": (lambda _: hlsim.listen(batch=torch.ones(3, 99)), "got .3, 99. for 'batch'"),
    "a diverged output to play": (
        lambda _: hlsim.listen(x=torch.ones(99) / 0.0),
        "NaN or infinite",
    ),
    "unknown aid": (lambda _: hlsim.compensate(SPEECH, "N3", compensator="none"), "'none'"),
    "URL": (lambda _: hlsim.load_audio("https://a.wav"), "there is no such audio file"),
    "rate as text": (lambda path: hlsim.load_audio(path, sample_rate="16000"), r"'16000' \(str\)"),
    "rate of 0": (lambda path: hlsim.load_audio(path, sample_rate=0), "got 0"),
    "rate of a telephone": (lambda path: hlsim.load_audio(path, sample_rate=8000), "from 16000"),
    "broken rate": (
        lambda _: resample(SPEECH, 16000, 22050.5),
        "whole number from 1 to 1000000 Hz, got 22050.5",
    ),
    "negative rate": (lambda _: resample(SPEECH, 16000, -8000), "got -8000"),
    "rate of a simulator as text": (
        lambda _: hlsim.simulate(SPEECH, "N3", sample_rate="16000"),
        r"got '16000' \(str\)",
    ),
    "rate of a score as text": (
        lambda _: haspi(SPEECH, SPEECH, "N3", sample_rate="16000"),
        r"got '16000' \(str\)",
    ),
    "rate to write as text": (lambda path: write_audio(path, SPEECH, "16000"), r"'16000' \(str\)"),
    "rate to write is None": (lambda path: write_audio(path, SPEECH, None), "NoneType"),
    "level as text": (lambda path: hlsim.load_audio(path, spl="65"), r"'65' \(str\)"),
    "full scale as text": (
        lambda _: hlsim.simulate(SPEECH, "N3", full_scale_spl="94"),
        r"got '94' \(str\)",
    ),
    "slider in per cent": (
        lambda _: hlsim.load_compensator("hearing-aid")(SPEECH, "N3", noise_reduction=70),
        "from 0 to 1, got 70",
    ),
    "a rate in place of the ear": (lambda _: haspi(SPEECH, SPEECH, 16000), "expected an audiogram"),
    "one output for two clean signals": (
        lambda _: haspi(SPEECH, torch.stack([SPEECH, SPEECH]), "N3"),
        "expected output and clean of the same shape",
    ),
    "channels last, to write": (lambda path: write_audio(path, SPEECH[:, None], 16000), "x.T"),
    "frequencies in kHz": (lambda _: NALR({0.25: 20, 1: 30, 4: 50}), "multiply kHz by 1000"),
    "levels below 0": (lambda _: NALR([-35] * 8), "from -10 to 120 dB HL"),
}


@pytest.mark.parametrize("situation", REJECTED)
def test_a_mistake_is_rejected_with_what_was_expected(situation: str, tmp_path: Path) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, ARRAY, 16000)
    call, message = REJECTED[situation]
    with pytest.raises(ValueError, match=message):
        call(path)
    assert read_audio(path)[1] == 16000  # also where the call was to overwrite it
