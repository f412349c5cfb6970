"""The paper's Figure 2 for any utterance: MSBG's output over its input, before and after alignment."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import dbfs
from hlsim.checks import check_choice
from hlsim.data.teacher import Teacher
from hlsim.msbg.ear import MSBG_RATE
from hlsim.report.pictures import new_figure

Method = Literal["impulse", "structural"]

_SHOWN = 0.12  # s: a delay of 28 ms is plain to see


def draw_alignment(
    signal: Tensor,
    ear: Audiogram,
    sample_rate: int,
    path: str | Path,
    *,
    method: Method = "impulse",
) -> float:
    """Write a PNG of the 0.12 s about the loudest place: A as MSBG gives it, B aligned. Returns the delay in samples.

    What is heard is drawn raised to the input's level, for it is the time that is to be seen. The legend says how far.
    ``method`` is ``impulse``, the paper's, or ``structural``.

    Shape: (time,) in pascals.

    Raises:
        ValueError: an unknown method, a path that does not end in .png, or a signal that is silent or shorter than
            0.12 s.
    """
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"{path}: what is drawn is a PNG; allowed: a name that ends in .png")
    check_choice("method", method, Method)
    shown = round(_SHOWN * sample_rate)
    if signal.shape[-1] < shown or not bool(signal.any()):
        raise ValueError(
            f"{signal.shape[-1]} samples to draw; allowed: {shown} or more, not all zero"
        )
    thresholds = torch.tensor(ear.thresholds)
    impulse = Teacher(sample_rate, alignment=method)
    teachers = (Teacher(sample_rate, alignment="none"), impulse)
    before, after = (teacher(signal[None], thresholds[None])[0] for teacher in teachers)
    delay = impulse.msbg.delay(ear.severity) * sample_rate / MSBG_RATE
    if method == "impulse":
        delay = float(impulse.delay(thresholds))
    first = min(max(0, int(signal.abs().argmax()) - shown // 2), signal.shape[-1] - shown)
    times = torch.arange(first, first + shown) / sample_rate

    figure = new_figure((9.0, 5.0))
    titles = (
        f"A. MSBG as it is, {1000.0 * delay / sample_rate:.1f} ms late",
        f"B. aligned, {method} method",
    )
    panels = figure.subplots(2, 1, sharex=True)
    for axes, heard, title in zip(panels, (before, after), titles, strict=True):
        gain, label = _raised(signal, heard)
        axes.plot(times, signal[first : first + shown], color="tab:blue", label="input")
        axes.plot(
            times, gain * heard[first : first + shown], color="tab:red", label=label, alpha=0.8
        )
        axes.set(title=title, ylabel="Pa")
        axes.legend(fontsize="small", loc="upper right")
    axes.set(xlabel="s")
    figure.savefig(path, dpi=110, format="png")
    return delay


def _raised(signal: Tensor, heard: Tensor) -> tuple[float, str]:
    """The factor that brings what is heard to the signal's level, and the legend's word for it."""
    if dbfs(heard) <= dbfs(torch.zeros_like(heard)):  # where levels end
        return 1.0, "MSBG: nothing is heard"
    gain_db = float(dbfs(signal) - dbfs(heard))
    return 10.0 ** (gain_db / 20.0), f"MSBG, raised by {gain_db:.0f} dB"
