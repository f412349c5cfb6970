"""Random clips of recordings, decoded once and kept."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from hlsim.audio import find_audio, read_audio
from hlsim.dsp.resample import resample

_TRIES = 100  # draws of files that cannot be used, one after the other, before it ends
_SILENT_TRIES = 10_000  # more, for a recording may be loud for one second in an hour


class Clips:
    """Clips of equal length from the recordings under a folder, first channel, resampled to one rate.

    Recordings are decoded when first drawn and kept as 16-bit samples (115 MB an hour at 16 kHz). A file that cannot be
    used (broken, silent, of another rate) is told of once, and wherever it is drawn another is drawn instead.

    Args:
        source: a folder, searched for wav, flac and ogg files, subfolders too; or the files.
        sample_rate: Hz.
        seconds: length of a clip; shorter recordings are repeated where ``repeat``, else followed by silence.

    Raises:
        ValueError: no such folder, or no audio in it, or clips of no samples; when clips are drawn, too many files that
            cannot be used, or too many silent clips; when one recording is asked for, that it cannot be used.
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
        self.sample_rate, self.repeat = sample_rate, repeat
        self.samples = round(seconds * sample_rate)
        if self.samples < 1:
            raise ValueError(
                f"clips of {seconds} s; allowed: a sample or more, {1.0 / sample_rate:.2g} s"
            )
        self._kept: dict[int, Tensor] = {}
        self._bad: dict[int, str] = {}

    def __len__(self) -> int:
        return len(self.files)

    def recording(self, index: int) -> Tensor:
        """The whole recording, peak at 1.0. Shape: -> (time,)."""
        if index not in self._kept:
            waveform, rate = read_audio(self.files[index])
            waveform = resample(waveform[:1], rate, self.sample_rate).squeeze(0)
            peak = float(waveform.abs().max())
            if peak == 0.0:
                raise ValueError(f"{self.files[index]}: its first channel is silent")
            self._kept[index] = (waveform / peak * 32767.0).round().to(torch.int16)
        return self._kept[index].float() / 32767.0

    def clip(self, index: int, place: float) -> Tensor:
        """The clip at a place from 0, the beginning, to 1, the end. Shape: -> (samples,)."""
        recording = self.recording(index)
        if self.repeat and len(recording) < self.samples:
            recording = recording.repeat(-(-self.samples // len(recording)))
        start = int(place * max(0, len(recording) - self.samples))
        clip = recording[start : start + self.samples]
        return torch.nn.functional.pad(clip, (0, self.samples - len(clip)))

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Random clips, none silent. Shape: -> (count, samples)."""
        clips: list[Tensor] = []
        failed = silent = 0
        while len(clips) < count:
            index = int(torch.randint(len(self), (), generator=generator))
            # drawn for a bad file too: what follows does not depend on when it was found bad
            place = float(torch.rand((), generator=generator))
            if not self._usable(index):
                failed += 1
                if failed == _TRIES:
                    raise ValueError(
                        f"{self._bad[index]}; {_TRIES} files like it were drawn in a row"
                    )
                continue
            failed, clip = 0, self.clip(index, place)
            if float(clip.square().mean()) > 1e-7:
                silent = 0
                clips.append(clip)
            elif (silent := silent + 1) == _SILENT_TRIES:
                raise ValueError(
                    f"{self.files[index]}: {silent} clips in a row were silent, this one the last; leave silent "
                    "recordings out, or take longer clips"
                )
        return torch.stack(clips)

    def _usable(self, index: int) -> bool:
        if index not in self._bad:
            try:
                self.recording(index)
                return True
            except ValueError as error:
                self._bad[index] = str(error)
                warnings.warn(f"left out: {error}", stacklevel=3)
        return False
