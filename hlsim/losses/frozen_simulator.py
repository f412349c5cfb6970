"""A simulator that is not trained, and the reference with which its output is compared."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.checks import check_shape
from hlsim.dsp.resample import resample
from hlsim.msbg.response import apply_bank_phase, simulate_normal_ear
from hlsim.simulators import LINEAR, load_simulator
from hlsim.torchtools import broadcast_shape, compute_once, flatten_items, on_device

ReferenceName = Literal["clean", "normal-hearing"]


@dataclass(frozen=True)
class ReferenceKind:
    """Signal with which a criterion compares what an impaired ear perceives.

    Attributes:
        signal: ``"clean"``, clean speech, or ``"normal-hearing"``, what a normal ear perceives of
            it.
        is_fixed: Whether ``signal`` applies even if the user of the loss chose another one.
        normal_ear: Normal ear of a simulator that emulates MSBG: ``"filter"``, one filter with
            MSBG's response for normal ears and the phase of the impaired ear's filter bank, or
            ``"simulator"``, the simulator itself at 0 dB HL.
        bank_phase: Whether clean speech, or the normal ear ``"simulator"``, gets the phase of
            MSBG's filter bank for the impaired ear, if the simulator emulates MSBG. The normal ear
            ``"filter"`` always has it.

    >>> ReferenceKind("clean").bank_phase
    True
    """

    signal: ReferenceName = "normal-hearing"
    is_fixed: bool = False
    normal_ear: Literal["filter", "simulator"] = "filter"
    bank_phase: bool = True


NormalEar = Callable[[Tensor], Tensor]
"""Function or module that returns what a normal ear perceives, (..., time) -> (..., time)."""


class FrozenSimulator:
    """Simulator of hearing loss that is not trained, with the normal ear that belongs to it.

    The simulator stays in eval mode and has no trainable parameter. This class is not a module, so
    that the loss that owns it does not register these parameters.

    Args:
        simulator: Name, folder or module, see ``load_simulator``. A module is changed, not copied,
            and so is ``normal``.
        sample_rate: Sample rate in Hz.
        full_scale_spl: Level in dB SPL of RMS 1.0, 0 to 200.
        normal: Normal ear that belongs to the simulator. By default, the filter of MSBG's normal
            ear or the simulator at 0 dB HL, see ``HearingLossLoss``.
        choice: Reference of the criteria that have a choice: ``"clean"`` speech, or
            ``"normal-hearing"``, what the normal ear perceives of it. By default, each criterion
            has its own.
        checkpoint: Whether activations of the simulator are computed again in the backward pass
            instead of stored.

    Raises:
        ValueError: There is no such simulator, it is not valid, was built for another rate or
            level, or delays its output, or the rate or the level is out of range.

    >>> frozen = FrozenSimulator("msbg", 16000, 94.0, normal=None, choice=None)
    >>> frozen.simulator.training
    False
    """

    def __init__(
        self,
        simulator: str | Path | nn.Module,
        sample_rate: int,
        full_scale_spl: float,
        normal: NormalEar | None,
        choice: ReferenceName | None,
        checkpoint: bool = False,
    ) -> None:
        model: Any = load_simulator(
            simulator, sample_rate=sample_rate, full_scale_spl=full_scale_spl
        )
        self.simulator = model.eval().requires_grad_(False)
        if checkpoint:
            model.checkpoint = True
        self.sample_rate = sample_rate
        self.normal = normal
        if isinstance(normal, nn.Module):
            normal.eval().requires_grad_(False)
        self.choice = choice
        self._band_rate = 2.0 * getattr(model, "highest_frequency", math.inf)
        self._needs_exact_lengths = getattr(model, "needs_exact_lengths", False)
        self._has_bank_phase = normal is None and getattr(model, "emulates_msbg", False)
        if self._has_bank_phase and model is not simulator:
            _warn_of_other_teacher(simulator, getattr(model, "teacher", ""))

    def simulate(
        self, waveform: Tensor, thresholds: Tensor, lengths: Tensor | None = None
    ) -> Tensor:
        """Compute what the impaired ears perceive.

        Args:
            waveform: Output of an aid, on the scale of ``full_scale_spl``.
            thresholds: Thresholds of the ears in dB HL.
            lengths: Number of samples of each item of a padded batch, (...), on the CPU. By
                default, all items are as long as the batch.

        Shape: (..., time), (..., 8) -> (..., time); the leading dimensions broadcast.

        Raises:
            ValueError: The simulator rejects its input, or returns no floating-point tensor of this
                shape.
        """
        if not type(self.simulator).__module__.startswith("hlsim."):
            # A module that changes its arguments in place must not change the ears of the loss.
            waveform, thresholds = waveform.clone(), thresholds.clone()
        time = waveform.shape[-1]
        batch = broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
        if lengths is None or not self._needs_exact_lengths:
            perceived = self.simulator(waveform, thresholds)
            return check_shape(perceived, "simulator", (*batch, time))
        # Items are simulated one by one, without the silence after their ends.
        items = flatten_items(waveform, batch, waveform.dtype)
        ears = flatten_items(thresholds, batch, thresholds.dtype)
        outputs = []
        ends = lengths.expand(batch).flatten().tolist()
        for item, ear, end in zip(items, ears, ends, strict=True):
            perceived = check_shape(self.simulator(item[:end], ear), "simulator", (end,))
            outputs.append(functional.pad(perceived, (0, time - end)))
        return torch.stack(outputs).reshape(*batch, time)

    def compute_reference(
        self,
        reference: ReferenceKind | None,
        clean: Tensor,
        thresholds: Tensor,
        batch: torch.Size,
        lengths: Tensor | None = None,
    ) -> Tensor:
        """Compute the signal with which a criterion compares what the impaired ears perceive.

        Args:
            reference: Kind of the signal; None stands for clean speech as it is.
            clean: Clean speech, (..., time).
            thresholds: Impaired ears in dB HL, (..., 8). Their severity selects the phase shift of
                the reference (``hlsim.msbg.response``).
            batch: Leading dimensions of the result.
            lengths: Lengths of the items, as in ``simulate``.

        Returns:
            Clean speech, or what a normal ear perceives of it, (*batch, time).

        Raises:
            ValueError: The simulator or the normal ear returns no floating-point tensor of this
                shape.
        """
        shape = (*batch, clean.shape[-1])
        if reference is None:
            return clean.expand(shape)
        is_chosen = self.choice is not None and not reference.is_fixed
        is_normal = (self.choice if is_chosen else reference.signal) == "normal-hearing"
        target = self._limit_band(clean)
        if is_normal and self.normal is not None:
            # A function that changes its argument in place must not change the caller's speech.
            target = check_shape(self.normal(target.clone()), "normal ear", target.shape)
        elif is_normal and self._has_bank_phase and reference.normal_ear == "filter":
            return simulate_normal_ear(target, thresholds, self.sample_rate).expand(shape)
        elif is_normal:
            # Thresholds whose values the CPU knows, so that it need not wait for a GPU.
            target = self.simulate(target, on_device(_normal_ear(), target.device), lengths)
        if self._has_bank_phase and reference.bank_phase:
            target = apply_bank_phase(target, thresholds, self.sample_rate, normal=is_normal)
        return target.expand(shape)

    def _limit_band(self, clean: Tensor) -> Tensor:
        """Remove frequencies above the highest one of the simulator's output.

        Shape: (..., time) -> (..., time).
        """
        if self._band_rate >= self.sample_rate:
            return clean
        low = resample(clean, self.sample_rate, round(self._band_rate))
        return resample(low, round(self._band_rate), self.sample_rate)[..., : clean.shape[-1]]


def _warn_of_other_teacher(simulator: Any, record: str) -> None:
    """Warn if a network has learned from a teacher that hlsim does not know as MSBG.

    Args:
        simulator: Name or folder of the simulator.
        record: Name of the teacher, perhaps with its fingerprint; empty if there is none.
    """
    teacher = record.partition(" (")[0]
    is_plugin = ":" in teacher and teacher.rpartition(":")[-1].isidentifier()
    if is_plugin or teacher == LINEAR:
        warnings.warn(
            f"{simulator} has learned from {teacher}, but is compared with the normal ear of "
            "MSBG; unless this teacher is MSBG, use the teacher itself as simulator "
            f"(--simulator {teacher}), or pass its normal ear to HearingLossLoss (normal)",
            stacklevel=4,
        )


@compute_once
def _normal_ear() -> Tensor:
    """Return the thresholds of a normal ear, 0 dB HL at all ``FREQUENCIES``, (8,), on the CPU."""
    return torch.zeros(len(FREQUENCIES), device="cpu")
