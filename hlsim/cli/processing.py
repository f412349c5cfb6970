"""The commands ``simulate`` and ``compensate``, which process a file or a folder of files."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hlsim.cli.inputs import load_compensator, read_ears, read_sliders, warn_of_other_ears
from hlsim.cli.options import Parser, input_path
from hlsim.files import check_extension, resolve_links

if TYPE_CHECKING:
    from torch import Tensor


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
        "speech aided --audiogram N4 --compensator nal-r",
    )
    text = (
        "nal-r (a prescription), wdrc (compression in bands), or a checkpoint's name or folder; a "
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
    text = "audio file of 16 kHz or more (wav, flac, ogg, mp3, ...), or a folder of such files"
    parser.option("input", input_path, text, metavar="IN")
    text = (
        "output file (.wav with 32-bit float; from simulate also .flac, or .ogg with up to 2 "
        "channels), or a folder for wav files if IN is a folder"
    )
    parser.option("output", Path, text, metavar="OUT")
    ears = parser.add_mutually_exclusive_group(required=True)
    parser.audiogram(group=ears)
    parser.listener("both ears, for stereo files, left first", group=ears)
    parser.levels("the input; the output keeps the scale of the file")


def _simulate(options: argparse.Namespace) -> None:
    def build(rate: int) -> Any:
        from hlsim.losses.frozen_simulator import build_simulator

        return build_simulator(options.simulator, rate, options.full_scale_spl)

    _process(options, build, {}, "--simulator msbg")


def _compensate(options: argparse.Namespace) -> None:
    if options.output.suffix.lower() in (".flac", ".ogg"):
        raise ValueError(
            f"{options.output}: expected the extension .wav, because an aid amplifies beyond the "
            "full scale of other formats"
        )
    sliders = read_sliders(options)
    alternatives = "--compensator hearing-aid, wdrc or nal-r"
    _process(options, lambda rate: load_compensator(options, rate), sliders, alternatives)


class _Output(NamedTuple):
    """Properties of the output for one file.

    Attributes:
        path: File that was written.
        levels: Levels of input and output in dB SPL, as text.
        peak: Largest magnitude of the samples in the file, where 1.0 is full scale.
        is_narrow: Whether the file could hold frequencies that the model does not return.
    """

    path: Path
    levels: str
    peak: float
    is_narrow: bool


def _process(
    options: argparse.Namespace,
    build: Callable[[int], Any],
    sliders: dict[str, float],
    alternatives: str,
) -> None:
    """Process the file, or each file of the folder, and print levels and warnings.

    Args:
        options: Options of the command.
        build: Function from a sample rate in Hz to a simulator or compensator.
        sliders: Further arguments of the simulator or compensator, each under its name.
        alternatives: Options for models that keep the band above 8 kHz, for a warning.
    """
    # Threads of OpenMP spin while they wait. On a busy machine that triples the time of the many
    # short computations here.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    is_folder = options.input.is_dir()
    _check_output(options.input, options.output)
    ears = read_ears(options)
    pairs = [(options.input, options.output)]
    if is_folder:
        pairs = _pair_files(options.input, options.output)
    from hlsim.checks import LOWEST_RATE

    build = cache(build)
    if is_folder:
        build(LOWEST_RATE)  # A model that cannot be loaded is reported before the first file.
    if "compensator" in options:
        warn_of_other_ears({options.compensator: options.compensator}, ears)
    outputs = []
    for number, (source, target) in enumerate(pairs, 1):
        try:
            output = _process_file(options, source, target, ears, build, sliders)
        except ValueError as error:
            if not is_folder:
                raise
            print(f"hlsim: warning: not processed: {error}", file=sys.stderr)
        else:
            prefix = f"{number} of {len(pairs)}: " if is_folder else ""
            print(f"{prefix}{target}: {output.levels}", flush=True)
            outputs.append(output)
    _print_warnings(outputs, alternatives)
    if len(outputs) < len(pairs):
        failures = len(pairs) - len(outputs)
        raise ValueError(f"{failures} of {len(pairs)} files failed, see the warnings above")


def _process_file(
    options: argparse.Namespace,
    source: Path,
    target: Path,
    ears: Any,
    build: Callable[[int], Any],
    sliders: dict[str, float],
) -> _Output:
    """Process one file and write the output.

    Args:
        options: Options of the command.
        source: File to read.
        target: File to write.
        ears: Audiogram or listener.
        build: Function from a sample rate in Hz to a simulator or compensator.
        sliders: Further arguments of the simulator or compensator, each under its name.
    """
    import torch

    from hlsim.audio import check_writable, read_audio, write_audio
    from hlsim.calibration import level_spl
    from hlsim.checks import HIGHEST_RATE
    from hlsim.dsp.resample import resample

    waveform, rate = read_audio(source, any_rate=True)
    channels, samples = waveform.shape
    check_writable(target, channels, rate)
    is_linked = getattr(options, "linked", False)
    if channels != 2 and (options.listener or is_linked):
        option = "--linked" if is_linked else "--listener"
        raise ValueError(
            f"{source}: {option} requires 2 channels, left and right, got {channels}; leave it out "
            "for such files"
        )

    def level(signal: Tensor) -> float:
        return float(level_spl(signal.flatten(), options.full_scale_spl))

    gain = 1.0 if options.spl is None else 10.0 ** ((options.spl - level(waveform)) / 20.0)
    signal = waveform * gain
    model_rate = min(rate, HIGHEST_RATE)
    model = build(model_rate)
    with torch.no_grad():
        output = model(resample(signal, rate, model_rate), ears, **sliders)
        output = resample(output, model_rate, rate)[..., :samples]
    write_audio(target, output / gain, rate)
    peak = output.abs().max()
    levels = {"input": level(signal), "output": level(output), "peak": level(peak[None])}
    return _Output(
        target,
        ", ".join(f"{name} {value:.1f} dB SPL" for name, value in levels.items()),
        peak=float(peak) / gain,
        is_narrow=getattr(model, "highest_frequency", math.inf) < rate / 2,
    )


def _check_output(source: Path, target: Path) -> None:
    """Raise ValueError if OUT is of another kind than IN, or would replace a file of IN."""
    kind = "folder" if source.is_dir() else "file"
    if target.exists() and target.is_dir() != source.is_dir():
        raise ValueError(f"{target}: expected a {kind}, because {source} is one")
    inner, outer = resolve_links(source), resolve_links(target)
    is_nested = inner.is_relative_to(outer) or outer.is_relative_to(inner)
    if is_nested or (target.exists() and target.samefile(source)):
        raise ValueError(
            f"{target}: refusing to overwrite the input; choose a {kind} that neither is inside "
            f"{source} nor contains it"
        )
    if kind == "file":
        check_extension(target)


def _pair_files(source: Path, target: Path) -> list[tuple[Path, Path]]:
    """List the audio files of a folder, each with the wav file to write in the other folder."""
    from hlsim.audio import list_files

    audio, other_files = list_files(source)
    if other_files:
        endings = sorted({path.suffix or path.name for path in other_files})
        text = ", ".join(endings[:5])
        print(f"files that are not audio, not used: {len(other_files)} ({text})", file=sys.stderr)
    sources: dict[Path, Path] = {}
    for path in audio:
        output = (target / path.relative_to(source)).with_suffix(".wav")
        if output in sources:
            raise ValueError(
                f"{path} and {sources[output]} would both be written to {output}; rename one of "
                "them"
            )
        sources[output] = path
    return [(path, output) for output, path in sources.items()]


def _print_warnings(outputs: list[_Output], alternatives: str) -> None:
    """Print one warning about clipping, and one about the band above 8 kHz, for all files."""
    loud = [output for output in outputs if output.peak > 1.0]
    if loud:
        peak = max(output.peak for output in loud)
        decibels = math.ceil(20.0 * math.log10(peak))
        _warn(
            loud,
            f"the peak is up to {peak:.3g} times full scale, and most players will clip it; lower "
            f"the level by {decibels} dB before playing",
        )
    narrow = [output for output in outputs if output.is_narrow]
    if narrow:
        _warn(narrow, f"the output has no band above 8 kHz, which {alternatives} would keep")


def _warn(outputs: list[_Output], text: str) -> None:
    """Print a warning about one or several files."""
    files = f"{outputs[0].path}"
    if len(outputs) > 1:
        files += f" and {len(outputs) - 1} more"
    print(f"hlsim: warning: {files}: {text}", file=sys.stderr)
