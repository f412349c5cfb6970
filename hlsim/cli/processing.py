"""The commands ``simulate`` and ``compensate``, which process a file or a folder of files."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Mapping, Sized
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hlsim.cli.inputs import read_compensator, read_ears, warn_of_other_ear
from hlsim.cli.options import Parser
from hlsim.files import check_extension, resolve_links

if TYPE_CHECKING:
    from torch import Tensor

    Model = Callable[..., Tensor]

UPPER_BAND_HZ = 8500.0
"""Lowest frequency in Hz of the band that models at 16 kHz remove."""

AUDIBLE_SHARE = 1e-6
"""Share of the input's power above which the upper band is worth a warning."""

REMOVED_SHARE = 1e-3
"""Share of the upper band's power below which the band counts as removed."""


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
    def build(rate: int) -> Model:
        from hlsim.losses.frozen_simulator import build_simulator

        return build_simulator(options.simulator, rate, options.full_scale_spl)

    # MSBG keeps the band above 8 kHz. If little of it remains, the ear cannot perceive it.
    hint = "" if options.simulator == "msbg" else "use --simulator msbg to keep it"
    _process(options, build, hint)


def _compensate(options: argparse.Namespace) -> None:
    if options.output.suffix.lower() in (".flac", ".ogg"):
        raise ValueError(
            f"{options.output}: expected the extension .wav, because an aid amplifies beyond the "
            "full scale of other formats"
        )

    def build(rate: int) -> Model:
        compensator, sliders = read_compensator(options, rate)
        return partial(compensator, **sliders)

    _process(options, build, "use --compensator hearing-aid, wdrc or nal-r to keep it")


def _process(
    options: argparse.Namespace, build: Callable[[int], Model], upper_band_hint: str
) -> None:
    """Process the file, or each file of the folder, and print levels and warnings.

    Args:
        options: Options of the command.
        build: Function from a sample rate in Hz to a model.
        upper_band_hint: Advice for files whose band above 8 kHz was removed. If it is empty, there
            is no such warning.
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

    models: dict[int, Model] = {}
    if is_folder:
        # A model that cannot be loaded is reported before the first file.
        models[LOWEST_RATE] = build(LOWEST_RATE)
    if getattr(options, "compensator", None):
        warn_of_other_ear(options)
    peaks: dict[Path, float] = {}
    dull: list[Path] = []
    for number, (source, target) in enumerate(pairs, 1):
        try:
            waveform, result, rate, gain = _process_file(
                options, source, target, ears, models, build
            )
        except ValueError as error:
            if not is_folder:
                raise
            print(f"hlsim: warning: not processed: {error}", file=sys.stderr)
            continue
        prefix = f"{number} of {len(pairs)}: " if is_folder else ""
        levels = _describe_levels(waveform * gain, result * gain, options.full_scale_spl)
        print(f"{prefix}{target}: {levels}", flush=True)
        peaks[target] = float(result.abs().max())
        if upper_band_hint and _lacks_upper_band(waveform, result, rate):
            dull.append(target)
    _print_warnings(peaks, dull, upper_band_hint)
    if len(peaks) < len(pairs):
        raise ValueError(
            f"{len(pairs) - len(peaks)} of {len(pairs)} files were not processed, see the warnings "
            "above"
        )


def _process_file(
    options: argparse.Namespace,
    source: Path,
    target: Path,
    ears: object,
    models: dict[int, Model],
    build: Callable[[int], Model],
) -> tuple[Tensor, Tensor, int, float]:
    """Write the output for one file.

    Returns:
        The input and the output at the scale of the file, their sample rate in Hz, and the gain
        from that scale to the level at which the input was processed.
    """
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
    gain = 1.0
    if options.spl is not None:
        level = float(level_spl(waveform.flatten(), options.full_scale_spl))
        gain = 10.0 ** ((options.spl - level) / 20.0)
    inner_rate = min(rate, HIGHEST_RATE)
    if inner_rate not in models:
        models[inner_rate] = build(inner_rate)
    with torch.no_grad():
        result = models[inner_rate](resample(waveform * gain, rate, inner_rate), ears)
        result = resample(result, inner_rate, rate)[..., :samples] / gain
    write_audio(target, result, rate)
    return waveform, result, rate, gain


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
                f"{target}: expected a folder that is neither inside {source} nor around it"
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


def _describe_levels(before: Tensor, after: Tensor, full_scale_spl: float) -> str:
    """Describe the levels of input and output, and the peak of the output."""
    from hlsim.calibration import level_spl

    signals = {
        "input": before.flatten(),
        "output": after.flatten(),
        "peak": after.abs().max()[None],
    }
    levels = {name: float(level_spl(signal, full_scale_spl)) for name, signal in signals.items()}
    return ", ".join(f"{name} {level:.1f} dB SPL" for name, level in levels.items())


def _lacks_upper_band(before: Tensor, after: Tensor, rate: int) -> bool:
    """Return whether the input has an audible upper band that the output lacks."""
    import torch

    first = round(UPPER_BAND_HZ / rate * before.shape[-1])
    shares = []
    for signal in (before, after):
        power = torch.fft.rfft(signal.double()).abs().square().sum(0)
        shares.append(float(power[first:].sum() / power.sum()))
    return shares[0] > AUDIBLE_SHARE and shares[1] < REMOVED_SHARE * shares[0]


def _print_warnings(peaks: Mapping[Path, float], dull: list[Path], upper_band_hint: str) -> None:
    """Print one warning about clipping, and one about a band that was removed, for all files."""
    warnings = []
    loud = {path: peak for path, peak in peaks.items() if peak > 1.0}
    if loud:
        path = max(loud, key=lambda path: loud[path])
        decibels = math.ceil(20.0 * math.log10(loud[path]))
        warnings.append(
            f"{_count(loud, path)}: the peak is {loud[path]:.3g} times full scale, and most "
            f"players will clip it; lower the level by {decibels} dB before playing"
        )
    if dull:
        warnings.append(
            f"{_count(dull, dull[0])}: the band above 8 kHz was removed, because the model is "
            f"limited to it; {upper_band_hint}"
        )
    for text in warnings:
        print(f"hlsim: warning: {text}", file=sys.stderr)


def _count(files: Sized, path: Path) -> str:
    """Name one of several files, and the number of the others."""
    return f"{path} (and {len(files) - 1} more)" if len(files) > 1 else str(path)
