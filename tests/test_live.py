"""Microphone to headphones without either: devices that hand a recording on in blocks, and refuse as PortAudio does."""

import csv
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

import numpy as np
import pytest
import torch

import hlsim
from compensators import WDRC
from hlsim import Audiogram, Listener, load_pretrained
from hlsim.calibration import set_level
from hlsim.cli.main import main
from hlsim.extras import MissingExtraError
from hlsim.live import Live, SimulatedStream, _key_reader, play
from tests.compensators.aids import varied_hearing_aid

EAR = Audiogram.standard("N3")
FINE = SimpleNamespace(
    input_overflow=False, input_underflow=False, output_overflow=False, output_underflow=False
)


class Devices:
    """Stands for the module sounddevice: one microphone, or as many as the recording has channels, and headphones."""

    class PortAudioError(Exception):
        pass

    def __init__(
        self,
        recording: torch.Tensor,
        lost: tuple[int, ...] = (),
        takes: int = 16000,
        plays: int = 2,
    ) -> None:
        self.recording, self.lost, self.takes = torch.atleast_2d(recording).mT.numpy(), lost, takes
        self.plays = plays
        self.played = np.zeros((0, 2), dtype=np.float32)
        self.opened: dict[str, Any] = {}

    def query_devices(self, device: int | str | None = None, kind: str | None = None) -> Any:
        if kind is None:
            return "  0 Loopback, ALSA (1 in, 2 out)"
        if device not in (None, 0, "Loopback"):
            raise ValueError(f"No {kind} device matching {device!r}")
        return {"max_input_channels": self.recording.shape[1], "max_output_channels": self.plays}

    def _settings(self, samplerate: int, **rest: Any) -> None:
        if samplerate != self.takes:
            raise self.PortAudioError("Invalid sample rate [PaErrorCode -9997]")

    check_input_settings = check_output_settings = _settings

    def Stream(self, callback: Callable[..., None], **opened: Any) -> Any:
        self.opened = opened
        block, number = opened["blocksize"], -1
        for number, given in enumerate(
            np.split(self.recording, range(block, len(self.recording), block))
        ):
            played = np.full((len(given), opened["channels"][1]), np.nan, dtype=np.float32)
            status = SimpleNamespace(**vars(FINE) | {"output_underflow": number in self.lost})
            callback(given, played, len(given), None, status)
            self.played = np.concatenate((self.played, played))
        return _Open()


class _Open:
    active, latency = True, (0.01, 0.02)

    def __enter__(self) -> "_Open":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    start = stop = __exit__


@pytest.fixture
def recording() -> torch.Tensor:
    """Noise of 65 dB SPL where RMS 1.0 is 100 dB SPL. Shape: (6400,)."""
    return set_level(torch.randn(6400), 65.0, 100.0)


def test_what_is_played_is_what_the_aid_gives(
    recording: torch.Tensor, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    devices = Devices(recording, lost=(3, 9))
    monkeypatch.setitem(sys.modules, "sounddevice", devices)
    call = ["live", "--audiogram", "n3", "--seconds", "0.05", "--block-ms", "5"]
    assert main([*call, "--compensator", "wdrc"]) == 0
    stream = WDRC(full_scale_spl=100.0).stream(EAR)
    stream(torch.zeros(20 * 80))  # before the devices open
    expected = stream(recording).clamp(-1.0, 1.0).numpy()
    assert np.abs(devices.played - expected[:, None]).max() < 1e-5 * np.abs(expected).max()
    assert devices.opened == {
        "samplerate": 16000, "blocksize": 80, "device": (None, None), "channels": (1, 2), "dtype": "float32",
        "latency": 0.02,
    }  # fmt: skip
    out = capsys.readouterr().out
    level = 10.0 * np.log10(np.square(expected).mean()) + 100.0
    assert "blocks of 5 ms, delay 34 ms" in out  # 30 of the devices, 4 of the aid
    assert f"in  65.0, out {level:5.1f} dB SPL, drop-outs 2" in out and out.endswith(
        "stopped, drop-outs 2\n"
    )


@pytest.mark.parametrize("microphones", [1, 2])
def test_two_ears_each_have_their_own(
    microphones: int,
    recording: torch.Tensor,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Through the aid, and through the impaired ears; each hears its own microphone, or the only one."""
    given = torch.stack((recording, 0.1 * recording.roll(99)))[:microphones]
    devices = Devices(given)
    monkeypatch.setitem(sys.modules, "sounddevice", devices)
    listener = Listener(Audiogram.standard("N2"), Audiogram.standard("N4"))
    with (tmp_path / "ears.csv").open("w", newline="") as file:
        rows = csv.DictWriter(file, fieldnames=[*listener.to_rows("A")[0]])
        rows.writeheader()
        rows.writerows(listener.to_rows("A"))
    call = ["live", "--listener", str(tmp_path / "ears.csv"), "--seconds", "0.05"]
    assert main([*call, "--compensator", "wdrc"]) == 0
    stream, both = WDRC(full_scale_spl=100.0).stream(listener), given.expand(2, -1)
    stream(torch.zeros(2, 20 * 64))  # before the devices open
    expected = stream(both).clamp(-1.0, 1.0).numpy()
    assert devices.opened["channels"] == (microphones, 2)
    assert np.abs(devices.played.T - expected).max() < 1e-5 * np.abs(expected).max()
    assert not np.allclose(expected[0], expected[1])
    second = 65.0 if microphones == 1 else 45.0
    assert f"in  65.0 /  {second:.1f}, out " in capsys.readouterr().out

    devices.played = devices.played[:0]
    assert main([*call, "--simulate"]) == 0
    stream = SimulatedStream(load_pretrained("neuro-msbg", full_scale_spl=100.0), listener)
    heard = (
        torch.cat([stream(chunk) for chunk in both.split(1536, -1)], -1).clamp(-1.0, 1.0).numpy()
    )
    assert np.abs(devices.played.T - heard).max() < 1e-4 * np.abs(heard).max() > 0.0


def test_keys_move_the_sliders_that_are_there() -> None:
    aid: Any = varied_hearing_aid()
    live = Live(aid.stream(EAR, 1.0, 0.5), 94.0)
    for key in "nnnNaAAx":
        live.press(key)
    assert live.status() == "noise reduction 0.8 (n/N), amplification 0.6 (a/A), drop-outs 0"
    for key in "A" * 9 + "n" * 12:
        live.press(key)
    assert "noise reduction 0.0 (n/N), amplification 1.0" in live.status()
    plain = Live(WDRC().stream(EAR), 94.0)
    plain.press("n")
    assert plain.status() == "drop-outs 0"


def test_output_stays_within_full_scale_and_levels_begin_anew() -> None:
    live, played = Live(lambda heard: 4.0 * heard, 94.0), np.zeros((64, 2), dtype=np.float32)
    live(np.full((64, 1), 0.5, dtype=np.float32), played, 64, None, FINE)
    assert (played == 1.0).all() and live.status() == "in  88.0, out  94.0 dB SPL, drop-outs 0"
    live(np.zeros((64, 1), dtype=np.float32), played, 64, None, FINE)
    assert live.status() == "in   0.0, out   0.0 dB SPL, drop-outs 0"


def test_what_a_stream_raises_ends_it(
    recording: torch.Tensor, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = 0

    def broken(heard: torch.Tensor) -> torch.Tensor:
        nonlocal calls
        calls += 1
        if calls > 21:
            raise ValueError("enough")
        return heard

    devices: Any = Devices(recording)
    with pytest.raises(ValueError, match="enough"):
        play(Live(broken, 94.0), devices)
    assert not devices.played[64:].any() and "stopped" in capsys.readouterr().out


def test_ctrl_c_ends_it_and_devices_that_stop_are_started_again_or_told(
    recording: torch.Tensor, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    devices: Any = Devices(recording)

    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("hlsim.live.time.sleep", interrupted)
        play(Live(WDRC().stream(EAR), 94.0), devices)
    assert capsys.readouterr().out.endswith("stopped, drop-outs 0\n")
    starts: list[Any] = [None, Devices.PortAudioError("Device unavailable [PaErrorCode -9985]")]

    def start(self: _Open) -> None:
        if error := starts.pop(0):
            raise error

    monkeypatch.setattr(_Open, "active", False)
    monkeypatch.setattr(_Open, "start", start)
    monkeypatch.setattr("hlsim.live.time.sleep", lambda seconds: None)
    live = Live(WDRC().stream(EAR), 94.0)
    with pytest.raises(ValueError, match="stopped: Device unavailable"):
        play(live, devices)
    assert live.drop_outs == 2 and not starts


def test_without_terminals_there_are_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "termios", None)
    with _key_reader() as key:
        assert key(0.0) == ""


def test_a_terminal_gives_its_keys_and_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    termios, pty = pytest.importorskip("termios"), pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    with open(theirs, closefd=False) as terminal, monkeypatch.context() as patch:
        patch.setattr(sys, "stdin", terminal)
        with _key_reader() as key:
            os.write(ours, b"Nq")
            assert [key(1.0), key(1.0), key(0.01)] == ["N", "q", ""]
    assert termios.tcgetattr(theirs) == before
    os.close(ours)
    os.close(theirs)


def test_simulated_blocks_are_what_is_heard_of_the_whole() -> None:
    simulator = load_pretrained("neuro-msbg")
    stream, signal = SimulatedStream(simulator, EAR), 0.03 * torch.randn(24 * 1024)
    assert (stream.latency, stream.block) == (3200, 128)
    found = torch.cat([stream(chunk) for chunk in signal.split(1536)])
    whole = simulator(signal, EAR)
    middle = slice(stream.latency, -2 * stream.latency)  # begun from silence, as the whole does not
    found = found[stream.latency :][middle]
    assert (found - whole[: -stream.latency][middle]).abs().max() < 1e-4 * whole.abs().max()
    with pytest.raises(ValueError, match="finite receptive field"):
        SimulatedStream(load_pretrained("neuro-msbg-lstm"), EAR)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ("", "--audiogram"),
        ("--listener nosuch.csv", "nosuch.csv"),
        ("--audiogram N3 --input 7", "--input 7 cannot be used: No input device matching 7"),
        ("--audiogram N3 --output Phones", "--output Phones cannot be used"),
        ("--audiogram N3 --compensator nalr", "nalr cannot process blocks"),
        ("--audiogram N3 --simulate --amplification 1", "no effect with --simulate"),
        (
            "--audiogram N3 --compensator wdrc --amplification 1",
            "no effect with --compensator wdrc",
        ),
        ("--audiogram N7", "100"),
    ],
)
def test_bad_options_are_one_line(
    arguments: str, part: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "sounddevice", Devices(torch.zeros(64)))
    assert main(["live", *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith("hlsim: error: ") and error.count("\n") == 1 and part in error


def test_devices_that_do_not_fit_are_rejected(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mono: Any = Devices(torch.zeros(64), plays=1)
    with pytest.raises(ValueError, match="one channel, expected two"):
        play(Live(lambda samples: samples, 94.0, ears=2), mono)
    monkeypatch.setitem(sys.modules, "sounddevice", Devices(torch.zeros(64), takes=48000))
    assert main(["live", "--audiogram", "N3"]) == 2
    assert "the system's input cannot be used: Invalid sample rate" in capsys.readouterr().err
    assert main(["live", "--list-devices"]) == 0 and "Loopback" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("error", "part"),
    [
        (OSError("PortAudio library not found"), "apt install libportaudio2"),
        (MissingExtraError("pip install 'hlsim[live]'"), "hlsim[live]"),
    ],
)
def test_missing_libraries_are_named(
    error: Exception, part: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("hlsim.cli.live.require", fail)
    assert main(["live", "--audiogram", "N3"]) == 2
    assert part in capsys.readouterr().err


@pytest.fixture
def server(tmp_path: Path) -> Iterator[dict[str, str]]:
    """A PulseAudio server with two sinks that play to nobody, ``room`` and ``ears``: its environment."""
    pytest.importorskip("sounddevice")
    if not all(map(which, ("pulseaudio", "pactl", "paplay", "parec"))):
        pytest.skip("PulseAudio and its utilities are not installed")
    path = f"{tmp_path}/native"
    own = {"XDG_RUNTIME_DIR": str(tmp_path), "HOME": str(tmp_path), "PULSE_SERVER": f"unix:{path}"}
    modules = [f"module-native-protocol-unix socket={path} auth-anonymous=1"]
    modules += [f"module-null-sink sink_name={name} rate=16000" for name in ("room", "ears")]
    command = ["pulseaudio", "-n", "--daemonize=no", "--exit-idle-time=-1", "--use-pid-file=no"]
    for module in modules:
        command += ["-L", module]
    environment = os.environ | own | {"PULSE_SINK": "ears", "PULSE_SOURCE": "room.monitor"}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as running:
        for _ in range(100):
            if Path(path).exists():
                break
            time.sleep(0.1)
        yield environment
        running.terminate()


@pytest.mark.audio
def test_through_an_audio_server(server: dict[str, str], tmp_path: Path) -> None:
    """A tone of 65 dB SPL in the room is at the ears as the aid gives it."""
    soundfile = pytest.importorskip("soundfile")
    tone = set_level(
        torch.sin(2.0 * torch.pi * 1000.0 * torch.arange(16000 * 60) / 16000.0), 65.0, 100.0
    )
    soundfile.write(tmp_path / "tone.wav", tone.numpy(), 16000)
    command = [sys.executable, "-m", "hlsim", "live", "--audiogram", "N3", "--seconds", "6"]
    command += ["--compensator", "wdrc"]
    command += ["--input", "pulse", "--output", "pulse", "--buffer-ms", "100"]
    # both ask for little at a time: a sink without anybody takes up to two seconds at once
    spoken = ["paplay", "--latency-msec=10", "--device=room", str(tmp_path / "tone.wav")]
    heard = ["parec", "--latency-msec=10", "--device=ears.monitor", "--rate=16000", "--channels=1"]
    with (
        (tmp_path / "heard").open("wb") as file,
        subprocess.Popen(spoken, env=server) as speaker,
        subprocess.Popen([*heard, "--format=float32le"], env=server, stdout=file) as listener,
    ):
        ended = subprocess.run(
            command, env=server, capture_output=True, text=True, cwd=Path(hlsim.__file__).parents[1]
        )
        speaker.terminate()
        listener.terminate()
    assert ended.returncode == 0, ended.stderr
    assert re.search(r"in  6[45]\.\d, out  \d\d\.\d dB SPL, drop-outs \d", ended.stdout), (
        ended.stdout
    )
    aid = WDRC(full_scale_spl=100.0)(tone[:16000], EAR)[8000:]
    expected = float(aid.square().mean().log10() * 10.0 + 100.0)
    blocks = np.fromfile(tmp_path / "heard", dtype=np.float32)
    blocks = blocks[: len(blocks) // 1600 * 1600].reshape(-1, 1600)
    levels = 10.0 * np.log10(np.square(blocks).mean(-1) + 1e-12) + 100.0
    assert (np.abs(levels - expected) < 0.5).sum() >= 20  # tenths of a second
