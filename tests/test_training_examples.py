"""The examples of training through the loss run as they stand, a few steps."""

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import pytest
import torch

EXAMPLES = Path(__file__).parents[1] / "examples" / "training"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(name).stem, EXAMPLES / name)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def losses(out: str) -> list[float]:
    return [float(line.split(":")[1]) for line in out.splitlines()]


def test_conv_tasnet_trains(tmp_path: Path, speech_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load("conv_tasnet.py").main(str(speech_dir / "train"), str(tmp_path / "out.pt"), "N3", "2", 0.3)
    assert all(0.0 < value < 5.0 for value in losses(capsys.readouterr().out))
    assert torch.load(tmp_path / "out.pt")


def test_a_criterion_of_ones_own_trains(capsys: pytest.CaptureFixture[str]) -> None:
    load("your_criterion.py").main(6)
    values = losses(capsys.readouterr().out)
    assert values[-1] < values[0]


def test_lightning_in_bf16(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("lightning")
    aid = load("lightning_bf16.py").main(2)
    assert set(aid.state_dict()) == {"network.weight", "network.bias"}
    assert float(aid.trainer.callback_metrics["loss"]) > 0.0


def test_a_filter_bank_trains(speech_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = load("filter_bank.py")
    ear = example.Audiogram.standard("N3")
    aid = example.trained(str(speech_dir / "train"), ear, 8)
    start, *_, end = losses(capsys.readouterr().err)
    assert end < start
    assert float(aid.gain.mean()) > 0.1  # of 10 dB
    assert torch.equal(
        example.FilterBank()(torch.ones(1, 500)).isfinite(), torch.ones(1, 500, dtype=torch.bool)
    )
    speech = example.Clips(str(speech_dir / "valid"), sample_rate=16000, seconds=1.0).draw(
        1, torch.Generator().manual_seed(0)
    )
    nothing, louder = (example.judged(lambda wave, g=gain: g * wave, ear, speech) for gain in (1.0, 10.0))
    assert "gives 65.0 dB SPL" in nothing and "gives 85.0 dB SPL" in louder
    assert nothing < louder  # HASPI comes first


def test_haspi_trains_with_the_level_and_without(
    speech_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    example = load("haspi_objective.py")
    ear = example.Audiogram.standard("N3")
    for name in ("HASPILoss", "HASPI alone"):
        aid = example.trained(str(speech_dir / "train"), ear, 3, math.inf, name)
        assert len(capsys.readouterr().err.splitlines()) == 2  # the first step and the last
        assert float(aid.gain.detach().mean()) > 0.05  # of 10 dB: speech is heard too softly
    speech = example.Clips(speech_dir / "valid", sample_rate=16000, seconds=1.0)
    told = example.told(aid, ear, speech.draw(1, torch.Generator().manual_seed(0)), math.inf)
    assert told.startswith("HASPI 0.") and 80.0 < float(told.split()[-3]) < 110.0
