"""Audio files: reading gives the samples that were written, and errors name bad files."""

import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
import soundfile
import torch
from torch import Tensor

from hlsim.audio import (
    find_audio,
    read_audio,
    read_parts,
    scan_audio,
    write_audio,
    write_parts,
)


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.5, 0.5, shape).astype(np.float32)


@pytest.mark.parametrize("shape", [(3000,), (1, 3000), (6, 3000)])
def test_written_samples_are_read_again_and_equal_signals_give_equal_files(
    tmp_path: Path, shape: tuple[int, ...]
) -> None:
    waveform = (20.0 * torch.randn(shape, dtype=torch.float64)).requires_grad_()
    for name in ("a.wav", "b.WAV"):
        write_audio(tmp_path / name, waveform, 22050)
    samples, rate = read_audio(tmp_path / "a.wav")
    assert rate == 22050
    assert torch.equal(samples, torch.atleast_2d(waveform.detach().float()))
    assert (tmp_path / "a.wav").read_bytes() == (tmp_path / "b.WAV").read_bytes()


FORMATS: dict[str, dict[str, str]] = {
    "a.mp3": {}, "a.opus": {"format": "OGG", "subtype": "OPUS"}, "a.aiff": {}, "a.flac": {},
    "a.caf": {"subtype": "PCM_16"}, "a.w64": {}, "a.rf64": {}, "a.au": {}, "a.ogg": {},
    "a.sph": {"format": "NIST"}, "gsm.wav": {"subtype": "GSM610"},
    "g721.au": {"subtype": "G721_32"}, "adpcm.wav": {"subtype": "IMA_ADPCM"},
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_everything_that_libsndfile_reads_is_read_and_found(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    soundfile.write(path, noise(16000), 16000, **FORMATS[name])
    assert find_audio(tmp_path) == [path]
    assert read_audio(path)[0].shape[-1] == pytest.approx(16000, rel=0.05)


@pytest.mark.parametrize("name", ["a.mp3", "a.wav", "a.aiff", "a.au", "a.w64", "a.rf64"])
def test_a_truncated_file_is_read_with_a_warning(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    soundfile.write(path, noise(48000), 16000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(UserWarning, match=f"{re.escape(name)}: the file is truncated"):
        samples = read_audio(path)[0].shape[-1]
    with pytest.warns(UserWarning, match=f"{re.escape(name)}: the file is truncated"):
        assert scan_audio(path).samples == samples
    assert 0 < samples < 48000


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [2**32 - 1, 2**31 - 1, 2**31 - 2**12])
def test_a_size_that_was_unknown_when_a_file_was_begun_is_no_truncation(
    tmp_path: Path, size: int
) -> None:
    path = tmp_path / "piped.wav"
    soundfile.write(path, noise(1000), 16000)
    header, samples = path.read_bytes().split(b"data", 1)
    path.write_bytes(header + b"data" + size.to_bytes(4, "little") + samples[4:])
    assert read_audio(path)[0].shape == (1, 1000)


BAD_SIGNALS: dict[str, tuple[np.ndarray, int]] = {
    "empty": (noise(0), 16000),
    "silent": (np.zeros(100), 16000),
    "NaN": (noise(100) * np.nan, 16000),
    "infinite": (np.full(100, np.inf), 16000),
    "slow": (noise(100), 8000),
}


@pytest.mark.parametrize("kind", [*BAD_SIGNALS, "missing", "folder", "text"])
def test_a_bad_file_is_named_first(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "bad.wav"
    if kind == "folder":
        path.mkdir()
    elif kind == "text":
        path.write_text("This is no recording.\n")
    elif kind in BAD_SIGNALS:
        soundfile.write(path, *BAD_SIGNALS[kind], subtype="FLOAT")
    messages = set()
    for read in (read_audio, scan_audio):
        with pytest.raises(ValueError, match=f"^{path}: ") as caught:
            read(path)
        messages.add(str(caught.value))
    assert len(messages) == 1 and "\n" not in messages.pop()


@pytest.mark.parametrize(
    ("name", "waveform", "rate"),
    [
        ("a.mp3", torch.ones(10), 16000),
        ("a.wav", torch.tensor([0.0, float("nan")]), 16000),
        ("a.wav", torch.ones(2, 3, 10), 16000),
        ("a.wav", torch.ones(10), 8000),
        ("a.wav", torch.ones(10), 44100.5),
    ],
)
def test_what_cannot_be_written_leaves_nothing(
    tmp_path: Path, name: str, waveform: Tensor, rate: Any
) -> None:
    with pytest.raises(ValueError, match=r"expected|nothing was written"):
        write_audio(tmp_path / name, waveform, rate)
    assert not list(tmp_path.iterdir())


def test_a_failing_write_leaves_the_old_file(tmp_path: Path) -> None:
    path, old = tmp_path / "a.wav", torch.full((1, 10), 0.5)
    write_audio(path, old, 16000)

    def parts() -> Iterator[Tensor]:
        yield torch.rand(1, 5)
        raise OSError("disk full")

    with pytest.raises(ValueError, match="disk full"):
        write_parts(path, parts(), 1, 10, 16000)
    assert list(tmp_path.iterdir()) == [path] and torch.equal(read_audio(path)[0], old)


def test_files_of_folders_are_sorted_and_hidden_ones_left_out(tmp_path: Path) -> None:
    (tmp_path / "folder.wav").mkdir()
    for name in ("b/2.FLAC", "b/1.mp3", "a.wav", ".hidden.wav", "b/notes.txt", ".cache/c.wav"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = [path.relative_to(tmp_path).as_posix() for path in find_audio(tmp_path)]
    assert names == ["a.wav", "b/1.mp3", "b/2.FLAC"]
    for folder in (tmp_path / "folder.wav", tmp_path / "none"):
        with pytest.raises(ValueError, match=f"^{folder}: "):
            find_audio(folder)


def test_parts_of_a_recording_are_read_and_written_as_the_whole_one(tmp_path: Path) -> None:
    samples = torch.randn(2, 5000, generator=torch.Generator().manual_seed(0))
    write_audio(tmp_path / "whole.wav", samples, 16000)
    recording = scan_audio(tmp_path / "whole.wav")
    assert (recording.channels, recording.samples, recording.sample_rate) == (2, 5000, 16000)
    assert recording.power == pytest.approx(float(samples.square().mean()), rel=1e-5)
    bounds = [(0, 2000), (1500, 3000), (3000, 5000)]
    parts = list(read_parts(recording, bounds))
    for part, (start, stop) in zip(parts, bounds, strict=True):
        assert torch.equal(part, samples[:, start:stop])
    consecutive = [parts[0][:, :1500], *parts[1:]]
    write_parts(tmp_path / "parts.wav", consecutive, 2, 5000, 16000)
    expected = (tmp_path / "whole.wav").read_bytes()
    assert (tmp_path / "parts.wav").read_bytes() == expected
    write_audio(tmp_path / "whole.wav", samples[:, :4000], 16000)
    with pytest.raises(ValueError, match=r"whole\.wav: the file has changed; run again$") as raised:
        list(read_parts(recording, bounds))
    assert str(raised.value).count("whole.wav") == 1
    scipy.io.wavfile.write(tmp_path / "scipy.wav", 16000, samples.mT.numpy())
    assert (tmp_path / "scipy.wav").read_bytes() == expected


def test_a_part_that_is_not_finite_leaves_no_file(tmp_path: Path) -> None:
    parts = [torch.zeros(1, 10), torch.full((1, 10), math.nan)]
    with pytest.raises(ValueError, match="NaN or infinite"):
        write_parts(tmp_path / "out.wav", parts, 1, 20, 16000)
    with pytest.raises(ValueError, match="4 GB"):
        write_parts(tmp_path / "out.wav", parts, 1, 2**30, 16000)
    assert not list(tmp_path.iterdir())


def test_more_channels_than_can_be_read_are_rejected(tmp_path: Path) -> None:
    write_audio(tmp_path / "out.wav", torch.ones(1024, 10), 16000)
    assert len(read_audio(tmp_path / "out.wav")[0]) == 1024
    for channels in (1025, 20000):
        with pytest.raises(ValueError, match="channels to be a whole number from 1 to 1024"):
            write_audio(tmp_path / "out.wav", torch.ones(channels, 10), 16000)


def test_links_are_followed_unless_they_lead_nowhere(tmp_path: Path) -> None:
    corpus, elsewhere = tmp_path / "corpus", tmp_path / "elsewhere"
    for path in (corpus / "ann" / "1.wav", elsewhere / "deep" / "2.wav", elsewhere / "3.wav"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (corpus / "bob").symlink_to(elsewhere / "deep")
    (corpus / "3.wav").symlink_to(elsewhere / "3.wav")
    (corpus / "notes.txt").symlink_to(elsewhere / "none.txt")
    names = [path.relative_to(corpus).as_posix() for path in find_audio(corpus)]
    assert names == ["3.wav", "ann/1.wav", "bob/2.wav"]
    for name in ("4.wav", "eve"):
        link = corpus / name
        link.symlink_to(elsewhere / "none")
        with pytest.raises(ValueError, match=f"1 links lead to files .* such as {link};"):
            find_audio(corpus)
        link.unlink()


@pytest.mark.parametrize(
    "links",
    [
        {"a.wav": "deep/1.wav", "b.wav": "a.wav"},
        {"deep/z.wav": "1.wav", "a": "deep"},
        {"deep/b": "..", "deep/up": "."},
        {"a": "elsewhere", "b": "elsewhere"},
        {"b.wav": "../elsewhere/2.wav", "elsewhere/c": "../deep"},
    ],
)
def test_a_file_to_which_several_paths_lead_is_found_once(
    tmp_path: Path, links: dict[str, str]
) -> None:
    corpus = tmp_path / "corpus"
    for path in ("corpus/deep/1.wav", "elsewhere/2.wav"):
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).touch()
    (corpus / "elsewhere").symlink_to("../elsewhere")
    for name, target in links.items():
        (corpus / name).symlink_to(os.path.normpath(corpus / Path(name).parent / target))
    with pytest.warns(UserWarning, match=r"2 links are left out .*, such as .*corpus/"):
        files = find_audio(corpus)
    assert corpus / "deep/1.wav" in files
    assert len({path.resolve() for path in files}) == len(files) == 2
    names = find_audio(corpus, by_name=True)
    linked_files = {corpus / name for name in links if name.endswith(".wav")}
    assert {*files} | linked_files <= {*names} and len({*names}) == len(names)


def test_links_between_many_folders_are_followed_once(tmp_path: Path) -> None:
    folders = [tmp_path / f"{number:02}" for number in range(12)]
    for folder in folders:
        folder.mkdir()
        (folder / "1.wav").touch()
        for other in folders:
            (folder / other.name).symlink_to(other)
    with pytest.warns(UserWarning, match="144 links are left out"):
        assert find_audio(tmp_path) == [folder / "1.wav" for folder in folders]


def test_audio_that_libsndfile_cannot_read_is_counted(tmp_path: Path) -> None:
    for name in ("1.wav", "2.m4a", "3.M4A", "notes.txt"):
        (tmp_path / name).touch()
    with pytest.warns(UserWarning, match=r"2 files are left out .* such as .*2\.m4a"):
        assert find_audio(tmp_path) == [tmp_path / "1.wav"]


def test_a_tensor_with_the_negative_bit_is_written(tmp_path: Path) -> None:
    signal = torch.view_as_complex(torch.randn(100, 2).clamp(-1, 1)).conj().imag
    assert signal.is_neg()
    write_audio(tmp_path / "a.wav", signal, 16000)
    assert torch.equal(read_audio(tmp_path / "a.wav")[0][0], signal)


@pytest.mark.parametrize(
    ("channels", "samples", "words"),
    [(2, 20, "parts with 2 channels, got 1"), (1, 30, "20 samples together, expected 30")],
)
def test_parts_of_another_size_than_stated_leave_no_file(
    tmp_path: Path, channels: int, samples: int, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        write_parts(tmp_path / "a.wav", torch.zeros(2, 1, 10), channels, samples, 16000)
    assert not list(tmp_path.iterdir())


def test_the_first_invalid_sample_is_placed(tmp_path: Path) -> None:
    parts = torch.zeros(3, 2, 16000)
    parts[1, 1, 4000] = torch.nan
    with pytest.raises(ValueError, match=r"sample at 1\.250 s is NaN"):
        write_parts(tmp_path / "a.wav", parts, 2, 48000, 16000)
