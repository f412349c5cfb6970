"""The one place for dB full scale, pascals and dB SPL.

A signal inside hlsim is in pascals over the root-mean-square pressure of 94 dB SPL (1 Pa re 20 uPa is 93.98 dB SPL, taken
as 94): RMS 1.0 is 94 dB SPL. ``full_scale_spl`` says what RMS 1.0 is in somebody else's file or tensor.
"""

import torch
from torch import Tensor

from hlsim.checks import check_time_last, is_finite

PASCAL_SPL = 94.0
"""Level in dB SPL of a signal in pascals whose RMS is 1.0."""

_LOWEST_POWER = 1e-20  # -106 dB SPL: keeps the level of silence finite


def check_full_scale(full_scale_spl: float) -> float:
    """Return ``full_scale_spl`` as a float, or raise ValueError where it cannot be a level in dB SPL (0 to 200)."""
    if not (is_finite(full_scale_spl) and 0.0 <= full_scale_spl <= 200.0):
        raise ValueError(
            f"full_scale_spl is {full_scale_spl!r}; allowed: 0 to 200 dB SPL at RMS 1.0"
        )
    return float(full_scale_spl)


def gain_to_pascals(full_scale_spl: float) -> float:
    """Linear factor that turns samples with RMS 1.0 at ``full_scale_spl`` dB SPL into pascals."""
    return float(10.0 ** ((check_full_scale(full_scale_spl) - PASCAL_SPL) / 20.0))


def level_spl(waveform: Tensor, full_scale_spl: float = PASCAL_SPL) -> Tensor:
    """RMS level of a waveform in dB SPL.

    Shape: (..., time) -> (...). Silence gives -106 dB SPL at the default scale, never infinity. Raises ValueError for
    what is no floating-point tensor.
    """
    power = _whole(waveform).square().mean(-1).clamp_min(_LOWEST_POWER)
    return (10.0 * torch.log10(power) + check_full_scale(full_scale_spl)).to(waveform.dtype)


def set_level(waveform: Tensor, spl: float | Tensor, full_scale_spl: float = PASCAL_SPL) -> Tensor:
    """Scale a waveform to an RMS level in dB SPL.

    Shape: (..., time) -> (..., time); ``spl`` is a number or (...). Silence stays silent. Raises ValueError
    as ``level_spl``, and for another ``spl``.
    """
    whole = _whole(waveform)
    if not isinstance(spl, Tensor) and not is_finite(spl):
        raise ValueError(f"spl is {spl!r}; allowed: a level in dB SPL, or a tensor of one an item")
    levels, wanted = level_spl(whole, full_scale_spl), torch.as_tensor(spl, device=waveform.device)
    try:
        gain_db = wanted.expand_as(levels) - levels
    except RuntimeError as error:
        shapes = f"spl of shape {tuple(wanted.shape)} for items of {tuple(levels.shape)}"
        raise ValueError(f"{shapes}; allowed: one for all, or one an item") from error
    silent = whole.square().mean(-1) <= _LOWEST_POWER
    gain = torch.where(silent, torch.ones_like(gain_db), 10.0 ** (gain_db / 20.0))
    return (whole * gain.unsqueeze(-1).to(whole.dtype)).to(waveform.dtype)


def _whole(waveform: Tensor) -> Tensor:
    """In float32 at least: float16 holds neither the power of soft speech nor that of silence."""
    check_time_last(waveform)
    return waveform.float() if waveform.dtype in (torch.float16, torch.bfloat16) else waveform


def dbfs(waveform: Tensor) -> Tensor:
    """RMS level in dB relative to RMS 1.0. Shape: (..., time) -> (...)."""
    return level_spl(waveform, 0.0)
