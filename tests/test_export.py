"""Exported simulators and aids give the outputs of the modules."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from compensators import WDRC, HearingAid
from hlsim import MSBG, Audiogram, NeuroMSBG, load_pretrained
from hlsim.export import (
    export_aid,
    export_fit,
    export_onnx,
    export_program,
    first_inputs,
    hop_program,
)
from hlsim.neuro import NeuroConfig
from tests.compensators.aids import EAR, WEARABLES, build_wearable, varied_hearing_aid

SMALL = NeuroConfig(channels=4, blocks=1)


def example(items: int = 2, seconds: float = 0.5) -> tuple[Tensor, Tensor]:
    ears = torch.tensor([[20.0, 30, 40, 50, 60, 60, 60, 60], [0.0, 5, 10, 15, 20, 20, 20, 20]])
    return 0.03 * torch.randn(items, round(16000 * seconds)), ears[:items]


def assert_near(output: Tensor, expected: Tensor, tolerance: float) -> None:
    assert float((output - expected).abs().max()) < tolerance * float(expected.abs().max())


def onnx_session(path: Path) -> Any:
    runtime = pytest.importorskip("onnxruntime")
    return runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


@pytest.mark.parametrize(
    ("name", "items", "seconds"),
    [("neuro-msbg", 2, 0.5), ("neuro-msbg", 1, 1.1), ("neuro-msbg-mamba", 2, 0.5)],
)
def test_a_program_gives_the_simulators_outputs(name: str, items: int, seconds: float) -> None:
    simulator = load_pretrained(name, full_scale_spl=100.0)
    # exported before the first call of this length, so that the export computes all constants
    program = export_program(simulator, seconds=seconds, items=items).module()
    wave, ears = example(items, seconds)
    assert_near(program(wave, ears), simulator(wave, ears), 1e-4)


def test_an_export_leaves_mode_and_precision_as_they_are() -> None:
    simulator = NeuroMSBG(SMALL).double().train()
    simulator.encoder.eval()
    before = [module.training for module in simulator.modules()]
    program = export_program(simulator, seconds=0.1, items=2).module()
    assert [module.training for module in simulator.modules()] == before
    wave, ears = (tensor.double() for tensor in example(seconds=0.1))
    torch.testing.assert_close(program(wave, ears), simulator(wave, ears))
    aid = HearingAid().train()
    hop_program(aid)
    assert all(module.training for module in aid.modules())


@pytest.mark.parametrize("name", WEARABLES)
def test_a_program_of_hops_gives_the_outputs_of_the_stream(name: str) -> None:
    """For two ears, at another full scale, with a slider that moves on the way."""
    aid: Any = build_wearable(name, full_scale_spl=110.0)
    ears = torch.tensor([EAR.thresholds, Audiogram.standard("S2").thresholds])
    inputs, stream, outputs, expected = first_inputs(aid, ears, items=2), aid.stream(ears), [], []
    assert not aid.SLIDERS or set(inputs) >= set(aid.initial_state(torch.ones(2, 2)))
    program = hop_program(aid, items=2).module()
    for number, samples in enumerate((0.005 * torch.randn(2, 6400)).split(64, -1)):
        if number == 40 and aid.SLIDERS:
            stream.noise_reduction, inputs["sliders"] = 0.2, torch.tensor([[0.2, 1.0]] * 2)
        results = program(**inputs | {"samples": samples})
        outputs.append(results.pop("output"))
        inputs |= {name.removeprefix("next_"): state for name, state in results.items()}
        expected.append(stream(samples))
    assert_near(torch.cat(outputs, -1), torch.cat(expected, -1), 1e-5)


@pytest.mark.parametrize("name", WEARABLES)
def test_a_program_of_several_hops_gives_the_outputs_of_the_stream(name: str) -> None:
    aid: Any = build_wearable(name)
    inputs = first_inputs(aid, EAR, hops=5)
    program = hop_program(aid, hops=5).module()
    signal = 0.02 * torch.randn(1, 20 * 320)
    outputs = []
    for samples in signal.split(320, -1):
        results = program(**inputs | {"samples": samples})
        outputs.append(results.pop("output"))
        inputs |= {name.removeprefix("next_"): state for name, state in results.items()}
    assert_near(torch.cat(outputs, -1), aid.stream(EAR)(signal), 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("items", "seconds"), [(2, 0.5), (1, 1.0)])
def test_onnx_gives_the_simulators_outputs(tmp_path: Path, items: int, seconds: float) -> None:
    pytest.importorskip("onnxscript")
    simulator, path = load_pretrained("neuro-msbg"), tmp_path / "simulator.onnx"
    wave, ears = example(items, seconds)
    export_onnx(simulator, path, seconds=seconds, items=items)
    session = onnx_session(path)
    inputs = {"waveform": wave.numpy(), "thresholds": ears.numpy()}
    assert_near(torch.from_numpy(session.run(None, inputs)[0]), simulator(wave, ears), 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", WEARABLES)
def test_onnx_gives_the_outputs_of_the_stream(name: str, tmp_path: Path) -> None:
    """For steps in level, with sliders that move on the way."""
    pytest.importorskip("onnxscript")
    aid: Any = build_wearable(name)
    export_aid(aid, tmp_path / "aid.onnx")
    session = onnx_session(tmp_path / "aid.onnx")
    names = [entry.name.removeprefix("next_") for entry in session.get_outputs()]
    inputs = {name: tensor.numpy() for name, tensor in first_inputs(aid, EAR).items()}
    levels = torch.tensor([20.0, 70.0, 50.0, 90.0, 60.0]).repeat_interleave(3200)
    signal = torch.randn(1, 16000) * 10.0 ** ((levels - 94.0) / 20.0)
    stream, outputs, expected = aid.stream(EAR), [], []
    for number, samples in enumerate(signal.split(64, -1)):
        if number == 100 and aid.SLIDERS:
            stream.noise_reduction = 0.2
            inputs["sliders"] = torch.tensor([[0.2, 1.0]]).numpy()
        inputs["samples"] = samples.numpy()
        results = dict(zip(names, session.run(None, inputs), strict=True))
        outputs.append(torch.from_numpy(results.pop("output")))
        inputs |= results
        expected.append(stream(samples))
    assert_near(torch.cat(outputs, -1), torch.cat(expected, -1), 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", WEARABLES)
def test_onnx_without_torch_gives_the_outputs_of_the_stream(name: str, tmp_path: Path) -> None:
    """For two hops per call, fitted and started as on a machine without torch."""
    pytest.importorskip("onnxscript")
    aid: Any = build_wearable(name)
    export_fit(aid, tmp_path / "fit.onnx")
    export_aid(aid, tmp_path / "aid.onnx", hops=2)
    thresholds = torch.tensor([EAR.thresholds]).numpy()
    fitted = onnx_session(tmp_path / "fit.onnx").run(None, {"thresholds": thresholds})[0]
    session = onnx_session(tmp_path / "aid.onnx")
    shapes = {entry.name: entry.shape for entry in session.get_inputs()}
    inputs = {name: torch.zeros(shape).numpy() for name, shape in shapes.items()}
    inputs["fitted"] = fitted
    for name in {"sliders", "gliding"} & set(inputs):
        inputs[name] = torch.tensor([aid.DEFAULT_SLIDERS]).numpy()
    names = [entry.name.removeprefix("next_") for entry in session.get_outputs()]
    signal = 0.02 * torch.randn(1, 6400)
    outputs = []
    for samples in signal.split(128, -1):
        inputs["samples"] = samples.numpy()
        results = dict(zip(names, session.run(None, inputs), strict=True))
        outputs.append(torch.from_numpy(results.pop("output")))
        inputs |= results
    assert_near(torch.cat(outputs, -1), aid.stream(EAR)(signal), 1e-4)


@pytest.mark.slow
def test_a_linked_aid_is_exported_for_two_ears(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    export_aid(WDRC(linked=True), tmp_path / "aid.onnx", items=2)
    assert onnx_session(tmp_path / "aid.onnx").get_outputs()[0].shape == [2, 64]


@pytest.mark.slow
def test_a_file_with_other_outputs_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    run = runtime.InferenceSession.run
    monkeypatch.setattr(
        runtime.InferenceSession,
        "run",
        lambda self, names, inputs: [0.999 * output for output in run(self, names, inputs)],
    )
    with pytest.raises(ValueError, match="differs by 1e-03 of its peak"):
        export_onnx(NeuroMSBG(SMALL), tmp_path / "simulator.onnx", seconds=0.1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "call",
    [
        lambda: export_program(MSBG()),
        lambda: export_program(load_pretrained("neuro-msbg", sample_rate=44100)),
        lambda: export_program(NeuroMSBG(SMALL), seconds=0.0),
        lambda: export_program(NeuroMSBG(SMALL), seconds=float("nan")),
        lambda: export_program(NeuroMSBG(SMALL), items=0),
        lambda: hop_program(varied_hearing_aid(sample_rate=44100)),
        lambda: first_inputs(varied_hearing_aid(), EAR, volume=1.0),
    ],
)
def test_what_cannot_be_exported_is_a_value_error(call: Callable[[], object]) -> None:
    with pytest.raises(ValueError):
        call()
