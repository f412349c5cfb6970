"""Recordings of any length: the output is that of the whole one, and the memory has a limit."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import hlsim
from compensators import load_compensator
from hlsim.audio import scan_audio, write_audio
from hlsim.cli.long_recordings import divide_recording, process_recording
from hlsim.dsp.resample import resample
from hlsim.simulators import load_simulator

BLOCKS = ("hlsim.cli.long_recordings", "hlsim.msbg.overlapping_blocks")
"""Modules that define the duration of their blocks."""


@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("msbg", 16000),
        ("neuro-msbg", 16000),
        ("neuro-msbg", 44100),
        ("attenuation", 44100),
        ("nalr", 16000),
        ("wdrc", 44100),
        ("hearing-aid", 16000),
    ],
)
def test_the_output_by_blocks_is_that_of_the_whole_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, rate: int
) -> None:
    channels = 2 if name in ("wdrc", "msbg") else 1
    # MSBG's blocks overlap by 2 s, and those of the default network begin 1.28 s apart.
    seconds = {"msbg": 4.0, "neuro-msbg": 1.3}.get(name, 0.7)
    speech = resample(hlsim.example_speech().repeat(2), 16000, rate)
    speech = speech[: round(2.6 * seconds * rate) + 7]
    signal = torch.stack([speech, 0.5 * speech.flip(0)])[:channels]
    write_audio(tmp_path / "speech.wav", signal, rate)
    ear: Any = hlsim.Listener("N2", "N4") if channels == 2 else "N3"
    settings: dict[str, Any] = {"linked": True} if name == "wdrc" else {}
    load: Any = load_simulator if "msbg" in name or name == "attenuation" else load_compensator
    model = load(name, sample_rate=rate, **settings)
    if name == "msbg":  # Its whole output is computed in blocks, too, and must have the same bits.
        monkeypatch.setattr("hlsim.msbg.overlapping_blocks._BLOCK_SECONDS", seconds)
        monkeypatch.setattr("hlsim.msbg.model._CPU_SAMPLES", 1)
    sliders = {"noise_reduction": 0.9} if name == "hearing-aid" else {}
    with torch.no_grad():
        whole = model(signal, ear, **sliders)
        for module in BLOCKS:
            monkeypatch.setattr(f"{module}._BLOCK_SECONDS", seconds)
        recording = scan_audio(tmp_path / "speech.wav")
        parts = list(process_recording(model, recording, 1.0, ear, **sliders))
    assert len(parts) > 1
    tolerance = 0.0 if name == "msbg" else 2e-5 * float(whole.abs().max())
    torch.testing.assert_close(torch.cat(parts, -1), whole, rtol=0.0, atol=tolerance)


def test_a_model_that_needs_the_whole_recording_gets_one_block() -> None:
    model = load_simulator("neuro-msbg-lstm")
    assert len(divide_recording(model, 10_000_000, 16000)) == 1


LONG_RECORDING = """
import resource, sys
import numpy as np, soundfile
import compensators, hlsim.simulators
from hlsim.cli.main import main
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
rate, minutes, command = int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
noise = 0.01 * np.random.default_rng(0).standard_normal((60 * rate, 2), dtype=np.float32)
with soundfile.SoundFile(sys.argv[1] + "/in.wav", "w", rate, 2, "PCM_16") as file:
    for _ in range(minutes):
        file.write(noise)
files = [sys.argv[1] + "/in.wav", sys.argv[1] + "/out.wav"]
before = peak()
assert main([command[0], *files, *command[1:]]) == 0
assert soundfile.info(files[1]).frames == 60 * rate * minutes
print(before, peak() - before)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("minutes", "rate", "command", "limit"),
    [
        (2, 16000, "simulate --audiogram N3 --spl 65", 350),
        (1, 48000, "simulate --audiogram N3 --simulator neuro-msbg", 200),
        (2, 16000, "compensate --audiogram N3 --no-clipping", 150),
        (1, 48000, "compensate --audiogram N3 --compensator wdrc --spl 100 --no-clipping", 220),
    ],
)
def test_memory_does_not_grow_with_the_recording(
    tmp_path: Path, minutes: int, rate: int, command: str, limit: int
) -> None:
    """A whole recording of so many minutes would take more than the limit, in MiB."""
    script = [sys.executable, "-c", LONG_RECORDING, str(tmp_path)]
    call = [*script, str(rate), str(minutes), *command.split()]
    ended = subprocess.run(call, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr[-2000:]
    # Imports take 200 MB with a torch for CPUs, and 500 MB with one for GPUs.
    assert int(ended.stdout.split()[-1]) <= limit, ended.stdout
