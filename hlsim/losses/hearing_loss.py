"""Training losses of hearing aids: what an impaired ear perceives, compared with a normal ear."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn

from hlsim.audiogram.thresholds import (
    AudiogramLike,
    StoredEars,
    check_two_channels,
)
from hlsim.calibration import (
    NEURO_RATE,
    PASCAL_SPL,
    Loudness,
    check_full_scale,
    check_loudness,
    gain_to_pascals,
    level_spl,
    loudness_at,
)
from hlsim.checks import (
    Lengths,
    check_choice,
    check_flag,
    check_lengths,
    check_rate,
    check_waveform,
    describe,
)
from hlsim.losses.criteria import Comparison, CriterionLike, read_criterion, weighted_sum
from hlsim.losses.frozen_simulator import FrozenSimulator, NormalEar, ReferenceKind, ReferenceName
from hlsim.losses.gradient_limit import limit_gradient_spikes
from hlsim.metrics.pair import check_pair
from hlsim.torchtools import broadcast_shape, flatten_items, not_compiled, silence_after

_Reduction = Literal["mean", "none"]

_EarsName = Literal["mean", "better"]

_TEMPERATURE = 0.1
"""Temperature of the softmax of ``ears="better"``.

An ear whose loss is 0.1 lower than that of the other ear counts 2.7 times as much.
"""

_LEVEL_WEIGHTS = {"levels": 0.03, "louder": 0.06, "peaks": 1.0}
"""Weights of the parts of ``HASPILoss`` that concern the level.

``louder`` has twice its default weight, because HASPI rises with gain.
"""


class HearingLossLoss(StoredEars, nn.Module):
    """Difference between what an impaired ear and what a normal ear perceives.

    The impaired ear perceives the output of an aid, and the normal ear clean speech. The
    simulator is frozen: it stays in eval mode and has no trainable parameter, but gradients pass
    through it to the output of the aid. It is not registered as a submodule, so that the parameters
    and the state dict of a module that contains this loss do not include it. It still moves with
    ``.to()``. Use ``DistributedDataParallel`` instead of ``nn.DataParallel``, because all threads
    of a process share one simulator.

    The level is not normalised: 65 dB SPL is an RMS of 0.035 at the default ``full_scale_spl``. NaN
    and infinity are not rejected, so that a gradient scaler can detect them. They make the value of
    their item NaN; only ``"haspi"`` and ``"hasqi"`` reject them in clean speech.

    In an autocast region, the loss computes in float32 (or float64). Call ``backward()`` outside of
    the region, as torch recommends, because gradients in float16 may be NaN. A compiled caller runs
    the loss uncompiled, with a graph break. ``torch.func.grad`` works without ``checkpoint`` and
    the criteria ``"haspi"`` and ``"hasqi"``.

    The criterion is one of

    - ``"coherent-bands"``: coherence and level in bands (``hlsim.losses.coherent_bands``)
    - ``"bands"``: levels in bands (``hlsim.metrics.band_levels``)
    - ``"paper"``: Equations 2 to 9 of the Neuro-MSBG paper, which are not balanced between ears and
      levels (``hlsim.losses.paper``)
    - ``"haspi"`` and ``"hasqi"``: 1 minus the score of the output
      (``hlsim.losses.score_loss``). They do not penalise loudness, so combine them with another
      criterion.
    - ``"interaural"``: change of the differences between the ears of a listener
      (``hlsim.losses.interaural``), to be combined with another criterion
    - names of several of these with their weights, ``{"coherent-bands": 1.0, "haspi": 0.3}``
    - a function of the perceived speech and the reference, (items, time) each in pascals, that
      returns one value per item, (items,)

    Args:
        audiogram: Ear or ears; may be passed to each call instead. The standard audiogram ``"N7"``
            is not accepted, because it has thresholds above 100 dB HL. The loss stores a copy of a
            tensor without its gradient: to train an audiogram, pass it to each call. Every
            simulator, ``"msbg"`` included, receives the levels at eight frequencies,
            ``Audiogram.thresholds``.
        simulator: ``"neuro-msbg"`` or the name or folder of another checkpoint; ``"msbg"``, the
            exact model; ``"attenuation"``, a linear ear; ``package.module:name``, a simulator of
            your own; or a module, which is called with a waveform, (..., time), and thresholds in
            dB HL, (..., 8), whose leading dimensions broadcast. The module itself is frozen, so
            pass a copy of one that is still trained. It may have the attributes
            ``sample_rate``, ``full_scale_spl`` and ``aligned`` (false if its output is delayed),
            which are validated; ``emulates_msbg``, true if its normal ear and its phases are those
            of MSBG; ``highest_frequency`` of its output in Hz; and ``needs_exact_lengths``, true if
            silence after the end of an item changes the output before.
        sample_rate: Sample rate of the speech in Hz, 16000 to 48000. Neuro-MSBG compares the band
            below 8 kHz. The criterion ``"paper"`` resamples what it compares to 16000.
        full_scale_spl: Level in dB SPL of RMS 1.0, 0 to 200.
        reference: Signal with which ``"paper"`` and a function compare: ``"clean"``, the clean
            speech (the default for ``"paper"``), or ``"normal-hearing"``, what a normal ear
            perceives of it (the default otherwise). ``heard`` returns the same choice, and by
            default ``"normal-hearing"`` for every criterion.
            ``"coherent-bands"`` and ``"bands"`` always compare with a normal ear, and scores and
            ``"interaural"`` with clean speech as it is. Except for ``"bands"``, which has no phase,
            the reference gets the phase of MSBG's filter bank for the severity of the ear
            (``hlsim.msbg.response``), unless ``normal`` is passed or the simulator does not emulate
            MSBG. Without this phase, speech of the opposite sign could have a lower loss.
        criterion: Criterion, as listed above.
        weights: Weight under the name of each part of ``parts``; other parts are ignored.
        reduction: ``"mean"`` over the items, whatever their lengths, or ``"none"`` for one value
            per item.
        normal: Normal ear that belongs to the simulator: a module, which is frozen too, or a
            function, (..., time) -> (..., time). By default, it is the filter of MSBG's normal ear
            for a simulator that emulates MSBG, and the simulator itself at 0 dB HL otherwise, and
            for ``"bands"`` and ``"paper"``. With the simulator itself, changes that it makes for
            every ear, such as a low-pass, apply to the reference, too. A network that emulates
            another teacher needs the normal ear of that teacher.
        ears: Reduction of two ears, (..., 2, time): ``"mean"``, or ``"better"`` for a smooth choice
            of the better ear. Each ear then counts by its share, ``softmax(-loss / 0.1)`` over
            both. The shares carry no gradient, so that no ear is made worse.
        checkpoint: Compute the activations of the simulator again in the backward pass instead of
            storing them, which takes less memory and more time. Value and gradient are the same. A
            module of your own gets the attribute ``checkpoint = True``; what it then stores is up
            to its code.
        loudness: Target of the perceived loudness, -40 to 20 dB relative to a normal ear: one
            number, or a dict of numbers by the level of the clean speech in dB SPL, 0 to 120, such
            as ``{50: 0, 65: -5, 80: -9}``, which is interpolated. The reference gets this gain.
            Each of two ears has this target; both together are louder than one, so that two ears
            need a lower number. Most people prefer less than normal loudness, see the guide about
            levels.

    Raises:
        ValueError: A name is unknown, a value has another type or is out of range, ``loudness`` is
            passed for criteria that compare no perceived level, or the simulator was built for
            another rate or level, or delays its output.

    >>> import hlsim
    >>> speech = hlsim.example_speech()[:16000]
    >>> loss = HearingLossLoss("N3", simulator="msbg")
    >>> print(loss(speech, speech).item() > loss(5.0 * speech, speech).item())  # amplified
    True
    >>> sorted(loss.parts(speech, speech))
    ['incoherence', 'levels', 'louder', 'misalignment', 'peaks']
    """

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        simulator: str | Path | nn.Module = "neuro-msbg",
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
        reference: ReferenceName | None = None,
        criterion: CriterionLike = "coherent-bands",
        weights: Mapping[str, float] | None = None,
        reduction: _Reduction = "mean",
        normal: NormalEar | None = None,
        ears: _EarsName = "mean",
        checkpoint: bool = False,
        loudness: Loudness = 0.0,
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        if reference is not None:
            check_choice("reference", reference, ReferenceName)
        check_choice("reduction", reduction, _Reduction)
        check_choice("ears", ears, _EarsName)
        check_flag("checkpoint", checkpoint)
        if not (normal is None or callable(normal)):
            raise ValueError(
                f"expected normal to be a module or a function, got {describe(normal)}; for a "
                "simulator, write: lambda x: simulator(x, 'NH')"
            )
        self.reduction = reduction
        self.ears = ears
        self.criteria, self.weights = read_criterion(criterion, weights)
        self.loudness = check_loudness(loudness)
        has_level = any(entry.reference is not None for entry in self.criteria.values())
        if self.loudness and not has_level:
            raise ValueError(
                f"expected a criterion that compares perceived levels for loudness={loudness!r}, "
                f"got {', '.join(self.criteria)}; add coherent-bands, or leave out loudness"
            )
        self.store_ears(audiogram)
        self._has_warned_of_order = False
        self._frozen = FrozenSimulator(
            simulator, self.sample_rate, self.full_scale_spl, normal, reference, checkpoint
        )
        # nn.Module does not register what is in a tuple.
        self._criterion = (criterion,)

    @property
    def simulator(self) -> nn.Module:
        """Simulator that computes what the impaired ear perceives, which is not trained."""
        return self._frozen.simulator

    def forward(
        self,
        output: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        lengths: Lengths | None = None,
    ) -> Tensor:
        """Compute the loss.

        Args:
            output: Output of an aid.
            clean: Clean speech.
            audiogram: One ear, (8,), or (..., 8) that broadcasts over the leading dimensions; by
                default the ears of the constructor. One signal may have several ears, but several
                signals are not combined with several ears. With (batch, 1, time), (batch, 8) is
                accepted, too. A ``Listener`` goes with (..., 2, time), left first.
            lengths: Number of samples of each item of a padded batch, (...). Samples after the end
                of an item are ignored, so that its value is the one that it has alone (within 1e-4
                for the exact MSBG, which simulates the padded batch at once, and within 1e-2 for
                ``"paper"``, whose phase counts faint frequencies with their rounding errors).

        Shape: (..., time) twice -> (), or with ``reduction="none"`` the leading dimensions. With
            ``ears="better"`` the result has no dimension of ears.

        Raises:
            ValueError: There is no audiogram, or one of two ears is missing; a signal is not a
                floating-point tensor with time last or has a sample above 1e9, shapes or devices do
                not fit, thresholds are outside -10 to 100 dB HL, lengths are outside 1 to time, a
                simulator, normal ear or criterion returns another shape than it should, or, with
                ``"haspi"`` or ``"hasqi"``, an item is shorter than 0.7 s, or its clean speech has
                NaN or infinity.
        """
        parts = self.parts(output, clean, audiogram, lengths)
        return weighted_sum(parts, self.weights)

    @not_compiled
    def parts(
        self,
        output: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        lengths: Lengths | None = None,
    ) -> dict[str, Tensor]:
        """Compute the named terms of the loss, before they are multiplied by their weights.

        ``forward`` returns ``sum(weight * parts[name] for name, weight in loss.weights.items())``.
        Arguments, shapes and errors are those of ``forward``.

        Returns:
            For ``"coherent-bands"`` the parts incoherence, misalignment, levels, louder and peaks
            (``hlsim.losses.coherent_bands`` describes them); for ``"bands"`` band_levels, in dB;
            for ``"paper"`` magnitude, phase, complex and time. Other criteria have one part of
            their own name, and a function has the part ``"criterion"``.
        """
        call = self._prepare(output, clean, audiogram, lengths)
        with torch.autocast(clean.device.type, enabled=False):
            parts = self._compare(*call)
        if self.ears == "better":
            losses = weighted_sum(parts, self.weights).detach()
            shares = torch.softmax(-losses / _TEMPERATURE, -1)
            parts = {name: (shares * part).sum(-1) for name, part in parts.items()}
        if self.reduction == "mean":
            parts = {name: part.mean() for name, part in parts.items()}
        return parts

    @not_compiled
    def heard(
        self,
        output: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        lengths: Lengths | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Compute the perceived speech and its reference, for a criterion of your own.

        Both signals are in pascals and time-aligned. They are silent after the end of each item.
        Gradients pass through the frozen simulator.

        Arguments and errors are those of ``forward``.

        Shape: (..., time) twice -> (..., time) twice; the leading dimensions broadcast with those
            of the ears.

        Returns:
            The output as the impaired ear perceives it, and its reference: the clean speech as a
            normal ear perceives it or, with ``reference="clean"``, the clean speech itself. Both
            kinds of reference end at the highest frequency of the simulator, and have the gain of
            ``loudness`` and, as described for ``reference``, the phase of MSBG's filter bank.
        """
        output, clean, ears, ends = self._prepare(output, clean, audiogram, lengths)
        with torch.autocast(clean.device.type, enabled=False):
            perceived = self._frozen.simulate(output, ears, ends)
            batch = perceived.shape[:-1]
            reference = self._compute_reference(ReferenceKind(), clean, ears, batch, ends)
            if ends is not None:
                perceived = silence_after(perceived, ends)
                reference = silence_after(reference, ends)
            gain = gain_to_pascals(self.full_scale_spl)
            return perceived * gain, reference * gain

    def extra_repr(self) -> str:
        simulator, criteria = type(self.simulator).__name__, "+".join(self.criteria)
        return f"simulator={simulator}, criterion={criteria}, sample_rate={self.sample_rate}"

    def _prepare(
        self,
        output: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None,
        lengths: Lengths | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Validate the arguments of a call, see ``forward`` for them and for errors.

        Returns:
            The output and the clean speech, silent after the end of each item, (..., time) each;
            thresholds in dB HL, (..., 8); and the number of samples of each item, (...), or None if
            all are as long as the batch.
        """
        check_waveform(output, "output", full_scale_spl=self.full_scale_spl)
        check_waveform(clean, "clean", full_scale_spl=self.full_scale_spl)
        check_pair(output, clean)
        if clean.requires_grad and not output.requires_grad and not self._has_warned_of_order:
            self._has_warned_of_order = True
            warnings.warn(
                "only clean requires a gradient, not output; did you swap the arguments? Pass the "
                "output of the aid first: loss(output, clean). There are no further warnings of "
                "this loss",
                stacklevel=3,
            )
        ears = self.resolve_thresholds(clean, audiogram)
        batch = broadcast_shape(clean.shape[:-1], ears.shape[:-1])
        if batch.numel() > max(clean[..., 0].numel(), ears[..., 0].numel()):
            raise ValueError(
                f"expected one ear for all items or one per item, {(*clean.shape[:-1], 8)}, got "
                f"{tuple(ears.shape)}, which would combine every item with every ear; reshape "
                "audiogram"
            )
        pairs_ears = any(entry.two_ears for entry in self.criteria.values())
        pairs_ears = pairs_ears or self.ears == "better"
        if pairs_ears:
            check_two_channels(clean)
        dtype = torch.promote_types(torch.result_type(output, clean), torch.float32)
        output, clean = output.to(dtype), clean.to(dtype)
        ends = None if lengths is None else check_lengths(lengths, clean.shape)
        if pairs_ears and ends is not None and not torch.equal(ends[..., 0], ends[..., 1]):
            raise ValueError(
                "expected the same length for both ears of an item, left and right, got "
                f"{ends.tolist()}; repeat the length of each item: "
                "lengths.unsqueeze(-1).expand(-1, 2)"
            )
        if ends is None or bool((ends == clean.shape[-1]).all()):
            return output, clean, ears, None
        return silence_after(output, ends), silence_after(clean, ends), ears, ends

    def _compare(
        self, output: Tensor, clean: Tensor, ears: Tensor, lengths: Tensor | None
    ) -> dict[str, Tensor]:
        """Compute the parts of the loss for each item.

        The arguments are the results of ``_prepare``.

        Returns:
            Values of each part by its name, without weights and not yet reduced. Their shape is
            that of the leading dimensions to which signals and ears broadcast.
        """
        limited = output
        if any(criterion.limits_gradient for criterion in self.criteria.values()):
            limited = limit_gradient_spikes(output, self.sample_rate, lengths)
        perceived = self._frozen.simulate(limited, ears, lengths)
        batch, time = perceived.shape[:-1], perceived.shape[-1]
        gain = gain_to_pascals(self.full_scale_spl)

        def as_items(waveform: Tensor) -> Tensor:
            """Return a waveform in pascals with one row per item, (items, time)."""
            return waveform.expand_as(perceived).reshape(-1, time) * gain

        ends = torch.tensor(time) if lengths is None else lengths
        signals: dict[str, Any] = {
            "output": as_items(output),
            "limited_output": as_items(limited),
            "clean": as_items(clean),
            "perceived": as_items(perceived),
            "ears": flatten_items(ears, batch, ears.dtype),
            "lengths": ends.expand(batch).flatten().tolist(),
            "sample_rate": self.sample_rate,
        }
        parts: dict[str, Tensor] = {}
        for criterion in self.criteria.values():
            reference = self._compute_reference(criterion.reference, clean, ears, batch, lengths)
            parts |= criterion.parts(Comparison(**signals, reference=as_items(reference)))
        return {name: part.reshape(batch) for name, part in parts.items()}

    def _compute_reference(
        self,
        reference: ReferenceKind | None,
        clean: Tensor,
        ears: Tensor,
        batch: torch.Size,
        lengths: Tensor | None,
    ) -> Tensor:
        """Compute the reference of a criterion, with the gain of ``loudness``, (*batch, time).

        Clean speech as it is (None) gets no gain. Arguments are those of
        ``FrozenSimulator.compute_reference``.
        """
        signal = self._frozen.compute_reference(reference, clean, ears, batch, lengths)
        if reference is None or not self.loudness:
            return signal
        levels = level_spl(clean, self.full_scale_spl)
        if lengths is not None:
            shares = lengths.to(levels) / clean.shape[-1]
            levels = levels - 10.0 * shares.log10()
        gain_db = loudness_at(self.loudness, levels.detach())
        return signal * 10.0 ** (gain_db / 20.0).unsqueeze(-1)

    def _apply(self, function: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Apply ``function``, such as that of ``.to()``, to modules that are not registered, too.

        They move to other devices except meta, and between float32 and float64, but not to half
        precision.
        """

        def move(tensor: Tensor) -> Tensor:
            # The function may drop the values, as ``to_empty`` does: no state dict restores those
            # of modules that are not registered.
            moved = function(tensor.new_empty(0))
            is_half = moved.is_floating_point() and moved.dtype.itemsize < 4
            device = tensor.device if moved.is_meta else moved.device
            return tensor.to(device, tensor.dtype if is_half else moved.dtype)

        super()._apply(function, recurse)
        for module in (self.simulator, self._frozen.normal, *self._criterion):
            if isinstance(module, nn.Module):
                module._apply(move)
        return self


class HASPILoss(HearingLossLoss):
    """Training loss that rises as HASPI, a score of intelligibility, falls.

    Prefer ``HearingLossLoss`` for an aid. Use this loss to find out how high HASPI can become, or
    as a rival in a comparison, and judge the result by words or by listeners. In an outside
    evaluation of one small network, it had the highest HASPI of all losses, but .15 fewer words
    correct than ``HearingLossLoss``; its output passed 121 dB SPL during training, and it was the
    only loss that made words harder to recognise behind a linear ear (a share of .28 less).

    It is 1 minus HASPI, optionally plus 1 minus HASQI (a score of quality), plus the error of the
    perceived level.

    HASPI alone rewards any gain. Therefore the loss also compares the level that is perceived
    through ``simulator`` with the level that a normal ear perceives of the clean speech, and
    penalises samples above 120 dB SPL. These terms are called ``levels``, ``louder`` and ``peaks``
    in ``loss.parts`` (see ``hlsim.losses.coherent_bands``). HASPI and HASQI are computed with
    ``noise="expected"``, which makes them deterministic. An item whose clean speech is inaudible
    has a HASPI term of 0.

    It is called as ``loss(output, clean, audiogram=None, lengths=None)``, with waveforms of shape
    (..., time) in pascals, and returns a scalar by default; ``HearingLossLoss`` describes the
    details. Items last 0.7 s or more, and no gradient of HASPI reaches ``clean``. On one core, a
    step costs 8 to 18 times that of the default loss, with HASQI 20 to 41 times, the more items the
    more.

    Args:
        audiogram: Ear or ears, as in ``HearingLossLoss``.
        quality: Weight of 1 minus HASQI, 0 or more, beside 1 for 1 minus HASPI.
        level: Weight of level and peaks, 0 or more. With 0 a model learns to be as loud as it can.
        options: ``simulator``, ``sample_rate``, ``full_scale_spl``, ``reduction``, ``normal``,
            ``ears``, ``checkpoint`` and ``loudness`` of ``HearingLossLoss``.

    Raises:
        ValueError: A weight is negative or not finite, or an option of ``HearingLossLoss`` is not
            valid.

    >>> import hlsim
    >>> speech = hlsim.example_speech()[:16000]
    >>> loss = HASPILoss("N3", simulator="msbg")
    >>> print(loss(speech, speech).item() > loss(5.0 * speech, speech).item())  # amplified
    True
    """

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        quality: float = 0.0,
        level: float = 1.0,
        **options: Any,
    ) -> None:
        weights = {"haspi": 1.0}
        if quality:
            weights["hasqi"] = 1.0
        if level:
            weights |= _LEVEL_WEIGHTS
        criterion = {"haspi": 1.0, "hasqi": quality, "coherent-bands": level}
        super().__init__(audiogram, criterion=criterion, weights=weights, **options)
