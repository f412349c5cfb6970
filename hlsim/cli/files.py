"""The commands ``simulate`` and ``compensate``: a file in, a file out, or a folder of them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hlsim.cli.inputs import check_files, check_folders, read_compensator, read_ears
from hlsim.cli.options import Parser
from hlsim.files import check_extension, resolved

if TYPE_CHECKING:
    from torch import Tensor

_UPPER_BAND = 8500.0  # Hz, from where on nothing of a model at 16 kHz comes
_HEARD, _LOST = (
    1e-6,
    1e-3,
)  # share of the upper band in the power, and what of that share counts as gone


def simulate(parser: Parser) -> None:
    _in_and_out(
        parser,
        _simulate,
        "speech.wav heard.wav --audiogram N3",
        "scenes heard --listener listeners.json:L0001 --simulator msbg",
    )
    parser.option(
        "--simulator", str, "msbg (exact), or a checkpoint's name or folder", "neuro-msbg"
    )


def compensate(parser: Parser) -> None:
    _in_and_out(
        parser,
        _compensate,
        "speech.wav aided.wav --audiogram N3 --noise-reduction 0.5",
        "speech aided --audiogram N4 --compensator nalr",
    )
    text = (
        "a checkpoint's name or folder (one of one ear alone warns of another), wdrc (compression in bands), or nalr "
        "(the prescription)"
    )
    parser.option("--compensator", str, text, "hearing-aid")
    parser.sliders()
    parser.flag(
        "--linked",
        "the level of both channels of a stereo file sets the gains of each: of a hearing aid or wdrc",
    )


def _in_and_out(parser: Parser, run: Callable[[argparse.Namespace], None], *examples: str) -> None:
    parser.runs(run, *examples)
    text = "wav, flac or ogg, 16 kHz or more, any number of channels; or a folder of them, with those in it"
    parser.option("input", Path, text, metavar="IN")
    text = "wav (32-bit float), flac, or ogg, which takes two channels; for a folder one that takes wav files alike"
    parser.option("output", Path, text, metavar="OUT")
    ears = parser.add_mutually_exclusive_group(required=True)
    parser.audiogram(group=ears)
    parser.listener("two ears, of stereo files, left first", group=ears)
    parser.full_scale()


def _simulate(options: argparse.Namespace) -> None:
    def build(rate: int, _: bool) -> Callable[..., Tensor]:
        from hlsim.losses.frozen_simulator import build_simulator

        return build_simulator(options.simulator, rate, options.full_scale_spl)

    # above 8 kHz msbg leaves little to many ears, and all that they hear
    _pass_through(
        options, build, "" if options.simulator == "msbg" else "--simulator msbg keeps it"
    )


def _compensate(options: argparse.Namespace) -> None:
    def build(rate: int, first: bool) -> Callable[..., Tensor]:
        compensator, sliders = read_compensator(options, rate, warn=first)
        return partial(compensator, **sliders)

    _pass_through(options, build, "--compensator hearing-aid, wdrc and nalr keep it")


def _pass_through(
    options: argparse.Namespace, build: Callable[[int, bool], Callable[..., Tensor]], keeper: str
) -> None:
    """Read, run what ``build`` makes for a rate, the first or not, write at each file's own, and say how loud it is.

    ``keeper`` says what keeps the band above 8 kHz; empty where its loss is no surprise.
    """
    whole = options.input.is_dir()
    if whole:
        check_folders(options.input, options.output)
    else:
        if options.output.is_dir():
            raise ValueError(f"{options.output}: a folder; allowed: a file, for IN is one")
        check_extension(options.output)
        check_files(options.input, options.output)
    ear = read_ears(options)
    import torch

    from hlsim.audio import check_written, read_audio, write_audio
    from hlsim.checks import HIGHEST_RATE, LOWEST_RATE
    from hlsim.dsp.resample import resample

    pairs = _pairs(options.input, options.output) if whole else [(options.input, options.output)]
    # one that cannot be loaded is no fault of a file
    models = {LOWEST_RATE: build(LOWEST_RATE, True)} if whole else {}
    left_out = 0
    for done, (source, target) in enumerate(pairs, 1):
        try:
            waveform, rate = read_audio(source, any_rate=True)
            check_written(target, waveform.shape[0], rate)
            if waveform.shape[0] != 2 and (options.listener or getattr(options, "linked", False)):
                asked = "--listener" if options.listener else "--linked"
                raise ValueError(
                    f"{source}: {waveform.shape[0]} channels; allowed with {asked}: 2, left and right"
                )
            inner = min(rate, HIGHEST_RATE)
            if inner not in models:
                models[inner] = build(inner, not models)
            with torch.no_grad():
                result = models[inner](resample(waveform, rate, inner), ear)
            result = resample(result, inner, rate)[..., : waveform.shape[-1]]
            if whole:
                target.parent.mkdir(parents=True, exist_ok=True)
            write_audio(target, result, rate)
        except ValueError as error:
            if not whole:
                raise
            left_out += 1
            print(f"hlsim: warning: left out: {error}", file=sys.stderr)
            continue
        count = f"{done} of {len(pairs)}: " if whole else ""
        print(f"{count}{target}: {_levels(waveform, result, options.full_scale_spl)}", flush=True)
        for line in _surprises(waveform, result, rate, keeper):
            print(f"hlsim: warning: {target}: {line}", file=sys.stderr)
    if left_out:
        raise ValueError(
            f"{left_out} of {len(pairs)} files were left out, each told above; the others are written"
        )


def _pairs(source: Path, target: Path) -> list[tuple[Path, Path]]:
    """Each file under a folder, and its place under the other as wav, which holds what is over full scale."""
    from hlsim.audio import find_audio

    made: dict[Path, Path] = {}
    for path in find_audio(source):
        one = (target / path.relative_to(source)).with_suffix(".wav")
        if one in made:
            raise ValueError(f"{path} and {made[one]} would both be {one}; rename one")
        made[one] = path
    read = {resolved(path) for path in made.values()}
    for one, path in made.items():
        if resolved(one) in read:
            raise ValueError(
                f"{one}: made of {path}, a file of IN would be lost; allowed: another OUT"
            )
    return [(path, one) for one, path in made.items()]


def _levels(before: Tensor, after: Tensor, full_scale_spl: float) -> str:
    from hlsim.calibration import level_spl

    given, made = (float(level_spl(one.flatten(), full_scale_spl)) for one in (before, after))
    peak = float(level_spl(after.abs().max().reshape(1), full_scale_spl))
    return f"{given:.1f} dB SPL in, {made:.1f} out, peak {peak:.1f}"


def _surprises(before: Tensor, after: Tensor, rate: int, keeper: str) -> Iterator[str]:
    """What a listener would not expect of the file."""
    import torch

    if (peak := float(after.abs().max())) > 1.0:
        yield f"reaches {peak:.3g} of full scale; a player clips it, unless it is turned down first"
    first = round(_UPPER_BAND / rate * before.shape[-1])
    powers = [torch.fft.rfft(one.double()).abs().square().sum(0) for one in (before, after)]
    given, made = (float(power[first:].sum() / power.sum()) for power in powers)
    if keeper and given > _HEARD and made < _LOST * given:
        yield f"what IN has above 8 kHz is missing; {keeper}"
