"""Simulators as ``torch.export`` programs and ONNX files, for one number of items and one length; ONNX of any program."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils._pytree import tree_flatten

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import gain_to_pascals
from hlsim.checks import is_finite
from hlsim.extras import require
from hlsim.files import Whole
from hlsim.neuro import NeuroMSBG
from hlsim.neuro.config import NEURO_RATE

_TOLERANCE = 1e-4


class _Call(nn.Module):
    """A simulator as a function of two tensors, without the checks that look at their values."""

    def __init__(self, simulator: NeuroMSBG) -> None:
        super().__init__()
        self.simulator = simulator
        self.gain = gain_to_pascals(simulator.full_scale_spl)

    def forward(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
        simulator = self.simulator
        assert isinstance(simulator, NeuroMSBG)
        return simulator._process(waveform * self.gain, thresholds) / self.gain


def export_program(
    simulator: nn.Module, *, seconds: float = 1.0, items: int = 1
) -> torch.export.ExportedProgram:
    """The simulator as a ``torch.export`` program of (items, time) at 16 kHz and (items, 8) dB HL -> (items, time).

    It is for inference: a program of Mamba blocks gives no gradient.

    Raises:
        ValueError: not a Neuro-MSBG at 16 kHz, no sample or item, or a part that cannot be exported.
    """
    if not isinstance(simulator, NeuroMSBG) or simulator.sample_rate != NEURO_RATE:
        raise ValueError(
            f"{type(simulator).__name__} cannot be exported; allowed: a Neuro-MSBG with sample_rate {NEURO_RATE} (the "
            "exact model chooses filters by the audiogram's values)"
        )
    time = round(NEURO_RATE * seconds) if is_finite(seconds) else 0
    if time < 1 or not isinstance(items, int) or items < 1:
        asked = f"a program for {seconds!r} seconds of {items!r} items"
        raise ValueError(f"{asked}; allowed: more than 0 seconds, 1 item or more")
    weight = next(simulator.parameters())
    example = tuple(weight.new_zeros(items, length) for length in (time, len(FREQUENCIES)))
    modes = [(module, module.training) for module in simulator.modules()]
    try:
        with torch.no_grad():
            return torch.export.export(_Call(simulator).eval(), example)
    except Exception as error:  # whatever a block that depends on values raises
        raise ValueError(f"torch.export cannot take the simulator: {_reason(error)}") from error
    finally:
        for module, training in modes:  # the simulator is the caller's
            module.training = training


def export_onnx(
    simulator: nn.Module, path: str | Path, *, seconds: float = 1.0, items: int = 1
) -> None:
    """Write ``export_program``'s program as an ONNX file, whole or not at all; with Mamba blocks that takes minutes.

    Raises:
        ValueError: as ``export_program``; no such folder; an operation that ONNX or its exporter does not have, which the
            message names; or onnxruntime's output is not the simulator's to 1e-4 of its peak, for noise at 64 dB SPL.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.
    """

    def make() -> tuple[torch.export.ExportedProgram, dict[str, Tensor]]:
        program = export_program(simulator, seconds=seconds, items=items)
        assert isinstance(simulator, NeuroMSBG) and program.example_inputs is not None
        waveform, thresholds = program.example_inputs[0]
        noise = torch.randn(waveform.shape, generator=torch.Generator().manual_seed(0)).to(waveform)
        ears = thresholds + torch.linspace(20.0, 90.0, len(FREQUENCIES)).to(thresholds)
        level = 0.03 / gain_to_pascals(simulator.full_scale_spl)
        return program, {"waveform": level * noise, "thresholds": ears}

    write_onnx("the simulator", path, make, ["heard"])


def write_onnx(
    what: str,
    path: str | Path,
    make: Callable[[], tuple[torch.export.ExportedProgram, dict[str, Tensor]]],
    outputs: Sequence[str],
) -> None:
    """Write a program as an ONNX file, whole or not at all, once onnxruntime has given its outputs.

    Args:
        what: it is, for errors.
        make: gives the program, and inputs by name, in its order, to compare outputs on.
        outputs: their names in the file.

    Raises:
        ValueError, MissingExtraError: as ``export_onnx``.
    """
    target = Path(path)
    if not (folder := target.parent).is_dir():  # the export takes minutes
        raise ValueError(
            f"{target}: there is no folder {str(folder)!r}; allowed: a file in a folder that exists"
        )
    for module in ("onnx", "onnxscript", "onnxruntime"):
        require(module, "dev")
    program, given = make()
    try:
        with Whole(target) as file:
            # not optimised: onnxscript's rules take a constant under 1e-8 for zero, and log(x + 1e-12) for log(x)
            converted = torch.onnx.export(
                program, dynamo=True, verbose=False, optimize=False, output_names=outputs
            )
            assert converted is not None
            converted.save(str(file.partial), external_data=False)
            _check(what, file.partial, program, given)
            file.keep()
    except torch.onnx.errors.OnnxExporterError as error:
        raise ValueError(f"ONNX cannot take {what}: {_reason(error)}") from error


def _check(
    what: str, path: Path, program: torch.export.ExportedProgram, given: Mapping[str, Tensor]
) -> None:
    """Run the file as its user will: the exporter also writes what no runtime takes, or takes wrongly."""
    runtime = require("onnxruntime", "dev")
    try:
        quiet = runtime.SessionOptions()
        quiet.log_severity_level = 3  # errors
        session = runtime.InferenceSession(str(path), quiet, providers=["CPUExecutionProvider"])
        results = session.run(None, {name: tensor.cpu().numpy() for name, tensor in given.items()})
    except Exception as error:  # onnxruntime has a class for each kind of refusal
        reason = f"refuses the file ({str(error).split('failed:', 1)[-1].strip().splitlines()[0]})"
        raise ValueError(f"ONNX cannot take {what}: onnxruntime {reason}") from error
    assert program.example_inputs is not None
    positional, _ = program.example_inputs
    with torch.no_grad():
        call = program.module()
        expected, _ = tree_flatten(call(*given.values()) if positional else call(**given))
    for result, wanted in zip(results, expected, strict=True):
        apart = (torch.from_numpy(result).to(wanted) - wanted).abs().max()
        off = float(apart / wanted.abs().max().clamp_min(torch.finfo(wanted.dtype).tiny))
        if not off <= _TOLERANCE:
            wrong = f"is off by {off:.0e} of its peak; allowed: {_TOLERANCE}"
            raise ValueError(f"ONNX cannot take {what}: onnxruntime's output {wrong}")


def _reason(error: BaseException) -> str:
    """The operation that an exporter stopped at, or its first line."""
    text = str(error)
    found = re.search(r"No ONNX function found for <OpOverload\(op='([\w.]+)'", text)
    if found:
        complex_input = " of complex numbers" if "complex" in text else ""
        return f"it has no {found.group(1)}{complex_input}; allowed: torch.export"
    return text.strip().splitlines()[0] if text.strip() else type(error).__name__
