"""Exported simulators and aids give the outputs of the modules."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from compensators import load_compensator
from hlsim import MSBG, Audiogram, load_pretrained
from hlsim.export import (
    export_aid,
    export_fit,
    export_onnx,
    export_program,
    first_inputs,
    hop_program,
)
from tests.compensators.aids import (
    EAR,
    WEARABLES,
    assert_close,
    build_wearable,
    varied_hearing_aid,
)

EARS = torch.tensor([EAR.thresholds, Audiogram.standard("S2").thresholds])

Call = Callable[[dict[str, Tensor]], dict[str, Tensor]]
wearables = pytest.mark.parametrize("name", WEARABLES)


def assert_equals_stream(
    call: Call, inputs: dict[str, Tensor], aid: Any, ears: Any, signal: Tensor, tolerance: float
) -> None:
    """Process a signal as the module's docstring says, with a slider that moves on the way."""
    stream, outputs, expected = aid.stream(ears), [], []
    for number, samples in enumerate(signal.split(inputs["samples"].shape[-1], -1)):
        if number == 20 and aid.SLIDERS:
            stream.set(noise_reduction=0.2)
            inputs["sliders"] = torch.tensor([[0.2, 1.0]] * len(signal))
        results = call(inputs | {"samples": samples})
        outputs.append(results.pop("output"))
        inputs |= {name.removeprefix("next_"): state for name, state in results.items()}
        expected.append(stream(samples))
    assert_close(torch.cat(outputs, -1), torch.cat(expected, -1), tolerance)


def open_onnx(path: Path) -> tuple[Call, dict[str, list[int]]]:
    """Return a function from inputs to outputs by name, and the shapes of the inputs."""
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [entry.name for entry in session.get_outputs()]

    def call(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        results = session.run(None, {name: tensor.numpy() for name, tensor in inputs.items()})
        return dict(zip(names, map(torch.from_numpy, results), strict=True))

    return call, {entry.name: entry.shape for entry in session.get_inputs()}


@pytest.mark.parametrize(
    ("name", "items", "samples"),
    [
        ("neuro-msbg", 1, 17600),
        pytest.param("neuro-msbg-mamba", 2, 1600, marks=pytest.mark.slow),
    ],
)
def test_a_program_gives_the_simulators_outputs(name: str, items: int, samples: int) -> None:
    simulator = load_pretrained(name, full_scale_spl=100.0)
    # exported before the first call of this length, so that the export computes all constants
    program = export_program(simulator, seconds=samples / 16000, items=items).module()
    waveform, ears = 0.03 * torch.randn(items, samples), EARS[:items]
    perceived = program(waveform=waveform, thresholds=ears)["perceived"]
    assert_close(perceived, simulator(waveform, ears), 1e-4)


@pytest.mark.parametrize(
    ("name", "items", "hops"),
    [
        pytest.param("wdrc", 2, 1, marks=pytest.mark.slow),
        pytest.param("wdrc", 1, 5, marks=pytest.mark.slow),
        pytest.param("aid", 2, 3, marks=pytest.mark.slow),
    ],
)
def test_a_program_of_hops_gives_the_outputs_of_the_stream(
    name: str, items: int, hops: int
) -> None:
    aid: Any = build_wearable(name, full_scale_spl=110.0)
    inputs = first_inputs(aid, EARS[:items], items=items, hops=hops)
    assert not aid.SLIDERS or set(inputs) >= set(aid.initial_state(torch.ones(2, 2)))
    program = hop_program(aid, items=items, hops=hops).module()
    signal = 0.005 * torch.randn(items, hops * 3200)
    assert_equals_stream(lambda x: program(**x), inputs, aid, EARS[:items], signal, 1e-5)


@pytest.mark.slow
def test_onnx_gives_the_simulators_outputs(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    simulator, path = load_pretrained("neuro-msbg"), tmp_path / "simulator.onnx"
    export_onnx(simulator, path, seconds=0.5, items=2)
    wave = 0.03 * torch.randn(2, 8000)
    results = open_onnx(path)[0]({"waveform": wave, "thresholds": EARS})
    assert_close(results["perceived"], simulator(wave, EARS), 1e-4)


@pytest.mark.slow
def test_onnx_differs_by_rounding_only_for_a_tone(tmp_path: Path) -> None:
    """The phase of frequencies without sound is that of rounding, in torch as in onnxruntime."""
    pytest.importorskip("onnxscript")
    simulator, path = load_pretrained("neuro-msbg-cnn-narrow"), tmp_path / "simulator.onnx"
    export_onnx(simulator, path, seconds=0.5)
    call, ears = open_onnx(path)[0], EARS[:1]
    tone = 0.05 * (torch.arange(8000) * torch.pi / 8.0).sin().unsqueeze(0)
    precise_simulator = copy.deepcopy(simulator).double()
    precise = precise_simulator(tone.double(), ears.double())
    rounding = 1e-7 * tone.abs().max() * torch.randn_like(tone)
    moved = precise_simulator((tone + rounding).double(), ears.double())
    onnx = call({"waveform": tone, "thresholds": ears})["perceived"]
    assert (moved - precise).abs().max() > 1e-4 * precise.abs().max()
    assert_close(onnx, precise.float(), 0.1)
    noise = 10.0 ** (-50.0 / 20.0) * tone.square().mean().sqrt() * torch.randn_like(tone)
    noisy = tone + noise
    results = call({"waveform": noisy, "thresholds": ears})
    assert_close(results["perceived"], simulator(noisy, ears), 1e-3)


@pytest.mark.slow
@wearables
def test_onnx_gives_the_outputs_of_the_stream(name: str, tmp_path: Path) -> None:
    """For steps in level and two hops per call, started as on a machine without torch."""
    pytest.importorskip("onnxscript")
    aid: Any = build_wearable(name)
    export_fit(aid, tmp_path / "fit.onnx")
    export_aid(aid, tmp_path / "aid.onnx", hops=2)
    call, shapes = open_onnx(tmp_path / "aid.onnx")
    inputs = {name: torch.zeros(shape) for name, shape in shapes.items()}
    inputs |= open_onnx(tmp_path / "fit.onnx")[0]({"thresholds": EARS[:1]})
    for name in {"sliders", "gliding"} & set(inputs):
        inputs[name] = torch.tensor([list(aid.SLIDERS.values())])
    levels = torch.tensor([20.0, 70.0, 50.0, 90.0, 60.0]).repeat_interleave(3200)
    signal = torch.randn(1, 16000) * 10.0 ** ((levels - 94.0) / 20.0)
    assert_equals_stream(call, inputs, aid, EAR, signal, 1e-4)


@pytest.mark.slow
def test_a_file_with_other_outputs_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    run = runtime.InferenceSession.run

    def run_with_error(*arguments: Any) -> list[Any]:
        return [0.999 * output for output in run(*arguments)]

    monkeypatch.setattr(runtime.InferenceSession, "run", run_with_error)
    with pytest.raises(ValueError, match="differs by 1e-03 of its peak"):
        export_fit(build_wearable("wdrc"), tmp_path / "fit.onnx")
    assert not list(tmp_path.iterdir())


BAD_CALLS: list[Callable[[], object]] = [
    lambda: export_program(MSBG()),
    lambda: export_program(load_pretrained("neuro-msbg", sample_rate=44100)),
    lambda: hop_program(varied_hearing_aid(sample_rate=44100)),
]


@pytest.mark.parametrize("call", BAD_CALLS)
def test_what_cannot_be_exported_is_a_value_error(call: Callable[[], object]) -> None:
    with pytest.raises(ValueError):
        call()


@pytest.mark.slow  # the other tests export with hlsim.export, which calls torch.export
@pytest.mark.parametrize("name", ["neuro-msbg", "compensator-general", "hearing-aid"])
def test_torch_exports_a_network_by_itself(name: str) -> None:
    """Levels that are out of range give NaN, because a program cannot raise an error."""
    model: Any = load_pretrained(name) if "msbg" in name else load_compensator(name)
    signal = 0.02 * torch.randn(2, 1600)
    call = torch.export.export(model, (signal, EARS)).module()
    assert_close(call(signal, EARS), model(signal, EARS), 1e-4)
    too_high = EARS.clone()
    too_high[1, 3] = 130.0
    output = call(signal, too_high)
    assert bool(output[0].isfinite().all()) and bool(output[1].isnan().all())


def test_other_aids_and_sizes_below_one_are_errors(tmp_path: Path) -> None:
    aid: Any = load_compensator("nalr")
    for export in (hop_program, lambda aid: export_fit(aid, tmp_path / "fit.onnx")):
        with pytest.raises(
            ValueError, match="expected a WDRC, a CAMFIT or a HearingAid, got a NALR"
        ):
            export(aid)
    for sizes in ({"items": 0}, {"hops": 0}):
        with pytest.raises(ValueError, match="a whole number from 1"):
            hop_program(load_compensator("wdrc"), **sizes)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected seconds to be a number from"):
        export_program(load_pretrained("neuro-msbg"), seconds=0.0)
