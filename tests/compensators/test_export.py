"""Exported aids give what the stream gives, hop by hop, with the state handed on outside."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compensators import WDRC, HearingAid
from compensators.export import export_aid, first_inputs, hop_program
from compensators.wearable import Wearable
from hlsim import Audiogram
from tests.compensators.test_wearable import AIDS, EAR, Make, trained


def hops(signal: torch.Tensor) -> list[torch.Tensor]:
    return list(signal.split(64, -1))


@AIDS
def test_a_program_gives_what_the_stream_gives(make: Make) -> None:
    """Of two ears, at another level of full scale, with a slider that moves on the way."""
    aid: Any = make(full_scale_spl=110.0)
    ears = torch.tensor([EAR.thresholds, Audiogram.standard("S2").thresholds])
    inputs, stream, found, expected = first_inputs(aid, ears, items=2), aid.stream(ears), [], []
    call = hop_program(aid, items=2).module()
    for number, samples in enumerate(hops(0.005 * torch.randn(2, 6400))):
        if number == 40 and aid.SLIDERS:
            stream.noise_reduction, inputs["sliders"] = 0.2, torch.tensor([[0.2, 1.0]] * 2)
        outputs = call(**inputs | {"samples": samples})
        found.append(outputs.pop("output"))
        inputs |= {name.removeprefix("next_"): kept for name, kept in outputs.items()}
        expected.append(stream(samples))
    whole = torch.cat(expected, -1)
    assert (torch.cat(found, -1) - whole).abs().max() < 1e-5 * whole.abs().max()


@pytest.mark.slow
@AIDS
def test_onnxruntime_gives_what_the_stream_gives(make: Make, tmp_path: Path) -> None:
    """A second of steps in level in hops of 4 ms, with sliders that move on the way."""
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    aid: Any = make()
    export_aid(aid, tmp_path / "aid.onnx")
    session = runtime.InferenceSession(
        str(tmp_path / "aid.onnx"), providers=["CPUExecutionProvider"]
    )
    names = [entry.name.removeprefix("next_") for entry in session.get_outputs()]
    inputs = {name: tensor.numpy() for name, tensor in first_inputs(aid, EAR).items()}
    steps = torch.tensor([20.0, 70.0, 50.0, 90.0, 60.0]).repeat_interleave(3200)
    signal = torch.randn(1, 16000) * 10.0 ** ((steps - 94.0) / 20.0)
    stream, found, expected = aid.stream(EAR), [], []
    for number, samples in enumerate(hops(signal)):
        if number == 100 and aid.SLIDERS:
            stream.noise_reduction, inputs["sliders"] = (
                0.2,
                np.array([[0.2, 1.0]], dtype=np.float32),
            )
        inputs["samples"] = samples.numpy()
        outputs = dict(zip(names, session.run(None, inputs), strict=True))
        found.append(torch.from_numpy(outputs.pop("output")))
        inputs |= outputs
        expected.append(stream(samples))
    whole = torch.cat(expected, -1)
    assert (torch.cat(found, -1) - whole).abs().max() < 1e-4 * whole.abs().max()


@pytest.mark.slow
def test_a_linked_aid_is_exported_for_two_ears(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    export_aid(WDRC(linked=True), tmp_path / "aid.onnx", items=2)
    session = runtime.InferenceSession(
        str(tmp_path / "aid.onnx"), providers=["CPUExecutionProvider"]
    )
    assert session.get_outputs()[0].shape == [2, 64]


def test_the_aid_keeps_its_mode() -> None:
    aid = HearingAid().train()
    hop_program(aid)
    assert all(module.training for module in aid.modules())


@pytest.mark.parametrize(
    "call",
    [
        lambda folder: hop_program(trained(sample_rate=44100)),
        lambda folder: first_inputs(trained(), EAR, volume=1.0),
        lambda folder: export_aid(trained(), folder / "missing" / "aid.onnx"),
    ],
)
def test_bad_call_raises_value_error(call: Callable[[Path], object], tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        call(tmp_path)


def test_every_state_of_an_aid_is_handed_on() -> None:
    aid: Wearable = trained()
    states = set(aid.initial(torch.ones(1, 2)))
    assert states == set(first_inputs(aid, EAR)) - {"samples", "fitted", "sliders"}
