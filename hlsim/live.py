"""Sound as it comes, microphone to headphones: what happens to each block, and the loop around it."""

from __future__ import annotations

import math
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.audiogram.listener import Listener
from hlsim.calibration import level_spl
from hlsim.neuro import NeuroMSBG
from hlsim.neuro.config import NEURO_RATE

KEYS = {"noise_reduction": ("n", "N"), "amplification": ("a", "A")}
"""The keys that move a slider down and up."""

_ALLOWED = "allowed: a device of hlsim live --list-devices that takes 16000 Hz"
_STEP = 0.1
_WARM_UP = 20  # blocks of silence before the first: the first calls take longest


class Live:
    """Called by sounddevice with each block; counts what there is to show.

    Args:
        stream: (time,) samples -> as many, or (2, time) of two ears; its attributes of the names in ``KEYS`` are its
            sliders.
        full_scale_spl: level in dB SPL of RMS 1.0, of microphone and headphones alike.
        ears: 1, or 2: left and right, each from its own microphone where there are two.
        latency: samples that the stream's output is late.
    """

    def __init__(
        self,
        stream: Callable[[Tensor], Tensor],
        full_scale_spl: float,
        ears: int = 1,
        latency: int = 0,
    ) -> None:
        self.stream, self.full_scale_spl, self.ears, self.latency = (
            stream,
            full_scale_spl,
            ears,
            latency,
        )
        self.drop_outs, self.error = 0, ""
        self._blocks: list[Tensor] = []

    def __call__(self, given: Any, played: Any, frames: int, clock: Any, status: Any) -> None:
        """Shape: ``given`` (frames, 1 or ears) and ``played`` (frames, channels), arrays of float32."""
        lost = (
            status.input_overflow,
            status.input_underflow,
            status.output_overflow,
            status.output_underflow,
        )
        self.drop_outs += any(lost)
        try:
            heard = torch.from_numpy(given.T.copy())
            heard = heard.expand(2, -1) if self.ears == 2 else heard[0]
            output = self.stream(heard).clamp(-1.0, 1.0)
            played[:] = torch.atleast_2d(output).mT.numpy()
            self._blocks.append(torch.stack((heard, output)))
        except Exception as error:  # nobody would see it in the device's thread
            played.fill(0.0)
            self.error = str(error) or type(error).__name__

    def press(self, key: str) -> None:
        """Move the slider that a key is for."""
        for name, (down, up) in KEYS.items():
            if key in (down, up) and hasattr(self.stream, name):
                moved = getattr(self.stream, name) + (_STEP if key == up else -_STEP)
                setattr(self.stream, name, round(min(1.0, max(0.0, moved)), 3))

    def told(self) -> str:
        """Levels since it was asked last, sliders, and drop-outs since the start."""
        blocks, self._blocks = self._blocks, []
        parts = []
        if blocks:
            levels = level_spl(torch.cat(blocks, -1), self.full_scale_spl).clamp_min(0.0)
            told = [
                " / ".join(f"{level:5.1f}" for level in ears)
                for ears in levels.view(2, -1).tolist()
            ]
            parts.append("in {}, out {} dB SPL".format(*told))
        for name, keys in KEYS.items():
            if hasattr(self.stream, name):
                parts.append(
                    f"{name.replace('_', ' ')} {getattr(self.stream, name):.1f} ({'/'.join(keys)})"
                )
        return ", ".join([*parts, f"drop-outs {self.drop_outs}"])


class Simulated:
    """What an ear hears, as a stream: each block is given once all has come on which it depends.

    Args:
        simulator: a Neuro-MSBG at 16 kHz that looks a known stretch to either side, as ``neuro-msbg``.

    Attributes:
        latency: samples that the output is late.
        block: chunks must be of so many samples, or a multiple.

    Raises:
        ValueError: another simulator.
    """

    def __init__(self, simulator: torch.nn.Module, audiogram: Audiogram | Listener) -> None:
        field = simulator._receptive_field if isinstance(simulator, NeuroMSBG) else None
        if field is None or simulator.sample_rate != NEURO_RATE:
            raise ValueError(
                "a simulator that looks at whole signals; allowed: neuro-msbg at 16000 Hz"
            )
        self._simulator, self._audiogram, (self.block, needed) = simulator, audiogram, field
        self.latency = math.ceil(needed / self.block) * self.block
        self._past = torch.zeros(2 * self.latency)

    def __call__(self, chunk: Tensor) -> Tensor:
        """Shape: (time,), or (2, time) of a listener -> the same."""
        samples = chunk.shape[-1]
        window = torch.cat((self._past.expand(*chunk.shape[:-1], -1), chunk), -1)
        self._past = window[..., samples:]
        with torch.no_grad():
            heard: Tensor = self._simulator(window, self._audiogram)
        return heard[..., self.latency : self.latency + samples]


def play(
    live: Live,
    sounddevice: ModuleType,
    *,
    devices: tuple[int | str | None, int | str | None] = (None, None),
    block: int = 64,
    buffer: float = 0.02,
    seconds: float = math.inf,
) -> None:
    """Run until the time is up, ``q`` or Ctrl-C; what is told stands on one line, or once a second without a terminal.

    Args:
        devices: number or part of the name of microphone and headphones; None for the system's.
        block: samples at 16 kHz.
        buffer: seconds that each device is asked to hold; it may hold more.

    Raises:
        ValueError: no such device, one that does not take 16 kHz or plays one ear where there are two, or what the
            stream raised.
    """
    there, here = [
        _check(sounddevice, *which) for which in zip(("input", "output"), devices, strict=True)
    ]
    if here < live.ears:
        raise ValueError(
            "the headphones have one channel for two ears; allowed: with two, or --audiogram"
        )
    for _ in range(_WARM_UP):
        live.stream(torch.zeros(2, block) if live.ears == 2 else torch.zeros(block))
    shown, every = ("\r{:<100}", 0.2) if sys.stdout.isatty() else ("{}\n", 1.0)
    channels = min(live.ears, there), min(2, here)
    options = {"device": devices, "channels": channels, "dtype": "float32", "latency": buffer}
    try:
        with (
            suppress(KeyboardInterrupt),
            _keys() as key,
            sounddevice.Stream(
                samplerate=NEURO_RATE, blocksize=block, callback=live, **options
            ) as audio,
        ):
            late = 1000.0 * (sum(audio.latency) + live.latency / NEURO_RATE)
            print(
                f"blocks of {1000 * block / NEURO_RATE:g} ms, {late:.0f} ms late; q or Ctrl-C ends it"
            )
            end, pressed = time.monotonic() + seconds, ""
            while pressed != "q" and not live.error and (left := end - time.monotonic()) > 0.0:
                live.press(pressed := key(min(every, left)))
                print(shown.format(live.told()), end="", flush=True)
                if not audio.active:  # as PortAudio's ALSA may after a drop-out
                    live.drop_outs += 1
                    audio.stop()
                    audio.start()
    except sounddevice.PortAudioError as error:
        raise ValueError(f"the devices do not play ({error}); {_ALLOWED}") from error
    print(f"\nstopped, drop-outs {live.drop_outs}")
    if live.error:
        raise ValueError(live.error)


def _check(sounddevice: ModuleType, kind: str, device: int | str | None) -> int:
    """Channels of a device; ValueError unless it is there and takes 16 kHz."""
    named = f"the system's {kind}" if device is None else f"--{kind} {device}"
    try:
        channels = int(sounddevice.query_devices(device, kind)[f"max_{kind}_channels"])
    except (ValueError, sounddevice.PortAudioError) as error:
        raise ValueError(f"{named}: no such device ({error}); {_ALLOWED}") from error
    try:
        check = getattr(sounddevice, f"check_{kind}_settings")
        check(device=device, channels=1, dtype="float32", samplerate=NEURO_RATE)
    except (ValueError, sounddevice.PortAudioError) as error:
        raise ValueError(f"{named} does not take {NEURO_RATE} Hz ({error}); {_ALLOWED}") from error
    return channels


@contextmanager
def _keys() -> Iterator[Callable[[float], str]]:
    """A function that waits so many seconds for a key of the terminal, and returns it or an empty text."""

    def wait(seconds: float) -> str:
        time.sleep(seconds)
        return ""

    try:
        import termios
        import tty
    except ImportError:  # no such terminals on this system
        yield wait
        return
    try:
        terminal = sys.stdin.fileno()
        before = termios.tcgetattr(terminal)
    except (AttributeError, OSError, ValueError, termios.error):  # no terminal
        yield wait
        return

    def read(seconds: float) -> str:
        ready = select.select([terminal], [], [], seconds)[0]
        return os.read(terminal, 1).decode(errors="ignore") if ready else ""

    try:
        tty.setcbreak(terminal)
        yield read
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
