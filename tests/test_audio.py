"""Audio files: what comes back, and bad files named."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from torch import Tensor

from hlsim.audio import encode_flac, find_audio, list_files, read_audio, write_audio


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.5, 0.5, shape).astype(np.float32)


@pytest.mark.parametrize(("suffix", "step"), [(".wav", 0.0), (".WAV", 0.0), (".flac", 2.0**-24)])
@pytest.mark.parametrize("channels", [1, 2, 6])
def test_wav_and_flac_come_back_to_the_sample(
    tmp_path: Path, suffix: str, step: float, channels: int
) -> None:
    waveform = torch.empty(channels, 3000).uniform_(-0.99, 0.99)
    write_audio(tmp_path / f"a{suffix}", waveform, 22050)
    back, rate = read_audio(tmp_path / f"a{suffix}")
    assert rate == 22050 and back.shape == waveform.shape and back.dtype == torch.float32
    assert float((back - waveform).abs().max()) <= step


def test_ogg_comes_back_aligned_and_close(tmp_path: Path, speech: list[tuple[Tensor, int]]) -> None:
    waveform, rate = speech[0]
    write_audio(tmp_path / "a.ogg", waveform, rate)
    back, read_rate = read_audio(tmp_path / "a.ogg")
    assert (back.shape, read_rate) == (waveform.shape, rate)
    assert float((back - waveform).square().sum() / waveform.square().sum()) < 0.02


def test_wav_holds_more_than_full_scale_and_one_signal_is_one_file(tmp_path: Path) -> None:
    waveform = torch.tensor([3.5, -20.0, 0.25], dtype=torch.float64, requires_grad=True)
    for name in ("a.wav", "b.wav"):
        write_audio(tmp_path / name, waveform, 48000)
    assert torch.equal(read_audio(tmp_path / "a.wav")[0], waveform.detach().float()[None])
    assert (tmp_path / "a.wav").read_bytes() == (tmp_path / "b.wav").read_bytes()


FORMATS: dict[str, dict[str, str]] = {
    "a.mp3": {}, "a.opus": {"format": "OGG", "subtype": "OPUS"}, "a.aiff": {},
    "a.caf": {"subtype": "PCM_16"}, "a.w64": {}, "a.rf64": {}, "a.au": {},
    "a.sph": {"format": "NIST"}, "gsm.wav": {"subtype": "GSM610"},
    "g721.au": {"subtype": "G721_32"}, "adpcm.wav": {"subtype": "IMA_ADPCM"},
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_everything_that_libsndfile_reads_is_read_and_found(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    soundfile.write(path, noise(16000), 16000, **FORMATS[name])
    assert find_audio(tmp_path) == [path]
    assert read_audio(path)[0].shape[-1] == pytest.approx(16000, rel=0.05)


def test_a_file_longer_than_a_block_is_read_whole(tmp_path: Path) -> None:
    samples = noise(2**20 + 5)
    soundfile.write(tmp_path / "a.wav", samples, 48000, subtype="FLOAT")
    assert np.array_equal(read_audio(tmp_path / "a.wav")[0][0].numpy(), samples)


def test_a_truncated_file_is_read_with_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "a.mp3"
    soundfile.write(path, noise(48000), 16000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(UserWarning, match=r"a\.mp3: the file is truncated"):
        assert 0 < read_audio(path)[0].shape[-1] < 48000


def bad_file(kind: str, path: Path) -> None:
    if kind == "folder":
        path.mkdir()
    elif kind in ("text", "no_bytes"):
        path.write_text("This is no recording.\n" * 20 if kind == "text" else "")
    else:
        changed = {"NaN": np.nan, "infinite": -np.inf}
        samples = noise({"empty": 0}.get(kind, 100)) * (kind != "silent")
        samples[50:51] = changed.get(kind, samples[50:51])
        rate = {"slow": 8000, "fast": 96000}.get(kind, 16000)
        soundfile.write(path, samples, rate, subtype="FLOAT")


BAD_FILES = "missing folder text no_bytes empty silent NaN infinite slow fast".split()


@pytest.mark.parametrize("kind", BAD_FILES)
def test_a_bad_file_is_named_first(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "bad.wav"
    if kind != "missing":
        bad_file(kind, path)
    with pytest.raises(ValueError, match=f"^{path}: ") as caught:
        read_audio(path)
    assert "\n" not in str(caught.value)


def test_faster_files_can_be_read(tmp_path: Path) -> None:
    bad_file("fast", tmp_path / "a.wav")
    assert read_audio(tmp_path / "a.wav", any_rate=True)[1] == 96000
    bad_file("slow", tmp_path / "b.wav")
    with pytest.raises(ValueError, match="8000 Hz"):
        read_audio(tmp_path / "b.wav", any_rate=True)


@pytest.mark.parametrize(
    ("name", "waveform", "rate"),
    [
        ("a.mp3", torch.ones(10), 16000),
        ("a", torch.ones(10), 16000),
        ("a.wav", torch.tensor([0.0, float("nan")]), 16000),
        ("a.flac", torch.tensor([0.0, -1.5]), 16000),
        ("a.ogg", torch.tensor([0.0, 1.5]), 16000),
        ("a.ogg", torch.ones(3, 10), 16000),
        ("a.ogg", torch.ones(10), 200_001),
        ("a.flac", torch.ones(9, 10), 16000),
        ("a.wav", torch.ones(2, 3, 10), 16000),
        ("a.wav", torch.ones(10), 8000),
        ("a.wav", torch.ones(10), 44100.5),
    ],
)
def test_what_cannot_be_written_leaves_nothing(
    tmp_path: Path, name: str, waveform: Tensor, rate: Any
) -> None:
    with pytest.raises(ValueError, match=f"^{tmp_path / name}: "):
        write_audio(tmp_path / name, waveform, rate)
    assert not list(tmp_path.iterdir())


def test_a_failing_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, old = tmp_path / "a.flac", torch.full((1, 10), 0.5)
    write_audio(path, old, 16000)

    def write_half(file: Path, *_: object, **__: object) -> None:
        file.write_bytes(b"fLaC")
        raise OSError("disk full")

    monkeypatch.setattr(soundfile, "write", write_half)
    with pytest.raises(ValueError, match="disk full"):
        write_audio(path, torch.rand(1, 10), 16000)
    assert os.listdir(tmp_path) == ["a.flac"] and torch.equal(read_audio(path)[0], old)


def test_files_of_folders_are_sorted_and_hidden_ones_left_out(tmp_path: Path) -> None:
    (tmp_path / "folder.wav").mkdir()
    for name in ("b/2.FLAC", "b/1.mp3", "a.wav", ".hidden.wav", "b/notes.txt", ".cache/c.wav"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    audio, other_files = list_files(tmp_path)
    names = [
        [path.relative_to(tmp_path).as_posix() for path in files] for files in (audio, other_files)
    ]
    assert names == [["a.wav", "b/1.mp3", "b/2.FLAC"], ["b/notes.txt"]]
    for folder in (tmp_path / "folder.wav", tmp_path / "none"):
        with pytest.raises(ValueError, match=f"^{folder}: "):
            find_audio(folder)


def test_encoded_flac_is_the_signal_to_16_bits(tmp_path: Path) -> None:
    signal = torch.linspace(-1.0, 0.99, 16000)
    (tmp_path / "x.flac").write_bytes(encode_flac(signal, 16000))
    back, rate = read_audio(tmp_path / "x.flac")
    assert rate == 16000 and float((back[0] - signal).abs().max()) <= 2**-15
    for bad in (signal * 2, torch.zeros(1, 2, 10), signal / 0):
        with pytest.raises(ValueError, match="expected shape"):
            encode_flac(bad, 16000)
