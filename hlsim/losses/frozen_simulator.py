"""What an ear hears of speech through a frozen simulator, and the reference that it is compared with."""

import math
import os
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.devices import on_device
from hlsim.checks import broadcast_shape, check_waveform
from hlsim.dsp.resample import resample
from hlsim.losses.band_levels import HIGHEST
from hlsim.msbg import MSBG
from hlsim.msbg.response import apply_bank_phase, simulate_normal_ear
from hlsim.neuro import NeuroMSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.pretrained import SIMULATOR, find_checkpoint, load_pretrained
from hlsim.torchtools import without_modes

ReferenceName = Literal["clean", "normal-hearing"]

Hearing = Callable[[Tensor], Tensor]
"""(..., time) -> (..., time), as a normal ear hears."""


class FrozenEar:
    """A simulator in eval mode without trainable parameters, and the normal ear that belongs to it.

    No module, so that what holds it does not register its parameters; the holder moves it by ``apply``.

    Args:
        simulator, sample_rate, full_scale_spl, normal, reference: as ``HearingLossLoss``.

    Raises:
        ValueError: as ``HearingLossLoss``, of these.
    """

    def __init__(
        self,
        simulator: str | Path | nn.Module,
        sample_rate: int,
        full_scale_spl: float,
        normal: Hearing | None,
        reference: ReferenceName | None,
    ) -> None:
        if normal is not None and not callable(normal):
            raise ValueError(
                f"normal is {type(normal).__name__}; allowed: a module or callable (waveform) -> waveform"
            )
        self.sample_rate, self.normal, self.choice = sample_rate, normal, reference
        self.simulator = (
            build_simulator(simulator, sample_rate, full_scale_spl).eval().requires_grad_(False)
        )
        if isinstance(normal, nn.Module):
            normal.eval().requires_grad_(False)

    def hear(
        self,
        waveform: Tensor,
        thresholds: Tensor,
        listener: Mapping[str, Any] | None,
        ends: Tensor | None = None,
    ) -> Tensor:
        """What the simulator makes of it. Shape: (..., time), (..., 8) -> (..., time), leading dimensions broadcast.

        Args:
            listener: more arguments of the simulator, by name.
            ends: samples of each item; hlsim's networks hear nothing after them.
        """
        weight = next(self.simulator.parameters(), None)
        if weight is not None and weight.device != waveform.device:
            raise ValueError(
                f"the speech is on {waveform.device} and the simulator on {weight.device}; move the loss with .to()"
            )
        allowed = _batches(waveform.shape[:-1], thresholds.shape[:-1])
        apart = not listener and len(allowed) == 2 and self._holds(NeuroMSBG)
        if apart and ends is not None and bool((ends != waveform.shape[-1]).any()):
            return self._hear_to_ends(waveform, thresholds, ends.expand(allowed[1]))
        more = {
            name: value.to(waveform.device) if isinstance(value, Tensor) else value
            for name, value in (listener or {}).items()
        }
        heard = self.simulator(waveform, thresholds, **more)
        return _check_heard(heard, "simulator", waveform, allowed)

    def _hear_to_ends(self, waveform: Tensor, thresholds: Tensor, ends: Tensor) -> Tensor:
        """``hear``, items of one length at a time: to a network, silence after an end is not the end itself.

        Shape: (..., time), (..., 8), (*batch) -> (*batch, time), zeros after each item's end.
        """
        batch, time, places = ends.shape, waveform.shape[-1], ends.flatten()
        items = waveform.expand(*batch, -1).reshape(-1, time)
        ears = thresholds.expand(*batch, -1).reshape(-1, len(FREQUENCIES))
        heard: dict[int, Tensor] = {}
        for end in places.unique().tolist():
            members = (places == end).nonzero().flatten()
            chosen = members.to(items.device)
            alone = self.hear(items[chosen, :end], ears[chosen], None)
            heard |= zip(members.tolist(), functional.pad(alone, (0, time - end)), strict=True)
        return torch.stack([heard[item] for item in range(len(items))]).reshape(*batch, time)

    def reference(
        self,
        kind: str,
        clean: Tensor,
        ears: Tensor,
        batch: torch.Size,
        listener: Mapping[str, Any] | None,
        ends: Tensor | None,
    ) -> Tensor:
        """What the heard is compared with. Shape: (..., time), (..., 8) -> (*batch, time).

        Args:
            kind: ``bands``, ``paper``, ``coherent-bands``, or of another criterion.
        """
        time, choice = clean.shape[-1], self.choice
        ours = self.normal is None and self._holds(MSBG, NeuroMSBG)
        if kind in ("coherent-bands", "bands"):
            choice = "normal-hearing"
        elif choice is None:
            choice = "clean" if kind == "paper" else "normal-hearing"
        if ours:
            ears = (
                ears.expand(*batch, -1).reshape(-1, len(FREQUENCIES))
                if ears.ndim > 1
                else ears.unsqueeze(0)
            )
        with torch.set_grad_enabled(torch.is_grad_enabled() and clean.requires_grad):
            if choice == "clean":
                aim = self._narrowed(clean)
            elif self.normal is not None:
                aim = _check_heard(self.normal(clean), "normal ear", clean, [clean.shape[:-1]])
                return aim.expand(*batch, time)
            elif ours and kind not in ("bands", "paper"):
                items = self._narrowed(clean).expand(*batch, time).reshape(-1, time)
                return simulate_normal_ear(items, ears, self.sample_rate).reshape(*batch, time)
            else:
                no_loss = on_device(_no_loss(clean.dtype), clean.device)
                aim = self.hear(clean, no_loss, listener, ends)
            if kind == "bands" or not ours:
                return aim.expand(*batch, time)
            aim = aim.expand(*batch, time).reshape(-1, time)
            normal = choice == "normal-hearing"
            return apply_bank_phase(aim, ears, self.sample_rate, normal=normal).reshape(
                *batch, time
            )

    def _narrowed(self, clean: Tensor) -> Tensor:
        """In the same band as what is heard."""
        if not self._narrow:
            return clean
        low = resample(clean, self.sample_rate, NEURO_RATE)
        return resample(low, NEURO_RATE, self.sample_rate)[..., : clean.shape[-1]]

    def _holds(self, *kinds: type[nn.Module]) -> bool:
        """Whether the simulator is one of these or, compiled or in somebody's module, holds one."""
        return any(isinstance(module, kinds) for module in self.simulator.modules())

    @property
    def _narrow(self) -> bool:
        """Whether the simulator leaves part of the band out."""
        return self.sample_rate > NEURO_RATE and self._holds(NeuroMSBG)

    def frequencies(self, fft: int) -> int | None:
        """Number of the transform's frequencies to compare: those that the simulator gives back."""
        return int(HIGHEST * fft / self.sample_rate) + 1 if self._narrow else None

    def apply(self, fn: Callable[[Tensor], Tensor]) -> None:
        """Move the modules, as ``nn.Module._apply`` does."""
        move(self.simulator, fn)
        move(self.normal, fn)


@lru_cache
def _no_loss(dtype: torch.dtype) -> Tensor:
    return without_modes(lambda: torch.zeros(len(FREQUENCIES), dtype=dtype))


def _batches(items: torch.Size, ears: torch.Size) -> list[torch.Size]:
    """Leading dimensions that what is heard may have.

    Raises:
        ValueError: ears broadcast so that each item is heard with each ear: (batch, 1) items, (batch,) ears.
    """
    try:
        together = broadcast_shape(items, ears)
    except RuntimeError:  # the simulator's to refuse
        return [items]
    if math.prod(together) > max(math.prod(items), math.prod(ears)):
        raise ValueError(
            f"audiograms of shape {(*ears, len(FREQUENCIES))} would pair each item of {tuple(items)} with each ear; "
            f"allowed: one audiogram, or one an item: {(*items, len(FREQUENCIES))}"
        )
    return [items, together]


def move(kept: object, fn: Callable[[Tensor], Tensor]) -> None:
    """Move what is kept unregistered with its host, if it is a module."""
    if isinstance(kept, nn.Module):
        kept._apply(lambda tensor: _moved(fn, tensor))


def _moved(fn: Callable[[Tensor], Tensor], tensor: Tensor) -> Tensor:
    """Move a tensor of a simulator with its host, but never to half precision, which it does not work in.

    Its values stay: where the host goes to ``meta`` it stays too, and follows when ``to_empty`` calls the host back.
    """
    moved = fn(tensor)
    device = tensor.device if moved.is_meta else moved.device
    halved = moved.is_floating_point() and moved.dtype not in (torch.float32, torch.float64)
    return tensor.to(device) if halved else tensor.to(device, moved.dtype)


def build_simulator(
    simulator: str | Path | nn.Module, sample_rate: int, full_scale_spl: float
) -> nn.Module:
    """The simulator of that name or folder, ``"msbg"`` being the exact one; a module is checked and returned."""
    if isinstance(simulator, nn.Module):
        for name, own in (("sample_rate", sample_rate), ("full_scale_spl", full_scale_spl)):
            if getattr(simulator, name, own) != own:
                raise ValueError(
                    f"the simulator has {name} {getattr(simulator, name):g} and the loss {own:g}; allowed: the same"
                )
        if getattr(simulator, "aligned", True) is False:
            raise ValueError(
                "the simulator delays what it hears; allowed: one that does not, as MSBG(aligned=True)"
            )
        return simulator
    if not isinstance(simulator, str | os.PathLike):
        raise ValueError(
            f"simulator is {type(simulator).__name__}; allowed: a name, a folder or a module (not its class)"
        )
    if str(simulator) == "msbg":
        return MSBG(sample_rate=sample_rate, full_scale_spl=full_scale_spl)
    folder = find_checkpoint(simulator, [SIMULATOR], ("msbg",))
    return load_pretrained(folder, sample_rate=sample_rate, full_scale_spl=full_scale_spl)


def _check_heard(heard: Any, what: str, waveform: Tensor, allowed: list[torch.Size]) -> Tensor:
    """What a simulator or normal ear returned, or ValueError unless it is a waveform like the one that it was given."""
    check_waveform(heard, f"what the {what} returned", highest=math.inf)
    if heard.shape[:-1] not in allowed:
        raise ValueError(
            f"the {what} made shape {tuple(heard.shape)} of {tuple(waveform.shape)}; allowed: one that keeps the "
            "shape, or broadcasts it with the audiograms'"
        )
    if heard.shape[-1] != waveform.shape[-1]:
        raise ValueError(
            f"the {what} made {heard.shape[-1]} samples of {waveform.shape[-1]}; allowed: one that keeps the "
            "length, as MSBG(aligned=True)"
        )
    return heard
