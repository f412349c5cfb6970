"""The commands ``simulate`` and ``compensate``: a file in, a file out."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch

from compensators import load_compensator
from hlsim.audio import check_channels, check_extension, read_audio, write_audio
from hlsim.checks import HIGHEST_RATE
from hlsim.cli.options import (
    Commands,
    add_command,
    audiogram_option,
    check_files,
    full_scale_option,
    other_ear,
    read_ear,
    read_simulator,
)
from hlsim.dsp.resample import resample


def add(commands: Commands) -> None:
    sub = _command(commands, "simulate", _simulate, "write what an impaired ear hears of a file")
    sub.add_argument(
        "--simulator", default="neuro-msbg", help="msbg (exact), or a checkpoint's name or folder"
    )
    sub = _command(commands, "compensate", _compensate, "write what an impaired ear is to be given of a file")
    sub.add_argument(
        "--compensator",
        default="nalr",
        help="nalr (the prescription), or a checkpoint's name or folder; one of one ear alone warns of another",
    )


def _command(
    commands: Commands, name: str, run: Callable[[argparse.Namespace], None], text: str
) -> argparse.ArgumentParser:
    sub = add_command(commands, name, run, text)
    sub.add_argument(
        "input", type=Path, metavar="IN", help="wav, flac or ogg, 16 kHz or more, any number of channels"
    )
    sub.add_argument(
        "output", type=Path, metavar="OUT", help="wav (32-bit float), flac, or ogg, which takes two channels"
    )
    audiogram_option(sub, required=True)
    full_scale_option(sub)
    return sub


def _simulate(options: argparse.Namespace) -> None:
    _pass_through(options, lambda rate: read_simulator(options.simulator, rate, options.full_scale_spl))


def _compensate(options: argparse.Namespace) -> None:
    def build(rate: int) -> torch.nn.Module:
        name = options.compensator
        compensator = load_compensator(name, sample_rate=rate, full_scale_spl=options.full_scale_spl)
        for line in other_ear(name, name, read_ear(options.audiogram)):
            print(f"hlsim: warning: {line}", file=sys.stderr)
        return compensator

    _pass_through(options, build)


def _pass_through(options: argparse.Namespace, build: Callable[[int], torch.nn.Module]) -> None:
    """Read, run what ``build`` makes for a sample rate, and write at the file's own rate."""
    check_files(options.input, options.output)
    check_extension(options.output)
    ear = read_ear(options.audiogram)
    waveform, rate = read_audio(options.input, any_rate=True)
    check_channels(options.output, waveform.shape[0])
    inner = min(rate, HIGHEST_RATE)
    module = build(inner)
    with torch.no_grad():
        result = module(resample(waveform, rate, inner), ear)
    write_audio(options.output, resample(result, inner, rate)[..., : waveform.shape[-1]], rate)
