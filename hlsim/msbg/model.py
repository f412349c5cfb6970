"""The exact MSBG: batched, differentiable, on a CPU or a GPU."""

import math
from functools import partial
from typing import NamedTuple

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
from hlsim.audiogram.devices import on_host
from hlsim.audiogram.thresholds import (
    AudiogramLike,
    ears_on_other_grids,
    has_listeners,
    resolve_thresholds,
    store_thresholds,
)
from hlsim.calibration import PASCAL_SPL, check_full_scale, gain_to_pascals
from hlsim.checks import broadcast_shape, check_rate, check_waveform
from hlsim.dsp.fft import rfft
from hlsim.msbg.blocks import in_blocks
from hlsim.msbg.cochlea import bank_points, simulate_cochlea, simulate_cochlea_at_full_rate
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.filterbank import BANKS, FilterBank
from hlsim.msbg.multirate import multirate_bank, total_response
from hlsim.msbg.recruitment import expansion_ratios, threshold_weights
from hlsim.msbg.resampling import from_cochlea, from_spectrum, resample_to_model_rate, to_cochlea
from hlsim.msbg.smearing import BROADENING, SMEARING_DELAY, smear, smearing_matrix_below
from hlsim.torchtools import compute_once, constant_like, not_compiled

STRUCTURAL_DELAY = 1047
"""Delay in samples at 44.1 kHz of the model without smearing, by which ``aligned`` advances the output.

The three linear-phase filters delay by 507 + 507 + 66 = 1080 samples. The filter bank takes some of it back, less at high
frequencies and with more loss: with none 186 at 200 Hz, 33 at 750 Hz, 21 at 1 kHz and 0 at 8 kHz, with N4 50 at 200 Hz
and 32 at 300 Hz (examples/delay.py).
"""

_HALF_RATE_HZ = 20000
"""Signals of this rate or less run at 22.05 kHz inside."""

# of signals that end in mid-speech, the samples at the end that run at 44.1 kHz throughout, and what these depend on
_ENDING = 4096
_ENDING_LEAD = 7296

# samples of all items that run together
_CPU_SAMPLES = 384_000
_DEVICE_SAMPLES = 12_000_000


class _Group(NamedTuple):
    """Properties that the ears of items must share so that the items can run together.

    Attributes:
        severity: Severity of the loss, one of ``SEVERITIES``.
        no_loss: Whether all thresholds are 0 dB HL.
        frequencies: Frequencies of the thresholds in Hz.
    """

    severity: str
    no_loss: bool
    frequencies: tuple[float, ...] = FREQUENCIES


class MSBG(nn.Module):
    """The Moore, Stone, Baer and Glasberg model of an impaired ear, as pyclarity's ``Ear.process`` computes it.

    Outer and middle ear, spectral smearing, gammatone filter bank, recruitment, the way back, low-pass (Baer and
    Moore 1993; Moore and Glasberg 1993; Nejime and Moore 1997; pyclarity 0.9.0). The recursive filters are
    evaluated on an FFT grid.

    Args:
        audiogram: Ear or ears; they may be passed with each call instead. Like pyclarity, the model
            takes an ``Audiogram`` at the frequencies at which it was measured: the severity from those
            that lie between 2 and 8 kHz, and the threshold of each channel by linear interpolation
            in Hz. A tensor has the thresholds at the eight ``FREQUENCIES``.
        sample_rate: of inputs and outputs in Hz, 16000 to 48000. Inside, the model runs at 44.1 kHz; aligned, and at
            20000 or less, at 22.05 kHz. Under 44100, the last 80 Hz below half the rate fade out.
        full_scale_spl: level in dB SPL of RMS 1.0.
        aligned: remove the model's delay and return as many samples as came in. Otherwise the reference's output, sample
            for sample at 44.1 kHz: with its delay, and where it smears 64 * (ceil(time / 64) + 3) samples long (in a
            mixed batch the shorter ones end in zeros). Under 1000 samples, all is the first filter's onset, and what the
            reference makes of a beginning, which is left out, counts: ``filtfilt``'s padding, and high-passes that start
            behind the advance. From 701 samples such signals were up to 0.03 off, from 501 0.1, from 441 0.2; below,
            pyclarity gives NaN or fails.
        rescale_active: first scale each signal by the ratio of its overall to its active RMS, as the reference does with
            one channel (two it scales alike); a gain of 1 to 3 dB down that depends on the utterance.

    Raises:
        ValueError: a rate, level or audiogram out of range.
    """

    emulates_msbg = True

    _levels: Tensor | None
    _two_ears: bool

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        sample_rate: int = MSBG_RATE,
        full_scale_spl: float = PASCAL_SPL,
        aligned: bool = True,
        rescale_active: bool = False,
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.aligned = aligned
        self.rescale_active = rescale_active
        levels = store_thresholds(audiogram)
        trained = levels is not None and levels.requires_grad
        self.register_buffer("_levels", None if trained else levels, persistent=False)
        self._trained = (
            levels if trained else None,
        )  # a buffer that moves would be another tensor
        self._two_ears = has_listeners(audiogram)
        self._other_grids = ears_on_other_grids(audiogram)

    @property
    def thresholds(self) -> Tensor | None:
        """The ear or ears given to the constructor, at ``FREQUENCIES``. Shape: (..., 8) dB HL."""
        return self._levels if self._trained[0] is None else self._trained[0]

    @not_compiled  # it depends on the ear's values, and its filters are made by numpy
    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """What the ear hears.

        Shape: (..., time) and one audiogram or (..., 8) that broadcasts over the leading dimensions -> (..., time).

        Raises:
            ValueError: no audiogram, levels outside -10 to 100 dB HL, or shapes that do not fit.
        """
        check_waveform(waveform)
        given = (
            self._trained[0] if audiogram is None else audiogram
        )  # what is trained may leave the range
        thresholds = resolve_thresholds(self._levels, given, waveform, two_ears=self._two_ears)
        grids = self._other_grids if audiogram is None else ears_on_other_grids(audiogram)
        with torch.autocast(waveform.device.type, enabled=False):
            return self._simulate(waveform, thresholds, grids)

    def delay(self, severity: str) -> int:
        """Structural delay in samples at 44.1 kHz at a severity, one of ``SEVERITIES``; ValueError for others."""
        if severity not in SEVERITIES:
            raise ValueError(f"severity {severity!r}; allowed: {', '.join(SEVERITIES)}")
        return STRUCTURAL_DELAY + (SMEARING_DELAY if severity in BROADENING else 0)

    def extra_repr(self) -> str:
        return f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}, aligned={self.aligned}"

    def _simulate(
        self, waveform: Tensor, thresholds: Tensor, grids: list[Audiogram | None]
    ) -> Tensor:
        """Perceived signals. Shape: (..., time), (..., 8) -> (..., time).

        Args:
            grids: Ears at other than the eight frequencies, as ``ears_on_other_grids`` returns them.
        """
        dtype = waveform.dtype if waveform.dtype == torch.float64 else torch.float32
        batch = broadcast_shape(waveform.shape[:-1], thresholds.shape[:-1])
        signals = waveform.to(dtype).expand(*batch, -1).reshape(-1, waveform.shape[-1])
        ears = thresholds.to(signals).expand(*batch, -1).reshape(-1, thresholds.shape[-1])
        if (gain := gain_to_pascals(self.full_scale_spl)) != 1.0:
            signals = signals * gain
        if self.rescale_active:
            signals = signals * active_rescaling(resample_to_model_rate(signals, self.sample_rate))

        outputs: list[Tensor] = []
        order: list[int] = []
        known = on_host(thresholds).to(dtype).expand(*batch, -1).reshape(ears.shape)
        if grids:
            ear_of_item = torch.arange(len(grids)).reshape(thresholds.shape[:-1]).expand(batch)
            grids = [grids[ear] for ear in ear_of_item.flatten().tolist()]
        for group, members in _alike(known, ears.requires_grad, grids).items():
            process = partial(self._simulate_alike, group=group)
            for some in _portions(members, signals.shape[-1], signals.device.type):
                chosen: slice | Tensor = slice(some[0], some[-1] + 1)
                if some[-1] - some[0] != len(some) - 1:  # a list would be copied with each use
                    chosen = _indices(some, signals.device)
                levels = ears[chosen]
                if group.frequencies != FREQUENCIES:
                    levels = _levels(grids, some).to(ears, non_blocking=True)
                outputs.append(in_blocks(process, signals[chosen], levels, self.sample_rate))
                order += some
        longest = max(output.shape[-1] for output in outputs)
        if len(outputs) == 1:  # a copy, or it would hold all that the last transform made
            heard = outputs[0].clone(memory_format=torch.contiguous_format)
        else:
            heard = torch.cat(
                [functional.pad(output, (0, longest - output.shape[-1])) for output in outputs]
            )
        if order != list(range(len(order))):
            heard = heard[_indices(torch.tensor(order).argsort().tolist(), heard.device)]
        if gain != 1.0:
            heard = heard / gain
        return heard.reshape(*batch, longest).to(waveform.dtype)

    def _simulate_alike(self, signals: Tensor, ears: Tensor, last: bool, group: _Group) -> Tensor:
        """Perceived signals of items of one group.

        Args:
            last: Whether the signals end here, and are not cut from longer ones.

        Shape: (items, time), (items, levels) dB HL at the group's frequencies -> (items, time).
        """
        samples, rate = signals.shape[-1], self.sample_rate
        severity = group.severity
        bank, smears = BANKS[severity], severity in BROADENING
        step = 2 if self.aligned and rate <= _HALF_RATE_HZ else 1
        delay = self.delay(severity) if self.aligned else 0
        highest = rate / 2 if step == 2 else MSBG_RATE / 2
        # a frame that smearing leaves next to nothing depends on the last bits: where every sample counts, keep more
        given = signals if self.aligned else signals.double()
        heard = to_cochlea(
            given, rate, math.ceil((math.ceil(samples * MSBG_RATE / rate) + delay) / step), step
        )
        if smears:
            heard = smear(
                heard, constant_like(heard, smearing_matrix_below, severity, step, highest), step
            )
        heard = heard.to(signals.dtype)
        weights = constant_like(signals, threshold_weights, bank, group.frequencies)
        ratios = expansion_ratios(ears, weights)
        gain = 10.0 ** (-bank.recombination_db / 20.0)
        length = heard.shape[-1]
        if not self.aligned:
            heard = self._late(heard, ratios, bank, smears, last)
            return from_cochlea(heard, rate, round(length * rate / MSBG_RATE), gain=gain)

        points = bank_points(length * step, rate, step)
        spectrum = rfft(heard, points // step)
        if group.no_loss:
            spectrum = spectrum * constant_like(heard, total_response, bank, points, step)
        else:
            key = bank, points, step, highest, heard.dtype, heard.device
            spectrum = simulate_cochlea(
                spectrum, ratios, compute_once(multirate_bank, *key), not smears
            )
        if smears:
            return from_spectrum(spectrum, points, step, rate, samples, gain=gain, delay=delay)
        # without smearing's delay, the way out reaches samples that the advances put before the first one
        heard = torch.fft.irfft(spectrum, points // step)[..., :length]
        return from_cochlea(heard, rate, samples, gain=gain, step=step, delay=delay)

    def _late(
        self, heard: Tensor, ratios: Tensor, bank: FilterBank, smears: bool, last: bool
    ) -> Tensor:
        """With the delay and, at the end, what the reference makes of it. Shape: (items, time) -> (items, time)."""
        length = heard.shape[-1]
        # with a slight loss and no smearing, nothing buries what the lower rates change where the envelope is next to 0
        if last and (length <= _ENDING + _ENDING_LEAD or not smears):
            return simulate_cochlea_at_full_rate(heard, ratios, bank)
        points = bank_points(length, MSBG_RATE)
        key = bank, points, 1, MSBG_RATE / 2, heard.dtype, heard.device
        spectrum = simulate_cochlea(
            rfft(heard, points), ratios, compute_once(multirate_bank, *key), not smears
        )
        all_but_the_end = torch.fft.irfft(spectrum, points)[..., :length]
        if not last:
            return all_but_the_end
        ending = simulate_cochlea_at_full_rate(heard[..., -_ENDING - _ENDING_LEAD :], ratios, bank)
        return torch.cat((all_but_the_end[..., :-_ENDING], ending[..., -_ENDING:]), -1)


def active_rescaling(signals: Tensor) -> Tensor:
    """Ratio of overall RMS to that of the active 10 ms frames (pyclarity's ``measure_rms`` at -12 dB).

    Shape: (..., time) at 44.1 kHz in pascals -> (..., 1); 1 where nothing is active.
    """
    frame = round(0.01 * MSBG_RATE)
    to_reference = 10.0 ** ((PASCAL_SPL - 120.0) / 10.0)  # powers in pyclarity's full scale
    overall = signals.square().mean(-1) * to_reference
    threshold_db = (10.0 * overall.clamp_min(1e-30).log10() - 12.0).clamp_min(-80.0)
    frames = (
        signals[..., : signals.shape[-1] // frame * frame]
        .unflatten(-1, (-1, frame))
        .square()
        .mean(-1)
    )
    frames = frames * to_reference
    floor = 10.0 ** ((threshold_db - 30.0) / 10.0)
    active = 10.0 * (frames + floor.unsqueeze(-1)).log10() >= threshold_db.unsqueeze(-1)
    count = active.sum(-1)
    power = (frames * active).sum(-1) / count.clamp_min(1)
    ratio = torch.where(
        (count > 0) & (power > 0), overall / power.clamp_min(1e-30), torch.ones_like(overall)
    )
    return ratio.sqrt().unsqueeze(-1)


def _alike(ears: Tensor, trained: bool, grids: list[Audiogram | None]) -> dict[_Group, list[int]]:
    """Group items that can run together.

    Args:
        ears: Thresholds on the CPU. Shape: (items, 8) dB HL.
        trained: Whether the ears require a gradient. Then no ear counts as one without a loss.
        grids: Per item its ear, if it is not at the eight frequencies; or an empty list.

    Returns:
        Indices of the items of each group.

    Raises:
        ValueError: A threshold was out of range, and a GPU has turned it into NaN.
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
            group = _Group(SEVERITIES[severity], without_loss[item] and not trained)
        else:
            group = _Group(grid.severity, not any(grid.levels), grid.frequencies)
        groups.setdefault(group, []).append(item)
    return groups


def _levels(grids: list[Audiogram | None], items: list[int]) -> Tensor:
    """Return the levels of items with one grid. Shape: (items, frequencies) dB HL."""
    ears = [grids[item] for item in items]
    levels = [ear.levels for ear in ears if ear is not None]
    return torch.tensor(levels, dtype=torch.float64)


def _indices(items: list[int], device: torch.device) -> Tensor:
    return torch.tensor(items).to(device, non_blocking=device.type != "cpu")


def _portions(members: list[int], samples: int, device: str) -> list[list[int]]:
    """Items that run together: as many as do not ask for too much memory."""
    size = max(1, (_CPU_SAMPLES if device == "cpu" else _DEVICE_SAMPLES) // samples)
    return [members[i : i + size] for i in range(0, len(members), size)]
