"""The command ``live``: microphone to headphones."""

from __future__ import annotations

import argparse
import math
from types import ModuleType

from hlsim.cli.inputs import read_compensator, read_ears
from hlsim.cli.options import STANDARD_EARS, Parser, checked_type, number, positive
from hlsim.extras import require

_RATE = 16000
_device = checked_type(
    lambda text: int(text) if text.isdecimal() else text,
    lambda device: device != "",
    "a number or part of a name",
)


def live(parser: Parser) -> None:
    parser.runs(
        _live,
        "--audiogram N3",
        "--listener listeners.json:L0001 --simulate --seconds 60",
    )
    ears = parser.add_mutually_exclusive_group()
    parser.audiogram(text="; this or --listener is needed but for --list-devices", group=ears)
    parser.listener(
        "two ears, left first, of headphones and of microphones, where those are two", group=ears
    )
    either = parser.add_mutually_exclusive_group()
    text = "what runs chunk by chunk: a hearing aid's checkpoint, name or folder, or wdrc (compression in bands)"
    parser.option("--compensator", str, text, "hearing-aid", group=either)
    text = "hear what that ear hears instead, by neuro-msbg, in blocks of 96 ms and 200 ms late"
    either.add_argument("--simulate", action="store_true", help=text)
    parser.sliders()
    text = "level in dB SPL of samples whose RMS is 1.0, of microphone and headphones alike; to be measured"
    parser.option("--full-scale-spl", number, text, 100.0)
    parser.option(
        "--input", _device, "microphone: number or part of its name; the system's by default"
    )
    parser.option(
        "--output", _device, "headphones: number or part of their name; the system's by default"
    )
    parser.option("--block-ms", positive, "of an aid", 4.0)
    parser.option(
        "--buffer-ms",
        positive,
        "that each device is asked to hold: more, where there are drop-outs",
        20.0,
    )
    parser.option("--seconds", positive, "until it ends by itself")
    parser.flag("--list-devices", "show what there is, and end")


def _live(options: argparse.Namespace) -> None:
    if not options.list_devices:
        if options.audiogram is None and options.listener is None:
            raise ValueError(
                "no --audiogram and no --listener; allowed: "
                f"{', '.join(STANDARD_EARS)}, or eight levels in dB HL, or a listener's file"
            )
        ears = read_ears(options)
    sounddevice = _sounddevice()
    if options.list_devices:
        print(sounddevice.query_devices() or "no devices")
        return
    import torch

    from hlsim.live import Live, Simulated, play
    from hlsim.losses.frozen_simulator import build_simulator

    torch.set_num_threads(1)  # others would only wait for one another in 4 ms
    block = max(1, round(options.block_ms * _RATE / 1000))
    if options.simulate:
        if options.noise_reduction is not None or options.amplification is not None:
            raise ValueError("sliders with --simulate; allowed: with a hearing aid")
        stream = Simulated(build_simulator("neuro-msbg", _RATE, options.full_scale_spl), ears)
        block, latency = 12 * stream.block, stream.latency
    else:
        aid, sliders = read_compensator(options, _RATE)
        if not hasattr(aid, "stream"):
            raise ValueError(
                f"{options.compensator} takes whole signals; allowed: wdrc, or a hearing aid"
            )
        stream, latency = aid.stream(ears, **sliders), aid.latency
    play(
        Live(stream, options.full_scale_spl, 2 if options.listener else 1, latency),
        sounddevice,
        devices=(options.input, options.output),
        block=block,
        buffer=options.buffer_ms / 1000.0,
        seconds=options.seconds or math.inf,
    )


def _sounddevice() -> ModuleType:
    try:
        return require("sounddevice", "live")
    except OSError as error:  # of its own, where the wheel brings no PortAudio
        raise ValueError(
            f"no PortAudio ({error}); allowed: with it, on Debian apt install libportaudio2"
        ) from error
