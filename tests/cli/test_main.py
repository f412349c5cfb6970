"""The command line: outputs, and errors of one line after which no files remain."""

import json
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from compensators import NALR, MappingCompensator, MappingConfig, load_compensator
from hlsim import MSBG, Audiogram, Listener
from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import set_level
from hlsim.cli.main import main
from hlsim.pretrained import save_checkpoint

N3 = Audiogram.standard("N3")


@pytest.fixture
def utterance(speech_dir: Path) -> Path:
    return sorted(speech_dir.glob("valid/*.flac"))[0]


def run(*arguments: object) -> int:
    """Run a command and return its exit status."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as end:
        assert isinstance(end.code, int)
        return end.code


def error_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that fails, and return its error, which must be one line."""
    assert run(*arguments) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1 and ": error: " in error
    return error


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["simulat"], "COMMAND"),
        (["simulate"], "hlsim simulate"),
        (["simulate", "a", "b", "--audiogram", "N3", "--loud"], "--loud"),
        (["simulate", "--full-scale-spl", "nan"], "--full-scale-spl"),
        (["compensate", "--amplification", "2"], "--amplification"),
        (["compensate", "a", "b", "--audiogram", "N3", "--listener", "c"], "--listener"),
        (["haspi-report", "--spl", "65", "--full-scale-spl", "94", "--out", "o"], "--spl"),
        (["demo", "--out", __file__], "is not a folder"),
        (["haspi-report", "--seed", "1.5"], "--seed"),
    ],
)
def test_options_that_cannot_be_read_are_named(
    capsys: pytest.CaptureFixture[str], arguments: list[str], part: str
) -> None:
    error = error_of(capsys, *arguments)
    assert part in error and error.endswith("--help")


@pytest.mark.parametrize("simulator", ["msbg", "neuro-msbg"])
@pytest.mark.parametrize(("rate", "channels"), [(16000, 1), (44100, 2), (96000, 1)])
def test_simulate_keeps_rate_channels_and_length(
    tmp_path: Path, simulator: str, rate: int, channels: int
) -> None:
    samples = np.random.default_rng(0).standard_normal((rate // 2, channels)) * 0.02
    soundfile.write(tmp_path / "in.wav", samples, rate, subtype="FLOAT")
    files = (tmp_path / "in.wav", tmp_path / "out.wav")
    assert run("simulate", *files, "--audiogram", "n3", "--simulator", simulator) == 0
    output, output_rate = soundfile.read(tmp_path / "out.wav", always_2d=True)
    assert (output_rate, output.shape) == (rate, samples.shape)
    assert 0 < np.std(output) < np.std(samples)


@pytest.mark.parametrize("levels", ["30,35,40,50,55,60,65,70", "-10 -5 0 10 20 30 40 50"])
def test_simulate_is_the_model(tmp_path: Path, utterance: Path, levels: str) -> None:
    options = ("--audiogram", levels, "--simulator", "msbg", "--full-scale-spl", "100")
    assert run("simulate", utterance, tmp_path / "out.wav", *options) == 0
    waveform, rate = read_audio(utterance)
    ear = Audiogram(tuple(map(float, levels.replace(",", " ").split())))
    expected = MSBG(ear, sample_rate=rate, full_scale_spl=100.0)(waveform)
    torch.testing.assert_close(read_audio(tmp_path / "out.wav")[0], expected, atol=1e-7, rtol=0)


@pytest.mark.parametrize("name", ["nalr", "NAL-R"])
def test_compensate_is_the_compensator(tmp_path: Path, utterance: Path, name: str) -> None:
    call = ("compensate", utterance, tmp_path / "out.wav", "--compensator", name, "--audiogram")
    assert run(*call, "N3") == 0
    waveform, rate = read_audio(utterance)
    expected = NALR(N3, sample_rate=rate)(waveform)
    torch.testing.assert_close(read_audio(tmp_path / "out.wav")[0], expected, atol=1e-7, rtol=0)
    assert run(*call, "N7") == 0  # N7 exceeds the range of a simulator.


def test_sliders_reach_the_hearing_aid(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = ("compensate", utterance, tmp_path / "out.wav", "--audiogram", "N3")
    assert run(*call, "--noise-reduction", "0.5", "--amplification", "0") == 0
    waveform, rate = read_audio(utterance)
    expected = load_compensator("hearing-aid", sample_rate=rate)(waveform, N3, 0.5, 0.0)
    torch.testing.assert_close(read_audio(tmp_path / "out.wav")[0], expected, atol=1e-6, rtol=1e-5)
    capsys.readouterr()
    error = error_of(capsys, *call, "--compensator", "nalr", "--noise-reduction", "1")
    assert "--noise-reduction has no effect" in error


def listeners_csv(folder: Path, **listeners: Listener) -> Path:
    rows = [row for name, listener in listeners.items() for row in listener.to_rows(name)]
    lines = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
    (folder / "ears.csv").write_text("\n".join(lines))
    return folder / "ears.csv"


def test_both_ears_of_a_stereo_file(tmp_path: Path, utterance: Path) -> None:
    waveform, rate = read_audio(utterance)
    scene, out = torch.cat((waveform, 0.3 * waveform))[:, :rate], tmp_path / "out.wav"
    write_audio(tmp_path / "in.wav", scene, rate)
    listener = Listener(Audiogram.standard("N2"), Audiogram.standard("N4"))
    entry = {
        "audiogram_levels_l": [*Audiogram.standard("N2").levels],
        "audiogram_levels_r": [*Audiogram.standard("N4").levels],
        "audiogram_cfs": [*FREQUENCIES],
    }
    (tmp_path / "listeners.json").write_text(json.dumps({"L1": entry, "L2": entry}))
    csv, json_name = listeners_csv(tmp_path, a=listener), f"{tmp_path / 'listeners.json'}:L2"
    files = (tmp_path / "in.wav", out)
    assert run("simulate", *files, "--simulator", "msbg", "--listener", csv) == 0
    expected = MSBG(listener, sample_rate=rate)(scene)
    torch.testing.assert_close(read_audio(out)[0], expected, atol=1e-6, rtol=1e-5)
    options = ("--compensator", "wdrc", "--linked", "--listener", json_name)
    assert run("compensate", *files, *options) == 0
    expected = load_compensator("wdrc", sample_rate=rate, linked=True)(scene, listener)
    torch.testing.assert_close(read_audio(out)[0], expected, atol=1e-6, rtol=1e-5)


def test_listeners_that_do_not_fit_are_rejected(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = listeners_csv(tmp_path, a=Listener(N3, N3), b=Listener(None, N3))
    call = ("compensate", utterance, tmp_path / "out.wav")
    for listener in (path, f"{path}:c", f"{path}:b", f"{path}:a", "N3"):
        error_of(capsys, *call, "--listener", listener)
    error_of(capsys, *call, "--audiogram", "N3", "--linked")
    assert not (tmp_path / "out.wav").exists()


@pytest.mark.parametrize(("ear", "warnings"), [("N4", 0), ("N3", 1)])
def test_a_compensator_for_another_ear_warns_once(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], ear: str, warnings: int
) -> None:
    model = MappingCompensator(MappingConfig(channels=8, blocks=1))
    about = {"audiogram": Audiogram.standard("N4").to_dict()}
    save_checkpoint(tmp_path / "mine", "mapping-compensator", model, model.config.to_dict(), about)
    (tmp_path / "in").mkdir()
    for rate in (16000, 48000):
        soundfile.write(tmp_path / "in" / f"{rate}.wav", np.full(rate // 10, 0.01), rate)
    for source, target in ((utterance, "out.wav"), (tmp_path / "in", "out")):
        options = ("--audiogram", ear, "--compensator", tmp_path / "mine")
        assert run("compensate", source, tmp_path / target, *options) == 0
        assert capsys.readouterr().err.count("was trained for one ear") == warnings


@pytest.mark.parametrize(
    "audiogram",
    [
        "10,20,30,40,50,60,70",
        "10,20,30,40,50,60,70,130",
        "10,20,30,x,50,60,70,80",
        "N7",
        "N9",
    ],
)
def test_audiograms_that_no_simulator_accepts(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], audiogram: str
) -> None:
    error_of(capsys, "simulate", utterance, tmp_path / "out.wav", "--audiogram", audiogram)
    assert not list(tmp_path.iterdir())


def test_paths_that_cannot_be_read_or_written(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, text = tmp_path / "in.flac", tmp_path / "text.wav"
    source.write_bytes(utterance.read_bytes())
    text.write_text("this is no audio")
    (tmp_path / "folder").mkdir()
    before = set(tmp_path.rglob("*"))
    for path, target in (
        (tmp_path / "missing.wav", tmp_path / "o.wav"),
        (text, tmp_path / "o.wav"),
        (source, tmp_path / "none" / "o.wav"),
        (source, tmp_path / "o.mp3"),
        (source, source),
        (source, tmp_path / "folder"),
        (tmp_path / "folder", text),
        (tmp_path / "folder", tmp_path / "folder" / "new"),
        (tmp_path / "folder", tmp_path),
        (tmp_path / "folder", tmp_path / "new"),
    ):
        error = error_of(capsys, "simulate", path, target, "--audiogram", "N3")
        assert str(path) in error or str(target) in error or str(target.parent) in error
    options = ("--audiogram", "N3", "--simulator", "no-such-model")
    error_of(capsys, "simulate", source, tmp_path / "o.wav", *options)
    assert set(tmp_path.rglob("*")) == before


def test_folders_keep_their_tree_and_unused_files_are_reported(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in" / "a").mkdir(parents=True)
    for name in ("one.flac", "a/two.flac"):
        (tmp_path / "in" / name).write_bytes(utterance.read_bytes())
    (tmp_path / "in" / "a" / "broken.wav").write_text("this is no audio")
    (tmp_path / "in" / "notes.txt").touch()
    call = ("compensate", tmp_path / "in", tmp_path / "out", "--audiogram", "N3", "--compensator")
    assert run(*call, "nobody") == 2 and not (tmp_path / "out").exists()
    assert "no checkpoint 'nobody'" in capsys.readouterr().err
    assert run(*call, "nalr") == 2
    printed = capsys.readouterr()
    assert "files that are not audio, not used: 1 (.txt)" in printed.err
    assert "broken.wav: cannot be read" in printed.err and "1 of 3 files" in printed.err
    written = {
        path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.wav")
    }
    assert written == {"one.wav", "a/two.wav"} and printed.out.count("dB SPL, output") == 2
    (tmp_path / "in" / "one.mp3").touch()
    assert run(*call, "nalr") == 2 and "would both be written" in capsys.readouterr().err


def test_a_presentation_level_is_that_of_the_input(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    waveform, rate = read_audio(utterance)
    calibrated = set_level(waveform, 50.0)
    aid = load_compensator("wdrc", sample_rate=rate)
    gain = float(calibrated.abs().max() / waveform.abs().max())
    options = ("--audiogram", "N3", "--spl", "50")
    for command, model in (("simulate", MSBG(N3, sample_rate=rate)), ("compensate", aid)):
        option = ("--compensator", "wdrc") if command == "compensate" else ()
        assert run(command, utterance, tmp_path / "out.wav", *options, *option) == 0
        assert "input 50.0 dB SPL" in capsys.readouterr().out
        inputs = (calibrated,) if command == "simulate" else (calibrated, N3)
        expected = model(*inputs) / gain  # at the scale of the file
        output = read_audio(tmp_path / "out.wav")[0]
        torch.testing.assert_close(output, expected, atol=1e-5, rtol=1e-4)
    both = ("--full-scale-spl", "94")
    error_of(capsys, "simulate", utterance, tmp_path / "out.wav", *options, *both)


def test_a_folder_causes_one_warning_about_clipping(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    for number in range(3):
        (tmp_path / "in" / f"{number}.flac").write_bytes(utterance.read_bytes())
    call = ("compensate", tmp_path / "in", tmp_path / "out", "--audiogram", "N4")
    assert run(*call, "--compensator", "Nal-R") == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert "0.wav (and 2 more): the peak is" in warning and "lower the level by" in warning


@pytest.mark.parametrize("name", ["out.flac", "out.OGG", "out.mp3"])
def test_compensate_rejects_other_formats_than_wav_at_once(
    tmp_path: Path,
    utterance: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
) -> None:
    monkeypatch.setattr("hlsim.audio.read_audio", None)
    call = ("compensate", utterance, tmp_path / name, "--audiogram", "N4")
    assert "expected the extension .wav" in error_of(capsys, *call)


@pytest.mark.parametrize(
    ("command", "level", "model", "clips", "is_dull"),
    [
        ("compensate", 0.001, "wdrc", False, False),
        ("compensate", 0.001, "compensator-general", False, True),
        ("compensate", 1.0, "nalr", True, False),
        ("simulate", 0.001, "neuro-msbg", False, True),
        ("simulate", 0.001, "msbg", False, False),
    ],
)
def test_clipping_and_a_missing_upper_band_are_warned_of(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: str,
    level: float,
    model: str,
    clips: bool,
    is_dull: bool,
) -> None:
    noise = np.random.default_rng(0).standard_normal(48000)
    soundfile.write(tmp_path / "in.wav", level * noise, 48000, subtype="FLOAT")
    option = {"compensate": "--compensator", "simulate": "--simulator"}[command]
    ear = {"compensate": "N3", "simulate": "N5"}[command]
    files = (tmp_path / "in.wav", tmp_path / "out.wav")
    assert run(command, *files, "--audiogram", ear, option, model) == 0
    error = capsys.readouterr().err
    assert ("players will clip" in error, "above 8 kHz was removed" in error) == (clips, is_dull)


def test_options_that_contradict_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = ("--speech", "s", "--audiograms", "a", "--out", tmp_path / "o")
    error = error_of(capsys, "evaluate-simulator", "msbg", *data, "--compensator", "nalr")
    assert "--compensator has no effect" in error
    options = ("--audiogram", "N3", "--gain-ears", "S3")
    assert "--gain-ears has no effect" in error_of(
        capsys, "evaluate-compensator", "nalr", "--speech", "s", "--out", tmp_path / "o", *options
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "module", "extra"),
    [
        ("train-compensator --speech s --out o", "tensorboard", "train"),
        ("evaluate-simulator msbg --speech s --audiograms a --out o", "pystoi", "eval"),
        ("demo --out o", "matplotlib", "eval"),
    ],
)
def test_a_missing_extra_names_the_command_that_installs_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    module: str,
    extra: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    assert f"pip install 'hlsim[{extra}]'" in error_of(capsys, *command.split())
    assert not list(tmp_path.iterdir())


def test_haspi_report_of_a_manifest(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("joblib", "matplotlib", "pystoi"):
        pytest.importorskip(module)
    samples, rate = soundfile.read(utterance)
    for name, gain in (("clean", 1.0), ("aided", 4.0)):
        second = gain * samples[rate : 2 * rate]
        soundfile.write(tmp_path / f"{name}.wav", second, rate, subtype="FLOAT")
    (tmp_path / "broken.wav").write_text("this is no audio")
    rows = ["listener,ear,condition,clean,processed,audiogram"]
    rows += ["L1,l,unaided,clean.wav,clean.wav,N4", "L1,l,aided,clean.wav,aided.wav,N4"]
    rows += ["L2,r,unaided,clean.wav,clean.wav,N2", "L2,r,aided,clean.wav,broken.wav,N2"]
    (tmp_path / "study.csv").write_text("\n".join(rows))
    out = tmp_path / "out"
    call = ("haspi-report", "--manifest", tmp_path / "study.csv", "--out", out, "--jobs", "1")
    call += ("--measures", "stoi", "--spl", "65", "--listen", "1")
    assert run(*call) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("aided") and "report.html" in printed.out
    assert "1 of 4 outputs lack scores" in printed.err
    scores = [row["stoi"] for row in json.loads((out / "report.json").read_text())["rows"]]
    assert [score is None for score in scores] == [False, False, False, True]
    stored = (out / "scores.jsonl").read_text()
    assert run(*call) == 0 and (out / "scores.jsonl").read_text() == stored
    capsys.readouterr()
    for option, value in (
        ("--measures", "loud"),
        ("--root", tmp_path / "none"),
        ("--baseline", "x"),
    ):
        assert str(value) in error_of(capsys, *call, option, value)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_stopped_command_says_how_to_continue(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    utterance: Path,
    tmp_path: Path,
    number: int,
    status: int,
) -> None:
    def stop(*_: object, **__: object) -> None:
        if number == signal.SIGINT:  # A background job ignores this signal.
            raise KeyboardInterrupt
        signal.raise_signal(number)

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr("hlsim.audio.read_audio", stop)
    assert run("simulate", utterance, tmp_path / "out.wav", "--audiogram", "N3") == status
    assert "run the same command again" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before
