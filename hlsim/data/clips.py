"""Random clips of recordings, which are decoded once and kept in memory."""

import hashlib
import math
import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from hlsim.audio import find_audio, read_audio
from hlsim.dsp.resample import resample

MAX_FAILURES = 10_000
"""Number of draws in a row without a usable clip after which an error is raised.

It allows for recordings that are silent except for one second per hour.
"""

MAX_SAMPLES_IN_MEMORY = 2**30
"""Largest number of samples of all recordings in memory: 2 GB, 18 hours at 16 kHz."""

AudioFiles = str | Path | Sequence[Path | tuple[Path, Path]]
"""A folder that is searched for audio, with its subfolders; or a list of files.

In a list, a pair of files, clean speech and its noisy version, means the noise: their difference.
"""

_MAX_HASHED_BYTES = 2**30
"""Total size in bytes up to which ``hash_source`` reads all files completely."""

_HASHED_PIECES = 4
_SMALLEST_PIECE = 4096  # bytes

_HIGHEST_CORRELATION = 0.4
"""Magnitude of the correlation of noise and clean speech above which the noise contains the speech.

Noise and speech of a true pair have about 0. If the noisy file has another sentence, a lower level
or a delay, their difference is mostly the clean speech with the opposite sign; at a higher level,
it contains the clean speech.
"""

_SILENT_POWER = 1e-7
"""Mean square up to which a clip counts as silent, if the peak of its recording is 1.0."""

_LOWEST_PEAK = 1e-9
"""Smallest peak that is scaled to 1.0; recordings with a lower one stay below 1.0."""


class Clips:
    """Clips of equal length from the first channels of recordings, at one sample rate.

    Recordings are scaled to a peak of 1.0, so that clips have no calibrated level. Recordings are
    decoded when they are first drawn, and stored as 16-bit samples, up to 2 GB; beyond that, the
    recording that was decoded first is dropped, and decoded again when it is drawn. A file that is
    broken, silent or has an unsupported sample rate causes a warning, and another one is drawn
    instead.

    Args:
        source: Folder or files, see ``AudioFiles``.
        sample_rate: Sample rate of the clips in Hz.
        seconds: Duration of a clip in seconds.
        repeat: Whether recordings that are shorter than a clip are repeated; otherwise silence
            follows them.

    Attributes:
        files: Paths of the recordings.
        samples: Length of a clip in samples.
        left_out: Indices of the recordings that were drawn so far and cannot be used.

    Raises:
        ValueError: There are no files, or the folder does not exist or contains no audio.

    >>> from hlsim.data.bundled import SPEECH
    >>> clips = Clips(SPEECH, sample_rate=16000, seconds=0.5)
    >>> clips.draw(3, torch.Generator()).shape
    torch.Size([3, 8000])
    """

    def __init__(
        self,
        source: AudioFiles,
        *,
        sample_rate: int,
        seconds: float,
        repeat: bool = False,
    ) -> None:
        self._pairs = _find_pairs(source)
        self.files = [file for _, file in self._pairs]
        if not self.files:
            raise ValueError("expected files of speech or noise, got an empty list; add some")
        self.sample_rate = sample_rate
        self.repeat = repeat
        self.samples = round(seconds * sample_rate)
        self.left_out: set[int] = set()
        self._recordings: dict[int, Tensor] = {}  # 16-bit samples by index of the file

    def __len__(self) -> int:
        return len(self.files)

    def read_recording(self, index: int) -> Tensor:
        """Return a whole recording, scaled to a peak of 1.0, or one zero if it cannot be used.

        A file that cannot be used causes a warning when it is first read.

        Args:
            index: Index of the file in ``files``.

        Returns:
            Samples at the clips' sample rate with shape (time,), or (channels, time) in a subclass.
        """
        if index not in self._recordings:
            try:
                waveform = self._decode(index)
            except ValueError as error:
                if index not in self.left_out:
                    warnings.warn(f"left out: {error}", stacklevel=4)
                self.left_out.add(index)
                waveform = torch.zeros(1)
            peak = max(float(waveform.abs().max()), _LOWEST_PEAK)
            self._recordings[index] = (waveform / peak * 32767.0).round().to(torch.int16)
            sizes = [samples.numel() for samples in self._recordings.values()]
            while len(sizes) > 1 and sum(sizes) > MAX_SAMPLES_IN_MEMORY:
                oldest = next(iter(self._recordings))
                del self._recordings[oldest], sizes[0]
        return self._recordings[index].float() / 32767.0

    def cut_clip(self, index: int, position: float) -> Tensor:
        """Cut a clip out of a recording. The recording has a peak of 1.0, no calibrated level.

        A recording that is shorter than the clip is repeated if ``repeat`` is true. Otherwise
        silence follows it.

        Args:
            index: Index of the file in ``files``.
            position: Position of the clip, from 0 at the start of the recording to 1 at its end.

        Returns:
            The clip, (samples,), or (channels, samples) in a subclass.
        """
        recording = self.read_recording(index)
        time = recording.shape[-1]
        if self.repeat and time < self.samples:
            recording = recording.tile(math.ceil(self.samples / time))  # along the last dimension
        start = int(position * max(0, recording.shape[-1] - self.samples))
        clip = recording[..., start : start + self.samples]
        return torch.nn.functional.pad(clip, (0, self.samples - clip.shape[-1]))

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw clips at random positions of random recordings, and redraw silent clips.

        A clip is silent if its RMS is at least 70 dB below the peak of its recording. A subclass
        may have another definition, see ``is_silent``.

        Args:
            count: Number of clips.
            generator: Source of the random numbers.

        Returns:
            Clips with shape (count, time), or (count, channels, time) in a subclass.

        Raises:
            ValueError: 10,000 draws in a row gave only silent clips and files that cannot be used.
        """
        clips: list[Tensor] = []
        failures = 0
        while len(clips) < count:
            index = int(torch.randint(len(self), (), generator=generator))
            position = float(torch.rand((), generator=generator))
            clip = self.cut_clip(index, position)
            if not self.is_silent(clip, index):
                clips.append(clip)
                failures = 0
                continue
            failures += 1
            if failures == MAX_FAILURES:
                raise ValueError(
                    f"{failures} draws in a row gave no clip, the last from {self.files[index]}; "
                    "remove broken and silent recordings, or draw longer clips"
                )
        return torch.stack(clips)

    def is_silent(self, clip: Tensor, index: int) -> bool:
        """Return whether a clip of the recording with this index counts as silent."""
        return float(clip.square().mean()) <= _SILENT_POWER

    def _decode(self, index: int) -> Tensor:
        """Decode the first channel of a file, or of the noise of a pair, at the clips' sample rate.

        The noise of a pair is its noisy minus its clean speech. Nothing is scaled.

        Shape: -> (time,).

        Raises:
            ValueError: A file cannot be read, the files of a pair do not fit together, or the first
                channel or the noise is silent.
        """
        clean_file, file = self._pairs[index]
        waveform, rate = read_audio(clean_file or file)
        if clean_file is not None:
            waveform = _read_noise(file, waveform, rate)
        if not bool(waveform[0].any()):
            # Its clips would never be drawn.
            part = "its first channel" if clean_file is None else "its difference from clean speech"
            raise ValueError(f"{file}: {part} is silent; replace or remove the file")
        return resample(waveform[:1], rate, self.sample_rate).squeeze(0)


def read_noisy(path: Path, clean: Tensor, clean_rate: int) -> Tensor:
    """Read noisy speech, and validate that it has the shape and the rate of its clean version.

    Args:
        path: File of noisy speech.
        clean: Clean speech with shape (channels, time).
        clean_rate: Sample rate of the clean speech in Hz.

    Returns:
        Noisy speech with shape (channels, time).

    Raises:
        ValueError: The file cannot be read, or differs in length, channels or sample rate from the
            clean speech.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> read_noisy(EXAMPLE_FILE, clean=torch.zeros(1, 64320), clean_rate=16000).shape
    torch.Size([1, 64320])
    """
    noisy, rate = read_audio(path)
    if (rate, noisy.shape) != (clean_rate, clean.shape):
        raise ValueError(
            f"{path}: expected {clean_rate} Hz and (channels, samples) {tuple(clean.shape)} as in "
            f"the clean version, got {rate} Hz and {tuple(noisy.shape)}; replace one of them"
        )
    return noisy


def _read_noise(path: Path, clean: Tensor, clean_rate: int) -> Tensor:
    """Return noisy minus clean speech, (channels, samples), from the arguments of ``read_noisy``.

    Raises:
        ValueError: The noisy speech cannot be read, has another rate, length or number of channels,
            or does not contain the clean speech at its level: their difference is mostly speech.
    """
    noise = read_noisy(path, clean, clean_rate) - clean
    scale = float(noise.norm() * clean.norm())
    correlation = float((noise * clean).sum()) / scale if scale else 0.0
    if abs(correlation) > _HIGHEST_CORRELATION:
        raise ValueError(
            f"{path}: expected the clean speech plus noise, but their difference is not noise "
            f"(correlation with the clean speech {correlation:.2f}); pair files of the same "
            "sentence, at the same level and without a delay"
        )
    return noise


def hash_source(source: AudioFiles) -> str:
    """Compute a hash of the contents of recordings, which changes when a recording is replaced.

    Paths have no influence except on the order of the files, so that a corpus may be moved. If all
    files together have 1 GB or less, they are read completely. Otherwise, the hash covers the size
    of each file, small files, and four pieces of each large file, from its start to its end. This
    is 1 GB at most for up to 32,768 recordings, and 16 kB of each large file for more.

    Args:
        source: Folder or files, see ``AudioFiles``.

    Returns:
        The SHA-256 in hexadecimal.

    Raises:
        ValueError: The folder does not exist, or contains no audio.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> hash_source([EXAMPLE_FILE]) == hash_source([EXAMPLE_FILE, EXAMPLE_FILE])
    False
    """
    files = [file for pair in _find_pairs(source) for file in pair]
    sizes = [os.path.getsize(file) if file and file.is_file() else 0 for file in files]
    piece = max(_SMALLEST_PIECE, _MAX_HASHED_BYTES // (_HASHED_PIECES * max(1, len(files))))
    reads_all = sum(sizes) <= _MAX_HASHED_BYTES
    digest = hashlib.sha256()
    for file, size in zip(files, sizes, strict=True):
        digest.update(f"{size};".encode())
        if file is None or not size:
            continue
        with file.open("rb") as data:
            if reads_all or size <= _HASHED_PIECES * piece:
                digest.update(data.read())
                continue
            for number in range(_HASHED_PIECES):
                data.seek(number * (size - piece) // (_HASHED_PIECES - 1))
                digest.update(data.read(piece))
    return digest.hexdigest()


def _find_pairs(source: AudioFiles) -> list[tuple[Path | None, Path]]:
    """Return a pair for each recording: the clean version, or None if there is none, and the file.

    Raises:
        ValueError: The folder does not exist, or contains no audio.
    """
    files = find_audio(source) if isinstance(source, str | Path) else source
    return [file if isinstance(file, tuple) else (None, file) for file in files]
