"""Neuro-MSBG and wearable aids as ``torch.export`` programs and as ONNX files, for inference.

An *item* is one signal for one ear. The program of a simulator processes a fixed number of items
with a fixed length.

The program of a wearable aid (``WDRC`` or ``HearingAid``) processes one *hop* of each item, 64
samples or 4 ms at 16 kHz, or a fixed number of hops. What the aid remembers from one call to the
next, its *state*, is passed in and returned as tensors. All tensors are float32.

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

Without torch, the file of ``export_fit`` computes ``fitted`` for an ear. The state after silence is
zeros, except ``gliding``, which equals ``sliders``.
"""

from __future__ import annotations

import copy
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from compensators.filter_bank import HOP, RATE
from compensators.limiter import soft_limit
from compensators.wearable import Slider, Wearable
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import gain_to_pascals
from hlsim.checks import check_names
from hlsim.extras import require
from hlsim.files import atomic_path
from hlsim.neuro import NeuroMSBG
from hlsim.neuro.config import NEURO_RATE

TOLERANCE = 1e-4
"""Largest error of an ONNX file, relative to the peak of the output."""

NOISE_RMS = 0.03
"""RMS in pascals (64 dB SPL) of the noise with which ONNX files are checked."""

EAR = torch.linspace(20.0, 90.0, len(FREQUENCIES))
"""Thresholds in dB HL with which ONNX files are checked."""

CHECKED_CALLS = 16
"""Number of calls, with successive noise, with which the program of an aid is checked."""

STATELESS_INPUTS = ("samples", "fitted", "sliders")
"""Names of the inputs of an aid's program that are not part of its state."""


class _SimulatorCall(nn.Module):
    """A simulator as a function of two tensors, which does not read their values."""

    def __init__(self, simulator: NeuroMSBG) -> None:
        super().__init__()
        self.simulator = simulator
        self.gain = gain_to_pascals(simulator.full_scale_spl)

    def forward(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
        return self.simulator._process(waveform * self.gain, thresholds) / self.gain


class _FitCall(nn.Module):
    """``Wearable.fit`` as a module."""

    def __init__(self, aid: Wearable) -> None:
        super().__init__()
        self.aid = aid

    def forward(self, thresholds: Tensor) -> Tensor:
        return self.aid.fit(thresholds)


class _HopCall(nn.Module):
    """``Wearable.process_hops``, with the limit, as a module with named inputs and outputs."""

    def __init__(self, aid: Wearable) -> None:
        super().__init__()
        self.aid = aid

    def forward(self, **inputs: Tensor) -> dict[str, Tensor]:
        gain = gain_to_pascals(self.aid.full_scale_spl)
        samples = inputs["samples"] * gain
        empty = inputs["samples"][:, :0]
        sliders = inputs.get("sliders", empty)
        state = {"gliding": empty} | inputs  # An aid without sliders has no such state.
        output, _, next_state = self.aid.process_hops(samples, inputs["fitted"], sliders, state)
        output = soft_limit(output, self.aid.limit_spl)
        names = [name for name in inputs if name not in STATELESS_INPUTS]
        return {"output": output / gain} | {f"next_{name}": next_state[name] for name in names}


def export_program(
    simulator: nn.Module, *, seconds: float = 1.0, items: int = 1
) -> torch.export.ExportedProgram:
    """Convert a Neuro-MSBG to a ``torch.export`` program for signals of a fixed length.

    ``program.module()`` is a function of a waveform (items, time) and of thresholds (items, 8) in
    dB HL. It returns what the ears perceive, in the shape of the waveform.

    Args:
        simulator: Neuro-MSBG at 16 kHz.
        seconds: Duration of the waveforms.
        items: Number of waveforms per call.

    Raises:
        ValueError: The simulator is no Neuro-MSBG at 16 kHz, or there is no sample or no item.

    >>> import hlsim
    >>> program = export_program(hlsim.load_pretrained("neuro-msbg-light"), seconds=0.1)
    >>> perceived = program.module()(torch.zeros(1, 1600), torch.full((1, 8), 40.0))
    """
    if not isinstance(simulator, NeuroMSBG) or simulator.sample_rate != NEURO_RATE:
        raise ValueError(
            f"expected a NeuroMSBG with sample_rate {NEURO_RATE}, got a "
            f"{type(simulator).__name__}; the exact MSBG cannot be exported, because its filters "
            "depend on the audiogram's values"
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
    """Write a Neuro-MSBG as an ONNX file for signals of a fixed length.

    Its inputs are ``waveform`` (items, time) and ``thresholds`` (items, 8) in dB HL, its output is
    ``perceived`` (items, time). Networks with Mamba blocks take minutes.

    Args:
        simulator: Neuro-MSBG at 16 kHz.
        path: File to write.
        seconds: Duration of the waveforms.
        items: Number of waveforms per call.

    Raises:
        ValueError: The simulator or the size is unsuitable, see ``export_program``; ONNX lacks an
            operation; or the output of onnxruntime for noise at 64 dB SPL differs by more than
            1e-4 of its peak.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.

    >>> import hlsim
    >>> simulator = hlsim.load_pretrained("neuro-msbg-light")
    >>> export_onnx(simulator, "simulator.onnx")  # doctest: +SKIP
    """
    _require_onnx()
    program = export_program(simulator, seconds=seconds, items=items)
    assert isinstance(simulator, NeuroMSBG)
    weight = next(simulator.parameters())
    noise = _draw_noise(items, round(seconds * NEURO_RATE), full_scale_spl=simulator.full_scale_spl)
    inputs = {"waveform": noise.to(weight), "thresholds": EAR.expand(items, -1).to(weight)}
    with torch.no_grad():
        perceived = _SimulatorCall(simulator)(*inputs.values())
    _write_onnx(program, path, inputs, {"perceived": perceived})


def first_inputs(
    aid: Wearable, audiogram: AudiogramLike, *, items: int = 1, hops: int = 1, **sliders: Slider
) -> dict[str, Tensor]:
    """Return the inputs with which the first call of an aid's program is made.

    Replace ``samples``, which are silence, by those of the signal.

    Args:
        aid: Aid at 16 kHz.
        audiogram: One ear for all items, or one per item.
        items: Number of signals per call.
        hops: Number of hops of 64 samples per call.
        sliders: Values of sliders from 0 to 1 by name, one for all items or one per item; by
            default those of ``aid.SLIDERS``.

    Returns:
        Tensors by the names of inputs that the module's docstring lists.

    Raises:
        ValueError: The aid's sample rate is not 16000 Hz, it has no such slider, or it rejects the
            ear or a value.

    >>> from compensators import WDRC
    >>> print(*first_inputs(WDRC(), "N3"))
    samples fitted past gains levels
    """
    if aid.sample_rate != RATE:
        raise ValueError(f"expected an aid at {RATE} Hz, got one at {aid.sample_rate} Hz")
    check_names(sliders, aid.SLIDERS, "sliders")
    weight = next(aid.parameters(), torch.empty(0))
    values = [sliders.get(name, default) for name, default in aid.SLIDERS.items()]
    with torch.no_grad():
        samples = weight.new_zeros(items, hops * HOP)
        batch, fitted = aid.prepare(samples, audiogram)
        settings = aid.stack_sliders(values, batch, fitted)
        inputs = {
            "samples": samples,
            "fitted": fitted,
            "sliders": settings,
            **aid.initial_state(settings),
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
        ValueError: The aid's sample rate is not 16000 Hz.

    >>> from compensators import WDRC
    >>> program = hop_program(WDRC())
    >>> outputs = program.module()(**first_inputs(WDRC(), "N3"))
    >>> outputs["output"].shape
    torch.Size([1, 64])
    """
    inputs = first_inputs(aid, torch.zeros(len(FREQUENCIES)), items=items, hops=hops)
    with torch.no_grad(), warnings.catch_warnings():
        # torch.export warns of the list of weights in nn.LSTM, which does no harm.
        warnings.filterwarnings("ignore", r"The tensor attributes .*_flat_weights")
        return torch.export.export(_HopCall(aid), (), inputs)


def export_aid(aid: Wearable, path: str | Path, *, items: int = 1, hops: int = 1) -> None:
    """Write a wearable aid as an ONNX file that processes a few ms per call.

    Its inputs and outputs are those of ``hop_program``.

    Args:
        aid: Aid at 16 kHz.
        path: File to write.
        items: Number of signals per call.
        hops: Number of hops of 64 samples (4 ms) per call.

    Raises:
        ValueError: The aid's sample rate is not 16000 Hz, or an output or state of onnxruntime
            differs by more than 1e-4 of its peak in the last of 16 calls with noise at 64 dB SPL.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.

    >>> from compensators import WDRC
    >>> export_aid(WDRC(), "aid.onnx")  # doctest: +SKIP
    """
    _require_onnx()
    program = hop_program(aid, items=items, hops=hops)
    call = _HopCall(aid)
    inputs = first_inputs(aid, EAR, items=items, hops=hops)
    if "sliders" in inputs:
        # Sliders that move, so that their state is checked as well.
        inputs["sliders"] = 0.2 * inputs["sliders"]
    noise = _draw_noise(CHECKED_CALLS, items, hops * HOP, full_scale_spl=aid.full_scale_spl)
    state_names = [name for name in inputs if name not in STATELESS_INPUTS]
    with torch.no_grad():
        for samples in noise.to(inputs["samples"]):
            inputs["samples"] = samples
            expected = call(**inputs)
            last_inputs = inputs
            inputs = inputs | {name: expected[f"next_{name}"] for name in state_names}
    _write_onnx(program, path, last_inputs, expected)


def export_fit(aid: Wearable, path: str | Path, *, items: int = 1) -> None:
    """Write an ONNX file that computes the parameters of a wearable aid from an audiogram.

    Its input is ``thresholds`` (items, 8), in dB HL at ``hlsim.audiogram.FREQUENCIES``. Its output
    is ``fitted`` (items, n), an input of the file that ``export_aid`` writes.

    Args:
        aid: Aid at any sample rate.
        path: File to write.
        items: Number of ears per call.

    Raises:
        ValueError: The output of onnxruntime differs from that of torch by more than 1e-4 of its
            peak.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.

    >>> from compensators import WDRC
    >>> export_fit(WDRC(), "fit.onnx")  # doctest: +SKIP
    """
    _require_onnx()
    ears = EAR.repeat(items, 1)
    call = _FitCall(aid)
    with torch.no_grad():
        program = torch.export.export(call, (ears,))
        fitted = call(ears)
    _write_onnx(program, path, {"thresholds": ears}, {"fitted": fitted})


def _draw_noise(*shape: int, full_scale_spl: float) -> Tensor:
    """Draw noise at 64 dB SPL with which ONNX files are checked."""
    generator = torch.Generator().manual_seed(0)
    return NOISE_RMS / gain_to_pascals(full_scale_spl) * torch.randn(*shape, generator=generator)


def _require_onnx() -> None:
    for module in ("onnx", "onnxscript", "onnxruntime"):
        require(module, "dev")


def _write_onnx(
    program: torch.export.ExportedProgram,
    path: str | Path,
    inputs: dict[str, Tensor],
    expected: dict[str, Tensor],
) -> None:
    """Write a program, and raise ValueError if onnxruntime computes other outputs than expected."""
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
        runtime = require("onnxruntime", "dev")
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
                    f"of its peak, expected {TOLERANCE:g} or less; the file was not written"
                )
