"""The command ``srt``, which measures the speech reception threshold in noise of simulated ears."""

import argparse
import math
from typing import Any

from hlsim.cli.inputs import build_single_microphone_aid, parse_ears, read_sliders
from hlsim.cli.options import Parser, count, seed, sound_level
from hlsim.progress import ProgressLine


def srt(parser: Parser) -> None:
    """Declare the options of the command ``srt``."""
    parser.set_command(
        _srt,
        "--audiogram N4 --compensator hearing-aid",
        "--audiogram N2 --audiogram N4 --simulator attenuation --triplets 300",
    )
    group = parser.add_mutually_exclusive_group(required=True)
    parser.audiogram(text="; repeat the option for several ears", group=group, action="append")
    parser.listener("both ears, each of which is tested alone", group=group)
    text = "aid to compare with none: nalr, nalrp, wdrc, camfit, or a checkpoint's name or folder"
    parser.option("--compensator", str, text)
    parser.sliders()
    parser.simulator("msbg")
    parser.option("--noise-spl", sound_level, "level of the noise in dB SPL, 40 to 90", 65.0)
    parser.option("--triplets", count, "triplets of digits per test, 30 to 3000", 120)
    parser.option("--seed", seed, "seed of digits and noises", 0)
    parser.set_defaults(full_scale_spl=94.0)  # for the aid, whose signals are in pascals


def _srt(options: argparse.Namespace) -> None:
    sliders: dict[str, Any] = {**read_sliders(options)}
    named_ears = parse_ears(options, options.audiogram or [])
    from hlsim.audiogram import Audiogram
    from hlsim.calibration import NEURO_RATE
    from hlsim.evaluation.digits import reception_threshold

    ears: dict[str, Audiogram] = {}
    for name, ear in named_ears.items():
        if isinstance(ear, Audiogram):
            ears[name] = ear
        else:
            ears.update(ear.ears().items())
    aid = build_single_microphone_aid(options, NEURO_RATE) if options.compensator else None
    with ProgressLine("tests") as progress:
        result = reception_threshold(
            [*ears.values()],
            aid,
            simulator=options.simulator,
            noise_spl=options.noise_spl,
            triplets=options.triplets,
            seed=options.seed,
            show=progress,
            **sliders,
        )
    tests = {
        "unaided": result.unaided,
        "aided": result.aided,
        "benefit": result.benefit,
        "people with this mean loss": result.people,
    }
    for number, name in enumerate(ears):
        texts = [
            f"{test} {_format_estimate(test, value, number)}"
            for test, value in tests.items()
            if value
        ]
        print(f"{name}, {result.pta[number]:.0f} dB HL: {', '.join(texts)}")


def _format_estimate(test: str, estimate: Any, number: int) -> str:
    """Return a text with the estimate for one of several ears, in dB, and its 95 % interval.

    An infinite threshold is "above 32 dB", and a benefit that is not finite "unknown".

    Args:
        test: Name of the estimate: ``"benefit"``, a difference of thresholds, or a threshold.
        estimate: ``Estimate`` with one value per ear.
        number: Index of the ear.
    """
    from hlsim.evaluation.digits.psychometric import HIGHEST_SNR

    value, low, high = (values[number] for values in estimate)
    if not math.isfinite(value):
        return "unknown" if test == "benefit" else f"above {HIGHEST_SNR:g} dB"
    return f"{value:.1f} dB [{low:.1f}, {high:.1f}]"
