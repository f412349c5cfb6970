"""A training loss that hears through an impaired ear."""

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES, AudiogramLike, as_thresholds, own_thresholds
from hlsim.calibration import PASCAL_SPL, check_full_scale, gain_to_pascals
from hlsim.checks import Lengths, check_lengths, check_rate, check_waveform, is_finite, silent_after
from hlsim.criteria import paper
from hlsim.criteria.bands import HIGHEST, band_level_loss
from hlsim.dsp.resample import resample
from hlsim.msbg import MSBG
from hlsim.msbg.response import with_phase_of_bank
from hlsim.neuro import NeuroMSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.pretrained import SIMULATOR, find_checkpoint, load_pretrained
from hlsim.torchtools import not_compiled

CRITERIA: dict[str, Mapping[str, float]] = {"paper": paper.DEFAULT_WEIGHTS, "bands": {"band_levels": 1.0}}
"""Criteria by name: their parts and the default weight of each."""

REFERENCES = ("clean", "normal-hearing")

REDUCTIONS = ("mean", "none")


class HearingLossLoss(nn.Module):
    """How far what an impaired ear hears of compensated speech is from the clean speech.

    The simulator is frozen: it stays in eval mode, has no trainable parameter, and is not registered, so that neither the
    parameters nor the checkpoint of a module that holds this loss know of it. It moves with ``.to()`` all the same, and
    gradients pass through it to the compensated speech. Being one for all, it is not for ``nn.DataParallel``; use
    ``DistributedDataParallel``.

    Levels matter, nothing is normalised: 65 dB SPL is RMS 0.035 at the default ``full_scale_spl``.

    It may be called in an autocast region and works in float32 there; call ``backward()`` outside of it, as torch says:
    inside one of float16, the gradient of ``"bands"`` is NaN.

    Args:
        audiogram: the ear or ears; may be given with each call instead. A tensor that is trained gets its gradient; it is
            not registered either.
        simulator: ``"neuro-msbg"`` or another checkpoint's name or folder; ``"msbg"``, the exact model; or a module
            called as they are, which is frozen as it stands (give a copy of one that still trains).
        sample_rate: of the speech in Hz, 16000 to 48000. Neuro-MSBG judges the band under 8 kHz, above 16000 that under
            7.5 kHz.
        full_scale_spl: level in dB SPL of RMS 1.0.
        reference: what is heard is compared with ``"clean"``, the clean speech itself, or ``"normal-hearing"``, what the
            same simulator makes of it at 0 dB HL. For the criterion ``"paper"`` either has the phase of MSBG's bank of
            the ear's severity (``hlsim.msbg.response``), or speech turned over could be nearer than the speech. With a
            module that neither is nor holds one of hlsim's simulators, it is compared as it is.
        criterion: ``"paper"``, magnitude, phase, complex and time losses (Equations 2 to 9), or ``"bands"``, levels in
            ERB-wide bands, always against what a normal ear hears.
        weights: of the parts by name; a part left out does not count.
        reduction: ``"mean"`` over the items, whatever their lengths, or ``"none"``, a value for each.

    Raises:
        ValueError: an unknown name, a value of another kind or out of range, a simulator made for another rate or level,
            or one that delays.
    """

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        simulator: str | Path | nn.Module = "neuro-msbg",
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
        reference: str = "clean",
        criterion: str = "paper",
        weights: Mapping[str, float] | None = None,
        reduction: str = "mean",
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        if not isinstance(reference, str) or reference not in REFERENCES:
            raise ValueError(f"reference is {reference!r}; allowed: {', '.join(REFERENCES)}")
        if not isinstance(criterion, str) or criterion not in CRITERIA:
            raise ValueError(f"criterion is {criterion!r}; allowed: {', '.join(CRITERIA)}")
        if not isinstance(reduction, str) or reduction not in REDUCTIONS:
            raise ValueError(f"reduction is {reduction!r}; allowed: {', '.join(REDUCTIONS)}")
        self.reference, self.criterion, self.reduction = reference, criterion, reduction
        self.weights = _check_weights(CRITERIA[criterion] if weights is None else weights, criterion)
        with torch.device("cpu"):  # where the host is made on ``meta``, nobody gives the ear its values later
            thresholds = own_thresholds(audiogram)
        built = _build(simulator, self.sample_rate, self.full_scale_spl)
        # in a tuple, nn.Module does not see them
        self._unregistered = (built.eval().requires_grad_(False), thresholds)

    @property
    def simulator(self) -> nn.Module:
        """The simulator, frozen."""
        return self._unregistered[0]

    @property
    def thresholds(self) -> Tensor | None:
        """The ear or ears given to the constructor. Shape: (..., 8) dB HL."""
        return self._unregistered[1]

    @not_compiled  # a compiled caller calls it as it is
    def forward(
        self,
        compensated: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        lengths: Lengths | None = None,
    ) -> Tensor:
        """The loss: mean over the items, or of each.

        Shape: (..., time) twice, and one audiogram or (..., 8) that broadcasts over the leading dimensions -> (), or with
            ``reduction="none"`` the leading dimensions.

        Args:
            lengths: samples of each item of a padded batch, (...). What follows an item's end is heard as silence,
                whatever is there, and is not compared. With the exact MSBG an item counts much as it does alone; blocks
                of a network that look at all of a signal (lstm, transformer, mamba) see the silence too.

        Raises:
            ValueError: shapes or devices that do not fit, no audiogram, levels outside -10 to 100 dB HL, lengths outside
                1 to time, or a simulator that does not return a waveform of the shape it was given.
        """
        return paper.weighted_sum(self.parts(compensated, clean, audiogram, lengths), self.weights)

    @not_compiled
    def parts(
        self,
        compensated: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        lengths: Lengths | None = None,
    ) -> dict[str, Tensor]:
        """The parts of the loss by name, before their weights: magnitude, phase, complex and time, or band_levels (dB).

        Their sum, ``sum(weight * parts[name] for name, weight in loss.weights.items())``, is what ``forward`` gives.

        Shape, arguments and errors: as ``forward``.
        """
        check_waveform(compensated, "compensated")
        check_waveform(clean, "clean")
        if compensated.shape != clean.shape:
            raise ValueError(
                f"compensated has shape {tuple(compensated.shape)}, clean {tuple(clean.shape)}; allowed: the same shape"
            )
        if compensated.device != clean.device:
            raise ValueError(
                f"compensated is on {compensated.device} and clean on {clean.device}; allowed: the same device"
            )
        ends = None if lengths is None else check_lengths(lengths, compensated.shape)
        ears = self.thresholds if audiogram is None else as_thresholds(audiogram)
        if ears is None:
            raise ValueError("no audiogram: give one when building the loss or with the call")
        with torch.autocast(compensated.device.type, enabled=False):
            dtype = torch.promote_types(torch.promote_types(compensated.dtype, clean.dtype), torch.float32)
            compensated, clean = compensated.to(dtype), clean.to(dtype)
            if ends is not None:
                compensated, clean = silent_after(compensated, ends), silent_after(clean, ends)
            heard = self._hear(compensated, ears.to(compensated.device))
            aim = self._aim(clean).expand_as(heard)
            batch, time = heard.shape[:-1], heard.shape[-1]
            gain = gain_to_pascals(self.full_scale_spl)
            heard, aim = heard.reshape(-1, time) * gain, aim.reshape(-1, time) * gain
            if self.criterion == "paper" and self._holds(MSBG, NeuroMSBG):
                own_ears = ears.to(aim.device).expand(*batch, -1).reshape(-1, len(FREQUENCIES))
                normal = self.reference == "normal-hearing"
                aim = with_phase_of_bank(aim, own_ears, self.sample_rate, normal=normal)
            if ends is None or bool((ends == time).all()):
                items = self._compare(heard, aim)
            else:
                each = [
                    self._compare(heard[item, None, :end], aim[item, None, :end])
                    for item, end in enumerate(ends.expand(batch).flatten().tolist())
                ]
                items = {name: torch.cat([own[name] for own in each]) for name in each[0]}
        if self.reduction == "none":
            return {name: part.reshape(batch) for name, part in items.items()}
        return {name: part.mean() for name, part in items.items()}

    def extra_repr(self) -> str:
        return (
            f"simulator={type(self.simulator).__name__}, sample_rate={self.sample_rate}, "
            f"full_scale_spl={self.full_scale_spl:g}, reference={self.reference!r}, criterion={self.criterion!r}"
        )

    def _compare(self, heard: Tensor, aim: Tensor) -> dict[str, Tensor]:
        """The parts of each item. Shape: (items, time) twice, in pascals -> (items,) each."""
        if self.criterion == "bands":
            return {"band_levels": band_level_loss(heard, aim, self.sample_rate)}
        stft = paper.paper_stft(self.sample_rate)
        return paper.paper_parts(heard, aim, stft, self._frequencies(stft.fft))

    def _hear(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
        weight = next(self.simulator.parameters(), None)
        if weight is not None and weight.device != waveform.device:
            raise ValueError(
                f"the speech is on {waveform.device} and the simulator on {weight.device}; move the loss with .to()"
            )
        allowed = _batches(waveform.shape[:-1], thresholds.shape[:-1])
        heard = check_waveform(self.simulator(waveform, thresholds), "what the simulator returned")
        if heard.shape[:-1] not in allowed:
            raise ValueError(
                f"the simulator made shape {tuple(heard.shape)} of {tuple(waveform.shape)}; allowed: one that keeps the "
                "shape, or broadcasts it with the audiograms'"
            )
        if heard.shape[-1] != waveform.shape[-1]:
            raise ValueError(
                f"the simulator made {heard.shape[-1]} samples of {waveform.shape[-1]}; allowed: one that keeps the "
                "length, as MSBG(aligned=True)"
            )
        return heard

    def _aim(self, clean: Tensor) -> Tensor:
        """What the heard is compared with."""
        if self.reference == "normal-hearing" or self.criterion == "bands":
            with torch.set_grad_enabled(torch.is_grad_enabled() and clean.requires_grad):
                return self._hear(clean, clean.new_zeros(len(FREQUENCIES)))
        if self._narrow:  # the same band as what is heard
            return resample(resample(clean, self.sample_rate, NEURO_RATE), NEURO_RATE, self.sample_rate)[
                ..., : clean.shape[-1]
            ]
        return clean

    def _holds(self, *kinds: type[nn.Module]) -> bool:
        """Whether the simulator is one of these or, compiled or in somebody's module, holds one."""
        return any(isinstance(module, kinds) for module in self.simulator.modules())

    @property
    def _narrow(self) -> bool:
        """Whether the simulator leaves part of the band out."""
        return self.sample_rate > NEURO_RATE and self._holds(NeuroMSBG)

    def _frequencies(self, fft: int) -> int | None:
        """Number of the transform's frequencies to compare: those that the simulator gives back."""
        return int(HIGHEST * fft / self.sample_rate) + 1 if self._narrow else None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "HearingLossLoss":
        super()._apply(fn, recurse)
        self.simulator._apply(lambda tensor: _moved(fn, tensor))
        return self


def _batches(items: torch.Size, ears: torch.Size) -> list[torch.Size]:
    """Leading dimensions that what is heard may have.

    Raises:
        ValueError: ears broadcast so that each item is heard with each ear: (batch, 1) items, (batch,) ears.
    """
    try:
        together = torch.broadcast_shapes(items, ears)
    except RuntimeError:  # the simulator's to refuse
        return [items]
    if math.prod(together) > max(math.prod(items), math.prod(ears)):
        raise ValueError(
            f"audiograms of shape {(*ears, len(FREQUENCIES))} would pair each item of {tuple(items)} with each ear; "
            f"allowed: one audiogram, or one an item: {(*items, len(FREQUENCIES))}"
        )
    return [items, together]


def _moved(fn: Callable[[Tensor], Tensor], tensor: Tensor) -> Tensor:
    """Move a tensor of the simulator with its host, but never to half precision, which it does not work in.

    Its values stay: where the host goes to ``meta`` it stays too, and follows when ``to_empty`` calls the host back.
    """
    moved = fn(tensor)
    device = tensor.device if moved.is_meta else moved.device
    halved = moved.is_floating_point() and moved.dtype not in (torch.float32, torch.float64)
    return tensor.to(device) if halved else tensor.to(device, moved.dtype)


def _build(simulator: str | Path | nn.Module, sample_rate: int, full_scale_spl: float) -> nn.Module:
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
    folder = find_checkpoint(simulator, SIMULATOR, ("msbg",))
    return load_pretrained(folder, sample_rate=sample_rate, full_scale_spl=full_scale_spl)


def _check_weights(weights: Mapping[str, float], criterion: str) -> dict[str, float]:
    allowed = CRITERIA[criterion]
    if not isinstance(weights, Mapping):
        raise ValueError(f"weights is {type(weights).__name__}; allowed: numbers by name, as {dict(allowed)}")
    if unknown := sorted(map(str, set(weights) - set(allowed))):
        raise ValueError(
            f"unknown weights {', '.join(unknown)} for criterion {criterion!r}; allowed: {', '.join(allowed)}"
        )
    if not all(is_finite(weight) and weight >= 0.0 for weight in weights.values()):
        raise ValueError(f"weights {dict(weights)}; allowed: finite numbers, 0 or more")
    checked = {name: float(weight) for name, weight in weights.items()}
    if not any(checked.values()):
        raise ValueError(
            f"weights {checked} count nothing; allowed: one above 0 at least, of {', '.join(allowed)}"
        )
    return checked
