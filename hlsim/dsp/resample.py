"""Resampling by a windowed sinc. The only file that imports torchaudio."""

import math
from functools import lru_cache
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.extras import MissingExtraError
from hlsim.torchtools import lasting

_SINC: dict[str, Any] = {
    "lowpass_filter_width": 64,
    "rolloff": 0.9475937167399596,
    "resampling_method": "sinc_interp_kaiser",
    "beta": 14.769656459379492,
}

# of values, some 0.4 GB: 441 / 160 has 70,560 and 44056 / 16000 11 million, but 44101 / 16000 would have 700 million
_LARGEST_KERNEL = 100_000_000


def resample(waveform: Tensor, source_rate: int, target_rate: int) -> Tensor:
    """Resample by a windowed sinc, time-aligned and differentiable.

    Flat within 0.1 dB to 90 % of the lower Nyquist frequency, 55 dB down at it and 80 dB from 101 % of it on; 75 dB on a
    GPU whose convolutions take TF32, as torch's do by default (from 44.1 to 16 kHz, with the rounding emulated on a CPU).
    ``torch.backends.cudnn.allow_tf32 = False`` keeps the 80 dB.

    Shape: (..., time) -> (..., ceil(time * target_rate / source_rate)).

    Raises:
        MissingExtraError: the rates differ and torchaudio cannot be loaded.
        ValueError: rates with so small a common factor that no kernel is kept for them, as 44101 and 16000 Hz.
    """
    if source_rate == target_rate:
        return waveform
    if source_rate * target_rate // math.gcd(source_rate, target_rate) ** 2 > _LARGEST_KERNEL:
        raise ValueError(
            f"from {source_rate} to {target_rate} Hz, whose common factor is too small; allowed: rates such as 16000, "
            "22050, 24000, 32000, 44100 and 48000"
        )
    waveform = waveform.contiguous()  # torchaudio takes a view of it
    # a kernel made while a program is traced, or of fake tensors, is of no use to others
    if torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack():
        slow: Tensor = _torchaudio().functional.resample(
            waveform, source_rate, target_rate, **_SINC
        )
        return slow
    resampled: Tensor = _resampler(source_rate, target_rate, waveform.dtype, waveform.device)(
        waveform
    )
    return resampled


@lru_cache(maxsize=32)
def _resampler(
    source_rate: int, target_rate: int, dtype: torch.dtype, device: torch.device
) -> nn.Module:
    """Its kernel takes up to forty times as long to compute as to apply to a second."""
    with lasting():
        made: nn.Module = _torchaudio().transforms.Resample(
            source_rate, target_rate, dtype=dtype, **_SINC
        )
        return made.to(device)


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
