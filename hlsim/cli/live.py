"""The command ``live``, which runs an aid or a simulator from microphone to headphones."""

import argparse
import math
from typing import Any

from hlsim.cli.inputs import build_single_microphone_aid, parse_ear, read_sliders
from hlsim.cli.options import AIDED_EARS, Parser, full_scale, positive_number


def live(parser: Parser) -> None:
    """Declare the options of the command ``live``."""
    parser.set_command(
        _live,
        "--audiogram N3",
        "--listener listeners.json:L0001 --simulate --seconds 60",
    )
    option = parser.option
    ears = parser.add_mutually_exclusive_group(required=True)
    parser.audiogram(ears=AIDED_EARS, group=ears)
    parser.listener("both ears, for stereo headphones", group=ears)
    models = parser.add_mutually_exclusive_group()
    text = (
        "a streaming aid: wdrc or camfit (compression in bands), or a hearing aid's name or folder"
    )
    option("--compensator", str, text, "hearing-aid", group=models)
    text = (
        "simulate the hearing loss with neuro-msbg instead, in blocks of 36 ms and with a "
        "delay of 219 ms"
    )
    parser.flag("--simulate", text, group=models)
    parser.sliders()
    parser.limit_to_ear("--listener has columns such as ucl_left_500")
    text = (
        "level in dB SPL of samples whose RMS is 1.0, at microphone and headphones, to be measured"
    )
    option("--full-scale-spl", full_scale, text, 100.0)
    text = "{}, by number or part of the name that python -m sounddevice prints"
    option("--input", _read_device, text.format("microphone"))
    option("--output", _read_device, text.format("headphones"))
    text = "buffer of each device in ms, to be increased if there are drop-outs"
    option("--buffer-ms", positive_number, text, 20.0)
    option("--seconds", positive_number, "stop after this many seconds")


def _read_device(text: str) -> int | str:
    """Convert a text of digits to the number of a device; return any other text, part of a name."""
    return int(text) if text.isdecimal() else text


def _live(options: argparse.Namespace) -> None:
    sliders = read_sliders(options)
    ears: Any = parse_ear(options)
    import torch

    from hlsim.calibration import NEURO_RATE
    from hlsim.cli.microphone import Live, play
    from hlsim.neuro import load_pretrained
    from hlsim.neuro.stream import SimulatedStream

    torch.set_num_threads(1)  # Threads would wait for each other for more than 4 ms.
    scale = options.full_scale_spl
    if options.simulate:
        stream = SimulatedStream(load_pretrained("neuro-msbg", full_scale_spl=scale), ears)
        block, latency = 12 * stream.block, stream.latency
    else:
        aid = build_single_microphone_aid(options, NEURO_RATE)
        stream = aid.stream(ears, **sliders)
        block = latency = aid.latency
    play(
        Live(stream, scale, 2 if options.listener else 1, latency),
        devices=(options.input, options.output),
        block=block,
        buffer=options.buffer_ms / 1000.0,
        seconds=options.seconds or math.inf,
    )
