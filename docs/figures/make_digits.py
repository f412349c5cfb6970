"""Make the spoken digits in ``hlsim/data/digits`` with the synthesisers flite and espeak-ng.

    python docs/figures/make_digits.py [FOLDER]

It needs the programs flite 2.2 and espeak-ng 1.51 (Debian 12: ``apt-get install flite espeak-ng``).
Each voice becomes one FLAC file of 16 kHz with the digits zero to nine in slots of 0.75 s.
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import soundfile
import torch
from numpy.typing import NDArray

from hlsim.data.bundled import DIGIT_DBFS, DIGITS, SLOT_SAMPLES
from hlsim.dsp.resample import resample

RATE = 16000

WORDS = "zero one two three four five six seven eight nine".split()

VOICES = {
    "flite": ("slt", "rms", "awb", "kal16"),
    "espeak-ng": ("en-gb-x-rp+f5", "en-us+f2", "en-us-nyc+m4", "en-gb-scotland+m7"),
}
"""Voices by program. Voices of espeak-ng consist of a language and a variant."""

FRAME = RATE // 100

MARGIN = RATE // 20
"""Samples that are kept before and after the speech."""


def speak(program: str, voice: str, word: str) -> NDArray[np.float64]:
    """Synthesise a word at 16 kHz."""
    with TemporaryDirectory() as folder:
        file = str(Path(folder) / "word.wav")
        command = ["flite", "-voice", voice, "-t", word, "-o", file]
        if program == "espeak-ng":
            command = ["espeak-ng", "-v", voice, "-s", "160", "-w", file, word]
        subprocess.run(command, check=True)
        samples, rate = soundfile.read(file)
    return resample(torch.from_numpy(samples)[None], rate, RATE)[0].numpy()


def fit_into_slot(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trim a word to 50 ms around the speech, set its level, and fill its slot with silence."""
    whole_frames = samples[: len(samples) // FRAME * FRAME].reshape(-1, FRAME)
    power = np.square(whole_frames).mean(1)
    active = np.flatnonzero(power > 1e-3 * power.max())
    first, end = active[0] * FRAME, (active[-1] + 1) * FRAME
    rms = np.sqrt(np.square(samples[first:end]).mean())
    word = samples[max(0, first - MARGIN) : end + MARGIN] * 10.0 ** (DIGIT_DBFS / 20.0) / rms
    word = np.pad(word, (max(0, MARGIN - first), 0))
    fade = np.linspace(0.0, 1.0, FRAME // 2)
    word[: len(fade)] *= fade
    word[-len(fade) :] *= fade[::-1]
    assert np.abs(word).max() < 1.0
    return np.pad(word, (0, SLOT_SAMPLES - len(word)))


def main(folder: Path = DIGITS) -> None:
    for program, voices in VOICES.items():
        for voice in voices:
            words = [fit_into_slot(speak(program, voice, word)) for word in WORDS]
            name = f"{program.removesuffix('-ng')}-{voice.replace('+', '-')}.flac"
            soundfile.write(folder / name, np.concatenate(words), RATE, subtype="PCM_16")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
