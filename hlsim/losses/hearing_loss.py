"""A training loss that hears through an impaired ear."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.devices import on_device
from hlsim.audiogram.thresholds import (
    AudiogramLike,
    as_thresholds,
    check_two_channels,
    has_listeners,
    store_thresholds,
    unsqueeze_mono,
)
from hlsim.calibration import PASCAL_SPL, check_full_scale, gain_to_pascals
from hlsim.checks import (
    Lengths,
    check_choice,
    check_lengths,
    check_rate,
    check_waveform,
    silence_after,
)
from hlsim.losses import coherent_bands, paper
from hlsim.losses.band_levels import band_level_loss
from hlsim.losses.criteria import (
    Criterion,
    check_criterion,
    check_values,
    combine_weights,
    weighted_sum,
)
from hlsim.losses.frozen_simulator import FrozenEar, Hearing, ReferenceName, move
from hlsim.metrics.interaural import interaural_loss
from hlsim.metrics.objective import SCORES, missing_score
from hlsim.neuro.config import NEURO_RATE
from hlsim.torchtools import not_compiled

Reduction = Literal["mean", "none"]

EarsName = Literal["mean", "better"]

_GIVEN = {*SCORES, "interaural"}  # of what the ears are given, not of what they hear

TEMPERATURE = 0.1
"""Temperature of ``ears="better"``: an ear whose loss is 0.1 less than the other's counts 2.7 times as much."""


class HearingLossLoss(nn.Module):
    """How far what an impaired ear hears of compensated speech is from what a normal ear hears of the clean speech.

    The simulator is frozen: it stays in eval mode, has no trainable parameter, and is not registered, so that neither the
    parameters nor the checkpoint of a module that holds this loss know of it. It moves with ``.to()`` all the same, and
    gradients pass through it to the compensated speech. Being one for all, it is not for ``nn.DataParallel``; use
    ``DistributedDataParallel``.

    Levels matter, nothing is normalised: 65 dB SPL is RMS 0.035 at the default ``full_scale_spl``. NaN and infinity are
    not refused, for a scaler of gradients is to see them: they make their item's value NaN, and no other's.

    It may be called in an autocast region and works in float32 there; call ``backward()`` outside of it, as torch says:
    inside one of float16, gradients may be NaN. A compiled caller calls it as it is, so that ``fullgraph=True`` and
    ``torch.export`` refuse it; compile or export the network alone. ``torch.func.grad`` works, except for the criteria
    ``"haspi"`` and ``"hasqi"``.

    Args:
        audiogram: the ear or ears; may be given with each call instead. A tensor that is trained gets its gradient; it is
            not registered either.
        simulator: ``"neuro-msbg"`` or another checkpoint's name or folder; ``"msbg"``, the exact model; or a module
            called as they are, ``(waveform, thresholds)``, which is frozen as it stands (give a copy of one that still
            trains).
        sample_rate: of the speech in Hz, 16000 to 48000. Neuro-MSBG judges the band under 8 kHz, above 16000 that under
            7.5 kHz.
        full_scale_spl: level in dB SPL of RMS 1.0.
        reference: what ``"paper"``, a callable and ``heard`` compare with: ``"clean"``, the clean speech itself (the
            default for ``"paper"``), or ``"normal-hearing"``, what a normal ear hears of it (the default else). Either
            has the phase of MSBG's bank of the ear's severity (``hlsim.msbg.response``), or polarity-inverted speech
            could be nearer than the speech; with ``normal``, or a module that neither is nor holds one of hlsim's
            simulators, it is compared as it is. The other criteria always compare with what a normal ear hears.
        criterion: ``"coherent-bands"``, whether bands follow the reference and have its level
            (``hlsim.losses.coherent_bands``); ``"bands"``, levels in bands alone; ``"paper"``, Equations 2 to 9 of
            Neuro-MSBG, not balanced between ears and levels (``hlsim.losses.paper``); ``"haspi"`` and ``"hasqi"``, 1
            less the score of what the ear is given (``hlsim.metrics.objective``), which say nothing of its level and go
            beside another, ``{"coherent-bands": 1.0, "haspi": 0.3}``, as does ``"interaural"``, how far the differences
            between a listener's ears are from the clean speech's (``hlsim.metrics.interaural``); several by name, of one
            hearing; or a callable of what is heard and the reference, (items, time) in pascals, that returns a value for
            each item, (items,).
        weights: of the parts by name; a part left out does not count.
        reduction: ``"mean"`` over the items, whatever their lengths, or ``"none"``, a value for each.
        normal: the normal ear that belongs to the simulator, a module (frozen too) or callable, (..., time) -> (...,
            time). By default hlsim's simulators have MSBG's at 0 dB HL, and another module is asked itself with 0 dB HL:
            what it does to every ear, such as a low-pass filter, it then does to the reference, and it costs nothing.
            A network that learned another teacher than MSBG needs that one's.
        ears: of two ears, (..., 2, time): ``"mean"``, or ``"better"``, smoothly the better one: each counts by its
            share, ``softmax(-loss / 0.1)`` over the two. The gradient holds the shares, so that no ear is made worse.

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
        reference: ReferenceName | None = None,
        criterion: Criterion = "coherent-bands",
        weights: Mapping[str, float] | None = None,
        reduction: Reduction = "mean",
        normal: Hearing | None = None,
        ears: EarsName = "mean",
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        if reference is not None:
            check_choice("reference", reference, ReferenceName)
        check_choice("reduction", reduction, Reduction)
        check_choice("ears", ears, EarsName)
        self.reduction, self.ears = reduction, ears
        self._two_ears = has_listeners(audiogram)
        self.criteria = check_criterion(criterion)
        self.weights = combine_weights(weights, self.criteria)
        with torch.device(
            "cpu"
        ):  # where the host is made on ``meta``, nobody gives the ear its values later
            thresholds = store_thresholds(audiogram, allow_missing=True)
        self._ear = FrozenEar(simulator, self.sample_rate, self.full_scale_spl, normal, reference)
        # in a tuple, nn.Module does not see them
        self._unregistered = (thresholds, criterion)

    def __setattr__(self, name: str, value: Any) -> None:
        # nn.Module would register a module behind the property's back, and the loss would not change
        if name in ("simulator", "normal", "criterion"):
            raise AttributeError(
                f"{name} is what the loss was built with; build another one for another {name}"
            )
        super().__setattr__(name, value)

    @property
    def criterion(self) -> Criterion:
        """The criterion, as it was given."""
        return self._unregistered[1]

    @property
    def simulator(self) -> nn.Module:
        """The simulator, frozen."""
        return self._ear.simulator

    @property
    def normal(self) -> Hearing | None:
        """The normal ear given to the constructor."""
        return self._ear.normal

    @property
    def reference(self) -> ReferenceName | None:
        """The reference given to the constructor."""
        return self._ear.choice

    @property
    def thresholds(self) -> Tensor | None:
        """The ear or ears given to the constructor. Shape: (..., 8) dB HL, NaN of a listener's missing ear."""
        return self._unregistered[0]

    @not_compiled  # a compiled caller calls it as it is
    def forward(
        self,
        compensated: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        lengths: Lengths | None = None,
        *,
        listener: Mapping[str, Any] | None = None,
    ) -> Tensor:
        """The loss: mean over the items, or of each.

        Shape: (..., time) twice, and one audiogram or (..., 8) that broadcasts over the leading dimensions -> (), or with
            ``reduction="none"`` the leading dimensions. (batch, 1, time) takes (batch, 8) and (batch,) lengths, too. Of a
            ``Listener`` (..., 2, time), left first; a missing ear does not count, and is NaN with ``"none"``. With
            ``ears="better"`` the dimension of the ears is not in the result.

        Args:
            lengths: samples of each item of a padded batch, (...), or shares of the longest above 0 to 1, as SpeechBrain
                has them. What follows an item's end is not heard, whatever is there, and an item counts as it does alone:
                Neuro-MSBG runs the items of each length apart, and with the exact MSBG the default criterion's value
                differs by 1e-4 at most. Another module, or one that is given ``listener``, runs all together and hears
                silence after an end.
            listener: what the simulator takes beyond the audiogram, by the names of its arguments; tensors come to the
                speech's device.

        Raises:
            ValueError: shapes or devices that do not fit, no audiogram, levels outside -10 to 100 dB HL, lengths outside
                1 to time, or a simulator, normal ear or criterion that does not return the shape it should; with
                ``"haspi"`` or ``"hasqi"`` items shorter than 0.7 s.
        """
        return weighted_sum(
            self.parts(compensated, clean, audiogram, lengths, listener=listener), self.weights
        )

    @not_compiled
    def parts(
        self,
        compensated: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        lengths: Lengths | None = None,
        *,
        listener: Mapping[str, Any] | None = None,
    ) -> dict[str, Tensor]:
        """The parts of the loss by name, before their weights.

        Those of ``"coherent-bands"`` are incoherence, misalignment, levels, louder and peaks, of ``"bands"`` band_levels
        (dB), of ``"paper"`` magnitude, phase, complex and time, and of ``"haspi"``, ``"hasqi"``, ``"interaural"`` and a
        callable criterion themselves. Their sum, ``sum(weight * parts[name] for name, weight in loss.weights.items())``,
        is what ``forward`` gives.

        Shape, arguments and errors: as ``forward``.
        """
        given, clean, ears, ends, known = self._check(compensated, clean, audiogram, lengths)
        with torch.autocast(given.device.type, enabled=False):
            output = given
            if {"coherent-bands", *SCORES} & self.criteria.keys():
                given = coherent_bands.limit_gradient_spikes(given, self.sample_rate)
            heard = self._ear.hear(given, ears, listener, ends)
            batch, time = heard.shape[:-1], heard.shape[-1]
            signals = {
                "heard": heard,
                "given": given.expand_as(heard),
                "output": output.expand_as(heard),
            }
            for name in [name for name in self.criteria if name not in _GIVEN]:
                signals[name] = self._ear.reference(name, clean, ears, batch, listener, ends)
            gain = gain_to_pascals(self.full_scale_spl)
            signals = {name: signal.reshape(-1, time) * gain for name, signal in signals.items()}
            if ends is None or bool((ends == time).all()):
                items = self._compare(signals)
            else:
                each = [
                    self._compare(
                        {name: signal[item, None, :end] for name, signal in signals.items()}
                    )
                    for item, end in enumerate(ends.expand(batch).flatten().tolist())
                ]
                items = {name: torch.cat([own[name] for own in each]) for name in each[0]}
            for name in [name for name in self.criteria if name in SCORES]:
                pair = (signals["given"], clean.expand_as(heard).reshape(-1, time) * gain)
                each_ear = ears.expand(*batch, -1).reshape(-1, len(FREQUENCIES))
                each_end = (
                    [time] * len(each_ear)
                    if ends is None
                    else ends.expand(batch).flatten().tolist()
                )
                items[name] = missing_score(name, *pair, each_ear, each_end, self.sample_rate)
            if "interaural" in self.criteria:
                left_right = [one.expand_as(heard) * gain for one in (given, clean)]
                changes = interaural_loss(left_right[0], left_right[1], self.sample_rate)
                both = 1.0 if known is None else known.all(-1).to(changes)
                items["interaural"] = (both * changes).unsqueeze(-1).expand(batch).flatten()
        return self._reduced({name: part.reshape(batch) for name, part in items.items()}, known)

    @not_compiled
    def heard(
        self,
        compensated: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        lengths: Lengths | None = None,
        *,
        listener: Mapping[str, Any] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """What the ear hears of the compensated speech, and the reference: for a criterion of one's own.

        Both are in pascals and aligned, silent after each item's end and at a listener's missing ear. The simulator is
        frozen, and the gradient flows.

        Shape: (..., time) twice -> (..., time) twice, their leading dimensions broadcast with the ears'.

        Args and errors: as ``forward``.
        """
        given, clean, ears, ends, _ = self._check(compensated, clean, audiogram, lengths)
        with torch.autocast(given.device.type, enabled=False):
            heard = self._ear.hear(given, ears, listener, ends)
            reference = self._ear.reference(
                "criterion", clean, ears, heard.shape[:-1], listener, ends
            )
            if ends is not None:
                heard, reference = silence_after(heard, ends), silence_after(reference, ends)
            gain = gain_to_pascals(self.full_scale_spl)
            return heard * gain, reference * gain

    def extra_repr(self) -> str:
        return (
            f"simulator={type(self.simulator).__name__}, sample_rate={self.sample_rate}, "
            f"full_scale_spl={self.full_scale_spl:g}, reference={self.reference!r}, criterion={self.criterion!r}"
        )

    def _check(
        self,
        compensated: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None,
        lengths: Lengths | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None]:
        """The speech in one precision and silent after its end, the ears' thresholds, where each item ends, and which
        ears are known, None where all are; an unknown one is a normal one that is given silence."""
        if torch.compiler.is_exporting():
            raise ValueError(
                "HearingLossLoss is for training, and not exported; allowed: the compensator alone"
            )
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
        shape = compensated.shape
        if self.ears == "better" or "interaural" in self.criteria:
            check_two_channels(clean)
        ends = None if lengths is None else check_lengths(lengths, shape)
        if self._two_ears if audiogram is None else has_listeners(audiogram):
            check_two_channels(clean)
        ears = (
            self.thresholds if audiogram is None else as_thresholds(audiogram, allow_missing=True)
        )
        if ears is None:
            raise ValueError("no audiogram: give one when building the loss or with the call")
        ears = unsqueeze_mono(ears, shape)
        dtype = torch.promote_types(
            torch.promote_types(compensated.dtype, clean.dtype), torch.float32
        )
        compensated, clean = compensated.to(dtype), clean.to(dtype)
        if ends is not None:
            compensated, clean = silence_after(compensated, ends), silence_after(clean, ends)
        host_ears = ears
        ears = on_device(ears, compensated.device)
        # only a listener, whose ears come from the CPU, may lack an ear
        listeners = self._two_ears if audiogram is None else has_listeners(audiogram)
        known = host_ears.isfinite().all(-1) if listeners else None
        if known is None or bool(known.all()):
            return compensated, clean, ears, ends, None
        known = known.to(compensated.device, non_blocking=True)
        compensated, clean = (
            torch.where(known.unsqueeze(-1), one, 0.0) for one in (compensated, clean)
        )
        return compensated, clean, ears.nan_to_num(), ends, known

    def _reduced(self, parts: dict[str, Tensor], known: Tensor | None) -> dict[str, Tensor]:
        """Over the ears, and the items. Shape: the leading dimensions each."""
        if known is not None:
            known = known.expand(next(iter(parts.values())).shape)
        if self.ears == "better":
            value = weighted_sum(parts, self.weights).detach()
            if known is not None:
                value = value.masked_fill(~known, math.inf)
            shares = torch.softmax(-value / TEMPERATURE, -1)
            parts = {name: (shares * part).sum(-1) for name, part in parts.items()}
        elif known is not None and self.reduction == "mean":
            return {name: part[known].mean() for name, part in parts.items()}
        elif known is not None:
            parts = {name: torch.where(known, part, torch.nan) for name, part in parts.items()}
        return (
            parts
            if self.reduction == "none"
            else {name: part.mean() for name, part in parts.items()}
        )

    def _compare(self, signals: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The parts of each item. Shape: (items, time) each, in pascals -> (items,) each."""
        heard = signals["heard"]
        items: dict[str, Tensor] = {}
        for name, criterion in self.criteria.items():
            if name in _GIVEN:
                continue
            aim = signals[name]
            if name == "coherent-bands":
                items |= coherent_bands.coherent_band_parts(heard, aim, self.sample_rate)
                items["peaks"] = coherent_bands.peak_excess(signals["output"])
            elif name == "bands":
                items["band_levels"] = band_level_loss(heard, aim, self.sample_rate)
            elif name == "paper":
                stft = paper.paper_stft(self.sample_rate)
                items |= paper.paper_parts(heard, aim, stft, self._ear.frequencies(stft.fft))
            else:
                items[name] = check_values(criterion(heard, aim), len(heard))
        return items

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "HearingLossLoss":
        super()._apply(fn, recurse)
        self._ear.apply(fn)
        move(self.criterion, fn)
        return self
