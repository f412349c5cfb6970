"""Reading, writing and listing of audio files.

Long recordings are read by ``scan_audio`` and ``read_parts``, and written by ``write_parts``, so
that only a part of them is in memory.
"""

import math
import os
import re
import struct
import warnings
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile
import torch
from torch import Tensor

from hlsim.checks import LOWEST_RATE, check_number, check_rate, check_waveform
from hlsim.files import atomic_path

EXTENSIONS = tuple(
    ".wav .flac .ogg .oga .opus .mp3 .aif .aiff .aifc .au .snd .caf .w64 .rf64 .sph .voc".split()
)
"""Extensions by which audio files are found in folders. libsndfile reads all of these formats."""

_SCANNED_SAMPLES = 250_000
"""Number of samples per channel that are read at once to scan a recording."""

_LARGEST_SIZE = 2**32 - 1
"""Largest size in bytes that the header of a WAV file can state."""

_STATED_SIZE = re.compile(r": (\d+) \(should be (\d+)\)")
"""Line of libsndfile's log: the size in bytes that a header states, and the actual one."""

_SMALLEST_UNKNOWN_SIZE = 2**31 - 2**16
"""Smallest size in bytes that stands for an unknown one, as programs write it into a pipe."""

_HEADER = struct.Struct("<4sI4s4sIHHIIHHH4sII4sI")
"""Header of a WAV file in 32-bit float: the chunks RIFF, fmt and fact, and the head of data."""

_MOST_CHANNELS = 1024
"""Largest number of channels that libsndfile reads."""

_OTHER_EXTENSIONS = (".m4a", ".aac", ".wma", ".amr", ".ape", ".wv", ".shn")
"""Extensions of audio files that libsndfile does not read."""


def read_audio(path: str | Path) -> tuple[Tensor, int]:
    """Read an audio file in any format that libsndfile reads, such as WAV, FLAC, Ogg or MP3.

    If libsndfile detects that a file is truncated, the file is read up to its end with a warning,
    as WAV, or rejected, as FLAC.

    Args:
        path: Audio file with a sample rate of 16 kHz or more.

    Returns:
        The samples in float32, (channels, time), where 1.0 is full scale, and the sample rate in
        Hz.

    Raises:
        ValueError: There is no such file; libsndfile cannot read it; it is empty, silent, or
            contains NaN or infinity; or its sample rate is below 16 kHz.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> samples, rate = read_audio(EXAMPLE_FILE)
    >>> samples.shape, rate
    (torch.Size([1, 64320]), 16000)
    """
    with _open_audio(path) as file:
        rate = file.samplerate
        samples = file.read(file.frames, dtype="float32", always_2d=True)
        _warn_if_truncated(file, len(samples))
    waveform = torch.from_numpy(samples.T.copy())
    _check_contents(path, rate, bool(waveform.isfinite().all()), bool(waveform.any()))
    return waveform, rate


@dataclass(frozen=True)
class AudioInfo:
    """Properties of an audio file, from ``scan_audio``.

    Attributes:
        path: Path of the file.
        sample_rate: Sample rate in Hz.
        channels: Number of channels.
        samples: Number of samples per channel.
        power: Mean square of all samples of all channels, where 1.0 is full scale.

    >>> AudioInfo(Path("noise.wav"), sample_rate=16000, channels=2, samples=320, power=0.01).samples
    320
    """

    path: Path
    sample_rate: int
    channels: int
    samples: int
    power: float


def scan_audio(path: str | Path) -> AudioInfo:
    """Read an audio file once, a part at a time, and return its ``AudioInfo``.

    The samples are not kept in memory. Truncated files are treated as by ``read_audio``.

    Args:
        path: Audio file with a sample rate of 16 kHz or more.

    Raises:
        ValueError: The file is one that ``read_audio`` rejects.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> recording = scan_audio(EXAMPLE_FILE)
    >>> recording.samples, recording.sample_rate, recording.channels
    (64320, 16000, 1)
    """
    energy, samples = 0.0, 0
    with _open_audio(path) as file:
        rate, channels = file.samplerate, file.channels
        # Of a truncated file, ``file.blocks`` returns samples beyond its end.
        while len(block := file.read(_SCANNED_SAMPLES, dtype="float32", always_2d=True)):
            samples += len(block)
            energy += float(np.square(block, dtype=np.float64).sum())
        _warn_if_truncated(file, samples)
    _check_contents(path, rate, math.isfinite(energy), energy > 0.0)
    return AudioInfo(Path(path), rate, channels, samples, energy / (samples * channels))


def read_parts(recording: AudioInfo, bounds: Iterable[tuple[int, int]]) -> Iterator[Tensor]:
    """Yield parts of a recording, each of which is read only when it is needed.

    Args:
        recording: Properties of the recording, from ``scan_audio``.
        bounds: Half-open range of samples of each part. The first part begins at 0. Each later one
            begins and ends later than the one before; it may overlap with it, and leaves no gap.

    Yields:
        Samples in float32, (channels, time), where 1.0 is full scale.

    Raises:
        ValueError: The file is missing, cannot be read, or ends before one of the parts does.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> parts = read_parts(scan_audio(EXAMPLE_FILE), [(0, 1000), (900, 2000)])
    >>> [part.shape for part in parts]
    [torch.Size([1, 1000]), torch.Size([1, 1100])]
    """
    with _open_audio(recording.path) as file:
        part = np.empty((0, recording.channels), np.float32)
        part_start = 0
        for start, stop in bounds:
            part = part[start - part_start :]
            count = stop - start - len(part)
            part = np.concatenate((part, file.read(count, dtype="float32", always_2d=True)))
            part_start = start
            if len(part) < stop - start:
                raise ValueError(f"{recording.path}: the file has changed; run again")
            yield torch.from_numpy(part.T.copy())


@contextmanager
def _open_audio(path: str | Path) -> Iterator[soundfile.SoundFile]:
    """Open an audio file for a ``with`` block.

    Raises:
        ValueError: There is no such file, it is no audio, or the block raised an exception.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path}: there is no such audio file; correct the path")
    try:
        with soundfile.SoundFile(path) as file:
            yield file
    except ValueError:
        raise
    except Exception as error:  # For broken files, soundfile raises exceptions of many types.
        raise ValueError(f"{path}: cannot be read as audio: {error}") from error


def _check_contents(path: str | Path, rate: int, is_finite: bool, has_sound: bool) -> None:
    """Raise ValueError if a recording has a low sample rate, NaN or infinity, or no sound."""
    if rate < LOWEST_RATE:
        raise ValueError(
            f"{path}: the sample rate is {rate} Hz, expected {LOWEST_RATE} Hz or more; use another "
            f"recording, because this one has no sound above {rate / 2:g} Hz"
        )
    if not is_finite:
        raise ValueError(f"{path}: some samples are NaN or infinite; replace or remove the file")
    if not has_sound:
        raise ValueError(f"{path}: the file is empty or silent; replace or remove it")


def _warn_if_truncated(file: soundfile.SoundFile, samples: int) -> None:
    """Warn if a file ends before its header says so.

    Args:
        file: Open file, which was read to its end.
        samples: Number of samples per channel that could be read.
    """
    # Of files without compression, libsndfile counts the samples that are there, and logs the rest.
    sizes = [(int(stated), int(size)) for stated, size in _STATED_SIZE.findall(file.extra_info)]
    if samples < file.frames or any(
        size < stated < _SMALLEST_UNKNOWN_SIZE for stated, size in sizes
    ):
        warnings.warn(
            f"{file.name}: the file is truncated; its header states a longer duration than the "
            f"{samples} samples per channel that could be read",
            stacklevel=3,
        )


def write_audio(path: str | Path, waveform: Tensor, sample_rate: int) -> None:
    """Write a WAV file with samples in 32-bit float, completely or not at all.

    Samples are not scaled, so the level in dB SPL is that of the waveform at the same full scale.

    Args:
        path: File to write.
        waveform: Samples, (channels, time) or (time,), where 1.0 is full scale.
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Raises:
        ValueError: The extension is not .wav, the waveform is not a floating-point tensor, its
            shape or the sample rate is not supported, the signal has no samples, more than 1024
            channels, or is too long for a WAV file (4 GB), a sample is NaN, infinite or (on the
            CPU) above 1e9 in magnitude, or the file cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_audio(f"{folder}/noise.wav", 0.1 * torch.randn(2, 16000), 16000)
    ...     read_audio(f"{folder}/noise.wav")[0].shape
    torch.Size([2, 16000])
    """
    samples = torch.atleast_2d(check_waveform(waveform))
    if samples.ndim > 2:
        shape = tuple(samples.shape)
        raise ValueError(f"{path}: expected shape (channels, time) or (time,), got {shape}")
    channels, time = samples.shape
    write_parts(path, [samples], channels, time, sample_rate)


def write_parts(
    path: str | Path, parts: Iterable[Tensor], channels: int, samples: int, sample_rate: int
) -> None:
    """Write a WAV file with samples in 32-bit float part by part, completely or not at all.

    Args:
        path: File to write.
        parts: Consecutive parts of the signal, (channels, time), where 1.0 is full scale.
        channels: Number of channels, at most 1024.
        samples: Number of samples per channel of all parts together.
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Raises:
        ValueError: The extension is not .wav, the sample rate or the number of channels is not
            supported, the signal is too long for a WAV file (4 GB), samples are NaN or infinite,
            the parts have another number of channels or samples, or the file cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_parts(f"{folder}/noise.wav", 0.1 * torch.randn(2, 1, 16000), 1, 32000, 16000)
    ...     read_audio(f"{folder}/noise.wav")[0].shape
    torch.Size([1, 32000])
    """
    if Path(path).suffix.lower() != ".wav":
        raise ValueError(f"{path}: expected the extension .wav; convert the file afterwards")
    rate = check_rate(sample_rate)
    check_number("the number of channels", channels, 1, _MOST_CHANNELS, whole=True)
    frame_bytes = 4 * channels
    data_bytes = frame_bytes * samples
    riff_bytes = _HEADER.size - 8 + data_bytes
    if riff_bytes > _LARGEST_SIZE:
        raise ValueError(f"{path}: the output exceeds the 4 GB of a WAV file; split the recording")
    # libsndfile would store the time of day, and equal signals would give different files.
    float_format = 18, 3, channels, rate, rate * frame_bytes, frame_bytes, 32, 0
    header = _HEADER.pack(
        *(b"RIFF", riff_bytes, b"WAVE", b"fmt "),
        *float_format,
        *(b"fact", 4, samples, b"data", data_bytes),
    )
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(header)
        written = 0
        for part in parts:
            values = part.detach().to("cpu", torch.float32).resolve_neg()
            invalid_times = values.isfinite().logical_not().any(0).nonzero()
            if len(invalid_times):
                seconds = (written + int(invalid_times[0])) / rate
                raise ValueError(
                    f"{path}: nothing was written, because the sample at {seconds:.3f} s is NaN or "
                    "infinite; correct the signal before it is written"
                )
            written += values.shape[-1]
            if len(values) != channels:
                raise ValueError(
                    f"{path}: expected parts with {channels} channels, got {len(values)}"
                )
            file.write(values.mT.contiguous().numpy().astype("<f4", copy=False).tobytes())
        if written != samples:
            raise ValueError(
                f"{path}: nothing was written, because the parts have {written} samples together, "
                f"expected {samples}"
            )


def find_audio(folder: str | Path, *, by_name: bool = False) -> list[Path]:
    """Find all audio files in a folder and its subfolders, except hidden ones, sorted by path.

    Links to files and folders are followed, even if they form a circle. A file that is found
    several times, because links lead to it or to a folder that contains it, is listed once: under
    its own path if that is in the folder, or else under the path of one link. A warning counts the
    links that are left out. Files are audio if their names have one of the ``EXTENSIONS``. Audio in
    formats that libsndfile does not read, such as M4A, causes a warning.

    Args:
        folder: Folder to search.
        by_name: Whether to list a file also under the names of links to it. This is needed where
            names have a meaning, for example if the clean speech of two outputs is one file.

    Returns:
        Paths that begin with ``folder``.

    Raises:
        ValueError: There is no such folder, a folder in it cannot be read, there is no audio in it,
            or a link that is named like audio, or has no extension, leads nowhere.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> [path.name for path in find_audio(EXAMPLE_FILE.parent)][:1]
    ['espeak-scotland-m7-01.flac']
    """
    if not Path(folder).is_dir():
        raise ValueError(f"{folder}: there is no such folder; correct the path")
    files: dict[str, Path] = {}  # by path if names matter, and otherwise by real path
    broken_links, repeated_links, unreadable_files = [], [], []
    try:
        for path, real_path in _visible_files(folder):
            extension = path.suffix.lower()
            key = str(path) if by_name else real_path
            if extension in ("", *EXTENSIONS) and not os.path.exists(real_path):
                broken_links.append(path)
            elif key in files or os.path.isdir(real_path):
                repeated_links.append(path)
            elif extension in EXTENSIONS and os.path.isfile(real_path):
                files[key] = path
            elif extension in _OTHER_EXTENSIONS:
                unreadable_files.append(path)
    except OSError as error:
        raise ValueError(f"{folder}: cannot be searched for audio: {error}") from error
    if broken_links:
        raise ValueError(
            f"{folder}: {len(broken_links)} links lead to files that do not exist, such as "
            f"{min(broken_links)}; fetch the files, or remove the links"
        )
    if repeated_links:
        warnings.warn(
            f"{folder}: {len(repeated_links)} links are left out because their files are found "
            f"elsewhere in the folder, such as {min(repeated_links)}; replace those by copies that "
            "should count several times",
            stacklevel=2,
        )
    if unreadable_files:
        warnings.warn(
            f"{folder}: {len(unreadable_files)} files are left out because libsndfile does not read"
            f" their format, such as {min(unreadable_files)}; convert them to FLAC or WAV",
            stacklevel=2,
        )
    if not files:
        extensions = ", ".join(EXTENSIONS)
        raise ValueError(f"{folder}: no audio in it; expected files ending in {extensions}")
    return sorted(files.values())


def _visible_files(folder: str | Path) -> Iterator[tuple[Path, str]]:
    """Yield the path and the real path of each file, and of some links.

    These links lead nowhere, or to a folder that was searched already. Hidden files and folders are
    left out. Every folder is searched once: first the folders that are no links, then those to
    which links lead.

    Args:
        folder: Folder to search.

    Raises:
        OSError: A folder cannot be read.
    """
    folders, links = [Path(folder)], deque[Path]()
    searched = set()
    while folders or links:
        path = folders.pop() if folders else links.popleft()
        real_path = os.path.realpath(path)
        is_file = not os.path.isdir(real_path)
        if is_file or real_path in searched:
            yield path, real_path
            continue
        searched.add(real_path)
        for entry in sorted(os.scandir(path), key=lambda entry: entry.name):
            if entry.name.startswith("."):
                continue
            if entry.is_symlink():
                links.append(path / entry.name)
            elif entry.is_dir():
                folders.append(path / entry.name)
            else:
                yield path / entry.name, os.path.join(real_path, entry.name)
