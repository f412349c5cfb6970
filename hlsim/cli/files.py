"""The commands ``simulate`` and ``compensate``: a file in, a file out."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hlsim.cli.inputs import check_files, read_compensator, read_ear, read_simulator
from hlsim.cli.options import Parser

if TYPE_CHECKING:
    from torch import Tensor

ENDINGS = (".wav", ".flac", ".ogg")


def simulate(parser: Parser) -> None:
    _in_and_out(parser, _simulate)
    parser.option("--simulator", str, "msbg (exact), or a checkpoint's name or folder", "neuro-msbg")


def compensate(parser: Parser) -> None:
    _in_and_out(parser, _compensate)
    text = "nalr (the prescription), wdrc (compression in bands), or a checkpoint's name or folder; one of one ear alone "
    parser.option("--compensator", str, text + "warns of another", "nalr")
    parser.sliders()


def _in_and_out(parser: Parser, run: Callable[[argparse.Namespace], None]) -> None:
    parser.set_defaults(run=run)
    parser.option("input", Path, "wav, flac or ogg, 16 kHz or more, any number of channels", metavar="IN")
    parser.option("output", Path, "wav (32-bit float), flac, or ogg, which takes two channels", metavar="OUT")
    parser.audiogram(required=True)
    parser.full_scale()


def _simulate(options: argparse.Namespace) -> None:
    _pass_through(options, lambda rate: read_simulator(options.simulator, rate, options.full_scale_spl))


def _compensate(options: argparse.Namespace) -> None:
    def build(rate: int) -> Callable[..., Tensor]:
        compensator, sliders = read_compensator(options, rate)
        return partial(compensator, **sliders)

    _pass_through(options, build)


def _check_ending(path: Path) -> None:
    """As ``hlsim.audio.check_extension``, without torch."""
    if (ending := path.suffix.lower()) not in ENDINGS:
        found = ending or "a file without extension"
        raise ValueError(f"{path}: cannot write {found}; allowed: {', '.join(ENDINGS)}")


def _pass_through(options: argparse.Namespace, build: Callable[[int], Callable[..., Tensor]]) -> None:
    """Read, run what ``build`` makes for a sample rate, and write at the file's own rate."""
    _check_ending(options.output)
    check_files(options.input, options.output)
    ear = read_ear(options.audiogram)
    import torch

    from hlsim.audio import check_channels, read_audio, write_audio
    from hlsim.checks import HIGHEST_RATE
    from hlsim.dsp.resample import resample

    waveform, rate = read_audio(options.input, any_rate=True)
    check_channels(options.output, waveform.shape[0])
    inner = min(rate, HIGHEST_RATE)
    module = build(inner)
    with torch.no_grad():
        result = module(resample(waveform, rate, inner), ear)
    write_audio(options.output, resample(result, inner, rate)[..., : waveform.shape[-1]], rate)
