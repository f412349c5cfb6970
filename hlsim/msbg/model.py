"""The exact MSBG: batched, differentiable, on any device."""

import math
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audio import check_rate, check_waveform
from hlsim.audiogram import SEVERITIES, AudiogramLike, as_thresholds, severity_index
from hlsim.calibration import PASCAL_SPL, check_full_scale, gain_to_pascals
from hlsim.msbg.ear import EAR_DELAY, RATE, ear_filter, lowpass_filter
from hlsim.msbg.ending import ending, ending_response, ending_weights
from hlsim.msbg.filterbank import BANKS, gammatone_response
from hlsim.msbg.recruitment import STEP, envelope, envelope_lowpass, expand, expansion_ratios
from hlsim.msbg.smearing import BROADENING, SMEARING_DELAY, smear, smearing_matrix

STRUCTURAL_DELAY = 1047
"""Delay in samples at 44.1 kHz of the model without smearing, by which ``aligned`` advances the output.

The three linear-phase filters delay by 507 + 507 + 66 = 1080 samples; the filter bank's advances take 3 (8 kHz) to 170
(200 Hz) of it back, 33 at about 1 kHz.
"""

_FIR_TAIL = 2 * EAR_DELAY
_BANK_TAIL = 3200  # 73 ms: the longest advance, and what it takes the narrowest channel to decay by 80 dB


class MSBG(nn.Module):
    """The Moore, Stone, Baer and Glasberg model of an impaired ear, as pyclarity's ``Ear.process`` computes it.

    Outer and middle ear, spectral smearing, gammatone filter bank, recruitment, the way back, low-pass (Baer and
    Moore 1993; Moore and Glasberg 1993; Nejime and Moore 1997; pyclarity 0.9.0). The recursive filters are
    evaluated on an FFT grid.

    Args:
        audiogram: the ear; may be given with each call instead.
        sample_rate: of inputs and outputs in Hz, 16000 to 48000. The model runs at 44.1 kHz inside.
        full_scale_spl: level in dB SPL of RMS 1.0.
        aligned: remove the model's delay and return as many samples as came in. Otherwise the reference's output, sample
            for sample at 44.1 kHz: with its delay, and where it smears 64 * (ceil(time / 64) + 3) samples long (in a
            mixed batch the shorter ones end in zeros).
        rescale_active: first scale each signal by the ratio of its overall to its active RMS, as the reference does; a
            gain of 1 to 3 dB down that depends on the utterance.

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
        self.register_buffer(
            "thresholds", None if audiogram is None else as_thresholds(audiogram), persistent=False
        )

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
        batch = torch.broadcast_shapes(waveform.shape[:-1], thresholds.shape[:-1])
        signals = waveform.to(dtype).expand(*batch, -1).reshape(-1, waveform.shape[-1])
        ears = thresholds.to(signals).expand(*batch, -1).reshape(-1, thresholds.shape[-1])
        signals = signals * gain_to_pascals(self.full_scale_spl)

        indices = severity_index(ears)
        outputs: list[Tensor] = []
        order: list[Tensor] = []
        for index in indices.unique().tolist():
            members = (indices == index).nonzero().squeeze(-1)
            outputs.append(self._simulate_alike(signals[members], ears[members], SEVERITIES[index]))
            order.append(members)
        longest = max(output.shape[-1] for output in outputs)
        joined = torch.cat([functional.pad(output, (0, longest - output.shape[-1])) for output in outputs])
        joined = joined[torch.cat(order).argsort()] / gain_to_pascals(self.full_scale_spl)
        return joined.reshape(*batch, longest).to(waveform.dtype)

    def _simulate_alike(self, signals: Tensor, ears: Tensor, severity: str) -> Tensor:
        """All items have the same severity. Shape: (items, time), (items, 8) -> (items, time)."""
        samples = signals.shape[-1]
        bank = BANKS[severity]
        delay = self.delay(severity) if self.aligned else 0
        inner = math.ceil(samples * RATE / self.sample_rate)
        heard = _to_cochlea(signals, self.sample_rate, inner + delay, self.rescale_active)
        if severity in BROADENING:
            heard = smear(heard, _tensor("smearing", BROADENING[severity], 0, heard))
        length = heard.shape[-1]

        points = _fft_length(length + _BANK_TAIL, 2 * STEP)
        spectrum = torch.fft.rfft(heard, points).unsqueeze(-2) * _tensor("bank", severity, points, heard)
        channels = torch.fft.irfft(spectrum, points) * _tensor("kept", severity, (points, length), heard)
        envelopes = envelope(channels, _tensor("lowpass", severity, points, heard))
        if not self.aligned:
            weights = _tensor("ending weights", severity, 0, heard)
            response = _tensor("ending response", severity, (length - 1) % STEP + 1, heard)
            envelopes = envelopes + ending(channels, weights, response, length)
        heard = expand(channels, envelopes, expansion_ratios(ears, bank))[..., :length]

        inner_out = inner if self.aligned else length
        out = samples if self.aligned else round(length * self.sample_rate / RATE)
        return _from_cochlea(heard, self.sample_rate, delay, inner_out, out) * 10.0 ** (
            -bank.recombination_db / 20.0
        )


def resolve_thresholds(stored: Tensor | None, audiogram: AudiogramLike | None, waveform: Tensor) -> Tensor:
    """The call's audiogram, or else the stored one, on the waveform's device, checked to fit its leading dimensions.

    Raises:
        ValueError: there is neither, or the shapes do not broadcast.
    """
    if audiogram is None and stored is None:
        raise ValueError("no audiogram: give one when building the simulator or with the call")
    thresholds = as_thresholds(audiogram) if audiogram is not None else stored
    assert thresholds is not None
    try:
        torch.broadcast_shapes(waveform.shape[:-1], thresholds.shape[:-1])
    except RuntimeError:
        raise ValueError(
            f"audiograms of shape {tuple(thresholds.shape)} for a waveform of shape {tuple(waveform.shape)}; allowed: "
            "one audiogram, or leading dimensions that broadcast"
        ) from None
    return thresholds.to(waveform.device)


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


def _to_cochlea(signals: Tensor, rate: int, length: int, rescale: bool) -> Tensor:
    """Resample to 44.1 kHz and pass outer and middle ear by one pair of FFTs. Shape: (items, time) -> (items, length)."""
    up, down = _ratio(rate)
    if rescale:
        at_rate = (
            signals
            if up == down
            else _convert(torch.fft.rfft(signals, _grid(signals.shape[-1], rate)[0]), rate, True)
        )
        signals = signals * active_rescaling(at_rate[..., : math.ceil(signals.shape[-1] * up / down)])
    own, points = _grid(
        max(signals.shape[-1], math.ceil(length * down / up)) + math.ceil(_FIR_TAIL * down / up), rate
    )
    bins = min(own, points) // 2 + 1
    spectrum = torch.fft.rfft(signals, own)[..., :bins] * (
        _tensor("forward", "", points, signals)[:bins] * (up / down)
    )
    return torch.fft.irfft(_without_nyquist(spectrum, own, points), points)[..., :length]


def _from_cochlea(heard: Tensor, rate: int, delay: int, inner: int, out: int) -> Tensor:
    """Back out of the ear, low-pass, advance by ``delay``, return to ``rate``. Shape: (items, time) -> (items, out)."""
    up, down = _ratio(rate)
    longest = max(heard.shape[-1], inner + delay) + _FIR_TAIL
    own, points = _grid(math.ceil(longest * down / up), rate)
    bins = min(own, points) // 2 + 1
    response = _tensor("backward", "", points, heard) * _tensor("advance", "", (points, delay), heard)
    spectrum = torch.fft.rfft(heard, points)[..., :bins] * (response[:bins] * (down / up))
    return torch.fft.irfft(_without_nyquist(spectrum, points, own), own)[..., :out]


def _convert(spectrum: Tensor, rate: int, inward: bool) -> Tensor:
    """Resample a spectrum made at ``rate`` to 44.1 kHz."""
    up, down = _ratio(rate)
    own = 2 * (spectrum.shape[-1] - 1)
    points = own * up // down
    bins = min(own, points) // 2 + 1
    return torch.fft.irfft(_without_nyquist(spectrum[..., :bins] * (up / down), own, points), points)


def _without_nyquist(spectrum: Tensor, source: int, target: int) -> Tensor:
    """Where rates differ, drop the bin at the lower Nyquist frequency, which the other grid cannot hold as it is."""
    if source != target:
        spectrum = spectrum[..., :-1]
    return spectrum


def _ratio(rate: int) -> tuple[int, int]:
    common = math.gcd(RATE, rate)
    return RATE // common, rate // common


def _grid(samples: int, rate: int) -> tuple[int, int]:
    """FFT lengths at ``rate`` and at 44.1 kHz that span the same time, at least ``samples`` at ``rate``."""
    up, down = _ratio(rate)
    blocks = _fft_length(math.ceil(samples / down), 1 if down % 2 == 0 and up % 2 == 0 else 2)
    return blocks * down, blocks * up


@lru_cache(maxsize=256)
def _fft_length(least: int, multiple: int) -> int:
    """The next length of small primes that is a multiple of ``multiple``."""
    best = multiple * 2 ** math.ceil(math.log2(max(1, math.ceil(least / multiple))))
    for threes in (1, 3, 9, 27):
        for fives in (1, 5, 25):
            odd = multiple * threes * fives
            best = min(best, odd * 2 ** math.ceil(math.log2(max(1, math.ceil(least / odd)))))
    return best


def _tensor(kind: str, key: Any, points: Any, like: Tensor) -> Tensor:
    return _cached(kind, key, points, like.dtype, like.device)


@lru_cache(maxsize=64)
def _cached(kind: str, key: Any, points: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A filter on the FFT grid, held per severity, length, type and device."""
    array: np.ndarray[Any, Any]
    match kind:
        case "smearing":
            array = smearing_matrix(*key)
        case "bank":
            array = gammatone_response(BANKS[key], points)
        case "lowpass":
            array = envelope_lowpass(BANKS[key], points)
        case "ending weights":
            array = ending_weights(BANKS[key])
        case "ending response":
            array = ending_response(BANKS[key], points)
        case "kept":
            # the advance has nothing to bring in at the end, where the reference puts zeros
            length = points[1] - np.array(BANKS[key].advances)[:, None]
            array = (np.arange(points[0]) < length).astype(float)
        case "forward":
            array = np.fft.rfft(ear_filter(), points)
        case "backward":
            array = np.fft.rfft(ear_filter(backward=True), points) * np.fft.rfft(lowpass_filter(), points)
        case "advance":
            array = np.exp(2j * np.pi * np.arange(points[0] // 2 + 1) * points[1] / points[0])
        case _:
            raise AssertionError(kind)
    wide = torch.complex128 if np.iscomplexobj(array) else torch.float64
    narrow = {torch.float64: wide, torch.float32: torch.complex64 if wide.is_complex else torch.float32}[
        dtype
    ]
    return torch.from_numpy(array).to(device=device, dtype=narrow)
