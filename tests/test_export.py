"""Exported simulators give the simulator's outputs."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hlsim import MSBG, NeuroMSBG, load_pretrained
from hlsim.export import export_onnx, export_program
from hlsim.neuro import NeuroConfig


def example(items: int = 2, seconds: float = 0.5) -> tuple[Tensor, Tensor]:
    ears = torch.tensor([[20.0, 30, 40, 50, 60, 60, 60, 60], [0.0, 5, 10, 15, 20, 20, 20, 20]])
    return 0.03 * torch.randn(items, round(16000 * seconds)), ears[:items]


@pytest.mark.parametrize(
    ("name", "items", "seconds"),
    [("neuro-msbg", 2, 0.5), ("neuro-msbg", 1, 1.1), ("neuro-msbg-mamba", 2, 0.5)],
)
def test_a_program_gives_the_simulators_outputs(name: str, items: int, seconds: float) -> None:
    simulator = load_pretrained(name, full_scale_spl=100.0)
    # first of all at this length, so that nothing made in the export may serve the simulator
    program = export_program(simulator, seconds=seconds, items=items).module()
    wave, ears = example(items, seconds)
    expected = simulator(wave, ears)
    assert float((program(wave, ears) - expected).abs().max()) < 1e-4 * float(expected.abs().max())


def test_the_simulator_keeps_its_mode_and_its_precision() -> None:
    simulator = NeuroMSBG(NeuroConfig(channels=4, blocks=1)).double().train()
    simulator.encoder.eval()
    before = [module.training for module in simulator.modules()]
    program = export_program(simulator, seconds=0.1, items=2).module()
    assert [module.training for module in simulator.modules()] == before
    wave, ears = (tensor.double() for tensor in example(seconds=0.1))
    torch.testing.assert_close(program(wave, ears), simulator(wave, ears))


@pytest.mark.parametrize(
    "options",
    [{"seconds": -1}, {"seconds": 0}, {"seconds": float("nan")}, {"items": 0}, {"items": 1.5}],
)
def test_sizes_of_no_program(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="allowed: more than 0 seconds, 1 item or more") as caught:
        export_program(NeuroMSBG(), **options)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_exported_is_said(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="MSBG cannot be exported; allowed: a Neuro-MSBG"):
        export_program(MSBG())
    with pytest.raises(ValueError, match="sample_rate 16000"):
        export_program(load_pretrained("neuro-msbg", sample_rate=44100))


def test_a_missing_folder_is_said_before_the_export(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hlsim.export.export_program", lambda *_, **__: pytest.fail("exported"))
    with pytest.raises(
        ValueError, match=r"there is no folder '.*missing'; allowed: a file in a folder"
    ):
        export_onnx(
            NeuroMSBG(NeuroConfig(channels=4, blocks=1)), tmp_path / "missing" / "simulator.onnx"
        )


@pytest.mark.slow
@pytest.mark.parametrize(("items", "seconds"), [(2, 0.5), (1, 1.0)])
def test_onnx_gives_the_outputs(tmp_path: Path, items: int, seconds: float) -> None:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    simulator, path = load_pretrained("neuro-msbg"), tmp_path / "simulator.onnx"
    wave, ears = example(items, seconds)
    export_onnx(simulator, path, seconds=seconds, items=items)
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [entry.name for entry in session.get_inputs()]
    heard = session.run(None, dict(zip(names, (wave.numpy(), ears.numpy()), strict=True)))[0]
    expected = simulator(wave, ears)
    assert float((torch.from_numpy(heard) - expected).abs().max()) < 1e-4 * float(
        expected.abs().max()
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("broken", "complaint"),
    [
        (
            lambda session, names, given: [0.999 * heard for heard in session(names, given)],
            "off by 1e-03",
        ),
        (lambda session, names, given: 1 / 0, "onnxruntime refuses the file"),
    ],
)
def test_onnx_that_gives_something_else_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: Any, complaint: str
) -> None:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    run = runtime.InferenceSession.run
    monkeypatch.setattr(
        runtime.InferenceSession,
        "run",
        lambda self, names, given: broken(lambda *wanted: run(self, *wanted), names, given),
    )
    with pytest.raises(
        ValueError, match=f"ONNX cannot take the simulator: .*{complaint}"
    ) as caught:
        export_onnx(
            NeuroMSBG(NeuroConfig(channels=4, blocks=1)), tmp_path / "simulator.onnx", seconds=0.1
        )
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())
