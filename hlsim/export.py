"""Neuro-MSBG and wearable aids as ``torch.export`` programs and as ONNX files, for inference.

An *item* is one signal for one ear. The program of a simulator processes a fixed number of items
with a fixed length.

The program of a wearable aid (``WDRC``, ``CAMFIT`` or ``HearingAid``) processes one *hop* of each
item, 64 samples or 4 ms at 16 kHz, or a fixed number of hops. The *state* of the aid, its memory of
earlier calls, is passed in and returned as tensors. All tensors are float32, unless the weights of
the aid have another type.

Inputs and their names:

- ``samples`` (items, hops * 64): the input, where RMS 1.0 is ``aid.full_scale_spl`` dB SPL
- ``fitted`` (items, n): the aid's parameters for the ear of each item
- ``sliders`` (items, sliders): values from 0 to 1 in the order of ``aid.SLIDERS``, if the aid has
    any
- the state, (items, ...) each: for example ``past`` (items, 192), the preceding samples in pascals

Outputs and their names:

- ``output`` (items, hops * 64): the aid's output, delayed by ``aid.latency`` = 64 samples
- the next state, with the prefix ``next_``: for example ``next_past``, the input ``past`` of the
    next call

``first_inputs`` returns all inputs of the first call. On a machine without torch, numpy and
onnxruntime run the file (``np.savez`` stores the inputs):

    export_aid(aid, "aid.onnx")
    tensors = first_inputs(aid, Audiogram.standard("N3"))
    inputs = {name: tensor.numpy() for name, tensor in tensors.items()}
    session = onnxruntime.InferenceSession("aid.onnx")
    names = [entry.name.removeprefix("next_") for entry in session.get_outputs()]
    for inputs["samples"] in hops:
        outputs = dict(zip(names, session.run(None, inputs)))
        play(outputs.pop("output"))
        inputs |= outputs

Without torch, the file of ``export_fit`` computes ``fitted`` for an ear. The first state is zeros,
except ``gliding``, which equals ``sliders``.
"""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from compensators.filter_bank import HOP, RATE
from compensators.limiter import soft_limit
from compensators.wearable import Wearable
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import NEURO_RATE, gain_to_pascals
from hlsim.checks import check_number
from hlsim.extras import require
from hlsim.files import atomic_path
from hlsim.neuro import NeuroMSBG

TOLERANCE = 1e-4
"""Largest error of an ONNX file, relative to the peak of the output."""

EAR = torch.linspace(20.0, 90.0, len(FREQUENCIES))
"""Thresholds in dB HL of the ear for which ONNX files are validated."""

CHECKED_CALLS = 16
"""Number of calls, with successive parts of noise, by which the program of an aid is validated."""

STATELESS_INPUTS = ("samples", "fitted", "sliders")
"""Names of the inputs of an aid's program that are not part of its state."""


def export_program(
    simulator: nn.Module, *, seconds: float = 1.0, items: int = 1
) -> torch.export.ExportedProgram:
    """Convert a Neuro-MSBG to a ``torch.export`` program for a fixed number and length of signals.

    ``program.module()`` is a function of ``waveform`` (items, time), whose RMS of 1.0 is
    ``simulator.full_scale_spl`` dB SPL, and ``thresholds`` (items, 8) in dB HL. It returns a dict
    with ``perceived`` (items, time), the perceived signals on the scale of ``waveform``. The
    program validates the shapes of its inputs, but not their values. All tensors have the dtype and
    device of the simulator's weights.

    Args:
        simulator: Neuro-MSBG at 16 kHz.
        seconds: Duration of the waveforms in seconds.
        items: Number of waveforms per call.

    Raises:
        ValueError: The simulator is no Neuro-MSBG at 16 kHz, or a number is out of range.

    >>> import hlsim
    >>> program = export_program(hlsim.load_pretrained("neuro-msbg"), seconds=0.1)
    >>> inputs = {"waveform": torch.zeros(1, 1600), "thresholds": torch.full((1, 8), 40.0)}
    >>> perceived = program.module()(**inputs)["perceived"]
    """
    if not isinstance(simulator, NeuroMSBG):
        raise ValueError(
            f"expected a NeuroMSBG, got a {type(simulator).__name__}; the exact MSBG cannot be "
            "exported, because its filters depend on the audiogram's values"
        )
    if simulator.sample_rate != NEURO_RATE:
        raise ValueError(
            f"expected a Neuro-MSBG with sample_rate {NEURO_RATE}, got {simulator.sample_rate}; "
            f"load it at {NEURO_RATE} Hz"
        )
    check_number("seconds", seconds, 1.0 / NEURO_RATE)
    check_number("items", items, 1, whole=True)
    weight = next(simulator.parameters())
    inputs = {
        "waveform": weight.new_zeros(items, round(seconds * NEURO_RATE)),
        "thresholds": weight.new_zeros(items, len(FREQUENCIES)),
    }
    return _to_program(simulator, _simulate, inputs)


def export_onnx(
    simulator: nn.Module, path: str | Path, *, seconds: float = 1.0, items: int = 1
) -> None:
    """Write a Neuro-MSBG as an ONNX file for signals of a fixed length.

    The file has the inputs ``waveform`` (items, time) and ``thresholds`` (items, 8) in dB HL, and
    the output ``perceived`` (items, time), as in ``export_program``. Networks with Mamba blocks
    take minutes. If an error is raised, no file is written.

    Args:
        simulator: Neuro-MSBG at 16 kHz.
        path: File to write.
        seconds: Duration of the waveforms in seconds.
        items: Number of waveforms per call.

    Raises:
        ValueError: The simulator or a number is not valid, see ``export_program``; ONNX lacks an
            operation; the output of onnxruntime for noise at 64 dB SPL differs by more than 1e-4 of
            its peak; or the file cannot be written.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.

    >>> import hlsim
    >>> simulator = hlsim.load_pretrained("neuro-msbg")
    >>> export_onnx(simulator, "simulator.onnx")  # doctest: +SKIP
    """
    program = export_program(simulator, seconds=seconds, items=items)
    weight = next(simulator.parameters())
    inputs = {
        "waveform": _draw_noise(simulator, items, round(seconds * NEURO_RATE)).to(weight),
        "thresholds": EAR.expand(items, -1).to(weight),
    }
    _write_onnx(program, path, inputs)


def first_inputs(
    aid: Wearable, audiogram: AudiogramLike, *, items: int = 1, hops: int = 1
) -> dict[str, Tensor]:
    """Return the inputs for the first call of an aid's program.

    Replace ``samples``, which are silence, by those of the signal. The sliders have the default
    values of ``aid.SLIDERS``.

    Args:
        aid: Aid at 16 kHz.
        audiogram: One ear for all items, or one per item.
        items: Number of signals per call, 2 if the aid is ``linked``.
        hops: Number of hops of 64 samples per call.

    Returns:
        Dict of the input tensors, whose names and shapes the module's docstring lists.

    Raises:
        ValueError: The aid is no ``WDRC``, ``CAMFIT`` or ``HearingAid`` at 16 kHz, it rejects the
            ear, or a number is out of range.

    >>> from compensators import WDRC
    >>> print(*first_inputs(WDRC(), "N3"))
    samples fitted past gains levels
    """
    _check_export(aid, items)
    check_number("hops", hops, 1, whole=True)
    if aid.sample_rate != RATE:
        raise ValueError(
            f"expected an aid at {RATE} Hz, got one at {aid.sample_rate} Hz; load it at {RATE} Hz"
        )
    weight = next(aid.parameters(), torch.empty(0))
    with torch.no_grad():
        samples = weight.new_zeros(items, hops * HOP)
        batch, fitted = aid.prepare(samples, audiogram)
        sliders = aid.stack_sliders({}, batch, fitted)
        inputs = {
            "samples": samples,
            "fitted": fitted,
            "sliders": sliders,
            **aid.initial_state(sliders),
        }
    # Copies, because torch.export would merge two inputs that are the same tensor.
    return {name: tensor.clone() for name, tensor in inputs.items() if tensor.numel()}


def hop_program(aid: Wearable, *, items: int = 1, hops: int = 1) -> torch.export.ExportedProgram:
    """Convert a wearable aid to a ``torch.export`` program that processes a few ms per call.

    ``program.module()(**inputs)`` returns the named outputs. The module's docstring lists inputs
    and outputs, and ``first_inputs`` returns the inputs of the first call.

    Args:
        aid: Aid at 16 kHz.
        items: Number of signals per call.
        hops: Number of hops of 64 samples (4 ms) per call.

    Raises:
        ValueError: The aid or a number is not valid, see ``first_inputs``.

    >>> from compensators import WDRC
    >>> program = hop_program(WDRC())
    >>> outputs = program.module()(**first_inputs(WDRC(), "N3"))
    >>> outputs["output"].shape
    torch.Size([1, 64])
    """
    return _to_program(aid, _process_hops, first_inputs(aid, EAR, items=items, hops=hops))


def export_aid(aid: Wearable, path: str | Path, *, items: int = 1, hops: int = 1) -> None:
    """Write a wearable aid as an ONNX file that processes a few ms per call.

    The inputs and outputs are those of ``hop_program``. If an error is raised, no file is written.

    Args:
        aid: Aid at 16 kHz.
        path: File to write.
        items: Number of signals per call.
        hops: Number of hops of 64 samples (4 ms) per call.

    Raises:
        ValueError: The aid or a number is not valid, see ``first_inputs``; ONNX lacks an operation;
            an output or state of onnxruntime differs by more than 1e-4 of its peak in the last of
            16 calls with noise at 64 dB SPL; or the file cannot be written.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.

    >>> from compensators import WDRC
    >>> export_aid(WDRC(), "aid.onnx")  # doctest: +SKIP
    """
    program = hop_program(aid, items=items, hops=hops)
    inputs = first_inputs(aid, EAR, items=items, hops=hops)
    state_names = inputs.keys() - STATELESS_INPUTS
    noise = _draw_noise(aid, CHECKED_CALLS, items, hops * HOP).to(inputs["samples"])
    process = program.module()
    for samples in noise[:-1]:
        inputs["samples"] = samples
        outputs = process(**inputs)
        inputs |= {name: outputs[f"next_{name}"] for name in state_names}
    _write_onnx(program, path, inputs | {"samples": noise[-1]})


def export_fit(aid: Wearable, path: str | Path, *, items: int = 1) -> None:
    """Write an ONNX file that computes the parameters of a wearable aid from an audiogram.

    The file has the input ``thresholds`` (items, 8), in dB HL at ``hlsim.audiogram.FREQUENCIES``,
    and the output ``fitted`` (items, n), an input of the file that ``export_aid`` writes. The
    limits of an aid with ``limit_to_ear`` are predicted from the thresholds; take ``fitted`` from
    ``first_inputs`` for an ear with measured uncomfortable levels. If an error is raised, no file
    is written.

    Args:
        aid: Aid at any sample rate.
        path: File to write.
        items: Number of ears per call.

    Raises:
        ValueError: The aid is not wearable, or the number of ears is below 1; ONNX lacks an
            operation; the output of onnxruntime differs from that of torch by more than 1e-4 of its
            peak; or the file cannot be written.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.

    >>> from compensators import WDRC
    >>> export_fit(WDRC(), "fit.onnx")  # doctest: +SKIP
    """
    _check_export(aid, items)
    inputs = {"thresholds": EAR.repeat(items, 1)}
    _write_onnx(_to_program(aid, _fit, inputs), path, inputs)


def _check_export(aid: Any, items: int) -> None:
    """Raise ValueError unless an aid and its number of signals per call can be exported."""
    if not isinstance(aid, Wearable):
        raise ValueError(
            f"expected a WDRC, a CAMFIT or a HearingAid, got a {type(aid).__name__}; other aids "
            "cannot be exported, because they process whole signals"
        )
    check_number("items", items, 1, whole=True)


class _Call(nn.Module):
    """Module that calls ``function(model, **tensors)``, because ``torch.export`` needs a module.

    The function returns tensors by name.
    """

    def __init__(self, model: nn.Module, function: Callable[..., dict[str, Tensor]]) -> None:
        super().__init__()
        self.model = model
        self.function = function

    def forward(self, **inputs: Tensor) -> dict[str, Tensor]:
        return self.function(self.model, **inputs)


def _simulate(simulator: NeuroMSBG, waveform: Tensor, thresholds: Tensor) -> dict[str, Tensor]:
    """Call a simulator without its validation, which would read the values of tensors.

    Shape: (items, time), (items, 8) in dB HL -> {"perceived": (items, time)}.
    """
    gain = gain_to_pascals(simulator.full_scale_spl)
    return {"perceived": simulator.process_items(waveform * gain, thresholds) / gain}


def _fit(aid: Wearable, thresholds: Tensor) -> dict[str, Tensor]:
    return {"fitted": aid.fit_with_limits(thresholds)}


def _process_hops(aid: Wearable, **inputs: Tensor) -> dict[str, Tensor]:
    """Call ``Wearable.process_hops`` with the inputs of a program, and limit the output.

    Args:
        aid: Aid of the program.
        inputs: Tensors of ``first_inputs``, with any samples and state.

    Returns:
        The output, (items, hops * 64), on the scale of the samples, and each tensor of the state
        after the hops, under its name with the prefix ``next_``.
    """
    gain = gain_to_pascals(aid.full_scale_spl)
    empty = inputs["samples"][:, :0]
    sliders = inputs.get("sliders", empty)
    state = {"gliding": empty} | inputs  # An aid without sliders has no such state.
    samples = inputs["samples"] * gain
    output, _, next_state = aid.process_hops(samples, inputs["fitted"], sliders, state)
    output = soft_limit(output, aid.limit_spl)
    names = [name for name in inputs if name not in STATELESS_INPUTS]
    return {"output": output / gain} | {f"next_{name}": next_state[name] for name in names}


def _to_program(
    model: nn.Module, function: Callable[..., dict[str, Tensor]], inputs: dict[str, Tensor]
) -> torch.export.ExportedProgram:
    """Export ``function(model, **inputs)`` for tensors with the names and shapes of ``inputs``."""
    with torch.no_grad(), warnings.catch_warnings():
        # torch.export warns of the list of weights in nn.LSTM, which does no harm.
        warnings.filterwarnings("ignore", r"The tensor attributes .*_flat_weights")
        return torch.export.export(_Call(model, function), (), inputs)


def _draw_noise(model: Any, *shape: int) -> Tensor:
    """Draw noise of some shape at 64 dB SPL, on the model's scale, to validate a model's file."""
    gain = gain_to_pascals(model.full_scale_spl)
    return 0.03 / gain * torch.randn(*shape, generator=torch.Generator().manual_seed(0))


def _write_onnx(
    program: torch.export.ExportedProgram, path: str | Path, inputs: dict[str, Tensor]
) -> None:
    """Write a program as an ONNX file, unless onnxruntime computes other outputs than torch.

    Args:
        program: Program to write.
        path: File to write.
        inputs: Inputs for which the outputs are compared.

    Raises:
        ValueError: ONNX lacks an operation, an output differs by more than ``TOLERANCE`` of its
            peak, or the file cannot be written.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.
    """
    for module in ("onnx", "onnxscript", "onnxruntime"):
        require(module, "onnx")
    with torch.no_grad():
        expected = program.module()(**inputs)
    with atomic_path(path) as temporary:
        try:
            # The optimiser of onnxscript would turn log(x + 1e-12) into log(x), because it treats
            # constants below 1e-8 as zero.
            converted = torch.onnx.export(
                program, dynamo=True, verbose=False, optimize=False, output_names=[*expected]
            )
        except torch.onnx.errors.OnnxExporterError as error:
            raise ValueError(f"{path}: ONNX cannot represent the program: {error}") from error
        assert converted is not None
        converted.save(str(temporary), external_data=False)
        runtime = require("onnxruntime", "onnx")
        options = runtime.SessionOptions()
        options.log_severity_level = 3  # Only errors are logged.
        session = runtime.InferenceSession(
            str(temporary), options, providers=["CPUExecutionProvider"]
        )
        arrays = {name: tensor.cpu().numpy() for name, tensor in inputs.items()}
        for array, reference in zip(session.run(None, arrays), expected.values(), strict=True):
            difference = (torch.from_numpy(array).to(reference) - reference).abs().max()
            peak = reference.abs().max().clamp_min(torch.finfo(reference.dtype).tiny)
            if not difference <= TOLERANCE * peak:
                raise ValueError(
                    f"{path}: the output of onnxruntime differs by {float(difference / peak):.0e} "
                    f"of its peak, expected {TOLERANCE:g} or less; the file was not written. "
                    "Update onnx, onnxscript and onnxruntime"
                )
