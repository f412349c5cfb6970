"""Resampling by a windowed sinc. The only file that imports torchaudio."""

import math
from functools import lru_cache
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.extras import MissingExtraError
from hlsim.torchtools import lasting, made_once

_SINC: dict[str, Any] = {
    "lowpass_filter_width": 64,
    "rolloff": 0.9475937167399596,
    "resampling_method": "sinc_interp_kaiser",
    "beta": 14.769656459379492,
}

# values of torchaudio's kernel: 441 / 160 has 70,560, but 44101 / 16000 would have 700 million
_LARGEST_KERNEL = 1_000_000

_TOGETHER = 64  # output samples that share a row of inputs between rates with larger ones


def resample(waveform: Tensor, source_rate: int, target_rate: int) -> Tensor:
    """Resample by a windowed sinc, time-aligned and differentiable.

    Flat within 0.1 dB to 90 % of the lower Nyquist frequency, 55 dB down at it and 80 dB from 101 % of it on; 75 dB on a
    GPU whose convolutions take TF32, as torch's do by default (from 44.1 to 16 kHz, with the rounding emulated on a CPU).
    ``torch.backends.cudnn.allow_tf32 = False`` keeps the 80 dB.

    Shape: (..., time) -> (..., ceil(time * target_rate / source_rate)).

    Raises:
        MissingExtraError: the rates differ and torchaudio, which all but odd ones need, cannot be loaded.
    """
    if source_rate == target_rate:
        return waveform
    common = math.gcd(source_rate, target_rate)
    if source_rate * target_rate // common**2 > _LARGEST_KERNEL:
        return _resample_odd(waveform, source_rate // common, target_rate // common)
    waveform = waveform.contiguous()  # torchaudio takes a view of it
    # a kernel made while a program is traced is of no use to others
    if torch.compiler.is_compiling():
        slow: Tensor = _torchaudio().functional.resample(waveform, source_rate, target_rate, **_SINC)
        return slow
    resampled: Tensor = _resampler(source_rate, target_rate, waveform.dtype, waveform.device)(waveform)
    return resampled


@lru_cache(maxsize=32)
def _resampler(source_rate: int, target_rate: int, dtype: torch.dtype, device: torch.device) -> nn.Module:
    """Its kernel takes up to forty times as long to compute as to apply to a second."""
    with lasting():
        made: nn.Module = _torchaudio().transforms.Resample(source_rate, target_rate, dtype=dtype, **_SINC)
        return made.to(device)


def _resample_odd(waveform: Tensor, source: int, target: int) -> Tensor:
    """As torchaudio, between rates without a common factor, whose kernel is nearly all zeros.

    Output sample k lies at k * source / target; it and those after it take one row of inputs, each its own weights.
    """
    time = waveform.shape[-1]
    length = -(-time * target // source)
    kernel = made_once(_odd_kernel, source, target, waveform.dtype, waveform.device)
    kernel = kernel[: -(-min(length, target) // _TOGETHER)]
    periods, (rows, _, span) = -(-length // target), kernel.shape
    first = torch.arange(rows, device=waveform.device) * _TOGETHER * source // target
    first = first + source * torch.arange(periods, device=waveform.device)[:, None]
    width = _width(source, target)
    padded = functional.pad(waveform, (width - 1, source + span))
    inputs = padded[..., first[..., None] + torch.arange(span, device=waveform.device)]
    outputs = torch.einsum("...prs,rks->...prk", inputs, kernel).flatten(-2)
    return outputs[..., :target].flatten(-2)[..., :length]


def _width(source: int, target: int) -> int:
    """Inputs on either side of an output sample."""
    return math.ceil(_SINC["lowpass_filter_width"] * source / (min(source, target) * _SINC["rolloff"]))


def _odd_kernel(source: int, target: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Weights of one period, some 40 MB in float32. Shape: (rows, output samples of a row, inputs of a row)."""
    zeros, beta = _SINC["lowpass_filter_width"], torch.tensor(_SINC["beta"], dtype=torch.float64)
    width, scale = _width(source, target), min(1.0, target / source) * _SINC["rolloff"]
    span = 2 * width + -(-(_TOGETHER - 1) * source // target)
    output = torch.arange(-(-target // _TOGETHER) * _TOGETHER).reshape(-1, _TOGETHER) * source
    place = (output - output[:, :1] // target * target).double() / target + (width - 1)
    made = []
    for part in place.split(32):  # in float64 the whole is large
        t = ((torch.arange(span) - part[..., None]) * scale).clamp_(-zeros, zeros)
        window = torch.i0(beta * (1.0 - (t / zeros).square()).sqrt()) / torch.i0(beta)
        made.append((torch.sinc(t) * window * scale).to(dtype))
    return torch.cat(made).to(device)


def _torchaudio() -> ModuleType:
    """Imported when a rate is to change: it does not load beside another build of torch, and 16 kHz can do without."""
    try:
        import torchaudio.functional
        import torchaudio.transforms
    except (ImportError, OSError) as error:
        raise MissingExtraError(
            f"torchaudio is needed to change the sample rate and cannot be loaded ({error}): "
            f"install torchaudio 2.11 from where torch {torch.__version__} came from"
        ) from error
    return torchaudio
