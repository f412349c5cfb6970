"""What compensators do, as curves: gain over frequency, output over input, tones as heard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from hlsim.audiogram.plot import frequency_axis
from hlsim.report.page import Picture
from hlsim.report.previous.pictures import draw_svg, legend, plain

Colours = Mapping[str, Any]
"""Of each condition, as ``pictures.condition_colours`` gives them."""

_LOWEST_DB = -60.0  # of tones as heard: what is further down is silent anyway


def gain_picture(ear: str, curves: Sequence[Mapping[str, Any]], colours: Colours) -> Picture:
    """Insertion gain over frequency of every compensator and level of ``gain_curves``, for one ear."""
    curves = [curve for curve in curves if curve["ear"] == ear]
    levels = curves[0]["levels"]
    widths = [1.5 * (1 + number // 4) for number in range(len(levels))]  # four dashes, then thicker
    styles = [*zip(range(len(levels)), cycle(("-", "--", ":", "-.")), strict=False)]

    def draw(axes: Any) -> None:
        for curve in curves:
            colour = colours[curve["compensator"]]
            for (number, style), gains in zip(styles, curve["gain_db"], strict=True):
                label = None if number else plain(curve["compensator"])
                axes.plot(
                    curve["frequencies"], gains, style, color=colour, label=label, lw=widths[number]
                )
        for (number, style), level in zip(styles, levels, strict=True):
            label = f"input of {level:g} dB SPL"
            axes.plot([], [], style, color="black", label=label, lw=widths[number])
        axes.set(ylabel="insertion gain (dB)")
        frequency_axis(axes, (250, 500, 1000, 2000, 4000))
        legend(axes)

    gains = [
        [f"{gains_at(2000.0, curve, row):.0f}" for row in curve["gain_db"]] for curve in curves
    ]
    at_2k = [
        f"{curve['compensator']} {', '.join(own)}" for curve, own in zip(curves, gains, strict=True)
    ]
    named = ", ".join(f"{level:g}" for level in levels)
    alt = f"Insertion gain for {ear} over frequency; at 2 kHz and {named} dB SPL: {'; '.join(at_2k)} dB."
    return Picture(draw_svg(draw), alt, f"Insertion gain, {ear}.")


def gains_at(hertz: Any, curve: Mapping[str, Any], gains: Sequence[float]) -> Any:
    """Between the bands' centres gains go linearly over log frequency."""
    return np.interp(np.log(hertz), np.log(curve["frequencies"]), gains)


def input_output_picture(conditions: Mapping[str, Mapping[str, Any]], colours: Colours) -> Picture:
    """Mean level of the output over that of the speech given, of a group's ``conditions``."""
    curves = {
        name: {float(level): cell["level_mean"] for level, cell in row["by_level"].items()}
        for name, row in conditions.items()
    }

    def draw(axes: Any) -> None:
        for name, curve in curves.items():
            axes.plot(
                [*curve], [*curve.values()], marker="o", color=colours[name], label=plain(name)
            )
        axes.set(xlabel="speech (dB SPL)", ylabel="output (dB SPL)")
        axes.grid(alpha=0.3)
        legend(axes)

    told = "; ".join(
        f"{name} {', '.join(f'{y:.0f}' for y in own.values())}" for name, own in curves.items()
    )
    alt = f"Level of the output over that of clean speech: {told} dB SPL."
    return Picture(draw_svg(draw), alt, "Output over input, clean speech, means over all ears.")


def tone_picture(ear: str, found: Sequence[Mapping[str, Any]], colours: Colours) -> Picture:
    """Level heard of steady tones at the middle level less a normal ear's, for one ear of ``steady_tones``."""
    rows = [row for row in found if row["ear"] == ear]
    middle = len(rows[0]["levels"]) // 2

    def draw(axes: Any) -> None:
        axes.axhline(0.0, color="0.5", linewidth=1.0, linestyle="--", label="a normal ear")
        for row in rows:
            offs = np.maximum(row["heard_off_db"][middle], _LOWEST_DB)
            name = row["compensator"]
            axes.plot(row["frequencies"], offs, marker="o", color=colours[name], label=plain(name))
        axes.set(ylabel="heard, against a normal ear (dB)")
        frequency_axis(axes, (250, 500, 1000, 2000, 4000))
        legend(axes)

    level = f"{rows[0]['levels'][middle]:g} dB SPL"
    return Picture(
        draw_svg(draw), f"Tones of {level} as heard, {ear}.", f"Tones of {level} as heard, {ear}."
    )
