"""The exact MSBG: batched, differentiable, on any device."""

import math
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from hlsim.audiogram import AudiogramLike, own_thresholds, resolve_thresholds, severity_of
from hlsim.calibration import PASCAL_SPL, check_full_scale, gain_to_pascals
from hlsim.checks import check_rate, check_waveform
from hlsim.dsp.fft import long_irfft, long_rfft
from hlsim.msbg.cochlea import bank_points, hear, hear_ending
from hlsim.msbg.ear import RATE
from hlsim.msbg.filterbank import BANKS
from hlsim.msbg.filters import Filters
from hlsim.msbg.recruitment import expansion_ratios
from hlsim.msbg.resampling import block_bounds, faded, from_cochlea, from_spectrum, to_cochlea, to_inner
from hlsim.msbg.smearing import BROADENING, SMEARING_DELAY, smear
from hlsim.torchtools import not_compiled

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


class MSBG(nn.Module):
    """The Moore, Stone, Baer and Glasberg model of an impaired ear, as pyclarity's ``Ear.process`` computes it.

    Outer and middle ear, spectral smearing, gammatone filter bank, recruitment, the way back, low-pass (Baer and
    Moore 1993; Moore and Glasberg 1993; Nejime and Moore 1997; pyclarity 0.9.0). The recursive filters are
    evaluated on an FFT grid.

    Args:
        audiogram: the ear; may be given with each call instead.
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

    thresholds: Tensor | None

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        sample_rate: int = RATE,
        full_scale_spl: float = PASCAL_SPL,
        aligned: bool = True,
        rescale_active: bool = False,
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.aligned = aligned
        self.rescale_active = rescale_active
        self.register_buffer("thresholds", own_thresholds(audiogram), persistent=False)

    @not_compiled  # it depends on the ear's values, and its filters are made by numpy
    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """What the ear hears.

        Shape: (..., time) and one audiogram or (..., 8) that broadcasts over the leading dimensions -> (..., time).

        Raises:
            ValueError: no audiogram, levels outside -10 to 100 dB HL, or shapes that do not fit.
        """
        check_waveform(waveform)
        thresholds = resolve_thresholds(self.thresholds, audiogram, waveform)
        with torch.autocast(waveform.device.type, enabled=False):
            return self._simulate(waveform, thresholds)

    def delay(self, severity: str) -> int:
        """Structural delay in samples at 44.1 kHz at a severity."""
        return STRUCTURAL_DELAY + (SMEARING_DELAY if severity in BROADENING else 0)

    def extra_repr(self) -> str:
        return (
            f"sample_rate={self.sample_rate}, full_scale_spl={self.full_scale_spl:g}, aligned={self.aligned}"
        )

    def _simulate(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
        dtype = waveform.dtype if waveform.dtype == torch.float64 else torch.float32
        batch = waveform.shape[:-1]
        if thresholds.ndim > 1:
            batch = torch.broadcast_shapes(batch, thresholds.shape[:-1])
        signals = waveform.to(dtype).expand(*batch, -1).reshape(-1, waveform.shape[-1])
        ears = thresholds.to(signals).expand(*batch, -1).reshape(-1, thresholds.shape[-1])
        if (gain := gain_to_pascals(self.full_scale_spl)) != 1.0:
            signals = signals * gain
        if self.rescale_active:
            signals = signals * active_rescaling(to_inner(signals, self.sample_rate))

        outputs: list[Tensor] = []
        order: list[int] = []
        for severity, none, members in _alike(ears):
            for some in _portions(members, signals.shape[-1], signals.device.type):
                if len(some) == len(signals):
                    outputs.append(self._in_blocks(signals, ears, severity, none))
                else:
                    chosen: slice | Tensor = slice(some[0], some[-1] + 1, 1)
                    if some[-1] - some[0] != len(some) - 1:
                        chosen = torch.tensor(
                            some, device=signals.device
                        )  # a list would be copied with each use
                    outputs.append(self._in_blocks(signals[chosen], ears[chosen], severity, none))
                order += some
        longest = max(output.shape[-1] for output in outputs)
        if len(outputs) == 1:  # a copy, or it would hold all that the last transform made
            heard = outputs[0].clone(memory_format=torch.contiguous_format)
        else:
            heard = torch.cat([functional.pad(output, (0, longest - output.shape[-1])) for output in outputs])
        if order != list(range(len(order))):
            heard = heard[torch.tensor(order).argsort().to(heard.device)]
        if gain != 1.0:
            heard = heard / gain
        return heard.reshape(*batch, longest).to(waveform.dtype)

    def _in_blocks(self, signals: Tensor, ears: Tensor, severity: str, none: bool) -> Tensor:
        """Long signals by overlapping blocks, so that memory does not grow. Shapes as ``_simulate_alike``'s."""
        samples = signals.shape[-1]
        bounds = block_bounds(samples, self.sample_rate)
        if len(bounds) == 1:
            return self._simulate_alike(signals, ears, severity, none, True)
        heard = []
        # torch.func's transforms refuse the hooks by which a block is computed again
        again = torch.is_grad_enabled() and torch._C._functorch.peek_interpreter_stack() is None
        for begin, start, stop, end in bounds:
            last = end == samples
            call = partial(self._simulate_alike, severity=severity, none=none, last=last)
            block = faded(signals[:, begin:end], self.sample_rate, begin > 0, not last)
            if again and (block.requires_grad or ears.requires_grad):
                output = checkpoint(call, block, ears, use_reentrant=False)
            else:
                output = call(block, ears)
            heard.append(output[:, start - begin : None if stop == samples else stop - begin])
        return torch.cat(heard, -1)

    def _simulate_alike(self, signals: Tensor, ears: Tensor, severity: str, none: bool, last: bool) -> Tensor:
        """All items have the same severity. Shape: (items, time), (items, 8) -> (items, time).

        Args:
            none: they hear everything at its level: 0 dB HL throughout.
            last: the signals end where they end, and are not cut from longer ones.
        """
        samples, rate = signals.shape[-1], self.sample_rate
        step = 2 if self.aligned and rate <= _HALF_RATE_HZ else 1
        delay = self.delay(severity) if self.aligned else 0
        highest = rate / 2 if step == 2 else RATE / 2
        inner = math.ceil(samples * RATE / rate)
        filters = Filters(signals.dtype, signals.device)
        # a frame that smearing leaves next to nothing hangs on the last bits: where every sample counts, keep more
        fine = filters if self.aligned else Filters(torch.float64, signals.device)
        heard = to_cochlea(signals.to(fine.dtype), rate, math.ceil((inner + delay) / step), step, fine)
        if severity in BROADENING:
            heard = smear(heard, fine.get("smearing", severity, step, highest), step)
        heard = heard.to(signals.dtype)
        ratios = expansion_ratios(ears, filters.get("thresholds", severity))
        gain = 10.0 ** (-BANKS[severity].recombination_db / 20.0)

        length = heard.shape[-1]
        if self.aligned:
            points = bank_points(length * step, rate, step)
            spectrum = long_rfft(heard, points // step)
            if none:
                spectrum = spectrum * filters.get("total", severity, points, step)
            else:
                plan = filters.get("plan", severity, points, step, highest)
                spectrum = hear(spectrum, ratios, plan, severity not in BROADENING)
            if severity in BROADENING:
                return from_spectrum(spectrum, points, step, rate, samples, filters, gain=gain, delay=delay)
            # without smearing's delay, the way out reaches samples that the advances put before the first one
            heard = long_irfft(spectrum, points // step)[..., :length]
            return from_cochlea(heard, rate, length, samples, filters, gain=gain, step=step, delay=delay)
        heard = self._late(heard, ratios, severity, last, filters)
        return from_cochlea(heard, rate, length, round(length * rate / RATE), filters, gain=gain)

    def _late(self, heard: Tensor, ratios: Tensor, severity: str, last: bool, filters: Filters) -> Tensor:
        """With the delay and, at the end, what the reference makes of it. Shape: (items, time) -> (items, time)."""
        length = heard.shape[-1]
        # with a slight loss and no smearing, nothing buries what the lower rates change where the envelope is next to 0
        whole = length <= _ENDING + _ENDING_LEAD or severity not in BROADENING
        parts = []
        if not whole or not last:
            points = bank_points(length, RATE)
            plan = filters.get("plan", severity, points, 1, RATE / 2)
            parts.append(
                long_irfft(hear(long_rfft(heard, points), ratios, plan, severity not in BROADENING), points)[
                    ..., :length
                ]
            )
        if last:
            ending = hear_ending(
                heard if whole else heard[..., -_ENDING - _ENDING_LEAD :], ratios, severity, filters
            )
            parts = [ending] if whole else [parts[0][..., :-_ENDING], ending[..., -_ENDING:]]
        return parts[0] if len(parts) == 1 else torch.cat(parts, -1)


def active_rescaling(signals: Tensor) -> Tensor:
    """Ratio of overall RMS to that of the active 10 ms frames (pyclarity's ``measure_rms`` at -12 dB).

    Shape: (..., time) at 44.1 kHz in pascals -> (..., 1); 1 where nothing is active.
    """
    frame = round(0.01 * RATE)
    to_reference = 10.0 ** ((PASCAL_SPL - 120.0) / 10.0)  # powers in pyclarity's full scale
    overall = signals.square().mean(-1) * to_reference
    threshold_db = (10.0 * overall.clamp_min(1e-30).log10() - 12.0).clamp_min(-80.0)
    frames = signals[..., : signals.shape[-1] // frame * frame].unflatten(-1, (-1, frame)).square().mean(-1)
    frames = frames * to_reference
    floor = 10.0 ** ((threshold_db - 30.0) / 10.0)
    active = 10.0 * (frames + floor.unsqueeze(-1)).log10() >= threshold_db.unsqueeze(-1)
    count = active.sum(-1)
    power = (frames * active).sum(-1) / count.clamp_min(1)
    ratio = torch.where((count > 0) & (power > 0), overall / power.clamp_min(1e-30), torch.ones_like(overall))
    return ratio.sqrt().unsqueeze(-1)


def _alike(ears: Tensor) -> list[tuple[str, bool, list[int]]]:
    """Severity, whether all is 0 dB HL, and the indices of the items with ears like that. Shape: (items, 8)."""
    groups: dict[tuple[str, bool], list[int]] = {}
    for item, levels in enumerate(ears.tolist()):  # once a call; the rest asks nothing of the device
        none = not any(levels) and not ears.requires_grad
        groups.setdefault((severity_of(levels), none), []).append(item)
    return [(*kind, members) for kind, members in groups.items()]


def _portions(members: list[int], samples: int, device: str) -> list[list[int]]:
    """Items that run together: as many as do not ask for too much memory."""
    size = max(1, (_CPU_SAMPLES if device == "cpu" else _DEVICE_SAMPLES) // samples)
    return [members[i : i + size] for i in range(0, len(members), size)]
