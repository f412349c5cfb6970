"""Small corpora made of the embedded speech, and plans of them."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim.audio import read_audio, write_audio
from hlsim.data.plan import prepare
from hlsim.data.plan_settings import PlanSettings
from hlsim.dsp.resample import resample

RATE = 16000


@pytest.fixture(scope="session")
def pieces(speech_dir: Path) -> list[Tensor]:
    """Ten pieces of 0.8 s of ten utterances, 16 kHz. Shape: (12800,) each."""
    found = []
    for path in sorted(speech_dir.glob("*/*.flac"))[:10]:
        waveform, rate = read_audio(path)
        at_rate = resample(waveform[0], rate, RATE)
        found.append(at_rate[4000:16800])
    return found


@pytest.fixture
def voicebank(tmp_path: Path, pieces: list[Tensor]) -> Path:
    """Three speakers' utterances in VoiceBank-DEMAND's layout, two to train with and one for test."""
    root = tmp_path / "vbd"
    generator = torch.Generator().manual_seed(5)
    names = {
        "trainset_28spk": ("p226_001", "p226_002", "p227_001", "p227_002"),
        "testset": ("p232_001", "p232_002"),
    }
    for number, (part, name) in enumerate(
        (part, name) for part, own in names.items() for name in own
    ):
        clean = pieces[number]
        noisy = clean + 0.01 * torch.randn(clean.shape, generator=generator)
        for kind, wave in (("clean", clean), ("noisy", noisy)):
            folder = root / f"{kind}_{part}_wav"
            folder.mkdir(parents=True, exist_ok=True)
            write_audio(folder / f"{name}.wav", wave, RATE)
    (root / "log_trainset_28spk.txt").write_text("p226_001 cafe 5\np227_002 bus 15\n")
    return root


@pytest.fixture
def noise_folder(tmp_path: Path) -> Path:
    """Three types of noise, one of them with long pauses."""
    generator = torch.Generator().manual_seed(6)
    for number, name in enumerate(("hiss", "hum", "taps")):
        noise = torch.randn(RATE, generator=generator)
        if name == "taps":
            noise[: RATE // 2] = 0.0
        (tmp_path / "noise" / name).mkdir(parents=True)
        write_audio(tmp_path / "noise" / name / "a.wav", 0.1 * noise / (number + 1), RATE)
    return tmp_path / "noise"


@pytest.fixture
def plan(voicebank: Path, tmp_path: Path) -> Path:
    """A prepared folder: 6 utterances, 24 instances."""
    prepare(PlanSettings(voicebank, level=(55.0, 75.0)), tmp_path / "plan", jobs=1)
    return tmp_path / "plan"
