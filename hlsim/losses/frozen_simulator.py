"""A frozen simulator, and the reference with which its output is compared."""

import math
import os
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.devices import on_device
from hlsim.checks import broadcast_shape, check_waveform
from hlsim.dsp.resample import resample
from hlsim.losses.band_levels import HIGHEST
from hlsim.msbg import MSBG
from hlsim.msbg.response import apply_bank_phase, simulate_normal_ear
from hlsim.neuro.network import EarNetwork
from hlsim.neuro.pretrained import load_pretrained
from hlsim.pretrained import SIMULATOR, find_checkpoint
from hlsim.torchtools import without_modes

ReferenceName = Literal["clean", "normal-hearing"]

Hearing = Callable[[Tensor], Tensor]
"""A normal ear: (..., time) -> (..., time)."""


class FrozenSimulator:
    """A simulator in eval mode without trainable parameters, and the normal ear that belongs to it.

    It is not a module, so that its owner does not register its parameters. The owner moves it with
    ``apply``.

    Args:
        simulator: simulator, as ``HearingLossLoss`` describes it and its attributes.
        sample_rate: sample rate in Hz.
        full_scale_spl: level in dB SPL of RMS 1.0.
        normal: normal ear, as in ``HearingLossLoss``.
        reference: reference of the criteria that have a choice, as in ``HearingLossLoss``.
        checkpoint: compute the activations of the simulator again in the backward pass.

    Raises:
        ValueError: an argument is not as ``HearingLossLoss`` describes it.
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
        self.sample_rate = sample_rate
        self.normal = normal
        self.choice = reference
        simulator = build_simulator(simulator, sample_rate, full_scale_spl)
        self.simulator = simulator.eval().requires_grad_(False)
        self._checkpoints_whole = checkpoint
        if checkpoint and isinstance(simulator, MSBG | EarNetwork):
            # They compute a few items at a time again, so that the peak is lower, too.
            simulator.checkpoint = True
            self._checkpoints_whole = False
        if isinstance(normal, nn.Module):
            normal.eval().requires_grad_(False)

    def simulate(
        self,
        waveform: Tensor,
        thresholds: Tensor,
        options: Mapping[str, Any] | None,
        ends: Tensor | None = None,
    ) -> Tensor:
        """Return the output of the simulator.

        Args:
            waveform: speech.
            thresholds: ears in dB HL.
            options: more arguments of the simulator by name.
            ends: number of samples of each item, for simulators that need exact lengths.

        Shape: (..., time), (..., 8) -> (..., time); the leading dimensions broadcast.
        """
        weight = next(self.simulator.parameters(), None)
        if weight is not None and weight.device != waveform.device:
            raise ValueError(
                f"the speech is on {waveform.device} and the simulator on {weight.device}; "
                "move the loss with .to()"
            )
        allowed = _allowed_batches(waveform.shape[:-1], thresholds.shape[:-1])
        by_length = len(allowed) == 2 and not options and self._needs_exact_lengths
        if by_length and ends is not None and bool((ends != waveform.shape[-1]).any()):
            return self._simulate_by_length(waveform, thresholds, ends.expand(allowed[1]))
        options = {
            name: value.to(waveform.device) if isinstance(value, Tensor) else value
            for name, value in (options or {}).items()
        }
        simulator = partial(self.simulator, **options)
        if self._checkpoints_whole:
            simulator = partial(checkpoint, simulator, use_reentrant=False)
        output = simulator(waveform, thresholds)
        return _check_output(output, "simulator", waveform, allowed)

    def _simulate_by_length(self, waveform: Tensor, thresholds: Tensor, ends: Tensor) -> Tensor:
        """Simulate the items of each length separately, without the silence after their ends.

        Shape: (..., time), (..., 8), (*batch) -> (*batch, time), with zeros after each end.
        """
        batch, time = ends.shape, waveform.shape[-1]
        items = waveform.expand(*batch, -1).reshape(-1, time)
        ears = thresholds.expand(*batch, -1).reshape(-1, len(FREQUENCIES))
        outputs: dict[int, Tensor] = {}
        for end in ends.flatten().unique().tolist():
            members = (ends.flatten() == end).nonzero().flatten()
            chosen = members.to(items.device)
            group = self.simulate(items[chosen, :end], ears[chosen], None)
            padded = functional.pad(group, (0, time - end))
            outputs |= zip(members.tolist(), padded, strict=True)
        return torch.stack([outputs[item] for item in range(len(items))]).reshape(*batch, time)

    def reference(
        self,
        criterion: str,
        clean: Tensor,
        ears: Tensor,
        batch: torch.Size,
        options: Mapping[str, Any] | None,
        ends: Tensor | None,
    ) -> Tensor:
        """Return the reference with which a criterion compares the output of the simulator.

        Args:
            criterion: ``coherent-bands``, ``bands``, ``paper``, or the name of another criterion.
            clean: clean speech.
            ears: thresholds in dB HL.
            batch: leading dimensions of the result.
            options: more arguments of the simulator by name.
            ends: number of samples of each item.

        Shape: (..., time), (..., 8) -> (*batch, time).
        """
        time = clean.shape[-1]
        with_phase = self.normal is None and self._emulates_msbg
        choice = self._choice(criterion)
        if with_phase and ears.ndim > 1:
            ears = ears.expand(*batch, -1).reshape(-1, len(FREQUENCIES))
        elif with_phase:
            ears = ears.unsqueeze(0)
        with torch.set_grad_enabled(torch.is_grad_enabled() and clean.requires_grad):
            if choice == "clean":
                reference = self._limit_band(clean)
            elif self.normal is not None:
                normal = self.normal(clean)
                normal = _check_output(normal, "normal ear", clean, [clean.shape[:-1]])
                return normal.expand(*batch, time)
            elif with_phase and criterion not in ("bands", "paper"):
                items = self._limit_band(clean).expand(*batch, time).reshape(-1, time)
                return simulate_normal_ear(items, ears, self.sample_rate).reshape(*batch, time)
            else:
                no_loss = on_device(_no_loss(clean.dtype), clean.device)
                reference = self.simulate(clean, no_loss, options, ends)
            if criterion == "bands" or not with_phase:
                return reference.expand(*batch, time)
            items = reference.expand(*batch, time).reshape(-1, time)
            normal_hearing = choice == "normal-hearing"
            items = apply_bank_phase(items, ears, self.sample_rate, normal=normal_hearing)
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
        if self.choice is not None:
            return self.choice
        return "clean" if criterion == "paper" else "normal-hearing"

    def _limit_band(self, clean: Tensor) -> Tensor:
        """Remove the band that the simulator does not return."""
        if not self._limits_band:
            return clean
        rate = round(2.0 * self._highest_frequency)
        low = resample(clean, self.sample_rate, rate)
        return resample(low, rate, self.sample_rate)[..., : clean.shape[-1]]

    @property
    def _limits_band(self) -> bool:
        return 2.0 * self._highest_frequency < self.sample_rate

    @property
    def _highest_frequency(self) -> float:
        return float(getattr(self.simulator, "highest_frequency", math.inf))

    @property
    def _emulates_msbg(self) -> bool:
        return bool(getattr(self.simulator, "emulates_msbg", False))

    @property
    def _needs_exact_lengths(self) -> bool:
        return bool(getattr(self.simulator, "needs_exact_lengths", False))


def apply_to_module(value: object, function: Callable[[Tensor], Tensor]) -> None:
    """Apply a function to the tensors of a module, but keep float32 or float64.

    Values that are not modules are ignored.
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
        sample_rate: sample rate in Hz.
        full_scale_spl: level in dB SPL of RMS 1.0.

    Raises:
        ValueError: there is no such checkpoint, or the module was built for another rate or level,
            or delays its output.
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


def _allowed_batches(items: torch.Size, ears: torch.Size) -> list[torch.Size]:
    """Return the leading dimensions that the output of a simulator may have.

    Raises:
        ValueError: the ears would broadcast so that each item is simulated for each ear, as
            (batch,) ears with (batch, 1) items would.
    """
    try:
        broadcast = broadcast_shape(items, ears)
    except RuntimeError:  # the simulator rejects them
        return [items]
    if math.prod(broadcast) > max(math.prod(items), math.prod(ears)):
        raise ValueError(
            f"expected one audiogram, or one per item in the shape {(*items, len(FREQUENCIES))}, "
            f"got {(*ears, len(FREQUENCIES))}, which would pair each item with each ear"
        )
    return [items, broadcast]


def _check_output(output: Any, source: str, waveform: Tensor, allowed: list[torch.Size]) -> Tensor:
    """Return an output, or raise ValueError unless it is a waveform with the shape of its input."""
    check_waveform(output, f"the output of the {source}", highest=math.inf)
    if output.shape[:-1] not in allowed or output.shape[-1] != waveform.shape[-1]:
        raise ValueError(
            f"expected the {source} to return the shape {tuple(waveform.shape)}, or to broadcast "
            f"it with the audiograms, got {tuple(output.shape)}"
        )
    return output
