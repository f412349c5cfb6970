"""Reading and writing audio files. The only module that imports soundfile."""

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

from hlsim.checks import HIGHEST_RATE, LOWEST_RATE, check_waveform
from hlsim.files import EXTENSIONS, atomic_path, check_extension

HIGHEST_FILE_RATE = 384_000
"""Highest sample rate in Hz of files that are resampled."""

# libvorbis rearranges more channels and fails at higher rates
_OGG_CHANNELS, _OGG_RATE = 2, 192_000
_BLOCK = 2**20  # frames
_SUBTYPES = {".flac": "PCM_24", ".ogg": "VORBIS"}


def read_audio(path: str | Path, *, any_rate: bool = False) -> tuple[Tensor, int]:
    """Read an audio file in any format that libsndfile knows.

    A truncated file is read up to where it ends, with a warning.

    Args:
        any_rate: Accept sample rates up to 384 kHz, not only up to 48 kHz.

    Returns: float32 samples at the scale of the file, (channels, time), and the sample rate in Hz.

    Raises:
        ValueError: libsndfile cannot read the file; it is empty, silent, or holds NaN or infinity; or
            its sample rate is below 16 kHz or too high.
    """
    if not os.path.isfile(path):
        raise ValueError(f"{path}: there is no such file")
    try:
        with soundfile.SoundFile(os.fspath(path)) as file:
            rate, expected = int(file.samplerate), file.frames
            samples = _read_blocks(file)
    except (OSError, soundfile.SoundFileError, MemoryError, TypeError, UnicodeError) as error:
        reason = getattr(error, "error_string", error)
        raise ValueError(f"{path}: cannot be read as audio: {reason}") from error
    if not len(samples):
        raise ValueError(f"{path}: the file is empty, it has no samples")
    highest = HIGHEST_FILE_RATE if any_rate else HIGHEST_RATE
    if not LOWEST_RATE <= rate <= highest:
        raise ValueError(
            f"{path}: the sample rate is {rate} Hz, expected {LOWEST_RATE} to {highest} Hz"
        )
    waveform = torch.from_numpy(samples.T.copy())
    if not bool(waveform.isfinite().all()):
        raise ValueError(f"{path}: there are samples that are NaN or infinite")
    if not bool(waveform.any()):
        raise ValueError(f"{path}: the file is silent, every sample is zero")
    if len(samples) < expected:
        warnings.warn(
            f"{path}: the file is truncated; its header promises {expected} samples per channel, it has {len(samples)}",
            stacklevel=2,
        )
    return waveform, rate


def _read_blocks(file: soundfile.SoundFile) -> NDArray[np.float32]:
    """Read to the end, also where the header promises too much or the codec cannot seek. Shape: (time, channels)."""
    blocks = []
    while True:
        block = file.read(_BLOCK, dtype="float32", always_2d=True)
        blocks.append(block)
        if len(block) < _BLOCK:
            return np.concatenate(blocks)


def write_audio(path: str | Path, waveform: Tensor, sample_rate: int) -> None:
    """Write a wav (32-bit float), flac (24-bit) or ogg (Vorbis) file atomically.

    Shape: (channels, time) or (time,).

    Raises:
        ValueError: The extension, the shape or the sample rate is not supported, samples are NaN or
            infinite, or samples exceed full scale in flac or ogg, which would clip them.
    """
    suffix = check_extension(path)
    if check_waveform(waveform).ndim > 2:
        shape = tuple(waveform.shape)
        raise ValueError(f"{path}: expected shape (channels, time) or (time,), got {shape}")
    samples = waveform.detach().to("cpu", torch.float32)
    samples = samples.reshape(-1, samples.shape[-1])
    check_written(path, len(samples), sample_rate)
    if not bool(samples.isfinite().all()):
        raise ValueError(f"{path}: there are samples that are NaN or infinite; nothing was written")
    peak = float(samples.abs().max())
    if suffix != ".wav" and peak > 1.0:
        raise ValueError(
            f"{path}: the peak is {peak:.3g} times full scale, which {suffix} would clip; "
            "write .wav instead"
        )
    frames = samples.mT.numpy()
    with atomic_path(path) as temporary:
        if suffix == ".wav":
            # libsndfile would store the time of day, so that equal signals gave different files
            scipy.io.wavfile.write(temporary, int(sample_rate), frames)
            return
        try:
            soundfile.write(
                temporary, frames, int(sample_rate), _SUBTYPES[suffix], format=suffix[1:].upper()
            )
        except soundfile.LibsndfileError as error:
            raise ValueError(f"{path}: cannot be written: {error.error_string}") from error


def check_written(path: str | Path, channels: int, sample_rate: int) -> None:
    """Raise ValueError unless a file with this extension can hold the channels and the sample rate (Hz)."""
    is_ogg = Path(path).suffix.lower() == ".ogg"
    if is_ogg and channels > _OGG_CHANNELS:
        raise ValueError(
            f"{path}: ogg files hold up to {_OGG_CHANNELS} channels, got {channels}; "
            "write .wav or .flac instead"
        )
    highest = _OGG_RATE if is_ogg else HIGHEST_FILE_RATE
    if not LOWEST_RATE <= sample_rate <= highest or int(sample_rate) != sample_rate:
        raise ValueError(
            f"{path}: expected a whole sample rate of {LOWEST_RATE} to {highest} Hz, "
            f"got {sample_rate} Hz"
        )


def encode_flac(waveform: Tensor, sample_rate: int) -> bytes:
    """Encode a signal as a 16-bit flac file, for the players of a page.

    Shape: (time,), samples from -1 to 1.

    Raises:
        ValueError: The shape, the samples or the sample rate do not fit.
    """
    samples = check_waveform(waveform).detach().to("cpu", torch.float32)
    if samples.ndim != 1 or not bool((samples.abs() <= 1.0).all()):
        raise ValueError(
            f"expected shape (time,) and samples from -1 to 1, got shape {tuple(samples.shape)} and a "
            f"peak of {float(samples.abs().max()):.3g}"
        )
    data = io.BytesIO()
    try:
        soundfile.write(data, samples.numpy(), int(sample_rate), format="FLAC", subtype="PCM_16")
    except soundfile.LibsndfileError as error:
        raise ValueError(f"cannot encode flac at {sample_rate} Hz: {error.error_string}") from error
    return data.getvalue()


def find_audio(folder: str | Path) -> list[Path]:
    """Find all audio files below a folder, sorted by path.

    Raises:
        ValueError: There is no such folder, or no audio in it.
    """
    return list_files(folder)[0]


def list_files(folder: str | Path) -> tuple[list[Path], list[Path]]:
    """List the audio files and all other files below a folder, sorted by path, without hidden ones.

    Raises:
        ValueError: As ``find_audio``.
    """
    root = Path(folder)
    if not root.is_dir():
        raise ValueError(f"{folder}: there is no such folder")
    audio: list[Path] = []
    others: list[Path] = []
    for path in sorted(root.rglob("*")):
        is_hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
        if is_hidden or path.is_dir():
            continue
        (audio if path.suffix.lower() in EXTENSIONS else others).append(path)
    if not audio:
        raise ValueError(f"{folder}: no audio in it ({', '.join(EXTENSIONS)})")
    return audio, others
