"""The commands ``simulate`` and ``compensate``, which process a file or a folder of files."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.cli.inputs import (
    build_compensator,
    build_simulator,
    level_and_gain,
    parse_ears,
    read_sliders,
    use_one_thread,
)
from hlsim.cli.options import AIDED_EARS, SIMULATED_EARS, Parser, input_path
from hlsim.progress import ProgressLine

if TYPE_CHECKING:
    from hlsim.audiogram import Audiogram
    from hlsim.audiogram.listener import Listener

PLAYED_PEAK = 0.9
"""Peak to which ``--no-clipping`` scales an output that exceeds full scale, 1.0."""

_MENTIONED_SHARE = 0.001
"""Smallest share of distorted samples that the printed line mentions."""


def simulate(parser: Parser) -> None:
    """Declare the options of the command ``simulate``."""
    _declare_files(
        parser,
        build_simulator,
        "speech.wav perceived.wav --audiogram N3 --spl 65",
        "scenes perceived --audiogram N2 --audiogram N4 --simulator neuro-msbg",
        ears=SIMULATED_EARS,
    )
    parser.simulator("msbg")


def compensate(parser: Parser) -> None:
    """Declare the options of the command ``compensate``."""
    _declare_files(
        parser,
        build_compensator,
        "speech.wav aided.wav --audiogram N3 --noise-reduction 0.5",
        "scenes aided --listener listeners.json:L0001 --compensator nalr --no-clipping",
        ears=AIDED_EARS,
    )
    text = (
        "nalr or nalrp (linear prescriptions), wdrc or camfit (compression in bands), or a "
        "checkpoint's name or folder; a checkpoint that was trained for one ear causes "
        "a warning if it is used for another, and one that was trained with several microphones "
        "takes their channels, the reference first"
    )
    parser.option("--compensator", str, text, "hearing-aid")
    parser.sliders()
    parser.linked("stereo files; ")
    parser.limit_to_ear("--listener has columns such as ucl_left_500")


def _declare_files(
    parser: Parser,
    build_model: Callable[[argparse.Namespace, int], Any],
    *examples: str,
    ears: str,
) -> None:
    """Declare the options that ``simulate`` and ``compensate`` have in common.

    Args:
        parser: Parser of the command.
        build_model: Function from the options and a sample rate in Hz to a simulator or
            compensator.
        examples: Options of each example in the help.
        ears: Names of the standard ears that the command accepts, for the help text.
    """
    parser.set_command(partial(_process, build_model=build_model), *examples)
    text = "audio file of 16 to 48 kHz (wav, flac, ogg, mp3, ...), or a folder of such files"
    parser.option("input", input_path, text)
    text = "wav file (32-bit float) to write, or a folder for such files if the input is a folder"
    parser.option("output", Path, text)
    parser.ears(ears, ", whose names then end those of the outputs")
    parser.levels("the input; the output keeps the scale of the file")
    text = (
        "make outputs that exceed full scale softer, to a peak of 0.9, so that players do not clip "
        "them; the printed line says by how many dB"
    )
    parser.flag("--no-clipping", text)


def _process(
    options: argparse.Namespace, build_model: Callable[[argparse.Namespace, int], Any]
) -> None:
    """Process one file, or each file of a folder, for each ear, and print one line per output.

    A file of a folder that fails causes a warning, which names its output of an earlier run, if
    there is one. The others are processed.

    Args:
        options: Options of the command.
        build_model: Function from the options and a sample rate in Hz to a simulator or
            compensator.

    Raises:
        ValueError: The single file failed or, once all are processed, a file of the folder did.
    """
    use_one_thread()
    from hlsim.calibration import NEURO_RATE

    ears = parse_ears(options, options.audiogram or [])
    sliders = read_sliders(options)
    tasks = _plan_outputs(options.input, options.output, [*ears])
    build = cache(partial(build_model, options))
    if options.input.is_dir():
        build(NEURO_RATE)  # A model that cannot be loaded is reported before the first file.
    failures = 0
    with ProgressLine("outputs") as progress:
        for number, (source, target, name) in enumerate(tasks):

            def show(share: float, number: int = number) -> None:
                progress(number + share, len(tasks))

            try:
                text = _process_file(options, source, target, ears[name], build, sliders, show)
            except ValueError as error:
                if source == options.input:
                    raise
                text = f"{source}: not processed: {error}"
                if os.path.exists(target):  # False also for a name that is too long
                    text += f"; {target} is the output of an earlier run"
                progress.print(f"hlsim: warning: {text}", sys.stderr)
                failures += 1
            else:
                progress.print(f"{target}: {text}")
    if failures:
        raise ValueError(f"{failures} of {len(tasks)} outputs failed, see the warnings above")


def _process_file(
    options: argparse.Namespace,
    source: Path,
    target: Path,
    ear: Audiogram | Listener,
    build: Callable[[int], Any],
    sliders: dict[str, float],
    show: Callable[[float], None],
) -> str:
    """Process one file block by block, write the output, and return a line with both levels.

    Args:
        options: Options of the command.
        source: File to read.
        target: File to write.
        ear: Audiogram or listener.
        build: Function from a sample rate in Hz to a simulator or compensator.
        sliders: Further arguments of the simulator or compensator, each under its name.
        show: Function that shows the finished share of the output, 0 to 1.

    Raises:
        ValueError: The file cannot be read, processed or written.
    """
    import torch

    from compensators.directional import behind_front_end
    from compensators.limiter import LIMITED
    from hlsim.audio import scan_audio, write_parts
    from hlsim.calibration import POWER_FLOOR
    from hlsim.cli.long_recordings import Meter, process_recording, read_all

    recording = scan_audio(source)
    level, gain_db = level_and_gain(recording.power, options)
    model = build(recording.sample_rate)
    gain = 10.0 ** (gain_db / 20.0)
    scale_spl = options.full_scale_spl + gain_db
    channels = model.ears if getattr(model, "takes_microphones", False) else recording.channels
    size = channels, recording.samples, recording.sample_rate
    limit_spl = getattr(behind_front_end(model), "limit_spl", math.inf)
    meter = Meter(LIMITED * 10.0 ** ((limit_spl - scale_spl) / 20.0))
    with torch.no_grad():
        outputs = process_recording(model, recording, gain, ear, **sliders)
        write_parts(target, meter.measure(outputs, recording.samples, show), *size)
    text = f"input {level + gain_db:.1f} dB SPL"
    output_level, _ = level_and_gain(max(meter.power, POWER_FLOOR), options)
    text += f", output {output_level + gain_db:.1f} dB SPL"
    if meter.share_above > _MENTIONED_SHARE:
        text += (
            f"; {100.0 * meter.share_above:.2g} % of the samples exceeded the aid's limit of "
            f"{limit_spl:g} dB SPL and are distorted"
        )
    if meter.peak > 1.0 and options.no_clipping:
        factor = PLAYED_PEAK / meter.peak
        write_parts(target, (factor * part for part in read_all(scan_audio(target))), *size)
        scale_spl -= 20.0 * math.log10(factor)
        text += (
            f"; the file is {-20.0 * math.log10(factor):.1f} dB softer, so that it does not clip"
        )
    elif meter.peak > 1.0:
        text += f"; the peak is {meter.peak:.3g} times full scale, and most players will clip it"
    highest_hz = getattr(model, "highest_frequency", math.inf)
    if highest_hz < recording.sample_rate / 2:
        text += f"; the output has no band above {highest_hz / 1000.0:g} kHz"
    if scale_spl != options.full_scale_spl:
        text += f"; --full-scale-spl {scale_spl:.2f} reads the file at this level"
    return text


def _plan_outputs(source: Path, target: Path, names: Sequence[str]) -> list[tuple[Path, Path, str]]:
    """Return, for each output, the file to read, the file to write and the name of the ear.

    Outputs of a folder keep their subfolders, and end in .wav. If there are several ears, the name
    of each output ends with that of its ear.

    Args:
        source: File, or folder of files, to read.
        target: File to write, or folder for the files to write.
        names: Names of the ears.

    Raises:
        ValueError: The target is a folder and the source is a file, one of two folders contains the
            other, or a file would replace an input or another output.
    """
    from hlsim.audio import find_audio

    if source.is_dir():
        inner, outer = source.resolve(), target.resolve()
        if inner.is_relative_to(outer) or outer.is_relative_to(inner):
            raise ValueError(
                f"{target}: outputs would be inputs of the next run; choose a folder that neither "
                f"is inside {source} nor contains it"
            )
        files = {
            path: (target / path.relative_to(source)).with_suffix(".wav")
            for path in find_audio(source, by_name=True)
        }
    elif target.is_dir():
        raise ValueError(f"{target} is a folder; name the file to write, as {target / 'out.wav'}")
    else:
        files = {source: target}
    tasks = []
    for path, output in files.items():
        for name in names:
            named = output.with_stem(f"{output.stem}-{name}") if len(names) > 1 else output
            tasks.append((path, named, name))
    inputs = {path.resolve() for path in files}
    for output, number in Counter(output for _, output, _ in tasks).items():
        if number > 1:
            raise ValueError(
                f"{number} files would be written to {output}; rename all but one of them"
            )
        if output.resolve() in inputs:
            raise ValueError(f"{output}: refusing to overwrite the input; choose another name")
    return tasks
