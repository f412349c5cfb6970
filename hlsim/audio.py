"""Reading, writing and listing of audio files. No other module imports soundfile."""

import io
import os
import warnings
from pathlib import Path

import numpy as np
import scipy
import soundfile
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.checks import HIGHEST_RATE, LOWEST_RATE, check_rate, check_waveform
from hlsim.files import EXTENSIONS, atomic_path, check_extension

HIGHEST_FILE_RATE = 384_000
"""Highest sample rate in Hz of files that are read to be resampled, or written."""

MAX_OGG_CHANNELS = 2
"""Largest number of channels in an ogg file, because libvorbis rearranges more of them."""

HIGHEST_OGG_RATE = 192_000
"""Highest sample rate in Hz of an ogg file, because libvorbis fails at higher ones."""

SAMPLES_PER_BLOCK = 2**20
"""Number of samples per channel that are read at once."""

SUBTYPES = {".flac": "PCM_24", ".ogg": "VORBIS"}
"""Encoding of the samples by extension, as soundfile calls it."""


def read_audio(path: str | Path, *, any_rate: bool = False) -> tuple[Tensor, int]:
    """Read an audio file in any format that libsndfile reads, such as WAV, FLAC, Ogg or MP3.

    A truncated file is read up to its end, with a warning.

    Args:
        path: Audio file.
        any_rate: Whether sample rates up to 384 kHz are accepted instead of 48 kHz.

    Returns:
        The samples in float32, (channels, time), where 1.0 is full scale, and the sample rate in
        Hz.

    Raises:
        ValueError: ``path`` is not a path; libsndfile cannot read the file; it is empty, silent, or
            holds NaN or infinity; or its sample rate is below 16 kHz or too high.

    >>> import hlsim
    >>> samples, rate = read_audio(hlsim.shortcuts.EXAMPLE_FILE)
    >>> samples.shape, rate
    (torch.Size([1, 64320]), 16000)
    """
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"expected the path of an audio file, got {type(path).__name__}; pass one")
    if os.path.isdir(path):
        raise ValueError(
            f"{path}: expected an audio file, got a folder; pass the path of a file in it"
        )
    if not os.path.isfile(path):
        raise ValueError(f"{path}: there is no such file; correct the path")
    try:
        with soundfile.SoundFile(os.fspath(path)) as file:
            rate = int(file.samplerate)
            expected = file.frames
            samples = _read_blocks(file)
    except (OSError, soundfile.SoundFileError, MemoryError, TypeError, UnicodeError) as error:
        reason = getattr(error, "error_string", error)
        raise ValueError(f"{path}: cannot be read as audio: {reason}") from error
    if not len(samples):
        raise ValueError(f"{path}: the file has no samples; replace or remove it")
    highest = HIGHEST_FILE_RATE if any_rate else HIGHEST_RATE
    if not LOWEST_RATE <= rate <= highest:
        fix = "resample the file"
        if rate < LOWEST_RATE:
            fix = f"use another recording, because this one has no sound above {rate / 2:g} Hz"
        raise ValueError(
            f"{path}: the sample rate is {rate} Hz, expected {LOWEST_RATE} to {highest} Hz; {fix}"
        )
    waveform = torch.from_numpy(samples.T.copy())
    if not bool(waveform.isfinite().all()):
        raise ValueError(f"{path}: some samples are NaN or infinite; replace or remove the file")
    if not bool(waveform.any()):
        raise ValueError(f"{path}: the file is silent, every sample is zero; replace or remove it")
    if len(samples) < expected:
        warnings.warn(
            f"{path}: the file is truncated; its header states {expected} samples per channel, but "
            f"only {len(samples)} could be read",
            stacklevel=2,
        )
    return waveform, rate


def _read_blocks(file: soundfile.SoundFile) -> NDArray[np.float32]:
    """Read all samples, (time, channels), even if the header is wrong or the codec cannot seek."""
    blocks = []
    while True:
        block = file.read(SAMPLES_PER_BLOCK, dtype="float32", always_2d=True)
        blocks.append(block)
        if len(block) < SAMPLES_PER_BLOCK:
            return np.concatenate(blocks)


def write_audio(path: str | Path, waveform: Tensor, sample_rate: int) -> None:
    """Write a WAV (32-bit float), FLAC (24-bit) or Ogg (Vorbis) file, completely or not at all.

    Args:
        path: File to write, whose extension decides the format.
        waveform: Samples, (channels, time) or (time,), where 1.0 is full scale.
        sample_rate: Sample rate in Hz.

    Raises:
        ValueError: The extension, the shape or the sample rate is not supported, samples are NaN or
            infinite, or samples exceed full scale in flac or ogg, which would clip them.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_audio(f"{folder}/noise.wav", 0.1 * torch.randn(2, 16000), 16000)
    ...     read_audio(f"{folder}/noise.wav")[0].shape
    torch.Size([2, 16000])
    """
    suffix = check_extension(path)
    if check_waveform(waveform).ndim > 2:
        shape = tuple(waveform.shape)
        raise ValueError(f"{path}: expected shape (channels, time) or (time,), got {shape}")
    samples = waveform.detach().to("cpu", torch.float32)
    samples = samples.reshape(-1, samples.shape[-1])
    check_writable(path, len(samples), sample_rate)
    if not bool(samples.isfinite().all()):
        raise ValueError(f"{path}: some samples are NaN or infinite; nothing was written")
    peak = float(samples.abs().max())
    if suffix != ".wav" and peak > 1.0:
        raise ValueError(
            f"{path}: the peak is {peak:.3g} times full scale, which {suffix} would clip; "
            "write .wav instead"
        )
    frames = samples.mT.numpy()
    with atomic_path(path) as temporary:
        if suffix == ".wav":
            # libsndfile would store the time of day, and equal signals would give different files.
            scipy.io.wavfile.write(temporary, int(sample_rate), frames)
            return
        try:
            soundfile.write(
                temporary, frames, int(sample_rate), SUBTYPES[suffix], format=suffix[1:].upper()
            )
        except soundfile.LibsndfileError as error:
            raise ValueError(f"{path}: cannot be written: {error.error_string}") from error


def check_writable(path: str | Path, channels: int, sample_rate: int) -> None:
    """Raise ValueError unless an audio file can have a number of channels and a sample rate.

    Args:
        path: File to write, whose extension decides the format.
        channels: Number of channels.
        sample_rate: Sample rate in Hz.

    >>> check_writable("noise.wav", channels=2, sample_rate=48000)
    """
    is_ogg = Path(path).suffix.lower() == ".ogg"
    if is_ogg and channels > MAX_OGG_CHANNELS:
        raise ValueError(
            f"{path}: an ogg file has up to {MAX_OGG_CHANNELS} channels, got {channels}; "
            "write .wav or .flac instead"
        )
    highest = HIGHEST_OGG_RATE if is_ogg else HIGHEST_FILE_RATE
    try:
        check_rate(sample_rate, highest=highest)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def encode_flac(waveform: Tensor, sample_rate: int) -> bytes:
    """Encode a signal as the contents of a 16-bit FLAC file, for audio players on web pages.

    Args:
        waveform: Samples from -1 to 1, (time,) or (channels, time).
        sample_rate: Sample rate in Hz.

    Returns:
        The contents of the file.

    Raises:
        ValueError: The signal has another shape, samples beyond full scale, or a sample rate that
            flac does not support.

    >>> encode_flac(torch.zeros(160), 16000)[:4]
    b'fLaC'
    """
    samples = check_waveform(waveform).detach().to("cpu", torch.float32)
    if samples.ndim > 2 or not bool((samples.abs() <= 1.0).all()):
        raise ValueError(
            "expected shape (time,) or (channels, time) and samples from -1 to 1, got shape "
            f"{tuple(samples.shape)} and a peak of {float(samples.abs().max()):.3g}"
        )
    data = io.BytesIO()
    try:
        soundfile.write(data, samples.numpy().T, int(sample_rate), format="FLAC", subtype="PCM_16")
    except soundfile.LibsndfileError as error:
        raise ValueError(f"cannot encode flac at {sample_rate} Hz: {error.error_string}") from error
    return data.getvalue()


def find_audio(folder: str | Path) -> list[Path]:
    """Find all audio files in a folder and its subfolders, sorted by path.

    Args:
        folder: Folder to search.

    Raises:
        ValueError: There is no such folder, or no audio in it.

    >>> import hlsim
    >>> [path.name for path in find_audio(hlsim.shortcuts.EXAMPLE_FILE.parent)][:1]
    ['espeak-scotland-m7-01.flac']
    """
    return list_files(folder)[0]


def list_files(folder: str | Path) -> tuple[list[Path], list[Path]]:
    """List the files in a folder and its subfolders, except hidden ones, sorted by path.

    Args:
        folder: Folder to search.

    Returns:
        The audio files, and the other files.

    Raises:
        ValueError: There is no such folder, or no audio in it.

    >>> import hlsim
    >>> audio, other_files = list_files(hlsim.shortcuts.EXAMPLE_FILE.parent)
    """
    root = Path(folder)
    if not root.is_dir():
        raise ValueError(f"{folder}: there is no such folder; correct the path")
    audio: list[Path] = []
    other_files: list[Path] = []
    for path in sorted(root.rglob("*")):
        is_hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
        if is_hidden or path.is_dir():
            continue
        is_audio = path.suffix.lower() in EXTENSIONS
        (audio if is_audio else other_files).append(path)
    if not audio:
        extensions = ", ".join(EXTENSIONS)
        raise ValueError(f"{folder}: no audio in it; expected files ending in {extensions}")
    return audio, other_files
