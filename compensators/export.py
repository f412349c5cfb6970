"""A wearable aid as a program of one hop with its state explicit: ``torch.export``, and ONNX for other runtimes.

One call takes one hop, ``HOP`` = 64 samples, 4 ms at 16 kHz, of each item (left and right ear, say). By name, float32:

- in: ``samples`` (items, 64), RMS 1.0 being ``aid.full_scale_spl`` dB SPL; ``fitted`` (items, n), what the aid needs of
  the ear; ``sliders`` (items, sliders), 0 to 1, in the order of ``aid.SLIDERS``, where it has any; and the state,
  (items, ...) each, such as ``past`` (items, 192), the samples before in pascals;
- out: ``output`` (items, 64), ``aid.latency`` = 64 samples late, and each state as ``next_past`` and so on, which the
  next call takes as ``past``.

``first_inputs`` gives all of them for the first hop: fitted to an ear, in the state after silence, with samples of 0.
On a machine without torch, numpy and onnxruntime do (``np.savez`` keeps the inputs):

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

import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from compensators.filter_bank import HOP, RATE
from compensators.stream import Slider
from compensators.wearable import Wearable
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import gain_to_pascals
from hlsim.export import write_onnx

_NEXT = "next_"
_GIVEN = ("samples", "fitted", "sliders")


class _Hop(nn.Module):
    """``Wearable.step`` of one hop, by names."""

    def __init__(self, aid: Wearable) -> None:
        super().__init__()
        self.aid = aid

    def forward(self, **inputs: Tensor) -> dict[str, Tensor]:
        gain, empty = gain_to_pascals(self.aid.full_scale_spl), inputs["samples"][:, :0]
        samples, fitted = inputs["samples"] * gain, inputs["fitted"]
        state = {"gliding": empty} | inputs  # an aid without sliders takes none
        output, after = self.aid.step(samples, fitted, inputs.get("sliders", empty), state)
        kept = {_NEXT + name: after[name] for name in inputs if name not in _GIVEN}
        return {"output": output / gain} | kept


def first_inputs(
    aid: Wearable, audiogram: AudiogramLike, *, items: int = 1, **sliders: Slider
) -> dict[str, Tensor]:
    """What the program takes for the first hop, by name.

    Args:
        audiogram: of the ear, or one an item.
        sliders: by name, 0 to 1, a number or one an item; 1 by default.

    Raises:
        ValueError: as the aid's call; a rate other than 16000 Hz, or a slider that the aid does not have.
    """
    if aid.sample_rate != RATE:
        raise ValueError(f"a program of an aid at {aid.sample_rate} Hz; allowed: {RATE}")
    if unknown := sliders.keys() - set(aid.SLIDERS):
        raise ValueError(
            f"no slider {', '.join(sorted(unknown))}; allowed: {', '.join(aid.SLIDERS) or 'none'}"
        )
    like = next(aid.parameters(), torch.empty(0))
    with torch.no_grad():
        samples = like.new_zeros(items, HOP)
        _, fitted, settings = aid.prepare(
            samples, audiogram, [sliders.get(name, 1.0) for name in aid.SLIDERS]
        )
        inputs = {
            "samples": samples,
            "fitted": fitted,
            "sliders": settings,
            **aid.initial(settings),
        }
    # each its own tensor: torch.export takes two inputs that are one tensor for one input
    return {name: tensor.clone() for name, tensor in inputs.items() if tensor.numel()}


def hop_program(aid: Wearable, *, items: int = 1) -> torch.export.ExportedProgram:
    """A ``torch.export`` program of one hop: ``program.module()(**inputs)`` gives the outputs by name. For inference.

    Raises:
        ValueError: an aid at another rate than 16000 Hz.
    """
    inputs = first_inputs(aid, torch.zeros(8), items=items)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", r"The tensor attributes .*_flat_weights"
        )  # nn.LSTM's own book-keeping
        return torch.export.export(_Hop(aid), (), inputs)


def export_aid(aid: Wearable, path: str | Path, *, items: int = 1) -> None:
    """Write ``hop_program``'s program as an ONNX file, whole or not at all.

    Raises:
        ValueError: as ``hop_program``; no such folder; or onnxruntime's output or state is off by more than 1e-4 of its
            peak, on the last of 16 hops of noise at 64 dB SPL.
        MissingExtraError: onnx, onnxscript or onnxruntime is not installed.
    """

    def make() -> tuple[torch.export.ExportedProgram, dict[str, Tensor]]:
        inputs, hop = first_inputs(aid, torch.linspace(20.0, 90.0, 8), items=items), _Hop(aid)
        noise = torch.randn(
            16, *inputs["samples"].shape, generator=torch.Generator().manual_seed(0)
        )
        level = 0.03 / gain_to_pascals(aid.full_scale_spl)
        given = inputs | {
            name: 0.2 * inputs[name] for name in inputs if name == "sliders"
        }  # on their way
        with torch.no_grad():
            for samples in level * noise.to(inputs["samples"]):
                after = hop(**given)
                given = {name: after.get(_NEXT + name, tensor) for name, tensor in given.items()}
                given["samples"] = samples
        return hop_program(aid, items=items), given

    given = first_inputs(aid, torch.zeros(8), items=items)
    outputs = ["output", *(_NEXT + name for name in given if name not in _GIVEN)]
    write_onnx(f"a {type(aid).__name__}", path, make, outputs)
