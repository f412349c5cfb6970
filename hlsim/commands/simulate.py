"""The command ``simulate``."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from hlsim.audio import HIGHEST_RATE, read_audio, resample, write_audio
from hlsim.commands.options import (
    Commands,
    add_command,
    audiogram_option,
    full_scale_option,
    read_ear,
    read_simulator,
)


def add(commands: Commands) -> None:
    sub = add_command(commands, "simulate", _simulate, "write what an impaired ear hears of a file")
    sub.add_argument(
        "input", type=Path, metavar="IN", help="wav, flac or ogg, 16 kHz or more, any number of channels"
    )
    sub.add_argument("output", type=Path, metavar="OUT", help="wav (32-bit float), flac or ogg")
    audiogram_option(sub, required=True)
    sub.add_argument(
        "--simulator", default="neuro-msbg", help="msbg (exact), or a checkpoint's name or folder"
    )
    full_scale_option(sub)


def _simulate(options: argparse.Namespace) -> None:
    ear = read_ear(options.audiogram)
    waveform, rate = read_audio(options.input, any_rate=True)
    inner = min(rate, HIGHEST_RATE)
    simulator = read_simulator(options.simulator, inner, options.full_scale_spl)
    with torch.no_grad():
        heard = simulator(resample(waveform, rate, inner), ear)
    write_audio(options.output, resample(heard, inner, rate)[..., : waveform.shape[-1]], rate)
