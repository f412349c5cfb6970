"""Recorded scenes: clean speech, and the same speech with noise at several microphones."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hlsim.audio import read_audio
from hlsim.calibration import level_spl, set_level
from hlsim.data.clips import Clips
from hlsim.data.layouts import CLARITY_REFERENCES
from hlsim.data.manifest import Utterance
from hlsim.dsp.resample import resample

_LARGEST_DIFFERENCE = 0.1
"""Largest difference in length between the files of a scene in seconds, which is cut off."""

_PAUSE_POWER = 1e-2
"""Highest power of the clean speech in a pause, relative to that of the whole recording.

Raised to the level of speech, a pause would have noise that is tens of dB too loud.
"""


class SceneFiles(NamedTuple):
    """Files of a recorded scene.

    Attributes:
        clean: File of the clean speech, with one channel, or one for each ear.
        microphones: Files of the noisy speech, whose channels count from the first to the last.
        references: Number of the reference channel, from 1, for one ear or for two. Empty for a
            single microphone, whose file has one channel.

    >>> SceneFiles(Path("clean.wav"), (Path("noisy.wav"),), references=(1, 2)).references
    (1, 2)
    """

    clean: Path
    microphones: tuple[Path, ...]
    references: tuple[int, ...]

    @classmethod
    def from_utterance(cls, row: Utterance, folder: Path) -> SceneFiles:
        """Return the files of a row of a manifest, whose paths are relative to a folder.

        A row without references is a scene with a single microphone.

        Raises:
            ValueError: The row has no noisy speech, or its reference is not valid.
        """
        if not row.noisy:
            raise ValueError(
                f"{row.path}: expected a noisy version in the column 'noisy', got none; add it"
            )
        microphones = tuple(folder / file for file in row.noisy_files)
        return cls(folder / row.path, microphones, row.references)

    @property
    def files(self) -> list[Path]:
        """All files that are read, except for the clean speech."""
        return [*self.microphones, *filter(None, [self._file_with_room])]

    @property
    def ears(self) -> int:
        """Number of ears, 1 or 2: the number of references, or 1 without any."""
        return len(self.references) or 1

    @property
    def reference_number(self) -> int:
        """Number of the reference microphone, from 0."""
        return (self.references[0] - 1) // self.ears if self.references else 0

    @property
    def _file_with_room(self) -> Path | None:
        """File of the target in its room, which belongs to clean speech of Clarity's scenes.

        The clean speech has another level than in the room, and the file beside it has the target
        at the reference microphone, or else at microphone 1. It is None if there is no such file,
        or if the clean speech has the right level.
        """
        last = len(self.microphones) - 1  # a file may have the channels of several microphones
        noisy = self.microphones[min(self.reference_number, last)]
        microphone = noisy.stem.rpartition("_")[-1]
        for ending in CLARITY_REFERENCES[:-1]:
            scene = self.clean.name.removesuffix(ending)
            for name in (f"{scene}_target_{microphone}.wav", f"{scene}_target_CH1.wav"):
                file = self.clean.with_name(name)
                if self.clean.name.endswith(ending) and file.is_file():
                    return file
        return None

    def read(self) -> tuple[Tensor, Tensor, int]:
        """Read the signals, with the reference microphone first.

        Samples have 1.0 as full scale. Files that differ by up to 0.1 s are cut to the shortest,
        with a warning, and clean speech with one channel is used for all ears. Anechoic clean
        speech of Clarity's scenes gets the level of the target in the room if that file exists.

        Returns:
            The clean speech, (ears, time), the signals of the microphones, (microphones, ears,
            time), and the sample rate in Hz.

        Raises:
            ValueError: A file cannot be read, or the files differ in sample rate or by more than
                0.1 s, or have numbers of channels that do not fit.
        """
        paths = (self.clean, *self.files)
        waveforms, rates = zip(*map(read_audio, paths), strict=True)
        lengths = [waveform.shape[-1] for waveform in waveforms]
        time = min(lengths)
        if len({*rates}) > 1 or max(lengths) - time > _LARGEST_DIFFERENCE * rates[0]:
            sizes = [
                f"{path.name} with {rate} Hz and {length} samples"
                for path, rate, length in zip(paths, rates, lengths, strict=True)
            ]
            raise ValueError(
                f"{self.clean}: expected the sample rate of its noisy version and its length "
                f"within {_LARGEST_DIFFERENCE:g} s, got {', '.join(sizes)}; replace the files"
            )
        if max(lengths) > time:
            warnings.warn(
                f"{self.clean}: the files of this scene have {time} to {max(lengths)} samples; "
                "all are cut to the shortest",
                stacklevel=2,
            )
        clean, *recordings = (waveform[:, :time] for waveform in waveforms)
        channels = torch.cat(recordings[: len(self.microphones)])
        if not self.references and len(channels) > 1:
            raise ValueError(
                f"{self.microphones[0]}: expected one channel, got {len(channels)}; name the "
                "reference in the column 'reference' of the manifest, or mix them to mono"
            )
        ears = self.ears
        if len(clean) not in (1, ears):
            raise ValueError(
                f"{self.clean}: expected clean speech with one channel, or one for each of {ears} "
                f"ears, got {len(clean)}; replace the file"
            )
        last_reference = max(self.references, default=1)
        if len(channels) % ears or len(channels) < last_reference:
            raise ValueError(
                f"{self.microphones[0]}: expected the same number of microphones for each of "
                f"{ears} ears, with channel {last_reference} among them, got {len(channels)} "
                "channels; correct the column 'reference' of the manifest"
            )
        first = self.reference_number
        microphones = channels.unflatten(0, (-1, ears))
        later = [number for number in range(len(microphones)) if number != first]
        clean = clean.expand(ears, -1)
        for in_room in recordings[len(self.microphones) :]:  # at most one
            clean = set_level(clean, level_spl(in_room))
        return clean, microphones[[first, *later]], rates[0]


class SceneClips(Clips):
    """Clips of recorded scenes, see ``Clips``: first the clean speech, then the microphones.

    Args:
        scenes: Files of the scenes.
        settings: Arguments ``sample_rate`` and ``seconds`` of ``Clips``.

    Attributes:
        ears: Number of ears.
        microphones: Number of microphones per ear.
        clean_files: Paths of the clean speech.
        is_diotic: Whether the clean speech of the first scene is the same at two ears.

    Raises:
        ValueError: There are no scenes, the first one is not valid, or another one has another
            number of ears.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> scene = SceneFiles(EXAMPLE_FILE, (EXAMPLE_FILE,), references=(1,))
    >>> clips = SceneClips([scene], sample_rate=16000, seconds=0.5)
    >>> clips.ears, clips.microphones
    (1, 1)
    """

    def __init__(self, scenes: Sequence[SceneFiles], **settings: Any) -> None:
        super().__init__([scene.microphones[0] for scene in scenes], **settings)
        self._scenes = scenes
        self.clean_files = [scene.clean for scene in scenes]
        self._speech_powers: dict[int, float] = {}  # of whole recordings, by index
        clean, microphones, _ = scenes[0].read()
        self.ears, self.microphones = len(clean), len(microphones)
        self.is_diotic = self.ears > 1 and torch.equal(clean[0], clean[1])
        if {scene.ears for scene in scenes} != {self.ears}:
            raise ValueError("expected the same number of references for all scenes; correct them")
        references = {scene.references for scene in scenes}
        if len(references) > 1:
            warnings.warn(
                "the reference is not the same channel in all scenes, so that a network gets the "
                "microphones in another order; correct the column 'reference' of the manifest "
                "unless the microphones differ, too",
                stacklevel=2,
            )

    def draw_scenes(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw clips at random positions of random scenes in which there is clean speech.

        Returns:
            The clean speech, (count, ears, time), and the signals of the microphones, (count,
            microphones, ears, time), without a calibrated level.
        """
        clips = self.draw(count, generator)
        return clips[:, : self.ears], clips[:, self.ears :].unflatten(1, (-1, self.ears))

    def is_silent(self, clip: Tensor, index: int) -> bool:
        """Return whether the clean speech is at least 20 dB softer than in the whole recording.

        There may be noise in such a pause.
        """
        if index not in self._speech_powers:
            recording = self.read_recording(index)[: self.ears]
            self._speech_powers[index] = float(recording.square().mean())
        clean = clip[: self.ears]
        highest = _PAUSE_POWER * self._speech_powers[index]
        return super().is_silent(clean, index) or float(clean.square().mean()) <= highest

    def _decode(self, index: int) -> Tensor:
        scene = self._scenes[index]
        clean, microphones, rate = scene.read()
        if len(microphones) != self.microphones:
            raise ValueError(
                f"{scene.microphones[0]}: expected {self.microphones} microphones per ear as in "
                f"{self.files[0]}, got {len(microphones)}; leave the scene out"
            )
        channels = torch.cat((clean, microphones.flatten(0, 1)))
        return resample(channels, rate, self.sample_rate)
