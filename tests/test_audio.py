"""Audio files, whole or not at all; bad ones named."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from scipy.io import wavfile
from torch import Tensor

from hlsim.audio import (
    encode_flac,
    find_audio,
    read_audio,
    read_stretch,
    write_audio,
)
from hlsim.files import EXTENSIONS


@pytest.mark.parametrize(("suffix", "step"), [(".wav", 0.0), (".flac", 2.0**-24)])
@pytest.mark.parametrize("channels", [1, 2])
def test_wav_and_flac_come_back_to_the_sample(
    tmp_path: Path, suffix: str, step: float, channels: int
) -> None:
    wave = torch.empty(channels, 3000).uniform_(-0.99, 0.99)
    write_audio(tmp_path / f"a{suffix}", wave, 22050)
    back, rate = read_audio(tmp_path / f"a{suffix}")
    assert rate == 22050
    assert back.shape == wave.shape and back.dtype == torch.float32
    assert float((back - wave).abs().max()) <= step


def test_wav_holds_more_than_full_scale(tmp_path: Path) -> None:
    wave = torch.tensor([[3.5, -20.0, 0.25]])
    write_audio(tmp_path / "a.wav", wave, 48000)
    assert torch.equal(read_audio(tmp_path / "a.wav")[0], wave)


def test_ogg_comes_back_aligned_and_close(tmp_path: Path, speech: list[tuple[Tensor, int]]) -> None:
    wave, rate = speech[0]
    write_audio(tmp_path / "a.ogg", wave, rate)
    back, read_rate = read_audio(tmp_path / "a.ogg")
    assert (back.shape, read_rate) == (wave.shape, rate)
    assert float((back - wave).square().sum() / wave.square().sum()) < 0.02


def test_one_dimension_is_one_channel_and_upper_case_is_an_extension(tmp_path: Path) -> None:
    wave = torch.rand(500)
    write_audio(tmp_path / "a.WAV", wave.double().requires_grad_(), 16000)
    assert torch.equal(read_audio(tmp_path / "a.WAV")[0], wave.unsqueeze(0))


def test_writing_over_a_file_replaces_it_and_leaves_nothing_else(tmp_path: Path) -> None:
    for level in (0.1, 0.2):
        write_audio(tmp_path / "a.flac", torch.full((100,), level), 16000)
    assert os.listdir(tmp_path) == ["a.flac"]
    assert float(read_audio(tmp_path / "a.flac")[0].mean()) == pytest.approx(0.2, abs=1e-6)


def test_one_sound_is_one_file(tmp_path: Path) -> None:
    sound = 3.0 * torch.rand(2, 100)
    for name in ("a.wav", "b.wav"):
        write_audio(tmp_path / name, sound, 44100)
    first, second = ((tmp_path / name).read_bytes() for name in ("a.wav", "b.wav"))
    assert first == second and b"PEAK" not in first  # libsndfile's chunk with the time of day
    assert torch.equal(read_audio(tmp_path / "a.wav")[0], sound)


@pytest.mark.parametrize("failure", [OSError("disk full"), KeyboardInterrupt()])
@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize(("ending", "writer"), [("wav", wavfile), ("flac", soundfile)])
def test_a_failing_write_leaves_what_was_there(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    failure: BaseException,
    before: bool,
    ending: str,
    writer: Any,
) -> None:
    path = tmp_path / f"a.{ending}"
    old = torch.full((1, 10), 0.5)
    if before:
        write_audio(path, old, 16000)

    def half_written(file: str, *args: Any, **kwargs: Any) -> None:
        Path(file).write_bytes(b"RIFF")
        raise failure

    monkeypatch.setattr(writer, "write", half_written)
    with pytest.raises((ValueError, KeyboardInterrupt)) as caught:
        write_audio(path, torch.rand(1, 10), 16000)
    if isinstance(failure, OSError):
        assert str(caught.value) == f"{path}: cannot be written (disk full)"
    assert os.listdir(tmp_path) == ([path.name] if before else [])
    if before:
        assert torch.equal(read_audio(path)[0], old)


@pytest.mark.parametrize(
    ("name", "wave", "said"),
    [
        ("a.mp3", torch.zeros(10), r"cannot write \.mp3; allowed: \.wav, \.flac, \.ogg"),
        ("a", torch.zeros(10), "cannot write a file without extension"),
        ("a.wav", torch.tensor([0.0, float("nan")]), "NaN or infinite"),
        ("a.wav", torch.tensor([0.0, float("inf")]), "NaN or infinite"),
        (
            "a.flac",
            torch.tensor([0.0, -1.5]),
            r"samples reach 1\.5, \.flac holds 1\.0; write \.wav",
        ),
        ("a.ogg", torch.tensor([0.0, 1.5]), r"samples reach 1\.5, \.ogg holds 1\.0; write \.wav"),
        ("a.flac", torch.zeros(9, 10), "cannot be written"),
        (
            "a.OGG",
            torch.zeros(3, 10),
            r"3 channels; allowed: up to 2 in \.ogg, more in \.wav and \.flac",
        ),
        (
            "a.wav",
            torch.zeros(2, 3, 10),
            r"shape \(2, 3, 10\); allowed: \(channels, time\) or \(time,\)",
        ),
        ("nowhere/a.wav", torch.zeros(10), "cannot be written"),
    ],
)
def test_what_cannot_be_written(tmp_path: Path, name: str, wave: Tensor, said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        write_audio(tmp_path / name, wave, 16000)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rate", [8000, 0, "16k", None])
@pytest.mark.parametrize("suffix", EXTENSIONS)
def test_rates_that_could_not_be_read_again_are_not_written(
    tmp_path: Path, suffix: str, rate: Any
) -> None:
    with pytest.raises(
        ValueError, match=rf"sample rate {rate!r} Hz; allowed: 16000 to 48000"
    ) as caught:
        write_audio(tmp_path / f"a{suffix}", torch.zeros(10), rate)
    assert str(caught.value).startswith(str(tmp_path))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("suffix", "most"), [(".wav", 2**31 - 1), (".flac", 655350), (".ogg", 200000)]
)
def test_rates_that_a_file_cannot_hold_are_not_written(
    tmp_path: Path, suffix: str, most: int
) -> None:
    wrong: list[Any] = [most + 1, 96000.5, 9_000_000_000]
    for beyond in wrong:
        with pytest.raises(
            ValueError, match=rf"sample rate {beyond} Hz; .* whole numbers up to {most}"
        ):
            write_audio(tmp_path / f"a{suffix}", torch.zeros(10), beyond)
    assert not list(tmp_path.iterdir())


def test_whole_rates_of_any_type_are_written(tmp_path: Path) -> None:
    rates: list[Any] = [44100.0, np.int64(44100), np.float32(44100)]
    for rate in rates:
        write_audio(tmp_path / "a.wav", torch.ones(10), rate)
        assert read_audio(tmp_path / "a.wav")[1] == 44100
        assert encode_flac(torch.ones(10), rate) == encode_flac(torch.ones(10), 44100)
    wrong: list[Any] = [96000.5, 9_000_000_000, 0, None, 65537]
    for bad in wrong:
        with pytest.raises(ValueError, match=f"sample rate {bad} Hz"):
            encode_flac(torch.ones(10), bad)


def bad_file(kind: str, path: Path) -> None:
    noise = np.random.default_rng(0).uniform(-0.5, 0.5, 100).astype(np.float32)
    match kind:
        case "text":
            path.write_text("This is no recording.\n" * 20)
        case "no bytes":
            path.write_bytes(b"")
        case "cut":
            whole = path.with_name("whole.flac")
            soundfile.write(whole, noise, 16000)
            path.write_bytes(whole.read_bytes()[:30])
        case "no samples":
            soundfile.write(path, noise[:0], 16000)
        case "silent":
            soundfile.write(path, 0 * noise, 16000)
        case "NaN":
            noise[50] = np.nan
            soundfile.write(path, noise, 16000, subtype="FLOAT")
        case "infinite":
            noise[50] = -np.inf
            soundfile.write(path, noise, 16000, subtype="FLOAT")
        case "slow":
            soundfile.write(path, noise, 8000)
        case "fast":
            soundfile.write(path, noise, 96000)
        case "folder":
            path.mkdir()


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("missing", "no such file"),
        ("folder", "no such file"),
        ("text", "not readable as audio .*; allowed: wav, flac, ogg"),
        ("no bytes", "not readable as audio"),
        ("cut", "not readable as audio"),
        ("no samples", "empty, no samples"),
        ("silent", "silent, every sample is zero"),
        ("NaN", "NaN or infinite"),
        ("infinite", "NaN or infinite"),
        ("slow", "sample rate 8000 Hz; allowed: 16000 to 48000"),
        ("fast", "sample rate 96000 Hz; allowed: 16000 to 48000"),
    ],
)
def test_a_bad_file_is_named_first(tmp_path: Path, kind: str, said: str) -> None:
    path = tmp_path / "bad.wav"
    bad_file(kind, path)
    with pytest.raises(ValueError, match=said) as caught:
        read_audio(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_faster_files_can_be_let_through(tmp_path: Path) -> None:
    wave = torch.rand(1, 50)
    write_audio(tmp_path / "a.wav", wave, 96000)
    back, rate = read_audio(tmp_path / "a.wav", any_rate=True)
    assert rate == 96000 and torch.equal(back, wave)
    bad_file("slow", tmp_path / "b.wav")
    with pytest.raises(ValueError, match="sample rate 8000 Hz"):
        read_audio(tmp_path / "b.wav", any_rate=True)


def test_find_audio_looks_into_folders_and_sorts(tmp_path: Path) -> None:
    (tmp_path / "folder.wav").mkdir()
    for name in ("b/2.FLAC", "b/1.ogg", "a.wav", ".hidden.wav", "b/notes.txt", ".cache/c.wav"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [p.relative_to(tmp_path).as_posix() for p in find_audio(tmp_path)] == [
        "a.wav",
        "b/1.ogg",
        "b/2.FLAC",
    ]


def test_a_name_that_is_not_utf_8_is_named_before_the_work(tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.wav"))
    try:
        path.touch()
    except OSError:
        pytest.skip("this disk takes no such names")
    (tmp_path / "good.wav").touch()
    for read in (lambda: find_audio(tmp_path), lambda: read_audio(path)):
        with pytest.raises(ValueError, match=r"caf\\xe9\.wav: its name is not UTF-8; rename it"):
            read()


def test_a_header_that_tells_of_more_than_memory_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "long.flac"
    write_audio(path, torch.rand(100), 16000)
    data = bytearray(path.read_bytes())
    data[21:26] = bytes([data[21] | 0x0F, *[0xFF] * 4])  # the number of samples
    path.write_bytes(data)
    assert soundfile.info(str(path)).frames == 2**36 - 1
    with pytest.raises(
        ValueError, match=r"its header tells of 68719476735 samples; allowed: up to 4294967296"
    ):
        read_audio(path)
    data[21] &= 0xF0
    path.write_bytes(data)

    def refuse(
        *args: object, **kwargs: object
    ) -> None:  # whether the system would, depends on its settings
        raise MemoryError("Unable to allocate 16. GiB")

    monkeypatch.setattr(np, "empty", refuse)
    with pytest.raises(ValueError, match=r"long\.flac: not readable as audio \(Unable to allocate"):
        read_audio(path)


def test_find_audio_says_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no audio in it; looked for \.wav, \.flac, \.ogg"):
        find_audio(tmp_path)
    for path in (tmp_path / "none", Path(__file__)):
        with pytest.raises(ValueError, match="no such folder") as caught:
            find_audio(path)
        assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("header", ["plain", "chunk before", "odd"])
def test_a_wav_cut_off_is_named(tmp_path: Path, header: str) -> None:
    path = tmp_path / "cut.wav"
    soundfile.write(
        path, np.full(101, 0.25), 16000, subtype="PCM_U8" if header == "odd" else "PCM_16"
    )
    whole = path.read_bytes()
    place = whole.index(b"data")
    if header == "chunk before":
        whole = whole[:place] + b"LIST\x03\0\0\0abc\0" + whole[place:]
    size = {"odd": 101}.get(header, 202)
    end = whole.index(b"data") + 8 + size
    for held in (size, size - 1, 2):
        path.write_bytes(whole[: end - size + held])
        for read in (read_audio, lambda name: read_stretch(name, 0.0, 0.001)):
            if held == size:  # the odd one without its byte of padding
                assert bool((read(path)[0] == 0.25).all())
                continue
            with pytest.raises(
                ValueError, match=f"{size} bytes of samples, {held} are there"
            ) as caught:
                read(path)
            assert str(caught.value).startswith(f"{path}: cut off") and "\n" not in str(
                caught.value
            )


@pytest.mark.parametrize("size", [0, 0x7FFFF000, 0xFFFFFFFF])
def test_a_streamed_wav_does_not_know_its_length(tmp_path: Path, size: int) -> None:
    path = tmp_path / "streamed.wav"
    soundfile.write(path, np.full(100, 0.25), 16000)
    data = bytearray(path.read_bytes())
    place = data.index(b"data") + 4
    data[4:8] = data[place : place + 4] = size.to_bytes(4, "little")
    path.write_bytes(data)
    if size:
        assert bool((read_audio(path)[0] == 0.25).all())
    else:  # libsndfile's own answer
        with pytest.raises(ValueError, match="empty"):
            read_audio(path)


@pytest.mark.parametrize("format", ["RF64", "W64", "FLAC", "OGG"])
def test_other_formats_are_left_to_libsndfile(tmp_path: Path, format: str) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, np.full(1000, 0.25), 16000, format=format)
    assert read_audio(path)[0].shape == (1, 1000)


def test_encoded_flac_is_the_signal_to_16_bits(tmp_path: Path) -> None:
    signal = torch.linspace(-1.0, 0.99, 16000)
    data = encode_flac(signal, 16000)
    assert data.startswith(b"fLaC")
    (tmp_path / "x.flac").write_bytes(data)
    back, rate = read_audio(tmp_path / "x.flac")
    assert rate == 16000 and float((back[0] - signal).abs().max()) <= 2**-15
    for bad in (signal * 2, torch.zeros(2, 10), signal / 0):
        with pytest.raises(ValueError, match=r"allowed: \(time,\), samples from -1\.0 to 1\.0"):
            encode_flac(bad, 16000)


@pytest.mark.parametrize("ending", [".ogg", ".wav"])
@pytest.mark.parametrize("share", [0.5, 0.99])
def test_a_file_that_was_cut_off_is_refused(tmp_path: Path, ending: str, share: float) -> None:
    path = tmp_path / f"a{ending}"
    soundfile.write(path, np.random.default_rng(0).uniform(-0.1, 0.1, 48000), 16000)
    read_audio(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    for read in (read_audio, lambda path: read_stretch(path, 0.0, 1.0)):
        with pytest.raises(ValueError, match=r"a\.\w+: cut off"):
            read(path)


@pytest.mark.parametrize(("rate", "channels"), [(1_000_000_000, 1), (16000, 250)])
def test_a_header_that_would_fill_the_memory_is_not_believed(
    tmp_path: Path, rate: int, channels: int
) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, np.full((1000, channels), 0.1), rate)
    with pytest.raises(
        ValueError, match=f"a.wav: its header tells of {rate} Hz and {channels} channels; allowed"
    ):
        read_audio(path, any_rate=True)


def test_samples_whose_powers_overflow_are_refused(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", np.full(1000, 1e18), 16000, subtype="FLOAT")
    with pytest.raises(ValueError, match=r"a\.wav: samples reach 1e\+18; allowed: up to 1e\+09"):
        read_audio(tmp_path / "a.wav")
