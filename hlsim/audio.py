"""Reading, writing and listing of audio files. No other module imports soundfile."""

import io
import warnings
from pathlib import Path

import scipy
import soundfile
import torch
from torch import Tensor

from hlsim.checks import LOWEST_RATE, check_rate, check_waveform
from hlsim.files import atomic_path

EXTENSIONS = tuple(
    ".wav .flac .ogg .oga .opus .mp3 .aif .aiff .aifc .au .snd .caf .w64 .rf64 .sph .voc".split()
)
"""Extensions by which audio files are found in folders. libsndfile reads all of these formats."""


def read_audio(path: str | Path) -> tuple[Tensor, int]:
    """Read an audio file in any format that libsndfile reads, such as WAV, FLAC, Ogg or MP3.

    A truncated file is read up to its end, with a warning.

    Args:
        path: Audio file with a sample rate of 16 kHz or more.

    Returns:
        The samples in float32, (channels, time), where 1.0 is full scale, and the sample rate in
        Hz.

    Raises:
        ValueError: There is no such file; libsndfile cannot read it; it is empty, silent, or holds
            NaN or infinity; or its sample rate is below 16 kHz.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> samples, rate = read_audio(EXAMPLE_FILE)
    >>> samples.shape, rate
    (torch.Size([1, 64320]), 16000)
    """
    if not Path(path).is_file():
        raise ValueError(f"{path}: there is no such audio file; correct the path")
    try:
        with soundfile.SoundFile(path) as file:
            rate, expected = file.samplerate, file.frames
            samples = file.read(expected, dtype="float32", always_2d=True)
    except Exception as error:  # For broken files, soundfile raises exceptions of many types.
        raise ValueError(f"{path}: cannot be read as audio: {error}") from error
    if rate < LOWEST_RATE:
        raise ValueError(
            f"{path}: the sample rate is {rate} Hz, expected {LOWEST_RATE} Hz or more; use another "
            f"recording, because this one has no sound above {rate / 2:g} Hz"
        )
    waveform = torch.from_numpy(samples.T.copy())
    if not bool(waveform.isfinite().all()):
        raise ValueError(f"{path}: some samples are NaN or infinite; replace or remove the file")
    if not bool(waveform.any()):
        raise ValueError(f"{path}: the file is empty or silent; replace or remove it")
    if len(samples) < expected:
        warnings.warn(
            f"{path}: the file is truncated; its header states {expected} samples per channel, but "
            f"only {len(samples)} could be read",
            stacklevel=2,
        )
    return waveform, rate


def write_audio(path: str | Path, waveform: Tensor, sample_rate: int) -> None:
    """Write a WAV file with samples in 32-bit float, completely or not at all.

    Args:
        path: File to write.
        waveform: Samples, (channels, time) or (time,), where 1.0 is full scale.
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Raises:
        ValueError: The extension is not .wav, the shape or the sample rate is not supported, or
            samples are NaN or infinite.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_audio(f"{folder}/noise.wav", 0.1 * torch.randn(2, 16000), 16000)
    ...     read_audio(f"{folder}/noise.wav")[0].shape
    torch.Size([2, 16000])
    """
    if Path(path).suffix.lower() != ".wav":
        raise ValueError(f"{path}: expected the extension .wav; convert the file afterwards")
    samples = torch.atleast_2d(check_waveform(waveform)).detach().to("cpu", torch.float32)
    if samples.ndim > 2:
        shape = tuple(samples.shape)
        raise ValueError(f"{path}: expected shape (channels, time) or (time,), got {shape}")
    if not bool(samples.isfinite().all()):
        raise ValueError(f"{path}: some samples are NaN or infinite; nothing was written")
    rate = check_rate(sample_rate)
    with atomic_path(path) as temporary:
        # libsndfile would store the time of day, and equal signals would give different files.
        scipy.io.wavfile.write(temporary, rate, samples.mT.numpy())


def encode_flac(waveform: Tensor, sample_rate: int) -> bytes:
    """Encode a signal as the contents of a 16-bit FLAC file, for audio players on web pages.

    Args:
        waveform: Samples from -1 to 1, (time,) or (channels, time).
        sample_rate: Sample rate in Hz.

    Returns:
        The contents of the file.

    >>> encode_flac(torch.zeros(160), 16000)[:4]
    b'fLaC'
    """
    data = io.BytesIO()
    samples = waveform.detach().cpu().float().numpy()
    soundfile.write(data, samples.T, sample_rate, format="FLAC", subtype="PCM_16")
    return data.getvalue()


def find_audio(folder: str | Path) -> list[Path]:
    """Find all audio files in a folder and its subfolders, except hidden ones, sorted by path.

    Args:
        folder: Folder to search.

    Raises:
        ValueError: There is no such folder, or no audio in it.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> [path.name for path in find_audio(EXAMPLE_FILE.parent)][:1]
    ['espeak-scotland-m7-01.flac']
    """
    root = Path(folder)
    if not root.is_dir():
        raise ValueError(f"{folder}: there is no such folder; correct the path")
    files = [
        path
        for path in sorted(root.rglob("*"))
        if path.suffix.lower() in EXTENSIONS
        and path.is_file()
        and "/." not in f"/{path.relative_to(root).as_posix()}"
    ]
    if not files:
        extensions = ", ".join(EXTENSIONS)
        raise ValueError(f"{folder}: no audio in it; expected files ending in {extensions}")
    return files
