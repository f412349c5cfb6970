"""The command ``prepare``: what they say and write, and one line on bad input."""

from pathlib import Path

import pytest
import torch

from hlsim.audio import write_audio
from hlsim.cli.main import main


@pytest.fixture
def corpus(tmp_path: Path) -> Path:
    """Two speakers, an utterance each, and one file that is no audio."""
    generator = torch.Generator().manual_seed(0)
    for name in ("ann", "bob"):
        (tmp_path / "speech" / name).mkdir(parents=True)
        write_audio(
            tmp_path / "speech" / name / "1.wav",
            0.05 * torch.randn(9600, generator=generator),
            16000,
        )
    (tmp_path / "speech" / "bob" / "2.wav").write_text("x")
    for kind in ("hum", "hiss"):
        (tmp_path / "noise" / kind).mkdir(parents=True)
        write_audio(
            tmp_path / "noise" / kind / "1.wav",
            0.05 * torch.randn(9600, generator=generator),
            16000,
        )
    return tmp_path / "speech"


def test_prepare_says_what_it_found_and_writes(
    corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = [
        "prepare",
        str(corpus),
        "--noise",
        str(tmp_path / "noise"),
        "--out",
        str(out),
        "--jobs",
        "1",
        "--write",
    ]
    for _ in range(2):
        assert main(command) == 0
        said = capsys.readouterr()
        assert said.out.splitlines() == [
            "train: 1 utterances, 0.00 h, 4 instances; ears 50 % mild, 50 % severe",
            "test: 1 utterances, 0.00 h, 4 instances; ears 50 % mild, 50 % severe",
            f"1 faults are left out: {out / 'faults.csv'}",
            f"8 instances are in {out / 'instances'}",
        ]
        assert "8 of 8 instances" in said.err
    assert len(list(out.rglob("*.safetensors"))) == 8


def test_options_reach_the_plan(
    corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    options = [
        "--severities",
        "none=1,severe=1",
        "--ears",
        "4",
        "--level",
        "50",
        "70",
        "--rate",
        "22050",
    ]
    assert main(["prepare", str(corpus), "--out", str(out), "--jobs", "1", *options]) == 0
    assert (
        capsys.readouterr().out.splitlines()[0].endswith("4 instances; ears 50 % none, 50 % severe")
    )
    rows = (out / "instances.csv").read_text().splitlines()[1:]
    assert {row.split(",")[3] for row in rows} == {"clean"}
    assert all(50.0 <= float(row.split(",")[4]) <= 70.0 for row in rows)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--strict"], "1 faults, the first bob/2.wav: not readable as audio"),
        (["--severities", "deaf=1"], "unknown severities deaf"),
        (["--level", "50", "60", "70"], "allowed: one level, or lowest and highest"),
        (["--backend", "dask"], "needs the scheduler's address"),
        (["--backend", "dask", "--scheduler", "tcp://127.0.0.1:1"], "no Dask scheduler answers"),
        (["--root", "."], "not in the root"),
        (
            ["--train-snr", "5,10", "--test-snr", "5", "--noise", "NOISE"],
            "SNRs 5 dB for training and test",
        ),
        (
            ["--train-snr", "5", "--test-types", "1"],
            "--train-snr, --test-types without --noise; allowed",
        ),
        (["--teacher", "pyclarity"], "--teacher without --write; allowed: only with it"),
        (["--teacher", "nobody:hears", "--write"], "teacher nobody:hears: cannot be had"),
        (["--rate", "44101", "--write"], "44101 Hz for a teacher; allowed: 16000"),
        (["--alignment", "impulse"], "--alignment without --write; allowed: only with it"),
    ],
)
def test_bad_input_is_one_line(
    corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    if "dask" in options:
        pytest.importorskip("distributed")
    options = [str(tmp_path / "noise") if option == "NOISE" else option for option in options]
    where = [] if "dask" in options else ["--jobs", "1"]
    assert main(["prepare", str(corpus), "--out", str(tmp_path / "out"), *where, *options]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("hlsim: error: ") and said in error
    assert not (tmp_path / "out" / "manifest.csv").exists()
