"""The command ``live``, from microphone to headphones."""

from __future__ import annotations

import argparse
import math
from types import ModuleType
from typing import Any

from hlsim.cli.inputs import load_compensator, read_ears, read_sliders, warn_of_other_ears
from hlsim.cli.options import Parser, checked_type, number, positive_number
from hlsim.extras import require

_RATE = 16000
"""Sample rate of the stream in Hz."""

_device = checked_type(
    lambda text: int(text) if text.isdecimal() else text,
    lambda device: device != "",
    "a device's number or part of its name",
)


def live(parser: Parser) -> None:
    """Declare the options of the command ``live``."""
    parser.set_command(
        _live,
        "--audiogram N3",
        "--listener listeners.json:L0001 --simulate --seconds 60",
    )
    option = parser.option
    ears = parser.add_mutually_exclusive_group(required=True)
    parser.audiogram(group=ears)
    parser.listener("both ears, for stereo headphones", group=ears)
    parser.flag("--list-devices", "list the devices and exit", group=ears)
    models = parser.add_mutually_exclusive_group()
    text = "a streaming aid: wdrc (compression in bands), or a hearing aid's name or folder"
    option("--compensator", str, text, "hearing-aid", group=models)
    text = (
        "simulate the hearing loss with neuro-msbg instead, in blocks of 96 ms and with a "
        "delay of 200 ms"
    )
    parser.flag("--simulate", text, group=models)
    parser.sliders()
    text = (
        "level in dB SPL of samples whose RMS is 1.0, at microphone and headphones, to be measured"
    )
    option("--full-scale-spl", number, text, 100.0, metavar="DB")
    text = "microphone, by number or part of its name; the system's by default"
    option("--input", _device, text, metavar="DEVICE")
    text = "headphones, by number or part of their name; the system's by default"
    option("--output", _device, text, metavar="DEVICE")
    option("--block-ms", positive_number, "block size of an aid in ms", 4.0)
    text = "buffer of each device in ms, to be increased if there are drop-outs"
    option("--buffer-ms", positive_number, text, 20.0)
    option("--seconds", positive_number, "stop after this many seconds")


def _live(options: argparse.Namespace) -> None:
    if options.list_devices:
        sounddevice = _import_sounddevice()
        print(sounddevice.query_devices() or "no devices")
        return
    if options.simulate:
        for slider in read_sliders(options):
            option = slider.replace("_", "-")
            raise ValueError(f"--{option} has no effect with --simulate; leave one of them out")
    ears: Any = read_ears(options)
    sounddevice = _import_sounddevice()
    import torch

    from hlsim.live import Live, SimulatedStream, play
    from hlsim.losses.frozen_simulator import build_simulator

    torch.set_num_threads(1)  # Threads would wait for each other for more than 4 ms.
    block = max(1, round(options.block_ms * _RATE / 1000))
    if options.simulate:
        stream = SimulatedStream(build_simulator("neuro-msbg", _RATE, options.full_scale_spl), ears)
        block = 12 * stream.block
        latency = stream.latency
    else:
        warn_of_other_ears({options.compensator: options.compensator}, ears)
        aid = load_compensator(options, _RATE)
        if not hasattr(aid, "stream"):
            raise ValueError(
                f"{options.compensator} cannot process blocks; choose wdrc or a hearing aid"
            )
        stream = aid.stream(ears, **read_sliders(options))
        latency = aid.latency
    play(
        Live(stream, options.full_scale_spl, 2 if options.listener else 1, latency),
        sounddevice,
        devices=(options.input, options.output),
        block=block,
        buffer=options.buffer_ms / 1000.0,
        seconds=options.seconds or math.inf,
    )


def _import_sounddevice() -> ModuleType:
    """Import sounddevice, or raise an error that states how to install it."""
    try:
        return require("sounddevice", "live")
    except OSError as error:  # PortAudio is missing: not all wheels of sounddevice include it.
        raise ValueError(
            f"PortAudio not found ({error}); install it (Debian: apt install libportaudio2)"
        ) from error
