"""Neuro-MSBG and wearable aids as ``torch.export`` programs and as ONNX files, for inference.

A simulator becomes a program for one number of items and one length. A wearable aid becomes a program of one hop,
``HOP`` = 64 samples (4 ms at 16 kHz) of each item (left and right ear, say), with its state explicit. By name, float32:

- inputs: ``samples`` (items, 64), where RMS 1.0 is ``aid.full_scale_spl`` dB SPL; ``fitted`` (items, n), which holds
  what the aid needs of the ear; ``sliders`` (items, sliders), 0 to 1, in the order of ``aid.SLIDERS``, if it has any;
  and the state, (items, ...) each, such as ``past`` (items, 192), the preceding samples in pascals;
- outputs: ``output`` (items, 64), delayed by ``aid.latency`` = 64 samples, and each state as ``next_past`` and so on,
  which the next call takes as ``past``.

``first_inputs`` gives all inputs of the first hop. On a machine without torch, numpy and onnxruntime run the file
(``np.savez`` stores the inputs):

    export_aid(aid, "aid.onnx")
    inputs = {name: tensor.numpy() for name, tensor in first_inputs(aid, Audiogram.standard("N3")).items()}
    session = onnxruntime.InferenceSession("aid.onnx")
    names = [entry.name.removeprefix("next_") for entry in session.get_outputs()]
    for inputs["samples"] in hops:
        outputs = dict(zip(names, session.run(None, inputs)))
        play(outputs.pop("output"))
        inputs |= outputs
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from compensators.filter_bank import HOP, RATE
from compensators.stream import Slider
from compensators.wearable import Wearable
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import gain_to_pascals
from hlsim.extras import require
from hlsim.files import atomic_path
from hlsim.neuro import NeuroMSBG
from hlsim.neuro.config import NEURO_RATE

TOLERANCE = 1e-4
"""Largest error of an ONNX file, relative to the peak of the output."""

_NOISE_RMS = 0.03  # Pa, 64 dB SPL
_CHECKED_HOPS = 16
_NOT_STATE = ("samples", "fitted", "sliders")


class _SimulatorCall(nn.Module):
    """A simulator as a function of two tensors, without the checks that read their values."""

    def __init__(self, simulator: NeuroMSBG) -> None:
        super().__init__()
        self.simulator = simulator
        self.gain = gain_to_pascals(simulator.full_scale_spl)

    def forward(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
        return self.simulator._process(waveform * self.gain, thresholds) / self.gain


class _HopCall(nn.Module):
    """``Wearable.step`` of one hop, with named inputs and outputs."""

    def __init__(self, aid: Wearable) -> None:
        super().__init__()
        self.aid = aid

    def forward(self, **inputs: Tensor) -> dict[str, Tensor]:
        gain, empty = gain_to_pascals(self.aid.full_scale_spl), inputs["samples"][:, :0]
        samples, fitted = inputs["samples"] * gain, inputs["fitted"]
        state = {"gliding": empty} | inputs  # an aid without sliders has no such state
        output, after = self.aid.step(samples, fitted, inputs.get("sliders", empty), state)
        states = {f"next_{name}": after[name] for name in inputs if name not in _NOT_STATE}
        return {"output": output / gain} | states


def export_program(
    simulator: nn.Module, *, seconds: float = 1.0, items: int = 1
) -> torch.export.ExportedProgram:
    """Export a Neuro-MSBG at 16 kHz as a ``torch.export`` program.

    Its inputs are a waveform (items, time) and thresholds (items, 8) in dB HL, its output has the
    waveform's shape.

    Raises:
        ValueError: The simulator is no Neuro-MSBG at 16 kHz, or there is no sample or no item.
    """
    if not isinstance(simulator, NeuroMSBG) or simulator.sample_rate != NEURO_RATE:
        raise ValueError(
            f"cannot export a {type(simulator).__name__}; expected a NeuroMSBG with sample_rate {NEURO_RATE} "
            "(the exact model chooses its filters by the audiogram's values)"
        )
    if not (seconds * NEURO_RATE >= 1 and items >= 1):
        raise ValueError(
            f"expected at least one sample and item, got {seconds} s and {items} items"
        )
    weight = next(simulator.parameters())
    time = round(seconds * NEURO_RATE)
    example = (weight.new_zeros(items, time), weight.new_zeros(items, len(FREQUENCIES)))
    with torch.no_grad():
        return torch.export.export(_SimulatorCall(copy.deepcopy(simulator)).eval(), example)


def export_onnx(
    simulator: nn.Module, path: str | Path, *, seconds: float = 1.0, items: int = 1
) -> None:
    """Write the program of ``export_program`` as an ONNX file; with Mamba blocks that takes minutes.

    Raises:
        ValueError: As ``export_program``; ONNX lacks an operation; or the output of onnxruntime for
            noise at 64 dB SPL differs by more than ``TOLERANCE``.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.
    """
    _require_onnx()
    program = export_program(simulator, seconds=seconds, items=items)
    assert isinstance(simulator, NeuroMSBG)
    like = next(simulator.parameters())
    rms = _NOISE_RMS / gain_to_pascals(simulator.full_scale_spl)
    noise = torch.randn(items, round(seconds * NEURO_RATE), generator=_generator())
    ears = torch.linspace(20.0, 90.0, len(FREQUENCIES)).expand(items, -1)
    inputs = {"waveform": (rms * noise).to(like), "thresholds": ears.to(like)}
    with torch.no_grad():
        expected = [_SimulatorCall(simulator)(*inputs.values())]
    _write_onnx(program, path, inputs, {"perceived": expected[0]})


def first_inputs(
    aid: Wearable, audiogram: AudiogramLike, *, items: int = 1, **sliders: Slider
) -> dict[str, Tensor]:
    """Inputs of an aid's program for the first hop: fitted to the ear, after silence, with samples of 0.

    Args:
        audiogram: One ear for all items, or one for each.
        sliders: Values by name, 0 to 1, one for all items or one for each; 1 by default.

    Raises:
        ValueError: As the aid's call, the aid's sample rate is not 16000 Hz, or it has no such slider.
    """
    if aid.sample_rate != RATE:
        raise ValueError(f"expected an aid at {RATE} Hz, got one at {aid.sample_rate} Hz")
    unknown = sorted(set(sliders) - set(aid.SLIDERS))
    if unknown:
        raise ValueError(
            f"a {type(aid).__name__} has no slider {', '.join(unknown)}; its sliders are: "
            f"{', '.join(aid.SLIDERS) or 'none'}"
        )
    like = next(aid.parameters(), torch.empty(0))
    values = [sliders.get(name, 1.0) for name in aid.SLIDERS]
    with torch.no_grad():
        samples = like.new_zeros(items, HOP)
        _, fitted, settings = aid.prepare(samples, audiogram, values)
        inputs = {
            "samples": samples,
            "fitted": fitted,
            "sliders": settings,
            **aid.initial(settings),
        }
    # torch.export would merge two inputs that are the same tensor
    return {name: tensor.clone() for name, tensor in inputs.items() if tensor.numel()}


def hop_program(aid: Wearable, *, items: int = 1) -> torch.export.ExportedProgram:
    """Export one hop of an aid: ``program.module()(**inputs)`` returns the outputs by name.

    Raises:
        ValueError: The aid's sample rate is not 16000 Hz.
    """
    inputs = first_inputs(aid, torch.zeros(len(FREQUENCIES)), items=items)
    with torch.no_grad(), warnings.catch_warnings():
        # nn.LSTM keeps a list of its weights
        warnings.filterwarnings("ignore", r"The tensor attributes .*_flat_weights")
        return torch.export.export(_HopCall(aid), (), inputs)


def export_aid(aid: Wearable, path: str | Path, *, items: int = 1) -> None:
    """Write the program of ``hop_program`` as an ONNX file.

    Raises:
        ValueError: As ``hop_program``; or an output or state of onnxruntime differs by more than
            ``TOLERANCE`` in the last of 16 hops of noise at 64 dB SPL.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.
    """
    _require_onnx()
    program, call = hop_program(aid, items=items), _HopCall(aid)
    inputs = first_inputs(aid, torch.linspace(20.0, 90.0, len(FREQUENCIES)), items=items)
    if "sliders" in inputs:  # so that they are moving
        inputs["sliders"] = 0.2 * inputs["sliders"]
    rms = _NOISE_RMS / gain_to_pascals(aid.full_scale_spl)
    noise = rms * torch.randn(_CHECKED_HOPS, items, HOP, generator=_generator())
    with torch.no_grad():
        for samples in noise.to(inputs["samples"]):
            inputs["samples"] = samples
            expected = call(**inputs)
            last_inputs = inputs
            states = {name: expected[f"next_{name}"] for name in inputs if name not in _NOT_STATE}
            inputs = inputs | states
    _write_onnx(program, path, last_inputs, expected)


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _require_onnx() -> None:
    for module in ("onnx", "onnxscript", "onnxruntime"):
        require(module, "dev")


def _write_onnx(
    program: torch.export.ExportedProgram,
    path: str | Path,
    inputs: dict[str, Tensor],
    expected: dict[str, Tensor],
) -> None:
    """Write a program atomically, once onnxruntime has computed the expected outputs from the inputs."""
    with atomic_path(path) as temporary:
        try:
            # not optimised: onnxscript's rules take a constant below 1e-8 for zero, and log(x + 1e-12) for log(x)
            converted = torch.onnx.export(
                program, dynamo=True, verbose=False, optimize=False, output_names=[*expected]
            )
        except torch.onnx.errors.OnnxExporterError as error:
            raise ValueError(f"{path}: ONNX cannot represent the program: {error}") from error
        assert converted is not None
        converted.save(str(temporary), external_data=False)
        _check_onnx(temporary, inputs, [*expected.values()])


def _check_onnx(path: Path, inputs: dict[str, Tensor], expected: Sequence[Tensor]) -> None:
    runtime = require("onnxruntime", "dev")
    options = runtime.SessionOptions()
    options.log_severity_level = 3  # errors only
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    arrays = {name: tensor.cpu().numpy() for name, tensor in inputs.items()}
    for array, reference in zip(session.run(None, arrays), expected, strict=True):
        error = (torch.from_numpy(array).to(reference) - reference).abs().max()
        peak = reference.abs().max().clamp_min(torch.finfo(reference.dtype).tiny)
        if not error <= TOLERANCE * peak:
            raise ValueError(
                f"{path.name}: onnxruntime's output differs by {float(error / peak):.0e} of its peak, "
                f"more than {TOLERANCE:g}; the file was not written"
            )
