"""The wheel contains what it should, and works without a checkout (``pytest -m install``)."""

import os
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import soundfile
from packaging.requirements import Requirement

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


def test_the_wheel_is_small(wheel: Path) -> None:
    assert wheel.stat().st_size < 20e6


def requirements(name: str) -> set[str]:
    """Return the names of all distributions that a distribution requires without any extra."""
    names = set()
    for text in distribution(name).requires or []:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            names |= {requirement.name, *requirements(requirement.name)}
    return names


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new environment with the wheel and no extra.

    What the wheel requires is linked from this environment, because a copy takes gigabytes.
    """
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder)
    [site] = folder.glob("lib/python*/site-packages")
    for name in requirements("hlsim"):
        for file in distribution(name).files or []:
            link = site / file.parts[0]
            if file.parts[0] not in ("..", "__pycache__") and not link.exists():
                link.symlink_to(distribution(name).locate_file(file.parts[0]))
    pip = (sys.executable, "-m", "pip", "--python", folder)
    run(*pip, "install", "--no-deps", wheel, cwd=folder)
    run(*pip, "check", cwd=folder)
    return folder


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
