"""The wheel contains what it should, and works without a checkout (``pytest -m install``)."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import soundfile

pytestmark = pytest.mark.install

ROOT = Path(__file__).parents[1]
CHECKPOINT_FILES = ("model.safetensors", "config.json", "README.md")


def run(*command: str | Path, cwd: Path) -> None:
    """Run a command without this environment's variables, and show its output if it fails."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    done = subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the source distribution, as an installer would that has only that."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, cwd=folder)
    [path] = folder.glob("hlsim-*.whl")
    return path


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A new environment with the wheel and no extra, which is deleted, because it is large."""
    folder = tmp_path_factory.mktemp("environment")
    try:
        run(sys.executable, "-m", "venv", folder, cwd=folder)
        run(folder / "bin" / "python", "-m", "pip", "install", wheel, cwd=folder)
        yield folder
    finally:
        shutil.rmtree(folder)


def test_wheel_holds_checkpoints_speech_and_type_markers(wheel: Path) -> None:
    expected = {
        f"{package}/py.typed": ROOT / package / "py.typed" for package in ("hlsim", "compensators")
    }
    for file in (ROOT / "hlsim" / "data" / "speech").rglob("*.*"):
        expected[file.relative_to(ROOT).as_posix()] = file
    checkpoints = sorted(config.parent for config in (ROOT / "checkpoints").glob("*/config.json"))
    assert "neuro-msbg" in [folder.name for folder in checkpoints]
    for folder in checkpoints:
        for name in CHECKPOINT_FILES:
            expected[f"hlsim/checkpoints/{folder.name}/{name}"] = folder / name

    with ZipFile(wheel) as archive:
        names = set(archive.namelist())
        assert expected.keys() <= names, f"missing: {sorted(expected.keys() - names)}"
        for name, file in expected.items():
            assert archive.read(name) == file.read_bytes(), name
    assert {name.split("/")[0].split("-")[0] for name in names} == {"hlsim", "compensators"}


@pytest.mark.parametrize("simulator", ["neuro-msbg", "msbg"])
def test_installed_wheel_simulates_outside_the_repository(
    simulator: str, environment: Path, tmp_path: Path
) -> None:
    [package] = environment.glob("lib/python*/site-packages/hlsim")
    source = package / "data" / "speech" / "valid" / "flite-rms-01.flac"
    command = [environment / "bin" / "hlsim", "simulate", source, "out.wav", "--audiogram", "N3"]
    run(*command, "--simulator", simulator, cwd=tmp_path)

    clean, clean_rate = soundfile.read(source)
    perceived, perceived_rate = soundfile.read(tmp_path / "out.wav")
    assert perceived_rate == clean_rate
    assert perceived.shape == clean.shape
    assert np.isfinite(perceived).all()
    # With the moderate loss N3, speech at 68 dB SPL is perceived, but softer
    level = 10 * np.log10(np.mean(perceived**2) / np.mean(clean**2))
    assert -60 < level < -3
