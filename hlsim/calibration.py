"""Conversion between samples, pascals, dB SPL and dB relative to full scale.

Inside hlsim, a sample is a sound pressure in pascals, and an RMS of 1.0 is 94 dB SPL. (To be exact,
1 Pa is 93.98 dB above 20 uPa.) Where a signal has another scale, ``full_scale_spl`` is the level in
dB SPL of an RMS of 1.0.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from hlsim.checks import check_number, check_time_last, describe, is_finite

PASCAL_SPL = 94.0
"""Level in dB SPL of a signal in pascals whose RMS is 1.0."""

NEURO_RATE = 16000
"""Sample rate in Hz at which the networks work, and default rate of modules and functions."""

LOWEST_SPL, HIGHEST_SPL = -20.0, 140.0
"""Range of levels in dB SPL of recordings: from inaudible to a level that damages ears at once."""

Loudness = float | Mapping[float, float]
"""Loudness in dB relative to a normal ear, one number or numbers by the input's level in dB SPL."""

POWER_FLOOR = 1e-20
"""Power of -106 dB SPL in Pa^2, to which lower powers are raised, so that all levels are finite."""


def check_full_scale(full_scale_spl: float) -> float:
    """Validate the level of full scale, and return it as a float.

    Args:
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, from 0 to 200.

    Raises:
        ValueError: The level is not a number, or out of range.

    >>> check_full_scale(120)
    120.0
    """
    check_number("full_scale_spl", full_scale_spl, 0.0, 200.0)
    return float(full_scale_spl)


def gain_to_pascals(full_scale_spl: float) -> float:
    """Compute the factor that converts samples to pascals, where 1 Pa counts as 94 dB SPL.

    Args:
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Raises:
        ValueError: The level is not a number, or out of range.

    >>> gain_to_pascals(114.0)
    10.0
    """
    return float(10.0 ** ((check_full_scale(full_scale_spl) - PASCAL_SPL) / 20.0))


def level_spl(waveform: Tensor, full_scale_spl: float = PASCAL_SPL) -> Tensor:
    """Compute the RMS level of waveforms in dB SPL.

    Silence has a finite level, -106 dB SPL at the default scale.

    Shape: (..., time) -> (...).

    Args:
        waveform: Samples.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Raises:
        ValueError: The waveform is not a floating-point tensor with time last, or
            ``full_scale_spl`` is out of range.

    >>> level_spl(torch.tensor([1.0, -1.0]))
    tensor(94.)
    """
    power = _as_float32_or_wider(waveform).square().mean(-1).clamp_min(POWER_FLOOR)
    level = 10.0 * torch.log10(power) + check_full_scale(full_scale_spl)
    return level.to(waveform.dtype)


def full_scale_at(spl: float, waveform: Tensor) -> float:
    """Compute the level of full scale at which a recording has a level in dB SPL.

    All channels have one scale, because the difference between their levels counts.

    Args:
        spl: Level of the recording in dB SPL.
        waveform: Samples of all channels. Any shape.

    Returns:
        Level in dB SPL of samples whose RMS is 1.0.

    Raises:
        ValueError: The result is outside 0 to 200, or there are no samples; the recording may be
            silent.

    >>> round(full_scale_at(65.0, torch.tensor([[0.1, -0.1]])))
    85
    """
    return check_full_scale(spl - float(dbfs(waveform.double().flatten())))


def set_level(waveform: Tensor, spl: float | Tensor, full_scale_spl: float = PASCAL_SPL) -> Tensor:
    """Scale waveforms to an RMS level in dB SPL. Silence stays silent.

    Each item, and so each channel, gets a gain of its own. For one gain, which keeps the level
    differences between channels, write ``set_level(x.flatten(), spl).view_as(x)``.

    Shape: (..., time) -> (..., time).

    Args:
        waveform: Samples.
        spl: Level in dB SPL of all items, or a tensor of levels that broadcasts to the leading
            dimensions, from the level of silence (-106 at the default scale) to 140 dB SPL. For
            a waveform on a GPU, levels are not validated, because that would synchronise with it.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Raises:
        ValueError: The waveform is not a floating-point tensor with time last, ``spl`` is not a
            level or does not fit the items, or a level is out of range.

    >>> level_spl(set_level(torch.randn(2, 16000), torch.tensor([65.0, 80.0]))).round()
    tensor([65., 80.])
    """
    samples = _as_float32_or_wider(waveform)
    if not isinstance(spl, Tensor) and not is_finite(spl):
        raise ValueError(
            "expected spl to be a level in dB SPL or a tensor of one level per item, "
            f"got {describe(spl)}"
        )
    levels = level_spl(samples, full_scale_spl)
    if isinstance(spl, Tensor):
        target_levels = spl.to(waveform.device)
    else:
        target_levels = torch.tensor(spl, dtype=samples.dtype, device=waveform.device)
    _check_levels(target_levels, full_scale_spl)
    try:
        gain_db = target_levels.expand_as(levels) - levels
    except RuntimeError as error:
        raise ValueError(
            f"expected spl to broadcast to the items' shape {tuple(levels.shape)}, "
            f"got shape {tuple(target_levels.shape)}"
        ) from error
    is_silent = samples.square().mean(-1) <= POWER_FLOOR
    gain = torch.where(is_silent, torch.ones_like(gain_db), 10.0 ** (gain_db / 20.0))
    return (samples * gain.unsqueeze(-1).to(samples.dtype)).to(waveform.dtype)


def check_loudness(loudness: Loudness) -> Loudness:
    """Validate a target of loudness, and return it in floats, a mapping by ascending levels.

    Args:
        loudness: Loudness in dB relative to a normal ear, -40 to 20: a number, or a mapping from
            levels in dB SPL, 0 to 120, to such numbers.

    Raises:
        ValueError: A number is out of range, or the mapping is empty.

    >>> check_loudness({80: -9, 50: 0})
    {50.0: 0.0, 80.0: -9.0}
    """
    if not isinstance(loudness, Mapping):
        check_number("loudness", loudness, -40.0, 20.0)
        return float(loudness)
    if not loudness:
        raise ValueError("expected at least one level in loudness, got an empty mapping")
    for level, value in loudness.items():
        check_number("a level of loudness", level, 0.0, 120.0)
        check_number("loudness", value, -40.0, 20.0)
    return {float(level): float(loudness[level]) for level in sorted(loudness)}


def loudness_at(loudness: Loudness, levels: Tensor) -> Tensor:
    """Return the target of loudness for inputs of some levels.

    A curve is linear between its levels, and constant beyond them.

    Args:
        loudness: Loudness in dB relative to a normal ear, as ``check_loudness`` returns it.
        levels: Levels of the inputs in dB SPL. Any shape.

    Returns:
        Loudness in dB relative to a normal ear, in the shape of ``levels``.

    >>> loudness_at({50: 0, 65: -5, 80: -9}, torch.tensor([40.0, 62.0, 90.0]))
    tensor([ 0., -4., -9.])
    """
    if not isinstance(loudness, Mapping):
        return torch.full_like(levels, loudness)
    points = levels.new_tensor(list(loudness))
    values = levels.new_tensor(list(loudness.values()))
    shares = ((levels.unsqueeze(-1) - points[:-1]) / points.diff()).clamp(0.0, 1.0)
    return values[0] + (shares * values.diff()).sum(-1)


def dbfs(waveform: Tensor) -> Tensor:
    """Compute the RMS level of waveforms in dB relative to RMS 1.0.

    A sine with a peak of 1.0 has -3 dB. Silence has -200 dB.

    Shape: (..., time) -> (...).

    Args:
        waveform: Samples.

    Raises:
        ValueError: The waveform is not a floating-point tensor with time last.

    >>> dbfs(torch.tensor([0.1, -0.1])).round()
    tensor(-20.)
    """
    return level_spl(waveform, 0.0)


def _check_levels(levels: Tensor, full_scale_spl: float) -> None:
    """Raise ValueError unless levels in dB SPL are from that of silence to 140.

    A gain of thousands of dB would give zeros, NaN or infinity without an error. Levels on a GPU
    and in compiled programs are not validated.
    """
    if levels.device.type != "cpu" or torch.compiler.is_compiling():
        return
    silence = 10.0 * math.log10(POWER_FLOOR) + full_scale_spl
    is_level = (levels >= silence - 1e-3) & (levels <= HIGHEST_SPL)
    if not bool(is_level.all()):
        wrong = float(levels.detach()[~is_level].flatten()[0])
        raise ValueError(
            f"expected spl from {silence:g}, the level of silence, to {HIGHEST_SPL:g} dB SPL, got "
            f"{wrong:g}; speech has about 65 dB SPL"
        )


def _as_float32_or_wider(waveform: Tensor) -> Tensor:
    """Convert half precision to float32, because float16 cannot represent the power of soft speech.

    Raises:
        ValueError: The waveform is not a floating-point tensor with time last.
    """
    check_time_last(waveform)
    return waveform.float() if waveform.dtype in (torch.float16, torch.bfloat16) else waveform
