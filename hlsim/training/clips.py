"""Random clips of recordings, decoded once and kept in memory."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from hlsim.audio import find_audio, read_audio
from hlsim.dsp.resample import resample

MAX_FAILURES = 10_000  # draws in a row; a recording may be loud for one second in an hour
MAX_SAMPLES_IN_MEMORY = 2**30  # 2 GB, 18 hours at 16 kHz
SILENT_POWER = 1e-7  # mean square of a clip whose recording has its peak at 1.0


class Clips:
    """Clips of equal length from the recordings in a folder, first channel, resampled to one rate.

    Recordings are decoded when they are first drawn and kept as 16-bit samples, up to 2 GB. A file that cannot be used
    (broken, silent, or with an unsupported rate) causes one warning, and whenever it is drawn, another is drawn instead.

    Args:
        source: folder that is searched for audio, with its subfolders; or a list of files.
        sample_rate: sample rate of the clips in Hz.
        seconds: length of a clip. Shorter recordings are repeated if ``repeat``, else followed by silence.

    Raises:
        ValueError: the folder does not exist or has no audio in it, or the clips would be empty. When clips are drawn:
            too many draws in a row that give no clip.
    """

    def __init__(
        self,
        source: str | Path | Sequence[Path],
        *,
        sample_rate: int,
        seconds: float,
        repeat: bool = False,
    ) -> None:
        self.files = find_audio(source) if isinstance(source, str | Path) else list(source)
        self.sample_rate = sample_rate
        self.repeat = repeat
        self.samples = round(seconds * sample_rate)
        if self.samples < 1:
            raise ValueError(
                f"clips of {seconds} s have no samples; choose {1.0 / sample_rate:.2g} s or more"
            )
        self._recordings: dict[int, Tensor] = {}  # 16-bit samples by number of the file
        self._errors: dict[int, str] = {}  # by number of the file

    def __len__(self) -> int:
        return len(self.files)

    def recording(self, index: int) -> Tensor:
        """A whole recording with its peak at 1.0. Shape: -> (time,)."""
        if index not in self._recordings:
            waveform = self._decode(index)
            peak = float(waveform.abs().max())
            if peak == 0.0:
                raise ValueError(f"{self.files[index]}: its first channel is silent")
            self._recordings[index] = (waveform / peak * 32767.0).round().to(torch.int16)
            self._limit_memory()
        return self._recordings[index].float() / 32767.0

    def clip(self, index: int, position: float) -> Tensor:
        """The clip at a position from 0, the start of the recording, to 1, its end. Shape: -> (samples,)."""
        recording = self.recording(index)
        if self.repeat and len(recording) < self.samples:
            recording = recording.repeat(-(-self.samples // len(recording)))
        start = int(position * max(0, len(recording) - self.samples))
        clip = recording[start : start + self.samples]
        return torch.nn.functional.pad(clip, (0, self.samples - len(clip)))

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Random clips, none of them silent. Shape: -> (count, samples)."""
        clips: list[Tensor] = []
        failures = 0
        while len(clips) < count:
            index = int(torch.randint(len(self), (), generator=generator))
            # drawn for a bad file as well, so that later draws do not depend on when it was found to be bad
            position = float(torch.rand((), generator=generator))
            if self._is_usable(index):
                clip = self.clip(index, position)
                if float(clip.square().mean()) > SILENT_POWER:
                    clips.append(clip)
                    failures = 0
                    continue
            failures += 1
            if failures == MAX_FAILURES:
                reason = self._errors.get(index, f"{self.files[index]}: a clip of it is silent")
                raise ValueError(
                    f"{reason}; this is the last of {failures} draws in a row without a clip to use; remove broken and "
                    "silent recordings, or draw longer clips"
                )
        return torch.stack(clips)

    def _decode(self, index: int) -> Tensor:
        """First channel of a file at the rate of the clips. Shape: -> (time,)."""
        waveform, rate = read_audio(self.files[index])
        return resample(waveform[:1], rate, self.sample_rate).squeeze(0)

    def _limit_memory(self) -> None:
        """Remove the recordings that were decoded first, but not the last one."""
        total = sum(map(len, self._recordings.values()))
        while total > MAX_SAMPLES_IN_MEMORY and len(self._recordings) > 1:
            total -= len(self._recordings.pop(next(iter(self._recordings))))

    def _is_usable(self, index: int) -> bool:
        if index in self._errors:
            return False
        try:
            self.recording(index)
        except ValueError as error:
            self._errors[index] = str(error)
            warnings.warn(f"left out: {error}", stacklevel=3)
            return False
        return True


class NoiseOfPairs(Clips):
    """Clips of the noise in pairs of clean and noisy speech: noisy minus clean.

    Args:
        pairs: files of clean speech, each with its noisy version, aligned and equally long.
        sample_rate, seconds: as for ``Clips``.
    """

    def __init__(
        self, pairs: Sequence[tuple[Path, Path]], *, sample_rate: int, seconds: float
    ) -> None:
        noisy_files = [noisy for _, noisy in pairs]
        super().__init__(noisy_files, sample_rate=sample_rate, seconds=seconds, repeat=True)
        self.clean_files = [clean for clean, _ in pairs]

    def _decode(self, index: int) -> Tensor:
        clean, rate = read_audio(self.clean_files[index])
        noise = read_noisy(self.files[index], clean, rate) - clean
        return resample(noise[:1], rate, self.sample_rate).squeeze(0)


def read_noisy(path: Path, clean: Tensor, clean_rate: int) -> Tensor:
    """Read the noisy version of clean speech.

    Shape: (channels, time) -> (channels, time).

    Raises:
        ValueError: the file cannot be read, or is not as long as the clean speech, or has another sample rate.
    """
    noisy, rate = read_audio(path)
    if (noisy.shape, rate) != (clean.shape, clean_rate):
        raise ValueError(
            f"{path}: {noisy.shape[-1]} samples at {rate} Hz, but its clean version has {clean.shape[-1]} at "
            f"{clean_rate} Hz; both files of a pair have equal lengths, rates and channels"
        )
    return noisy
