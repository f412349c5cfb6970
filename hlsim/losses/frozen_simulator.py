"""A simulator that is not trained, and the reference with which its output is compared."""

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
from hlsim.neuro import load_pretrained
from hlsim.neuro.network import EarNetwork
from hlsim.torchtools import without_modes

ReferenceName = Literal["clean", "normal-hearing"]

NormalEar = Callable[[Tensor], Tensor]
"""Function or module that returns what a normal ear perceives, (..., time) -> (..., time)."""


class FrozenSimulator:
    """Simulator of an impaired ear that is not trained, with the normal ear that belongs to it.

    The simulator stays in eval mode and has no trainable parameter. This class is not a module, so
    that the loss that owns it does not register these parameters. The loss moves it with ``apply``.

    Args:
        simulator: ``"msbg"``, the name or folder of a checkpoint, or a module, as in
            ``HearingLossLoss``.
        sample_rate: Sample rate in Hz.
        full_scale_spl: Level in dB SPL of RMS 1.0.
        normal: Normal ear that belongs to the simulator. By default, the simulator at 0 dB HL.
        reference: Reference of the criteria that have a choice: ``"clean"`` speech, or
            ``"normal-hearing"``, what the normal ear perceives of it. By default, the criterion
            ``"paper"`` takes clean speech.
        checkpoint: Whether activations of the simulator are computed again in the backward pass
            instead of stored.

    Raises:
        ValueError: An argument is not as described.

    >>> frozen = FrozenSimulator("msbg", 16000, 94.0, normal=None, reference=None)
    >>> frozen.simulator.training
    False
    """

    def __init__(
        self,
        simulator: str | Path | nn.Module,
        sample_rate: int,
        full_scale_spl: float,
        normal: NormalEar | None,
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

    def simulate(
        self,
        waveform: Tensor,
        thresholds: Tensor,
        lengths: Tensor | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> Tensor:
        """Compute what the impaired ears perceive.

        Args:
            waveform: Speech.
            thresholds: Ears in dB HL.
            lengths: Number of samples of each item of a padded batch, on the CPU. By default, all
                items are as long as the batch.
            options: Further keyword arguments of the simulator.

        Shape: (..., time), (..., 8) -> (..., time); the leading dimensions broadcast.
        """
        if not self._needs_exact_lengths or lengths is None or options:
            return self._run(waveform, thresholds, options or {})
        # Items of each length are simulated separately, without the silence after their ends.
        time = waveform.shape[-1]
        batch = _broadcast_batch(waveform.shape[:-1], thresholds.shape[:-1])
        ends = lengths.expand(batch).flatten()
        items = waveform.expand(*batch, -1).reshape(-1, time)
        ears = thresholds.expand(*batch, -1).reshape(-1, len(FREQUENCIES))
        outputs: dict[int, Tensor] = {}
        for end in ends.unique().tolist():
            members = (ends == end).nonzero().flatten()
            chosen = members.to(items.device)
            perceived = self._run(items[chosen, :end], ears[chosen], {})
            padded = functional.pad(perceived, (0, time - end))
            outputs |= zip(members.tolist(), padded, strict=True)
        return torch.stack([outputs[item] for item in range(len(items))]).reshape(*batch, time)

    def _run(self, waveform: Tensor, thresholds: Tensor, options: Mapping[str, Any]) -> Tensor:
        """Run the simulator, and validate its output."""
        batch = _broadcast_batch(waveform.shape[:-1], thresholds.shape[:-1])
        weight = next(self.simulator.parameters(), None)
        if weight is not None and weight.device != waveform.device:
            raise ValueError(
                f"the speech is on {waveform.device} and the simulator on {weight.device}; "
                "move the loss with .to()"
            )
        arguments = {
            name: value.to(waveform.device) if isinstance(value, Tensor) else value
            for name, value in options.items()
        }
        simulator = partial(self.simulator, **arguments)
        if self._checkpoints_whole:
            simulator = partial(checkpoint, simulator, use_reentrant=False)
        return _check_output(simulator(waveform, thresholds), "simulator", waveform, batch)

    def reference(
        self,
        criterion: str,
        clean: Tensor,
        thresholds: Tensor,
        batch: torch.Size,
        lengths: Tensor | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> Tensor:
        """Compute the reference with which a criterion compares what the impaired ears perceive.

        Args:
            criterion: Name of the criterion.
            clean: Clean speech, (..., time).
            thresholds: Impaired ears in dB HL, (..., 8). Their severity selects the phase shift of
                the reference (``hlsim.msbg.response``).
            batch: Leading dimensions of the result.
            lengths: Lengths of the items, as in ``simulate``.
            options: Further arguments of the simulator, as in ``simulate``.

        Returns:
            Clean speech, or what a normal ear perceives of it, (*batch, time).
        """
        time = clean.shape[-1]
        ears = thresholds
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
                reference = self.simulate(clean, no_loss, lengths, options)
            reference = reference.expand(*batch, time)
            if criterion == "bands" or not self._has_bank_phase:
                return reference
            normal = choice == "normal-hearing"
            items = reference.reshape(-1, time)
            items = apply_bank_phase(items, ears, self.sample_rate, normal=normal)
            return items.reshape(*batch, time)

    def frequencies(self, fft: int) -> int | None:
        """Return how many frequencies of a Fourier transform the criteria compare.

        Args:
            fft: Length of the transform.

        Returns:
            Number of frequencies from 0 Hz up to 7500 Hz if the output of the simulator ends below
            half the loss's sample rate, as that of Neuro-MSBG does at 8 kHz for rates above 16 kHz;
            otherwise ``None``, for all of them.
        """
        return int(HIGHEST * fft / self.sample_rate) + 1 if self._limits_band else None

    def apply(self, function: Callable[[Tensor], Tensor]) -> None:
        """Move or convert the simulator and the normal ear, as ``nn.Module.to`` does.

        Args:
            function: Function that moves or converts a tensor.
        """
        apply_to_module(self.simulator, function)
        apply_to_module(self.normal, function)

    def _choice(self, criterion: str) -> ReferenceName:
        if criterion in ("coherent-bands", "bands"):
            return "normal-hearing"
        return self.choice or ("clean" if criterion == "paper" else "normal-hearing")

    def _limit_band(self, clean: Tensor) -> Tensor:
        """Remove the frequencies above those that the simulator returns."""
        if not self._limits_band:
            return clean
        rate = round(2.0 * self._highest_frequency)
        low = resample(clean, self.sample_rate, rate)
        return resample(low, rate, self.sample_rate)[..., : clean.shape[-1]]


def apply_to_module(value: object, function: Callable[[Tensor], Tensor]) -> None:
    """Move or convert all tensors of a module in place, but never to half precision.

    Args:
        value: Module, or another value, which is ignored.
        function: Function that moves or converts a tensor.

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
    """Return the simulator that a name, a folder or a module describes.

    Args:
        simulator: ``"msbg"`` for the exact model, the name or the folder of a checkpoint, or a
            module, which is validated and returned.
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
    return load_pretrained(simulator, sample_rate=sample_rate, full_scale_spl=full_scale_spl)


@lru_cache
def _no_loss(dtype: torch.dtype) -> Tensor:
    return without_modes(lambda: torch.zeros(len(FREQUENCIES), dtype=dtype))


def _broadcast_batch(items: torch.Size, ears: torch.Size) -> torch.Size:
    """Return the shape to which the leading dimensions of signals and ears broadcast.

    Raises:
        ValueError: They do not broadcast, or so that each item would be simulated for each ear, as
            (batch,) ears with (batch, 1) items would.
    """
    try:
        batch = broadcast_shape(items, ears)
    except RuntimeError:
        batch = None
    if batch is None or math.prod(batch) > max(math.prod(items), math.prod(ears)):
        raise ValueError(
            f"expected one audiogram, or one per item in the shape {(*items, len(FREQUENCIES))}, "
            f"got {(*ears, len(FREQUENCIES))}"
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
        batch: Leading dimensions that the output may have instead of those of its input.
    """
    check_waveform(output, f"the output of the {source}", highest=math.inf)
    time = waveform.shape[-1:]
    if output.shape != waveform.shape and (batch is None or output.shape != batch + time):
        raise ValueError(
            f"expected the {source} to return the shape {tuple(waveform.shape)}, or to broadcast "
            f"it with the audiograms, got {tuple(output.shape)}"
        )
    return output
