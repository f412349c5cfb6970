"""The commands ``simulate`` and ``compensate``, which process a file or a folder of files."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hlsim.cli.inputs import load_compensator, read_ears, read_sliders, warn_of_other_ear
from hlsim.cli.options import Parser
from hlsim.files import check_extension, resolve_links

if TYPE_CHECKING:
    from torch import Tensor

Build = Callable[[int], Any]
"""Function from a sample rate in Hz to a model."""


def simulate(parser: Parser) -> None:
    """Declare the options of ``simulate``."""
    _declare_files(
        parser,
        _simulate,
        "speech.wav perceived.wav --audiogram N3 --spl 65",
        "scenes perceived --listener listeners.json:L0001 --simulator neuro-msbg",
    )
    text = "msbg (exact), or a checkpoint's name or folder"
    parser.option("--simulator", str, text, "msbg")


def compensate(parser: Parser) -> None:
    """Declare the options of ``compensate``."""
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
    parser.option("input", Path, text, metavar="IN")
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


class Result(NamedTuple):
    """Properties of the output for one file, which decide about warnings."""

    path: Path
    peak: float
    lacks_band: bool


def _process(
    options: argparse.Namespace, build: Build, sliders: dict[str, float], alternatives: str
) -> None:
    """Process the file, or each file of the folder, and print levels and warnings.

    Args:
        options: Options of the command.
        build: Function from a sample rate in Hz to a model.
        sliders: Further arguments of the model.
        alternatives: Options for models that keep the band above 8 kHz.
    """
    # Threads of OpenMP spin while they wait. On a busy machine that triples the time of the many
    # short computations here.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    _check_paths(options.input, options.output)
    ears = read_ears(options)
    is_folder = options.input.is_dir()
    pairs = [(options.input, options.output)]
    if is_folder:
        pairs = _pair_files(options.input, options.output)
    from hlsim.checks import LOWEST_RATE

    models: dict[int, Any] = {}
    if is_folder:
        # A model that cannot be loaded is reported before the first file.
        models[LOWEST_RATE] = build(LOWEST_RATE)
    if "compensator" in options:
        warn_of_other_ear(options)
    results = []
    for number, (source, target) in enumerate(pairs, 1):
        prefix = f"{number} of {len(pairs)}: " if is_folder else ""
        try:
            result, levels = _process_file(options, source, target, ears, models, build, sliders)
        except ValueError as error:
            if not is_folder:
                raise
            print(f"hlsim: warning: not processed: {error}", file=sys.stderr)
        else:
            print(f"{prefix}{target}: {levels}", flush=True)
            results.append(result)
    _print_warnings(results, alternatives)
    if len(results) < len(pairs):
        failures = len(pairs) - len(results)
        raise ValueError(f"{failures} of {len(pairs)} files failed, see the warnings above")


def _process_file(
    options: argparse.Namespace,
    source: Path,
    target: Path,
    ears: Any,
    models: dict[int, Any],
    build: Build,
    sliders: dict[str, float],
) -> tuple[Result, str]:
    """Write the output for one file, and return its properties and a description of levels."""
    import torch

    from hlsim.audio import check_writable, read_audio, write_audio
    from hlsim.calibration import level_spl
    from hlsim.checks import HIGHEST_RATE
    from hlsim.dsp.resample import resample

    waveform, rate = read_audio(source, any_rate=True)
    channels, samples = waveform.shape
    check_writable(target, channels, rate)
    needs_stereo = "--listener" if options.listener else ""
    if getattr(options, "linked", False):
        needs_stereo = "--linked"
    if needs_stereo and channels != 2:
        raise ValueError(
            f"{source}: {needs_stereo} requires 2 channels, left and right, got {channels}"
        )

    def level(signal: Tensor) -> float:
        return float(level_spl(signal.flatten(), options.full_scale_spl))

    gain = 1.0 if options.spl is None else 10.0 ** ((options.spl - level(waveform)) / 20.0)
    inner_rate = min(rate, HIGHEST_RATE)
    if inner_rate not in models:
        models[inner_rate] = build(inner_rate)
    model = models[inner_rate]
    with torch.no_grad():
        output = model(resample(waveform * gain, rate, inner_rate), ears, **sliders)
        output = resample(output, inner_rate, rate)[..., :samples]
    peak = output.abs().max()
    write_audio(target, output / gain, rate)
    levels = {"input": level(waveform * gain), "output": level(output), "peak": level(peak[None])}
    lacks_band = getattr(model, "highest_frequency", math.inf) < rate / 2
    description = ", ".join(f"{name} {value:.1f} dB SPL" for name, value in levels.items())
    return Result(target, float(peak) / gain, lacks_band), description


def _check_paths(source: Path, target: Path) -> None:
    """Raise ValueError if OUT could not be written, or would replace a file of IN."""
    if not source.exists():
        raise ValueError(f"{source}: there is no such file or folder")
    if source.is_dir():
        if target.exists() and not target.is_dir():
            raise ValueError(f"{target}: expected a folder, because {source} is one")
        inner, outer = resolve_links(source), resolve_links(target)
        if inner.is_relative_to(outer) or outer.is_relative_to(inner):
            raise ValueError(
                f"{target}: expected a folder that is neither inside {source} nor contains it"
            )
        return
    if target.is_dir():
        raise ValueError(f"{target}: expected a file, because {source} is one")
    check_extension(target)
    if not target.parent.is_dir():
        raise ValueError(f"{target.parent}: there is no such folder")
    if target.exists() and target.samefile(source):
        raise ValueError(f"{target}: refusing to overwrite the input; choose another file")


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


def _print_warnings(results: Iterable[Result], alternatives: str) -> None:
    """Print one warning about clipping, and one about the band above 8 kHz, for all files."""
    loud = [result for result in results if result.peak > 1.0]
    if loud:
        peak = max(result.peak for result in loud)
        decibels = math.ceil(20.0 * math.log10(peak))
        _warn(
            loud,
            f"the peak is up to {peak:.3g} times full scale, and most players will clip it; lower "
            f"the level by {decibels} dB before playing",
        )
    dull = [result for result in results if result.lacks_band]
    if dull:
        _warn(dull, f"the output has no band above 8 kHz, which {alternatives} would keep")


def _warn(results: list[Result], text: str) -> None:
    """Print a warning about one or several files."""
    files = f"{results[0].path}"
    if len(results) > 1:
        files += f" and {len(results) - 1} more"
    print(f"hlsim: warning: {files}: {text}", file=sys.stderr)
