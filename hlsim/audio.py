"""Reading and writing audio. The only file that imports soundfile."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import scipy
import soundfile
import torch
from torch import Tensor

from hlsim.checks import HIGHEST_RATE, HIGHEST_SAMPLE, check_rate, check_waveform, is_finite
from hlsim.files import EXTENSIONS, Whole, check_extension

_LARGEST_PAGE, _ENDS = (
    65_307,
    4,
)  # of Ogg: bytes of a page, and the flag of a stream's last one (RFC 3533, 6)
_STREAMED = 0x7FFF0000  # sizes from here on were written before the length was known: 0x7FFFF000, 0xFFFFFFFF

# what a header may tell, beyond which it is believed to be broken; of samples 16 GB
_HIGHEST_READ, _MOST_CHANNELS, _MOST_SAMPLES = 384_000, 64, 2**32

_HIGHEST_STORED = {
    ".wav": 2**31 - 1,
    ".flac": 655_350,
    ".ogg": 200_000,
}  # in Hz; libvorbis crashes beyond
_SUBTYPES = {".wav": "FLOAT", ".flac": "PCM_24", ".ogg": "VORBIS"}


def read_audio(path: str | Path, *, any_rate: bool = False) -> tuple[Tensor, int]:
    """Read a wav, flac or ogg file.

    Args:
        any_rate: let rates above 48 kHz through.

    Returns: float32 samples as they are in the file, (channels, time), and the rate in Hz.

    Raises:
        ValueError: the file is missing, broken, cut off, empty, silent or holds NaN, infinity or samples over 1e9, it has
            more than 64 channels, or its rate is below 16 kHz or above 48 kHz (384 kHz with ``any_rate``). The message
            starts with the path.
    """
    check_name(path)
    if not os.path.isfile(path):
        raise ValueError(f"{path}: no such file")
    with _told(path), soundfile.SoundFile(str(path)) as file:
        rate = int(file.samplerate)
        _refuse_header(path, rate, file.channels)
        if (told := file.frames * file.channels) > _MOST_SAMPLES:
            raise ValueError(
                f"{path}: its header tells of {told} samples; allowed: up to {_MOST_SAMPLES}"
            )
        samples = file.read(dtype="float32", always_2d=True)
    if samples.shape[0] == 0:
        raise ValueError(f"{path}: empty, no samples")
    waveform = torch.from_numpy(samples.T.copy())
    if not bool(torch.isfinite(waveform).all()):
        raise ValueError(f"{path}: holds samples that are NaN or infinite")
    if not (peak := float(waveform.abs().max())):
        raise ValueError(f"{path}: silent, every sample is zero")
    if peak > HIGHEST_SAMPLE:
        raise ValueError(f"{path}: samples reach {peak:.3g}; allowed: up to {HIGHEST_SAMPLE:g}")
    try:
        check_rate(min(rate, HIGHEST_RATE) if any_rate else rate)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return waveform, rate


def read_stretch(path: str | Path, start: float, seconds: float) -> tuple[Tensor, int]:
    """Read so many seconds of a recording from a second on; it begins again where it ends.

    Returns: float32 samples (channels, time) and the rate in Hz; silence and any rate are let through.

    Raises:
        ValueError: the file is missing, broken, cut off (wav) or empty.
    """
    with _told(path), soundfile.SoundFile(str(path)) as file:
        rate, left = int(file.samplerate), max(1, round(seconds * file.samplerate))
        _refuse_header(path, rate, file.channels)
        file.seek(int(start * rate) % max(1, file.frames))
        pieces = []
        while left > 0:
            piece = file.read(left, dtype="float32", always_2d=True)
            if not len(piece) and file.tell() == 0:
                raise ValueError(f"{path}: empty, no samples")
            pieces.append(torch.from_numpy(piece.T.copy()))
            left -= len(piece)
            file.seek(0)
    return torch.cat(pieces, -1), rate


@contextmanager
def _told(path: str | Path) -> Iterator[None]:
    """Raises ValueError, with the path, where the file cannot be read."""
    try:
        _refuse_cut(path)
        yield
    except (OSError, soundfile.LibsndfileError, RuntimeError, MemoryError) as error:
        # no memory is enough for the length that a broken header tells
        raise ValueError(
            f"{path}: not readable as audio ({error}); allowed: wav, flac, ogg"
        ) from error


def _refuse_header(path: str | Path, rate: int, channels: int) -> None:
    """Raise ValueError where reading and resampling what a header tells of would take all memory."""
    if rate > _HIGHEST_READ or channels > _MOST_CHANNELS:
        raise ValueError(
            f"{path}: its header tells of {rate} Hz and {channels} channels; allowed: up to {_HIGHEST_READ} Hz and "
            f"{_MOST_CHANNELS} channels"
        )


def _refuse_cut(path: str | Path) -> None:
    """Raise ValueError where a wav file holds less than its header tells, or an Ogg file's last page does not end it;
    libsndfile would read what there is."""
    with open(path, "rb") as file:
        start = file.read(12)
        if start[:4] == b"OggS":
            file.seek(max(0, os.fstat(file.fileno()).st_size - _LARGEST_PAGE))
            end = file.read()
            page = end[end.rfind(b"OggS") :]
            segments = page[27 : 27 + page[26]] if len(page) > 26 else b""
            if not (
                segments and page[5] & _ENDS and len(page) >= 27 + len(segments) + sum(segments)
            ):
                raise ValueError(f"{path}: cut off, its last page does not end the stream")
        if start[:4] != b"RIFF" or start[8:] != b"WAVE":
            return
        while len(chunk := file.read(8)) == 8:
            size = int.from_bytes(chunk[4:], "little")
            if chunk[:4] == b"data":
                held = os.fstat(file.fileno()).st_size - file.tell()
                if held < size < _STREAMED:
                    told = f"its header tells of {size} bytes of samples, {held} are there"
                    raise ValueError(f"{path}: cut off, {told}")
                return
            file.seek(size + size % 2, os.SEEK_CUR)


def check_channels(path: str | Path, channels: int) -> int:
    """Return the number, or raise ValueError for ogg with more than two: libvorbis takes the sixth for a subwoofer's."""
    if Path(path).suffix.lower() == ".ogg" and channels > 2:
        raise ValueError(
            f"{path}: {channels} channels; allowed: up to 2 in .ogg, more in .wav and .flac"
        )
    return channels


def _check_stored_rate(rate: int, suffix: str) -> int:
    """Return the rate, or raise ValueError unless it is a whole number of Hz that such a file holds."""
    highest = _HIGHEST_STORED[suffix]
    if not is_finite(rate) or not 1 <= rate <= highest or int(rate) != rate:
        raise ValueError(
            f"sample rate {rate!r} Hz; allowed in {suffix}: whole numbers up to {highest}"
        )
    return int(rate)


def write_audio(path: str | Path, waveform: Tensor, sample_rate: int) -> None:
    """Write (channels, time) or (time,) samples as wav (32-bit float), flac (24-bit) or ogg, whole or not at all.

    Raises:
        ValueError: unknown extension, another shape, ogg with more than two channels, a rate below 16 kHz or one that
            such a file cannot hold, samples that are NaN or infinite, or, for flac and ogg, beyond full scale (they would
            be clipped).
    """
    suffix = check_extension(path)
    if check_waveform(waveform).ndim > 2:
        raise ValueError(
            f"{path}: shape {tuple(waveform.shape)}; allowed: (channels, time) or (time,)"
        )
    check_channels(path, waveform.shape[:-1].numel())
    try:
        check_rate(min(sample_rate, HIGHEST_RATE) if is_finite(sample_rate) else sample_rate)
        rate = _check_stored_rate(sample_rate, suffix)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    samples = waveform.detach().to("cpu", torch.float32)
    if not bool(torch.isfinite(samples).all()):
        raise ValueError(f"{path}: samples are NaN or infinite, nothing written")
    if suffix != ".wav" and (peak := float(samples.abs().max())) > 1.0:
        raise ValueError(f"{path}: samples reach {peak:.3g}, {suffix} holds 1.0; write .wav")
    rows = samples.reshape(-1, samples.shape[-1]).mT.numpy()
    kind = {"subtype": _SUBTYPES[suffix], "format": suffix[1:].upper()}
    with Whole(path, new_folder=False) as file:
        try:
            if suffix == ".wav":
                # libsndfile would store the time of day, so that equal sounds gave different files
                scipy.io.wavfile.write(file.partial, rate, rows)
            else:
                soundfile.write(str(file.partial), rows, rate, **kind)
        except (OSError, soundfile.LibsndfileError) as error:
            raise file.refusal(error) from error
        file.keep()


def encode_flac(waveform: Tensor, sample_rate: int) -> bytes:
    """The contents of a 16-bit flac file of samples up to 1.0, for a page to play. Shape: (time,).

    Raises:
        ValueError: another shape, a rate that flac cannot hold, or samples that are NaN, infinite or beyond 1.0.
    """
    rate = _check_stored_rate(sample_rate, ".flac")
    samples = check_waveform(waveform).detach().to("cpu", torch.float32)
    if samples.ndim != 1 or not bool((samples.abs() <= 1.0).all()):
        raise ValueError(
            f"shape {tuple(samples.shape)}; allowed: (time,), samples from -1.0 to 1.0"
        )
    data = io.BytesIO()
    try:
        soundfile.write(data, samples.numpy(), rate, format="FLAC", subtype="PCM_16")
    except soundfile.LibsndfileError as error:  # above 65535 Hz it holds multiples of 10 only
        raise ValueError(f"sample rate {rate} Hz: cannot be written as flac ({error})") from error
    return data.getvalue()


def find_audio(folder: str | Path) -> list[Path]:
    """All wav, flac and ogg files under a folder, sorted by path.

    Raises:
        ValueError: no such folder, no audio in it, or a file whose name is not UTF-8.
    """
    root = Path(folder)
    if not root.is_dir():
        raise ValueError(f"{folder}: no such folder")
    files = sorted(
        path
        for path in root.rglob("*")
        if path.suffix.lower() in EXTENSIONS
        and not any(part.startswith(".") for part in path.relative_to(root).parts)
        and not path.is_dir()
    )
    if not files:
        raise ValueError(f"{folder}: no audio in it; looked for {', '.join(EXTENSIONS)}")
    for path in files:
        check_name(path)
    return files


def check_name(path: str | Path) -> None:
    """Raise ValueError where a path is not UTF-8: neither soundfile nor a report takes it."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        shown = os.fsencode(path).decode("utf-8", "backslashreplace")
        raise ValueError(f"{shown}: its name is not UTF-8; rename it") from error
