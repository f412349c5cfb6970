"""Random clips of recordings, decoded once and kept."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from hlsim.audio import find_audio, read_audio, resample


class Clips:
    """Clips of equal length from the recordings under a folder, first channel, resampled to one rate.

    Recordings are decoded when first drawn and kept as 16-bit samples (115 MB an hour at 16 kHz).

    Args:
        source: a folder, searched for wav, flac and ogg files, subfolders too; or the files.
        sample_rate: Hz.
        seconds: length of a clip; shorter recordings are repeated where ``repeat``, else followed by silence.
        repeat: for noises.

    Raises:
        ValueError: no such folder, or no audio in it; and when a clip is drawn, a file that cannot be used.
    """

    def __init__(
        self, source: str | Path | Sequence[Path], *, sample_rate: int, seconds: float, repeat: bool = False
    ) -> None:
        self.files = find_audio(source) if isinstance(source, str | Path) else list(source)
        self.sample_rate = sample_rate
        self.samples = round(seconds * sample_rate)
        self.repeat = repeat
        self._kept: dict[int, Tensor] = {}

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
        while len(clips) < count:
            index = int(torch.randint(len(self), (), generator=generator))
            clip = self.clip(index, float(torch.rand((), generator=generator)))
            if float(clip.square().mean()) > 1e-7:
                clips.append(clip)
        return torch.stack(clips)
