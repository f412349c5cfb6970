"""The commands ``simulate`` and ``compensate``, which process a file or a folder of files."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from hlsim.cli.inputs import load_compensator, read_ears, read_sliders, warn_of_other_ears
from hlsim.cli.options import Parser, input_path


def simulate(parser: Parser) -> None:
    """Declare the options of the command ``simulate``."""
    _declare_files(
        parser,
        _simulate,
        "speech.wav perceived.wav --audiogram N3 --spl 65",
        "scenes perceived --listener listeners.json:L0001 --simulator neuro-msbg",
    )
    text = "msbg (exact), or a checkpoint's name or folder"
    parser.option("--simulator", str, text, "msbg")


def compensate(parser: Parser) -> None:
    """Declare the options of the command ``compensate``."""
    _declare_files(
        parser,
        _compensate,
        "speech.wav aided.wav --audiogram N3 --noise-reduction 0.5",
        "speech aided --audiogram N4 --compensator nalr",
    )
    text = (
        "nalr (a prescription), wdrc (compression in bands), or a checkpoint's name or folder; a "
        "checkpoint that was trained for one ear causes a warning if it is used for another"
    )
    parser.option("--compensator", str, text, "hearing-aid")
    parser.sliders()
    parser.linked("stereo files; ")


def _declare_files(
    parser: Parser, run: Callable[[argparse.Namespace], None], *examples: str
) -> None:
    """Declare the options that both commands have."""
    parser.set_command(run, *examples)
    text = "audio file of 16 to 48 kHz (wav, flac, ogg, mp3, ...), or a folder of such files"
    parser.option("input", input_path, text)
    text = "wav file (32-bit float) to write, or a folder for such files if the input is a folder"
    parser.option("output", Path, text)
    ears = parser.add_mutually_exclusive_group(required=True)
    parser.audiogram(group=ears)
    parser.listener("both ears, for stereo files, left first", group=ears)
    parser.levels("the input; the output keeps the scale of the file")


def _simulate(options: argparse.Namespace) -> None:
    def build(rate: int) -> Any:
        from hlsim.simulators import load_simulator

        return load_simulator(
            options.simulator, sample_rate=rate, full_scale_spl=options.full_scale_spl
        )

    _process(options, build, {})


def _compensate(options: argparse.Namespace) -> None:
    warn_of_other_ears({options.compensator: options.compensator}, read_ears(options))
    _process(options, lambda rate: load_compensator(options, rate), read_sliders(options))


def _process(
    options: argparse.Namespace, build: Callable[[int], Any], sliders: dict[str, float]
) -> None:
    """Process the file or each file of the folder, and print a line about each output.

    Args:
        options: Options of the command.
        build: Function from a sample rate in Hz to a simulator or compensator.
        sliders: Further arguments of the simulator or compensator, each under its name.
    """
    # Threads of OpenMP spin while they wait. On a busy machine that triples the time of the many
    # short computations here.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from hlsim.checks import LOWEST_RATE

    files = _pair_files(options.input, options.output)
    ears = read_ears(options)
    build = cache(build)
    if options.input.is_dir():
        build(LOWEST_RATE)  # A model that cannot be loaded is reported before the first file.
    failures = 0
    for source, target in files.items():
        try:
            text = _process_file(options, source, target, ears, build, sliders)
        except ValueError as error:
            if source == options.input:
                raise
            print(f"hlsim: warning: {source}: not processed: {error}", file=sys.stderr)
            failures += 1
        else:
            print(f"{target}: {text}", flush=True)
    if failures:
        raise ValueError(f"{failures} of {len(files)} files failed, see the warnings above")


def _process_file(
    options: argparse.Namespace,
    source: Path,
    target: Path,
    ears: Any,
    build: Callable[[int], Any],
    sliders: dict[str, float],
) -> str:
    """Process one file, write the output, and return a line with its level.

    Args:
        options: Options of the command.
        source: File to read.
        target: File to write.
        ears: Audiogram or listener.
        build: Function from a sample rate in Hz to a simulator or compensator.
        sliders: Further arguments of the simulator or compensator, each under its name.
    """
    import torch

    from hlsim.audio import read_audio, write_audio
    from hlsim.calibration import level_spl

    waveform, rate = read_audio(source)
    level = float(level_spl(waveform.flatten(), options.full_scale_spl))
    gain_db = 0.0 if options.spl is None else options.spl - level
    gain = 10.0 ** (gain_db / 20.0)
    model = build(rate)
    with torch.no_grad():
        output = model(waveform * gain, ears, **sliders) / gain
    write_audio(target, output, rate)
    output_level = float(level_spl(output.flatten(), options.full_scale_spl))
    text = f"input {level + gain_db:.1f} dB SPL, output {output_level + gain_db:.1f} dB SPL"
    peak = float(output.abs().max())
    if peak > 1.0:
        text += f"; the peak is {peak:.3g} times full scale, and most players will clip it"
    if getattr(model, "highest_frequency", math.inf) < rate / 2:
        text += "; the output has no band above 8 kHz"
    return text


def _pair_files(source: Path, target: Path) -> dict[Path, Path]:
    """Return the file to write for the file, or for each audio file of the folder, to read.

    Raises:
        ValueError: A file would replace an input or another output.
    """
    from hlsim.audio import find_audio

    inner, outer = source.resolve(), target.resolve()
    if inner.is_relative_to(outer) or outer.is_relative_to(inner):
        raise ValueError(
            f"{target}: refusing to overwrite the input; choose a path that neither is inside "
            f"{source} nor contains it"
        )
    if not source.is_dir():
        return {source: target}
    files = {
        path: (target / path.relative_to(source)).with_suffix(".wav") for path in find_audio(source)
    }
    output, number = Counter(files.values()).most_common(1)[0]
    if number > 1:
        raise ValueError(f"{number} files would be written to {output}; rename all but one of them")
    return files
