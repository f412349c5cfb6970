"""A frozen simulator, and the reference with which its output is compared."""

import math
import os
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.devices import on_device
from hlsim.checkpoint import SIMULATOR, find_checkpoint
from hlsim.checks import broadcast_shape, check_waveform
from hlsim.dsp.resample import resample
from hlsim.losses.band_levels import HIGHEST
from hlsim.msbg import MSBG
from hlsim.msbg.response import apply_bank_phase, simulate_normal_ear
from hlsim.neuro import load_pretrained
from hlsim.neuro.network import EarNetwork
from hlsim.torchtools import without_modes

ReferenceName = Literal["clean", "normal-hearing"]

Hearing = Callable[[Tensor], Tensor]
"""A normal ear: (..., time) -> (..., time)."""


class Inputs(NamedTuple):
    """Validated arguments of a call of the loss.

    Attributes:
        compensated: Output of the compensator, silent after each end and at missing ears.
        clean: Clean speech, silent there, too.
        ears: Thresholds in dB HL, 0 dB HL for missing ears.
        ends: Number of samples of each item, or None if all are as long as the batch.
        known: Mask of the ears that are not missing, or None if all are known.
        options: Arguments of the simulator beyond the audiogram, by name.

    >>> speech = torch.randn(2, 1600)
    >>> Inputs(speech, speech, torch.zeros(8), ends=None, known=None, options={}).ears.shape
    torch.Size([8])
    """

    compensated: Tensor
    clean: Tensor
    ears: Tensor
    ends: Tensor | None
    known: Tensor | None
    options: Mapping[str, Any]


class FrozenSimulator:
    """A simulator in eval mode without trainable parameters, and the normal ear that belongs to it.

    It is not a module, so that its owner does not register its parameters. The owner moves it with
    ``apply``.

    Args:
        simulator: Simulator, as ``HearingLossLoss`` describes it and its attributes.
        sample_rate: Sample rate in Hz.
        full_scale_spl: Level in dB SPL of RMS 1.0.
        normal: Normal ear, as in ``HearingLossLoss``.
        reference: Reference of the criteria that have a choice, as in ``HearingLossLoss``.
        checkpoint: Compute the activations of the simulator again in the backward pass.

    Raises:
        ValueError: An argument is not as ``HearingLossLoss`` describes it.

    >>> frozen = FrozenSimulator("msbg", 16000, 94.0, normal=None, reference=None)
    >>> frozen.simulator.training
    False
    """

    def __init__(
        self,
        simulator: str | Path | nn.Module,
        sample_rate: int,
        full_scale_spl: float,
        normal: Hearing | None,
        reference: ReferenceName | None,
        checkpoint: bool = False,
    ) -> None:
        if normal is not None and not callable(normal):
            raise ValueError(
                "expected normal to be a module or a function of a waveform, "
                f"got {type(normal).__name__}"
            )
        simulator = build_simulator(simulator, sample_rate, full_scale_spl)
        self.simulator = simulator.eval().requires_grad_(False)
        self.sample_rate = sample_rate
        self.normal = normal
        if isinstance(normal, nn.Module):
            normal.eval().requires_grad_(False)
        self.choice = reference
        self._highest_frequency = float(getattr(simulator, "highest_frequency", math.inf))
        self._limits_band = 2.0 * self._highest_frequency < sample_rate
        self._needs_exact_lengths = bool(getattr(simulator, "needs_exact_lengths", False))
        self._has_bank_phase = normal is None and bool(getattr(simulator, "emulates_msbg", False))
        self._checkpoints_whole = checkpoint
        if checkpoint and isinstance(simulator, MSBG | EarNetwork):
            # They compute a few items at a time again, so that the peak is lower, too.
            simulator.checkpoint = True
            self._checkpoints_whole = False

    def simulate(self, waveform: Tensor, thresholds: Tensor, inputs: Inputs) -> Tensor:
        """Return the output of the simulator.

        Args:
            waveform: Speech.
            thresholds: Ears in dB HL.
            inputs: Lengths, and further arguments of the simulator.

        Shape: (..., time), (..., 8) -> (..., time); the leading dimensions broadcast.
        """
        batch = _broadcast_batch(waveform.shape[:-1], thresholds.shape[:-1])
        if not self._needs_exact_lengths or inputs.ends is None or inputs.options or batch is None:
            return self._run(waveform, thresholds, inputs.options)
        time = waveform.shape[-1]
        ends = inputs.ends.expand(batch).flatten()
        if all(end == time for end in ends.tolist()):
            return self._run(waveform, thresholds)
        # Items of each length are simulated separately, without the silence after their ends.
        items = waveform.expand(*batch, -1).reshape(-1, time)
        ears = thresholds.expand(*batch, -1).reshape(-1, len(FREQUENCIES))
        outputs: dict[int, Tensor] = {}
        for end in ends.unique().tolist():
            members = (ends == end).nonzero().flatten()
            chosen = members.to(items.device)
            padded = functional.pad(self._run(items[chosen, :end], ears[chosen]), (0, time - end))
            outputs |= zip(members.tolist(), padded, strict=True)
        return torch.stack([outputs[item] for item in range(len(items))]).reshape(*batch, time)

    def _run(
        self, waveform: Tensor, thresholds: Tensor, options: Mapping[str, Any] | None = None
    ) -> Tensor:
        """Run the simulator, and validate its output."""
        weight = next(self.simulator.parameters(), None)
        if weight is not None and weight.device != waveform.device:
            raise ValueError(
                f"the speech is on {waveform.device} and the simulator on {weight.device}; "
                "move the loss with .to()"
            )
        arguments = {
            name: value.to(waveform.device) if isinstance(value, Tensor) else value
            for name, value in (options or {}).items()
        }
        simulator = partial(self.simulator, **arguments)
        if self._checkpoints_whole:
            simulator = partial(checkpoint, simulator, use_reentrant=False)
        output = simulator(waveform, thresholds)
        batch = _broadcast_batch(waveform.shape[:-1], thresholds.shape[:-1])
        return _check_output(output, "simulator", waveform, batch)

    def reference(self, criterion: str, inputs: Inputs, batch: torch.Size) -> Tensor:
        """Return the reference with which a criterion compares the output of the simulator.

        Args:
            criterion: ``coherent-bands``, ``bands``, ``paper``, or the name of another criterion.
            inputs: Arguments of the call.
            batch: Leading dimensions of the result.

        Shape: (*batch, time).
        """
        clean, ears = inputs.clean, inputs.ears
        time = clean.shape[-1]
        if self._has_bank_phase:
            ears = ears.expand(*batch, -1) if ears.ndim > 1 else ears
            ears = ears.reshape(-1, len(FREQUENCIES))
        choice = self._choice(criterion)
        with torch.set_grad_enabled(torch.is_grad_enabled() and clean.requires_grad):
            if choice == "clean":
                reference = self._limit_band(clean)
            elif self.normal is not None:
                reference = _check_output(self.normal(clean), "normal ear", clean)
            elif self._has_bank_phase and criterion not in ("bands", "paper"):
                items = self._limit_band(clean).expand(*batch, time).reshape(-1, time)
                return simulate_normal_ear(items, ears, self.sample_rate).reshape(*batch, time)
            else:
                no_loss = on_device(_no_loss(clean.dtype), clean.device)
                reference = self.simulate(clean, no_loss, inputs)
            reference = reference.expand(*batch, time)
            if criterion == "bands" or not self._has_bank_phase:
                return reference
            normal = choice == "normal-hearing"
            items = reference.reshape(-1, time)
            items = apply_bank_phase(items, ears, self.sample_rate, normal=normal)
            return items.reshape(*batch, time)

    def frequencies(self, fft: int) -> int | None:
        """Return the number of a transform's frequencies to compare, or None for all of them."""
        return int(HIGHEST * fft / self.sample_rate) + 1 if self._limits_band else None

    def apply(self, function: Callable[[Tensor], Tensor]) -> None:
        """Move the modules, as ``nn.Module._apply`` does."""
        apply_to_module(self.simulator, function)
        apply_to_module(self.normal, function)

    def _choice(self, criterion: str) -> ReferenceName:
        if criterion in ("coherent-bands", "bands"):
            return "normal-hearing"
        return self.choice or ("clean" if criterion == "paper" else "normal-hearing")

    def _limit_band(self, clean: Tensor) -> Tensor:
        """Remove the band that the simulator does not return."""
        if not self._limits_band:
            return clean
        rate = round(2.0 * self._highest_frequency)
        low = resample(clean, self.sample_rate, rate)
        return resample(low, rate, self.sample_rate)[..., : clean.shape[-1]]


def apply_to_module(value: object, function: Callable[[Tensor], Tensor]) -> None:
    """Apply a function to the tensors of a module, but keep float32 or float64.

    Values that are not modules are ignored.

    >>> layer = nn.Linear(2, 1)
    >>> apply_to_module(layer, lambda tensor: tensor.bfloat16())
    >>> layer.weight.dtype
    torch.float32
    """

    def move(tensor: Tensor) -> Tensor:
        moved = function(tensor)
        halved = moved.is_floating_point() and moved.dtype not in (torch.float32, torch.float64)
        return tensor.to(moved.device) if halved else moved

    if isinstance(value, nn.Module):
        value._apply(move)


def build_simulator(
    simulator: str | Path | nn.Module, sample_rate: int, full_scale_spl: float
) -> nn.Module:
    """Build the simulator of a name or a folder, or validate a module and return it.

    Args:
        simulator: ``"msbg"`` for the exact model, the name or the folder of a checkpoint, or a
            module.
        sample_rate: Sample rate in Hz.
        full_scale_spl: Level in dB SPL of RMS 1.0.

    Raises:
        ValueError: There is no such checkpoint, or the module was built for another rate or level,
            or delays its output.

    >>> build_simulator("msbg", sample_rate=16000, full_scale_spl=94.0)
    MSBG(sample_rate=16000, full_scale_spl=94, aligned=True)
    """
    if isinstance(simulator, nn.Module):
        settings = {"sample_rate": sample_rate, "full_scale_spl": full_scale_spl}
        for name, value in settings.items():
            if getattr(simulator, name, value) != value:
                raise ValueError(
                    f"expected a simulator with {name}={value:g}, got {getattr(simulator, name):g}"
                )
        if getattr(simulator, "aligned", True) is False:
            raise ValueError(
                "expected a simulator that does not delay its output, such as MSBG(aligned=True)"
            )
        return simulator
    if not isinstance(simulator, str | os.PathLike):
        raise ValueError(
            "expected a simulator as a name, a folder or a module (not its class), "
            f"got {type(simulator).__name__}"
        )
    if str(simulator) == "msbg":
        return MSBG(sample_rate=sample_rate, full_scale_spl=full_scale_spl)
    folder = find_checkpoint(simulator, [SIMULATOR], ("msbg",))
    return load_pretrained(folder, sample_rate=sample_rate, full_scale_spl=full_scale_spl)


@lru_cache
def _no_loss(dtype: torch.dtype) -> Tensor:
    return without_modes(lambda: torch.zeros(len(FREQUENCIES), dtype=dtype))


def _broadcast_batch(items: torch.Size, ears: torch.Size) -> torch.Size | None:
    """Return the shape to which the leading dimensions of signals and ears broadcast, or None.

    Raises:
        ValueError: The ears would broadcast so that each item is simulated for each ear, as
            (batch,) ears with (batch, 1) items would.
    """
    try:
        batch = broadcast_shape(items, ears)
    except RuntimeError:  # the simulator rejects them
        return None
    if math.prod(batch) > max(math.prod(items), math.prod(ears)):
        raise ValueError(
            f"expected one audiogram, or one per item in the shape {(*items, len(FREQUENCIES))}, "
            f"got {(*ears, len(FREQUENCIES))}, which would pair each item with each ear"
        )
    return batch


def _check_output(
    output: Any, source: str, waveform: Tensor, batch: torch.Size | None = None
) -> Tensor:
    """Return an output, or raise ValueError unless it is a waveform with the shape of its input.

    Args:
        output: Value to validate.
        source: Name of the module that returned it, for messages.
        waveform: Input of the module.
        batch: Further leading dimensions that the output may have.
    """
    check_waveform(output, f"the output of the {source}", highest=math.inf)
    time = waveform.shape[-1:]
    if output.shape != waveform.shape and (batch is None or output.shape != batch + time):
        raise ValueError(
            f"expected the {source} to return the shape {tuple(waveform.shape)}, or to broadcast "
            f"it with the audiograms, got {tuple(output.shape)}"
        )
    return output
