"""The exact MSBG: batched, differentiable, on a CPU or a GPU."""

import itertools
import math
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audiogram import (
    FREQUENCIES,
    HIGHEST_SIMULATED,
    LOWEST_LEVEL,
    SEVERITIES,
    Audiogram,
    severity_index,
)
from hlsim.audiogram.thresholds import AudiogramLike, StoredEars, ears_on_other_grids
from hlsim.calibration import PASCAL_SPL, check_full_scale, gain_to_pascals
from hlsim.checks import check_flag, check_rate, check_waveform
from hlsim.dsp.fft import rfft
from hlsim.dsp.interpolation import interpolation_weights
from hlsim.msbg.cochlea import (
    cochlea_fft_length,
    common_period,
    simulate_cochlea,
    simulate_delayed_cochlea,
)
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.filter_bank import BANKS
from hlsim.msbg.multirate import total_response
from hlsim.msbg.overlapping_blocks import in_blocks
from hlsim.msbg.recruitment import expansion_ratios
from hlsim.msbg.resampling import from_cochlea, from_spectrum, to_cochlea
from hlsim.msbg.smearing import BROADENING, SMEARING_DELAY, smear, smearing_matrix
from hlsim.torchtools import flatten_items, not_compiled, on_host, pair_items

STRUCTURAL_DELAY = 1047
"""Delay in samples at 44.1 kHz that ``aligned`` removes from the output of ears without smearing.

The three linear-phase filters delay by 507 + 507 + 66 = 1080 samples. The filter bank takes some of
that back, less at high frequencies and with more loss: without a loss 186 at 200 Hz, 33 at 750 Hz,
21 at 1 kHz and 0 at 8 kHz, with N4 50 at 200 Hz and 32 at 300 Hz (docs/figures/delay.py).
"""

_POWER_FLOOR = 1e-30
"""Smallest power by which powers are divided, where 1 is 120 dB SPL."""

HALF_RATE_HZ = 20000
"""Highest sample rate in Hz at which aligned signals run at 22.05 kHz inside the model."""

_CPU_SAMPLES = 384_000
"""Largest number of samples of several items at once on a CPU, or with checkpointing."""

_DEVICE_SAMPLES = 12_000_000
"""Largest number of samples of several items at once on another device."""


class _Group(NamedTuple):
    """Properties that ears must share for their items to be processed in one batch.

    Attributes:
        severity: Severity of the loss, one of ``SEVERITIES``.
        no_loss: Whether all thresholds are 0 dB HL, and need no gradient.
        frequencies: Frequencies of the thresholds in Hz.
    """

    severity: str
    no_loss: bool
    frequencies: tuple[float, ...] = FREQUENCIES


class MSBG(StoredEars, nn.Module):
    """The Moore, Stone, Baer and Glasberg model of what an impaired ear perceives.

    The model computes the same as ``Ear.process`` of pyclarity 0.9.0: outer and middle ear,
    spectral smearing, gammatone filter bank, recruitment, the inverse of outer and middle ear, and
    a low-pass filter. It is differentiable and takes batches.

    Source: Baer and Moore (1993); Moore and Glasberg (1993); Nejime and Moore (1997).

    Args:
        audiogram: Ear or ears; they may be passed with each call instead. The standard audiogram
            ``"N7"`` is not accepted, because it has thresholds above 100 dB HL. Like pyclarity, the
            model uses the measured thresholds of an ``Audiogram`` at any frequencies: the severity
            follows from those from 2 to 8 kHz, and the threshold of each channel is interpolated
            linearly in Hz. A tensor has the thresholds at the eight ``FREQUENCIES``.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. At rates below 44100
            the last 80 Hz below half the rate fade out; at rates above 44100 outputs end at
            22.05 kHz.
        full_scale_spl: Level in dB SPL of RMS 1.0, 0 to 200.
        aligned: Whether the delay of the model is removed, so that the output has as many samples
            as the input. Otherwise the output, with ``rescale_active``, is that of pyclarity,
            sample by sample at 44.1 kHz, with its delay. If spectra are smeared, this output is
            64 * (ceil(time / 64) + 3) samples long at 44.1 kHz; in a batch, shorter outputs are
            zero-padded. For signals under 1000 samples, pyclarity's output differs, by an RMS of up
            to 5 % of the output from 701 samples and 40 % from 441 samples, because pyclarity pads
            the beginning. With fewer samples, pyclarity returns NaN or fails.
        rescale_active: Whether each signal is first scaled by the ratio of its overall RMS to the
            RMS of its active frames, 1 to 3 dB down depending on the utterance, as pyclarity does
            with one channel. (It scales two channels by one gain.)
        smearing: Whether the wide auditory filters of an impaired ear smear spectra. Without
            smearing, recruitment remains; the difference shows what depends on smearing.

    Attributes:
        emulates_msbg: True, because the simulator is MSBG.
        thresholds: Thresholds of the constructor's ears at ``FREQUENCIES`` in dB HL, (..., 8), or
            None. They have no gradient; to train an ear, pass it with each call.
        checkpoint: Whether to use gradient checkpointing: activations are computed again in the
            backward pass, a few items or one block at a time, instead of stored. False by default.

    Raises:
        ValueError: The rate, the level or an audiogram is out of range, or a setting is not True or
            False.

    >>> import hlsim
    >>> speech = hlsim.example_speech()[:16000]
    >>> MSBG("N4")(speech).shape
    torch.Size([16000])
    >>> ears = torch.tensor([[20.0] * 8, [60.0] * 8])
    >>> MSBG()(speech, ears).shape  # one signal, two ears
    torch.Size([2, 16000])
    """

    emulates_msbg = True

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        aligned: bool = True,
        rescale_active: bool = False,
        smearing: bool = True,
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        check_flag("aligned", aligned)
        check_flag("rescale_active", rescale_active)
        check_flag("smearing", smearing)
        self.aligned = aligned
        self.rescale_active = rescale_active
        self.smearing = smearing
        self.checkpoint = False
        self.store_ears(audiogram)

    def store_ears(self, audiogram: AudiogramLike | None) -> None:
        """Store ears as ``StoredEars`` does, and the frequencies at which they were measured."""
        super().store_ears(audiogram)
        self._other_grids = ears_on_other_grids(audiogram)

    @not_compiled  # it depends on the values of the ears, and numpy designs its filters
    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """Compute what the ear perceives.

        Args:
            waveform: Input signals, where RMS 1.0 has the level ``full_scale_spl``.
            audiogram: One ear, or ears whose thresholds, (..., 8), broadcast over the leading
                dimensions of the waveform. By default, the ears of the constructor.

        Shape: (..., time), (..., 8) -> (..., time), where the leading dimensions broadcast. The
        output is as long as the input unless ``aligned`` is false.

        Raises:
            ValueError: There is no audiogram or an invalid one, a threshold is outside -10 to 100
                dB HL (as in the standard audiogram ``"N7"``), the shapes do not fit, or the
                waveform is not a floating-point tensor with time last, or has no samples or, on a
                CPU, one above 1e9 in magnitude.
        """
        check_waveform(waveform, full_scale_spl=self.full_scale_spl)
        grids = self._other_grids if audiogram is None else ears_on_other_grids(audiogram)
        thresholds = self.resolve_thresholds(waveform, audiogram)
        with torch.autocast(waveform.device.type, enabled=False):
            return self._simulate(waveform, thresholds, grids)

    def delay(self, severity: str) -> int:
        """Return the delay of the model, which ``aligned=True`` removes from the output.

        The filters and the smearing cause the delay, which depends only on the severity of the
        loss and on the argument ``smearing`` of the constructor.

        Args:
            severity: Severity of the loss: ``"none"``, ``"mild"``, ``"moderate"`` or ``"severe"``.

        Returns:
            Delay in samples at 44.1 kHz.

        Raises:
            ValueError: The severity is unknown.
        """
        if severity not in SEVERITIES:
            raise ValueError(f"expected a severity of {', '.join(SEVERITIES)}, got {severity!r}")
        return STRUCTURAL_DELAY + (SMEARING_DELAY if self._smears(severity) else 0)

    def _smears(self, severity: str) -> bool:
        """Return whether spectra are smeared for ears of a severity."""
        return self.smearing and severity in BROADENING

    def extra_repr(self) -> str:
        return (
            f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}, "
            f"aligned={self.aligned}, rescale_active={self.rescale_active}, "
            f"smearing={self.smearing}"
        )

    def _simulate(
        self, waveform: Tensor, thresholds: Tensor, grids: list[Audiogram | None]
    ) -> Tensor:
        """Compute the perceived signals.

        Shape: (..., time), (..., 8) -> (..., time), or longer with ``aligned=False``; then outputs
            that are shorter than the longest one are zero-padded.

        Args:
            waveform: Input in the unit of ``full_scale_spl``.
            thresholds: Ears at the eight frequencies in dB HL.
            grids: Ears at other frequencies, from ``ears_on_other_grids``.
        """
        dtype = waveform.dtype if waveform.dtype == torch.float64 else torch.float32
        batch, signals, ears = pair_items(waveform, thresholds, dtype)
        gain = gain_to_pascals(self.full_scale_spl)
        signals = signals * gain
        if self.rescale_active:
            signals = signals * active_rescaling(signals, self.sample_rate)

        # The severity decides which filters the CPU launches, so the CPU needs the thresholds.
        levels_on_host = flatten_items(on_host(thresholds), batch, dtype)
        if grids:
            ear_of_item = torch.arange(len(grids)).reshape(thresholds.shape[:-1]).expand(batch)
            grids = [grids[ear] for ear in ear_of_item.flatten().tolist()]
        groups = _group_items(levels_on_host, ears.requires_grad, grids)
        order = torch.tensor([*itertools.chain(*groups.values())])
        if len(groups) > 1:
            index = order.to(signals.device, non_blocking=True)
            signals, ears = signals[index], ears[index]

        needs_small_portions = self.checkpoint or signals.device.type == "cpu"
        samples_at_once = _CPU_SAMPLES if needs_small_portions else _DEVICE_SAMPLES
        items_at_once = max(1, samples_at_once // signals.shape[-1])
        counts = [len(members) for members in groups.values()]
        outputs: list[Tensor] = []
        for (group, members), group_signals, group_ears in zip(
            groups.items(), signals.split(counts), ears.split(counts), strict=True
        ):
            levels = group_ears
            if group.frequencies != FREQUENCIES:
                ears_of_group = [grids[item] for item in members]
                measured = [ear.levels for ear in ears_of_group if ear is not None]
                levels = torch.tensor(measured, dtype=torch.float64).to(ears, non_blocking=True)
            process = partial(self._simulate_group, group=group)
            for portion in zip(
                group_signals.split(items_at_once), levels.split(items_at_once), strict=True
            ):
                output = in_blocks(
                    process, *portion, self.sample_rate, checkpoints_short=self.checkpoint
                )
                outputs.append(output)
        longest = max(output.shape[-1] for output in outputs)
        padded = [functional.pad(output, (0, longest - output.shape[-1])) for output in outputs]
        perceived = torch.cat(padded) / gain
        if len(groups) > 1:
            perceived = perceived[order.argsort().to(perceived.device, non_blocking=True)]
        return perceived.reshape(*batch, longest).to(waveform.dtype)

    def _simulate_group(
        self, signals: Tensor, ears: Tensor, is_last: bool, group: _Group
    ) -> Tensor:
        """Compute the perceived signals, in pascals, of items whose ears belong to one group.

        Args:
            signals: Signals in pascals.
            ears: Thresholds at the frequencies of the group in dB HL.
            is_last: Whether the signals end here, and are not cut from longer ones. It has an
                effect with ``aligned=False`` only.
            group: Properties that the ears share.

        Shape: (items, time), (items, frequencies) -> (items, time), or longer with
            ``aligned=False``.
        """
        rate = self.sample_rate
        samples = signals.shape[-1]
        bank = BANKS[group.severity]
        smears = self._smears(group.severity)
        rate_divisor = 2 if self.aligned and rate <= HALF_RATE_HZ else 1
        delay = self.delay(group.severity) if self.aligned else 0
        highest = rate / 2 if rate_divisor == 2 else MSBG_RATE / 2
        # A frame that smearing leaves nearly empty depends on the last bits, so unaligned output,
        # of which every sample counts, takes double precision.
        precise = signals if self.aligned else signals.double()
        model_samples = math.ceil(samples * MSBG_RATE / rate)
        length = math.ceil((model_samples + delay) / rate_divisor)
        cochlear = to_cochlea(precise, rate, length, rate_divisor)
        if smears:
            matrix = smearing_matrix(group.severity, rate_divisor, highest, like=cochlear)
            cochlear = smear(cochlear, matrix, rate_divisor)
        cochlear = cochlear.to(signals.dtype)
        weights = interpolation_weights(group.frequencies, bank.centre_frequencies, like=signals)
        ratios = expansion_ratios(ears, weights)
        gain = 10.0 ** (-bank.recombination_db / 20.0)
        length = cochlear.shape[-1]
        if not self.aligned:
            cochlear = simulate_delayed_cochlea(cochlear, ratios, bank, smears, is_last)
            return from_cochlea(cochlear, rate, round(length * rate / MSBG_RATE), gain=gain)

        points = cochlea_fft_length(length * rate_divisor, rate, rate_divisor)
        if group.no_loss:
            response = total_response(bank, points, rate_divisor, like=cochlear)
            spectrum = rfft(cochlear, points // rate_divisor) * response
        else:
            spectrum = simulate_cochlea(
                cochlear,
                ratios,
                bank,
                points,
                rate_divisor=rate_divisor,
                highest=highest,
                corrects_kinks=not smears,
            )
        if smears and common_period(rate, rate_divisor):
            return from_spectrum(
                spectrum, points, rate_divisor, rate, samples, gain=gain, delay=delay
            )
        # Without the delay of smearing, the output filters reach samples that the advances of the
        # channels have put before the first one.
        cochlear = torch.fft.irfft(spectrum, points // rate_divisor)[..., :length]
        return from_cochlea(
            cochlear, rate, samples, gain=gain, rate_divisor=rate_divisor, delay=delay
        )


def estimate_delay(
    simulator: Any, audiogram: AudiogramLike | None = None, *, level: float = 94.0
) -> int:
    """Measure by how many samples a simulator delays its output.

    The input is an impulse: one second of zeros, except for one sample in the middle. The delay is
    the time from the impulse to the largest magnitude of the output. The delay depends on the ear
    and on the level, because MSBG delays low frequencies less than high ones: at 44.1 kHz it is
    1078 samples without a hearing loss and 1237 to 1271 samples with one. To align signals, use
    ``MSBG.delay``, in samples at 44.1 kHz, which depends only on the severity of the loss and on
    the argument ``smearing``.

    Source: the Neuro-MSBG paper, Section III-A.

    Args:
        simulator: Simulator on the CPU with the attributes ``sample_rate`` and ``full_scale_spl``.
            Build MSBG with ``aligned=False``, because aligned simulators have no delay.
        audiogram: Hearing loss of one ear, by default the simulator's stored one.
        level: Pressure of the impulse, as the level in dB SPL of a sound with this RMS pressure:
            94 is 1 Pa.

    Returns:
        The delay in samples at the simulator's sample rate.

    Raises:
        ValueError: There is no audiogram, it has more than one ear, or the simulator rejects it.

    >>> estimate_delay(MSBG("NH", sample_rate=44100, aligned=False))
    1078
    """
    position = simulator.sample_rate // 2
    impulse = torch.zeros(simulator.sample_rate)
    impulse[position] = 10.0 ** ((level - simulator.full_scale_spl) / 20.0)
    with torch.no_grad():
        output = simulator(impulse, audiogram)
    ears = output.shape[:-1].numel()
    if ears != 1:
        raise ValueError(f"expected the audiogram of one ear, got audiograms of {ears} ears")
    return int(output.abs().argmax()) - position


def active_rescaling(signals: Tensor, rate: int) -> Tensor:
    """Compute the ratio of the overall RMS of signals to that of their active frames of 10 ms.

    Active frames are at most 12 dB softer than the signal as a whole, and not below 40 dB SPL, as
    in pyclarity's ``measure_rms``. Without any, the ratio is 1.

    Shape: (..., time) -> (..., 1).

    Args:
        signals: Signals in pascals.
        rate: Sample rate in Hz.

    >>> pause, sound = torch.zeros(44100), torch.ones(44100)
    >>> print(active_rescaling(torch.cat((sound, pause)), 44100).square().round(decimals=2))
    tensor([0.5000])
    """
    samples = signals.shape[-1]
    points = round(samples * MSBG_RATE / rate)
    if points != samples:
        signals = torch.fft.irfft(rfft(signals), points) * (points / samples)
    frame = round(0.01 * MSBG_RATE)
    to_reference = 10.0 ** ((PASCAL_SPL - 120.0) / 10.0)  # to powers in pyclarity's full scale
    overall = signals.square().mean(-1, keepdim=True) * to_reference
    whole_frames = signals[..., : points // frame * frame]
    powers = whole_frames.unflatten(-1, (-1, frame)).square().mean(-1) * to_reference
    threshold = (overall * 10.0**-1.2).clamp_min(1e-8)
    # pyclarity adds a thousandth of the threshold to the powers.
    is_active = powers >= 0.999 * threshold
    active_frames = is_active.sum(-1, keepdim=True).clamp_min(1)
    power = (powers * is_active).sum(-1, keepdim=True) / active_frames
    ratio = torch.where(power > 0.0, overall / power.clamp_min(_POWER_FLOOR), 1.0)
    return ratio.sqrt()


def _group_items(
    ears: Tensor, is_trained: bool, grids: list[Audiogram | None]
) -> dict[_Group, list[int]]:
    """Group items by severity, absence of a loss and frequencies of the audiogram.

    The items of a group are processed in one batch.

    Args:
        ears: Thresholds on the CPU in dB HL, (items, 8).
        is_trained: Whether the ears require a gradient. If so, ears at 0 dB HL take the general
            path, which has a gradient, instead of the shortcut.
        grids: Ear of each item, or None for an item at the eight frequencies; an empty list if all
            items are.

    Returns:
        Indices of the items of each group, in ascending order.

    Raises:
        ValueError: A threshold is NaN. On a GPU, thresholds out of range were replaced by NaN
            earlier, because checking them would have synchronised with the GPU.
    """
    if bool(ears.isnan().any()):
        raise ValueError(
            f"expected thresholds from {LOWEST_LEVEL:g} to {HIGHEST_SIMULATED:g} dB HL, got NaN or "
            "levels outside this range"
        )
    groups: dict[_Group, list[int]] = {}
    severities = severity_index(ears).tolist()
    without_loss = (ears == 0.0).all(-1).tolist()
    for item, severity in enumerate(severities):
        grid = grids[item] if grids else None
        if grid is None:
            group = _Group(SEVERITIES[severity], without_loss[item] and not is_trained)
        else:
            group = _Group(grid.severity, not any(grid.levels), grid.frequencies)
        groups.setdefault(group, []).append(item)
    return groups
