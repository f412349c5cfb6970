"""Live processing from microphone to headphones: a function for each block, and its loop.

A *stream* is a function from a block of samples to its output, which stores what it needs of
earlier blocks: a ``compensators.wearable.Stream`` or a ``hlsim.neuro.stream.SimulatedStream``.
"""

import math
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import torch
from torch import Tensor

from hlsim.calibration import NEURO_RATE, level_spl
from hlsim.extras import require
from hlsim.progress import show_line

KEYS = {"noise_reduction": ("n", "N"), "amplification": ("a", "A")}
"""Keys that lower and raise each slider."""

SLIDER_STEP = 0.1
"""Change of a slider per pressed key."""

WARM_UP_BLOCKS = 20
"""Number of blocks of silence that are processed before the start, because early calls are slow."""


class Live:
    """Function that sounddevice calls with each block of the microphone, and that plays the output.

    Args:
        stream: Function from a block to its output, both with shape (time,) for one ear or
            (2, time) for two. If it has an attribute ``sliders`` and a method ``set``, as the
            stream of an aid, keys of the keyboard move its sliders.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, at microphone and headphones.
        ears: Number of ears, 1 or 2. If there are two microphones, each ear has its own.
        latency: Delay of the stream's output in samples, which is displayed.

    Attributes:
        drop_outs: Number of blocks of which samples were lost, plus the restarts of the devices.
        error: Message of an exception in the stream; empty if there was none.

    >>> from compensators import WDRC
    >>> live = Live(WDRC().stream("N3"), full_scale_spl=100.0)
    >>> live.status()
    'drop-outs 0'
    """

    def __init__(
        self,
        stream: Any,
        full_scale_spl: float,
        ears: int = 1,
        latency: int = 0,
    ) -> None:
        self.stream = stream
        self.full_scale_spl = full_scale_spl
        self.ears = ears
        self.latency = latency
        self.drop_outs = 0
        self.error = ""
        self._blocks: list[Tensor] = []

    def __call__(self, recorded: Any, played: Any, frames: int, clock: Any, status: Any) -> None:
        """Process a block; sounddevice calls this method with its arguments.

        If the stream raises an exception, the block is silent, and ``error`` has the message.

        Args:
            recorded: Input from the microphones, an array (frames, microphones). For one ear, the
                first microphone is used.
            played: Array (frames, channels) into which the output is written, limited to -1 to 1.
            frames: Number of samples per channel, which is not used.
            clock: Times of the block, which are not used.
            status: Flags of lost samples. A block with a flag is counted in ``drop_outs``.
        """
        underflow = status.input_underflow or status.output_underflow
        overflow = status.input_overflow or status.output_overflow
        self.drop_outs += bool(underflow or overflow)
        try:
            samples = torch.from_numpy(recorded.T.copy())
            samples = samples.expand(2, -1) if self.ears == 2 else samples[0]
            output = self.stream(samples).clamp(-1.0, 1.0)
            played[:] = torch.atleast_2d(output).mT.numpy()
            self._blocks.append(torch.stack((samples, output)))
        except Exception as error:  # It would be lost in the thread of the device.
            played.fill(0.0)
            self.error = str(error) or type(error).__name__

    @property
    def _sliders(self) -> dict[str, float]:
        """Values of the stream's sliders by their names, empty for a simulator."""
        return getattr(self.stream, "sliders", {})

    def press(self, key: str) -> None:
        """Move a slider by 0.1, within 0 to 1.

        Args:
            key: One of ``KEYS``: n and N for less and more noise reduction, a and A for less and
                more amplification. Other keys, and keys of a slider that the stream does not have,
                have no effect.
        """
        for name, (down, up) in KEYS.items():
            if key in (down, up) and name in self._sliders:
                step = SLIDER_STEP if key == up else -SLIDER_STEP
                value = min(1.0, max(0.0, self._sliders[name] + step))
                self.stream.set(**{name: round(value, 3)})

    def status(self) -> str:
        """Return a line of text with levels, sliders and drop-outs.

        The levels are those since the last call, in dB SPL, at least 0. Drop-outs are counted from
        the start.
        """
        blocks = self._blocks
        self._blocks = []
        parts = []
        if blocks:
            levels = level_spl(torch.cat(blocks, -1), self.full_scale_spl).clamp_min(0.0)
            texts = [
                " / ".join(f"{level:5.1f}" for level in ears)
                for ears in levels.view(2, -1).tolist()
            ]
            parts.append(f"in {texts[0]}, out {texts[1]} dB SPL")
        for name, keys in KEYS.items():
            if name in self._sliders:
                label = name.replace("_", " ")
                parts.append(f"{label} {self._sliders[name]:.1f} ({'/'.join(keys)})")
        return ", ".join([*parts, f"drop-outs {self.drop_outs}"])


def play(
    live: Live,
    *,
    devices: tuple[int | str | None, int | str | None] = (None, None),
    block: int = 64,
    buffer: float = 0.02,
    seconds: float = math.inf,
) -> None:
    """Process the sound of a microphone until the time is over, or ``q`` or Ctrl-C is pressed.

    A status line shows levels, sliders and drop-outs.

    Args:
        live: Function that processes the blocks.
        devices: Microphone and headphones, by number or part of their names; None for the default
            device of the system.
        block: Number of samples per block at 16 kHz.
        buffer: Length of the buffer of each device in seconds. Longer ones prevent drop-outs.
        seconds: Duration after which to stop.

    Raises:
        ValueError: A device does not exist, does not support 16 kHz, or has too few channels; the
            stream failed; or PortAudio is missing.
        MissingExtraError: sounddevice is not installed.

    >>> play(live, seconds=10.0)  # doctest: +SKIP
    """
    try:
        sounddevice = require("sounddevice", "live")
    except OSError as error:  # Not all wheels of sounddevice include PortAudio.
        raise ValueError(
            f"PortAudio not found ({error}); install it (Debian: apt install libportaudio2)"
        ) from error
    silence = torch.zeros(2, block) if live.ears == 2 else torch.zeros(block)
    for _ in range(WARM_UP_BLOCKS):
        live.stream(silence)
    try:
        microphones = sounddevice.query_devices(devices[0], "input")["max_input_channels"]
        options = {
            "samplerate": NEURO_RATE,
            "blocksize": block,
            "device": devices,
            "channels": (min(live.ears, microphones), 2),
            "dtype": "float32",
            "latency": buffer,
        }
        with (
            suppress(KeyboardInterrupt),
            _key_reader() as read_key,
            sounddevice.Stream(callback=live, **options) as audio,
        ):
            delay_ms = 1000.0 * (sum(audio.latency) + live.latency / NEURO_RATE)
            block_ms = 1000.0 * block / NEURO_RATE
            print(f"blocks of {block_ms:g} ms, delay {delay_ms:.0f} ms; q or Ctrl-C stops")
            _show_status(live, audio, read_key, time.monotonic() + seconds)
    except sounddevice.PortAudioError as error:
        raise ValueError(
            f"the devices cannot be used: {error}; choose two that support {NEURO_RATE} Hz and "
            "stereo headphones by --input and --output; python -m sounddevice lists them"
        ) from error
    print(f"\nstopped, drop-outs {live.drop_outs}")
    if live.error:
        raise ValueError(live.error)


def _show_status(live: Live, audio: Any, read_key: Callable[[float], str], end: float) -> None:
    """Show a status line and move sliders by keys, until ``q``, an error or the end of the time.

    The line is shown five times per second, or once per second outside a terminal.

    Args:
        live: Function that processes the blocks.
        audio: Running stream of sounddevice, which is restarted if it has stopped.
        read_key: Function from ``_key_reader``.
        end: Time of ``time.monotonic`` at which to stop.
    """
    interval = 0.2 if sys.stdout.isatty() else 1.0
    key = ""
    while key != "q" and not live.error and time.monotonic() < end:
        key = read_key(max(0.0, min(interval, end - time.monotonic())))
        live.press(key)
        show_line(live.status(), sys.stdout)
        if not audio.active:  # With ALSA, PortAudio may stop after a drop-out.
            live.drop_outs += 1
            audio.stop()
            audio.start()


@contextmanager
def _key_reader() -> Iterator[Callable[[float], str]]:
    """Yield a function that waits for a key for at most a number of seconds, and returns the key.

    It returns an empty text if no key was pressed or stdin is no terminal.
    """

    try:
        import termios
        import tty

        terminal = sys.stdin.fileno()
        settings = termios.tcgetattr(terminal)
    except Exception:  # Windows has no termios, and stdin may be closed or no terminal.
        yield _wait
        return

    def read(seconds: float) -> str:
        ready = select.select([terminal], [], [], seconds)[0]
        return os.read(terminal, 1).decode(errors="ignore") if ready else ""

    try:
        tty.setcbreak(terminal)
        yield read
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, settings)


def _wait(seconds: float) -> str:
    """Wait for a number of seconds, and return an empty text: no key was pressed."""
    time.sleep(seconds)
    return ""
