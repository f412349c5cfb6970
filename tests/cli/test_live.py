"""From microphone to headphones, with devices that replay a recording in blocks."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import which
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from torch import Tensor

import hlsim
from compensators import WDRC
from hlsim import Listener, load_pretrained
from hlsim.calibration import set_level
from hlsim.cli.main import main
from hlsim.cli.microphone import Live, _key_reader, play
from hlsim.extras import MissingExtraError
from hlsim.neuro.stream import SimulatedStream
from tests.compensators.aids import EAR, tone, varied_hearing_aid

FLAGS = ("input_overflow", "input_underflow", "output_overflow", "output_underflow")
NO_LOSS = SimpleNamespace(**dict.fromkeys(FLAGS, False))


class Devices:
    """A replacement of the module sounddevice.

    Args:
        recording: Signal of each microphone, (microphones, time).
        lost: Numbers of the blocks that are reported as lost.
    """

    class PortAudioError(Exception):
        pass

    def __init__(self, recording: Tensor, lost: tuple[int, ...] = ()) -> None:
        self.recording = torch.atleast_2d(recording).mT.numpy()
        self.lost = lost
        self.played = np.zeros((0, 2), dtype=np.float32)
        self.options: dict[str, Any] = {}

    def query_devices(self, device: int | str | None, kind: str) -> Any:
        if device == 99:
            raise self.PortAudioError("Error querying device 99")
        if device not in (None, 0, "Loopback"):
            raise ValueError(f"No {kind} device matching {device!r}")
        return {"max_input_channels": self.recording.shape[1]}

    def Stream(self, callback: Callable[..., None], **options: Any) -> Any:
        if options["device"][1] == "Phones":
            raise self.PortAudioError("Invalid sample rate [PaErrorCode -9997]")
        self.options = options
        starts = range(options["blocksize"], len(self.recording), options["blocksize"])
        for number, block in enumerate(np.split(self.recording, starts)):
            played = np.full((len(block), options["channels"][1]), np.nan, dtype=np.float32)
            flags = SimpleNamespace(**vars(NO_LOSS) | {"output_underflow": number in self.lost})
            callback(block, played, len(block), None, flags)
            self.played = np.concatenate((self.played, played))
        return OpenStream()


class OpenStream:
    active, latency = True, (0.01, 0.02)

    def __enter__(self) -> "OpenStream":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    start = stop = __exit__


@pytest.fixture
def recording() -> Tensor:
    """Noise of 65 dB SPL where RMS 1.0 is 100 dB SPL. Shape: (5760,), whole blocks."""
    return set_level(torch.randn(5760), 65.0, 100.0)


def assert_played(devices: Devices, expected: Tensor, tolerance: float) -> None:
    """Compare the output of each ear with what the headphones played."""
    limited = expected.clamp(-1.0, 1.0).expand(2, -1).mT.numpy()
    assert np.abs(devices.played - limited).max() < tolerance * np.abs(limited).max()


def test_the_output_of_the_aid_is_played(
    recording: Tensor, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    devices = Devices(recording, lost=(3, 9))
    monkeypatch.setitem(sys.modules, "sounddevice", devices)
    command = "live --audiogram n3 --seconds 0.05 --compensator wdrc"
    assert main(command.split()) == 0
    stream = WDRC(full_scale_spl=100.0).stream(EAR)
    stream(torch.zeros(20 * 64))  # before the devices open
    expected = stream(recording)
    assert_played(devices, expected, 1e-5)
    assert devices.options == {
        "samplerate": 16000, "blocksize": 64, "device": (None, None), "channels": (1, 2),
        "dtype": "float32", "latency": 0.02,
    }  # fmt: skip
    text = capsys.readouterr().out
    level = 10.0 * np.log10(np.square(expected.clamp(-1.0, 1.0)).mean()) + 100.0
    assert "blocks of 4 ms, delay 34 ms" in text  # 30 of the devices, 4 of the aid
    assert f"in  65.0, out {level:5.1f} dB SPL, drop-outs 2" in text
    assert text.endswith("stopped, drop-outs 2\n")


@pytest.mark.parametrize("microphones", [1, 2])
def test_each_ear_gets_the_signal_of_its_microphone_or_of_the_only_one(
    microphones: int,
    recording: Tensor,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    channels = torch.stack((recording, 0.1 * recording.roll(99)))[:microphones]
    devices, both = Devices(channels), channels.expand(2, -1)
    monkeypatch.setitem(sys.modules, "sounddevice", devices)
    listener, table = Listener("N2", "N4"), tmp_path / "ears.csv"
    rows = [f"A,{side},{','.join(ear.to_row().values())}" for side, ear in listener.ears().items()]
    table.write_text("\n".join([f"listener,ear,{','.join(EAR.to_row())}", *rows]))
    command = ["live", "--listener", str(table), "--seconds", "0.05"]
    assert main([*command, "--compensator", "wdrc"]) == 0
    stream = WDRC(full_scale_spl=100.0).stream(listener)
    stream(torch.zeros(2, 20 * 64))  # before the devices open
    expected = stream(both)
    assert devices.options["channels"] == (microphones, 2)
    assert_played(devices, expected, 1e-5)
    assert not torch.allclose(expected[0], expected[1])
    right_level = 65.0 if microphones == 1 else 45.0
    assert f"in  65.0 /  {right_level:.1f}, out " in capsys.readouterr().out

    devices.played = devices.played[:0]
    assert main([*command, "--simulate"]) == 0
    simulated = SimulatedStream(load_pretrained("neuro-msbg", full_scale_spl=100.0), listener)
    for _ in range(20):  # before the devices open
        simulated(torch.zeros(2, 576))
    perceived = torch.cat([simulated(chunk) for chunk in both.split(576, -1)], -1)
    assert perceived.any()
    assert_played(devices, perceived, 1e-4)


def test_keys_move_the_sliders_that_a_stream_has() -> None:
    aid: Any = varied_hearing_aid()
    live = Live(aid.stream(EAR, noise_reduction=1.0, amplification=0.5), 94.0)
    for key in "nnnNaAAx":
        live.press(key)
    assert live.status() == "noise reduction 0.8 (n/N), amplification 0.6 (a/A), drop-outs 0"
    for key in "A" * 9 + "n" * 12:
        live.press(key)
    assert "noise reduction 0.0 (n/N), amplification 1.0" in live.status()
    without_sliders = Live(WDRC().stream(EAR), 94.0)
    without_sliders.press("n")
    assert without_sliders.status() == "drop-outs 0"


def test_the_output_is_limited_to_full_scale_and_levels_are_those_since_the_last_call() -> None:
    live, played = Live(lambda samples: 4.0 * samples, 94.0), np.zeros((64, 2), dtype=np.float32)
    for sample, status in ((0.5, "in  88.0, out  94.0"), (0.0, "in   0.0, out   0.0")):
        live(np.full((64, 1), sample, dtype=np.float32), played, 64, None, NO_LOSS)
        assert (played == min(1.0, 4.0 * sample)).all()
        assert live.status() == f"{status} dB SPL, drop-outs 0"


def test_an_error_of_the_stream_stops_it(
    recording: Tensor, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blocks = [torch.ones(64)] * 21  # the warm-up and one block
    stream = Mock(side_effect=[*blocks, *[ValueError("the stream failed")] * 99], spec=[])
    devices = Devices(recording)
    monkeypatch.setitem(sys.modules, "sounddevice", devices)
    with pytest.raises(ValueError, match="the stream failed"):
        play(Live(stream, 94.0))
    assert not devices.played[64:].any()
    assert "stopped" in capsys.readouterr().out


def test_ctrl_c_stops_and_devices_that_stop_are_started_again(
    recording: Tensor, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "sounddevice", Devices(recording))
    with monkeypatch.context() as patch:
        patch.setattr("hlsim.cli.microphone.time.sleep", Mock(side_effect=KeyboardInterrupt))
        play(Live(WDRC().stream(EAR), 94.0))
    assert capsys.readouterr().out.endswith("stopped, drop-outs 0\n")
    start = Mock(side_effect=[None, Devices.PortAudioError("Device unavailable")])
    monkeypatch.setattr(OpenStream, "active", False)
    monkeypatch.setattr(OpenStream, "start", start)
    monkeypatch.setattr("hlsim.cli.microphone.time.sleep", Mock())
    live = Live(WDRC().stream(EAR), 94.0)
    with pytest.raises(ValueError, match="cannot be used: Device unavailable"):
        play(live)
    assert live.drop_outs == start.call_count == 2


def test_keys_are_read_from_a_terminal_whose_settings_are_restored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    termios, pty = pytest.importorskip("termios"), pytest.importorskip("pty")
    keyboard, stdin = pty.openpty()
    settings = termios.tcgetattr(stdin)
    with open(stdin, closefd=False) as terminal, monkeypatch.context() as patch:
        patch.setattr(sys, "stdin", terminal)
        with _key_reader() as read_key:
            os.write(keyboard, b"Nq")
            assert [read_key(1.0), read_key(1.0), read_key(0.01)] == ["N", "q", ""]
    assert termios.tcgetattr(stdin) == settings
    os.close(keyboard)
    os.close(stdin)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--listener nosuch.csv", "nosuch.csv"),
        ("--audiogram N3 --input 7", "No input device matching 7"),
        ("--audiogram N3 --input 99", "the devices cannot be used: Error querying device 99"),
        ("--audiogram N3 --output Phones", "Invalid sample rate [PaErrorCode -9997]; choose two"),
        ("--audiogram N3 --compensator nalr", "NALR processes whole signals only"),
        ("--audiogram N3 --simulate --amplification 1", "no effect with --simulate"),
        ("--audiogram N3 --simulate --limit-to-ear", "no effect with --simulate"),
        ("--audiogram N3 --simulate --loudness -5", "no effect with --simulate"),
        ("--audiogram N3 --compensator hearing-aid-directional", "has several microphones"),
        ("--audiogram N3 --compensator nalr --limit-to-ear", "leave out limit_to_ear"),
        ("--audiogram N3 --compensator wdrc --amplification 1", "no effect with wdrc"),
        ("--audiogram N7", "100"),
    ],
)
def test_bad_options_cause_one_line(
    arguments: str,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "sounddevice", Devices(torch.zeros(64)))
    assert main(["live", *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith("hlsim: error: ")
    assert error.count("\n") == 1
    assert message in error


def test_missing_libraries_are_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for error, fix in (
        (OSError("PortAudio library not found"), "apt install libportaudio2"),
        (MissingExtraError("pip install 'hlsim[live]'"), "hlsim[live]"),
    ):
        monkeypatch.setattr("hlsim.cli.microphone.require", Mock(side_effect=error))
        assert main(["live", "--audiogram", "N3", "--compensator", "wdrc"]) == 2
        assert fix in capsys.readouterr().err


@pytest.fixture
def server(tmp_path: Path) -> Iterator[dict[str, str]]:
    """Environment of a PulseAudio server with the sinks ``room`` and ``ears``."""
    pytest.importorskip("sounddevice")
    if not all(map(which, ("pulseaudio", "pactl", "paplay", "parec"))):
        pytest.skip("PulseAudio and its utilities are not installed")
    socket = tmp_path / "native"
    command = "pulseaudio -n --daemonize=no --exit-idle-time=-1 --use-pid-file=no".split()
    command += ["-L", f"module-native-protocol-unix socket={socket} auth-anonymous=1"]
    for name in ("room", "ears"):
        command += ["-L", f"module-null-sink sink_name={name} rate=16000"]
    environment = os.environ | {
        "XDG_RUNTIME_DIR": str(tmp_path), "HOME": str(tmp_path), "PULSE_SERVER": f"unix:{socket}",
        "PULSE_SINK": "ears", "PULSE_SOURCE": "room.monitor",
    }  # fmt: skip
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as running:
        for _ in range(100):
            if socket.exists():
                break
            time.sleep(0.1)
        yield environment
        running.terminate()


@pytest.mark.audio
def test_a_tone_in_the_room_reaches_the_ears(server: dict[str, str], tmp_path: Path) -> None:
    soundfile = pytest.importorskip("soundfile")
    sound = tone(1000.0, 65.0 - 6.0, 60.0)  # 65 dB SPL where RMS 1.0 is 100 dB SPL
    soundfile.write(tmp_path / "tone.wav", sound.numpy(), 16000)
    command = "-m hlsim live --audiogram N3 --seconds 6 --compensator wdrc --input pulse"
    command += " --output pulse --buffer-ms 100"
    # A sink asks for two seconds at once unless the latency is low.
    speaker = ["paplay", "--latency-msec=10", "--device=room", str(tmp_path / "tone.wav")]
    recorder = "parec --latency-msec=10 --device=ears.monitor --rate=16000 --channels=1"
    with (
        (tmp_path / "recording").open("wb") as file,
        subprocess.Popen(speaker, env=server) as playing,
        subprocess.Popen(
            [*recorder.split(), "--format=float32le"], env=server, stdout=file
        ) as recording,
    ):
        result = subprocess.run(
            [sys.executable, *command.split()],
            env=server,
            capture_output=True,
            text=True,
            cwd=Path(hlsim.__file__).parents[1],
        )
        playing.terminate()
        recording.terminate()
    assert result.returncode == 0, result.stderr
    status = r"in  6[45]\.\d, out  \d\d\.\d dB SPL, drop-outs \d"
    assert re.search(status, result.stdout), result.stdout
    output = WDRC(full_scale_spl=100.0)(sound[:16000], EAR)[8000:]
    expected = float(output.square().mean().log10() * 10.0 + 100.0)
    samples = np.fromfile(tmp_path / "recording", dtype=np.float32)
    blocks = samples[: len(samples) // 1600 * 1600].reshape(-1, 1600)
    levels = 10.0 * np.log10(np.square(blocks).mean(-1) + 1e-12) + 100.0
    assert (np.abs(levels - expected) < 0.5).sum() >= 20  # blocks of 0.1 s
