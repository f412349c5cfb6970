"""The command line: outputs, and errors of one line after which no files remain."""

import io
import json
import math
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import soundfile
import torch
from torch import Tensor

import hlsim
from compensators import (
    NALR,
    MappingCompensator,
    MappingConfig,
    load_compensator,
    save_compensator,
)
from hlsim import MSBG, Audiogram, Listener
from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import level_spl, set_level
from hlsim.checkpoint import save_checkpoint
from hlsim.cli.evaluation import _read_labels
from hlsim.cli.inputs import warn_of_other_ears
from hlsim.cli.main import main, make_parser
from hlsim.evaluation.fitting.gain_tables import export_gains
from tests.helpers import write_table

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


@pytest.mark.parametrize("module", ["hlsim", "hlsim.cli.main"])
def test_the_program_runs_as_a_module(module: str) -> None:
    command = [sys.executable, "-m", module, "simulat"]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 2 and "did you mean simulate?" in ended.stderr


def error_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that fails, and return its error, which must be one line."""
    assert run(*arguments) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1 and ": error: " in error
    return error


def check_output(path: Path, expected: Tensor, atol: float = 1e-6) -> None:
    torch.testing.assert_close(read_audio(path)[0], expected, atol=atol, rtol=1e-4)


ERRORS = """simulat | did you mean simulate?
loud | there is no command 'loud'; see
compensate {speech} {out} --audiogram N3 --compensator nal-r | did you mean nalr?
simulate {speech} {out} --audiogram N3 --simulator neuro-msgb | did you mean neuro-msbg?
simulate | hlsim simulate
simulate {speech} b --audiogram N3 --loud | --loud
simulate {speech} {out} --audiogram N3 --full-scale-spl nan | --full-scale-spl
simulate {speech} {out} --audiogram N3 --spl 1e4 | a level in dB SPL from -20 to 140
simulate {speech} {out} --audiogram N3 --spl -300 | a level in dB SPL from -20 to 140
simulate {speech} {out} --audiogram 500:30,4000:60,500.0:60 | one level for each frequency
train-simulator --speech {folder} --max-minutes 1e300 --out {out} | at most 1,000,000
train-simulator --speech {folder} --workers -1 --out {out} | from 0 to 1,024
train-simulator --speech {folder} --recipe.seconds 1e9 --out {out} | seconds is
train-simulator --speech {folder} --recipe.seed 99999999999 --out {out} | seed is
evaluate-compensator nalr --speech {folder} --seed 99999999999 --out {out} | --seed
evaluate-compensator nalr --speech {folder} --jobs 0 --out {out} | --jobs
evaluate-compensator nalr --speech {folder} --levels 65 1e9 --out {out} | --levels
prepare {folder} --valid-share nan --out {out} | a number from 0 to 1
simulate {speech} b --audiogram N3 --spl 65 --full-scale-spl 94 | --full-scale-spl
compensate {speech} {out} --audiogram N3 --amplification 2 | from 0 to 1
compensate {speech} b --audiogram N3 --listener c | --listener
haspi-report --spl 65 --full-scale-spl 94 --out o | --full-scale-spl
haspi-report --seed 1.5 | --seed
demo --steps 0 | a whole number, 1 or more
live | --listener
simulate {missing} {out} --audiogram N3 | missing.wav', expected an existing file or folder
simulate {speech} {out} --audiogram 10,20,30,40,50,60,70 | got 7 levels for 8 frequencies
simulate {speech} {out} --audiogram 10,20,30,40,50,60,70,130 | 120 dB HL
simulate {speech} {out} --audiogram 10,20,30,x,50,60,70,80 | --audiogram
simulate {speech} {out} --audiogram N9 | N9
train-simulator --out {out} | --manifest
train-simulator --speech {folder} --manifest {text} --out {out} | --manifest
train-simulator --manifest {missing} --out {out} | --manifest
train-simulator --manifest {folder}/.. --out {out} | cannot read the manifest
train-compensator --speech {folder} --audiogram N3 --audiograms {text} --out {out} | one ear
train-compensator --speech {folder} --recipe {folder} --out {out} | folder
prepare {folder} --out {out} | no audio in it
simulate {text} {out} --audiogram N3 | text.wav: cannot be read
simulate {speech} {folder}/o.mp3 --audiogram N3 | o.mp3: expected the extension
simulate {speech} {speech} --audiogram N3 | refusing to overwrite
simulate {speech} {folder} --audiogram N3 | name the file to write
simulate {folder} {folder}/new --audiogram N3 | neither is inside
simulate {folder} {folder}/.. --audiogram N3 | nor contains
simulate {folder} {folder}-new --audiogram N3 | no audio in it
simulate {speech} {out} --audiogram N3 --simulator no-such-model | no-such-model
simulate {speech} {out} --audiogram N7 | 100 dB HL
compensate {speech} {out} --audiogram N3 --compensator nalr --noise-reduction 1 | have no effect
compensate {speech} {out} --listener {ears} | NAME is one of the 2 listeners, such as a, b
compensate {speech} {out} --listener {ears}:c | no listener 'c'
compensate {speech} {out} --listener {ears}:b | expected two ears
compensate {speech} {out} --listener {ears}:a | two channels for two ears, left first (a stereo
compensate {speech} {out} --audiogram N3 --compensator wdrc --linked | expected two channels
listen {speech} --listener {ears}:a --out {out} | in.flac: expected two channels
simulate {speech} {out} --audiogram 10,20 | such as 500:20,4000:50 on the command line
simulate {speech} {out} --audiogram 500:30,500:60 | one level for each frequency
evaluate-compensator nalr --speech {speech} --out {out} --loudness 50:0,50:1 | one number for
evaluate-compensator nalr --speech {folder} --out {out} --limit-to-ear | leave out limit_to_ear
compensate {speech} {out} --audiogram N3 --compensator nalr --limit-to-ear | leave out limit_to_ear
evaluate-compensator nalr --speech {folder} --out {out} --rival NAL-R | (did you mean nalr?)
export-gains --audiogram N3 --to CamillaDSP | no format 'CamillaDSP' (did you mean camilladsp?)
evaluate-compensator nalr --speech {folder} --out {out} --levels 65,x | got 'x'
compensate {speech} {out} --audiogram N3 --ucl 500:90 | without --limit-to-ear
compensate {speech} {out} --listener {ears}:a --limit-to-ear --ucl 500:90 | such as ucl_left_500
evaluate-compensator wdrc --speech {folder} --out {out} --limit-to-ear --ucl 500:90 | --audiograms
compensate {speech} {out} --audiogram N3 --audiogram N4 --limit-to-ear --ucl 500:90 | got 2 ears
compensate {speech} {out} --audiogram N3 --limit-to-ear --ucl 500 | such as 500:100,1000:95
compensate {speech} {out} --audiogram N3 --limit-to-ear --ucl 500:900 | got 900 at 500 Hz
compensate {speech} {out} --audiogram N3 --compensator nalr --loudness -5 | leave out loudness
compensate {speech} {out} --audiogram N3 --loudness 5 | expected a number from -40 to 0
listen {speech} --audiogram N3 --loudness -5 --out {out} | no effect without an aid
srt --audiogram N3 --loudness -5 | --loudness: no effect without an aid
srt --audiogram N3 --seed -1 | a whole number from 0 to 4,294,967,295
live --audiogram N3 --simulate --amplification 1 | --amplification: no effect with --simulate
simulate {speech} {out} --audiogram 500:30,1000 | expected a name such as N3
compensate {speech} {out} --listener N3 | N3: cannot read audiograms
evaluate-simulator m --speech {folder} --audiograms standard --out o --compensator nalr | no effect
train-simulator --speech {folder} --root {folder} --out o | no effect without --manifest
evaluate-compensator nalr a=nalr a=wdrc --speech {folder} --out {out} | LABEL=NAME
listen {speech} --audiogram N3 --compensator hearing-aid-directional --out {out} | per ear
srt --audiogram N3 --compensator hearing-aid-directional | one signal per ear
listen {speech} --audiogram N3 --out {folder} | got a folder; add a name
listen {speech} --audiogram N3 --out {text}/page.html | text.wav is a file
listen {text} {speech} --audiogram N3 --out {speech} | refusing to overwrite the input
verify {speech} {speech} --audiogram N3 --csv {speech} | refusing to overwrite the input
verify {speech} {speech} --audiogram N3 --plot {folder} | got a folder; add a name
listen {speech} {text} --audiogram N3 --simulator no-such --out {out} | text.wav: cannot
haspi-report --clean {folder} --after {folder} --out {text} | text.wav is a file
evaluate-compensator nalr --speech {folder} --out {text}/judged | text.wav is a file
evaluate-compensator nalr --speech {folder} --seconds 0.6 --out {out} | a number from 0.7
evaluate-compensator nalr --speech {folder} --simulator msbg --out {out} | checkpoint 'msbg'; e
evaluate-compensator nalr --speech {folder} --measure none:f --out {out} | measure none:f
evaluate-simulator msbg --speech {folder} --audiograms standard --teacher x --out o | checkpoint
train-compensator --speech {folder} --recipe.weights.haspi 1 --out {out} | seconds is 0.6
train-simulator --speech {folder} --recipe.levels [80,.nan] --out {out} | levels is (80.0, nan)
train-compensator --speech {folder} --recipe.snr [20,0] --out {out} | snr is (20.0, 0.0)"""


@pytest.mark.parametrize("line", ERRORS.splitlines())
def test_errors_are_one_line_and_nothing_is_written(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], line: str
) -> None:
    names = {"speech": "in.flac", "text": "text.wav", "missing": "missing.wav", "out": "out.wav"}
    paths = {name: tmp_path / file for name, file in {**names, "folder": "folder"}.items()}
    paths["folder"].mkdir()
    paths["speech"].write_bytes(utterance.read_bytes())
    paths["text"].write_text("this is no audio")
    paths["ears"] = write_listeners(tmp_path, a=Listener(N3, N3), b=Listener(None, N3))
    before = set(tmp_path.rglob("*"))
    call, part = line.split(" | ")
    error = error_of(capsys, *call.format(**paths).split())
    assert part in error
    assert "torch." not in error  # advice in Python does not help on the command line
    assert error.endswith("--help") or error.startswith("hlsim: error: ")
    assert set(tmp_path.rglob("*")) == before


SLOPING = Audiogram((-10.0, -5.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0))
N7 = Audiogram.standard("N7")  # N7 exceeds the range of a simulator.
OUTPUTS: dict[str, Callable[[Tensor, int], Tensor]] = {
    "simulate --audiogram -10,-5,0,10,20,30,40,50 --full-scale-spl 100": (
        lambda wave, rate: MSBG(SLOPING, sample_rate=rate, full_scale_spl=100.0)(wave)
    ),
    "compensate --audiogram N3 --compensator nalr": (
        lambda wave, rate: NALR(N3, sample_rate=rate)(wave)
    ),
    "compensate --audiogram N7 --compensator nalr": (
        lambda wave, rate: NALR(N7, sample_rate=rate)(wave)
    ),
    "compensate --audiogram N3 --noise-reduction 0.5 --amplification 0": (
        lambda wave, rate: load_compensator("hearing-aid", sample_rate=rate)(wave, N3, 0.5, 0.0)
    ),
}


@pytest.mark.parametrize("call", OUTPUTS)
def test_the_output_is_that_of_the_library(tmp_path: Path, utterance: Path, call: str) -> None:
    assert run(*call.split(), utterance, tmp_path / "out.wav") == 0
    check_output(tmp_path / "out.wav", OUTPUTS[call](*read_audio(utterance)), 1e-7)


def test_a_presentation_level_is_that_of_the_input(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    waveform, rate = read_audio(utterance)
    calibrated = set_level(waveform, 50.0)
    gain = float(calibrated.abs().max() / waveform.abs().max())
    aid = load_compensator("wdrc", sample_rate=rate)
    outputs = {
        ("simulate",): MSBG(N3, sample_rate=rate)(calibrated),
        ("compensate", "--compensator", "wdrc"): aid(calibrated, N3),
    }
    files = (utterance, tmp_path / "out.wav")
    for (command, *options), expected in outputs.items():
        assert run(command, *files, "--audiogram", "N3", "--spl", "50", *options) == 0
        assert "input 50.0 dB SPL" in capsys.readouterr().out
        check_output(tmp_path / "out.wav", expected / gain, atol=1e-5)  # at the file's scale


def test_several_ears_give_one_output_each(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    waveform, rate = read_audio(utterance)
    ears = ("n2", "500:30,4000:60", "10,10,20,20,30,40,50,60")
    names = ("N2", "500_30-4000_60", "10-10-20-20-30-40-50-60")
    options = [word for ear in ears for word in ("--audiogram", ear)]
    call = ("compensate", utterance, tmp_path / "out.wav", "--compensator", "nalr", *options)
    assert run(*call) == 0
    printed = capsys.readouterr().out
    values: list[Any] = ["N2", {500: 30, 4000: 60}, [10, 10, 20, 20, 30, 40, 50, 60]]
    for name, ear in zip(names, values, strict=True):
        path = tmp_path / f"out-{name}.wav"
        check_output(path, NALR(sample_rate=rate)(waveform, ear))
        assert printed.count(f"{path}: ") == 1
    assert len(list(tmp_path.iterdir())) == 3
    assert "N2 appears twice" in error_of(capsys, *call, "--audiogram", "N2")
    (tmp_path / "out-N2.wav").replace(tmp_path / "a-N2.wav")
    call = ("simulate", tmp_path / "a-N2.wav", tmp_path / "a.wav", "--audiogram")
    assert "refusing to overwrite" in error_of(capsys, *call, "N2", "--audiogram", "N4")


def test_no_clipping_makes_a_loud_output_softer(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    waveform, rate = read_audio(utterance)
    output = NALR(N3, sample_rate=rate)(waveform / waveform.abs().max())
    write_audio(tmp_path / "loud.wav", waveform / waveform.abs().max(), rate)
    call = ("compensate", tmp_path / "loud.wav", tmp_path / "out.wav", "--compensator", "nalr")
    call += ("--audiogram", "N3", "--no-clipping")
    peak = float(output.abs().max())
    assert run(*call) == 0 and peak > 1.0
    check_output(tmp_path / "out.wav", output * 0.9 / peak)
    softer_db = 20.0 * math.log10(peak / 0.9)
    assert f"the file is {softer_db:.1f} dB softer" in capsys.readouterr().out
    write_audio(tmp_path / "loud.wav", 0.001 * waveform, rate)
    assert run(*call) == 0 and "softer" not in capsys.readouterr().out


def write_listeners(folder: Path, **listeners: Listener) -> Path:
    rows = [
        {"listener": name, "ear": side, **ear.to_row()}
        for name, listener in listeners.items()
        for side, ear in listener.ears().items()
    ]
    return write_table(folder / "ears.csv", rows)


def test_both_ears_of_a_stereo_file(tmp_path: Path, utterance: Path) -> None:
    """Listeners of a CSV file, and of a JSON file in which another listener is incomplete."""
    waveform, rate = read_audio(utterance)
    scene, out = torch.cat((waveform, 0.3 * waveform))[:, :rate], tmp_path / "out.wav"
    write_audio(tmp_path / "in.wav", scene, rate)
    listener = Listener(Audiogram.standard("N2"), Audiogram.standard("N4"))
    entry = {
        "audiogram_levels_l": [*Audiogram.standard("N2").levels],
        "audiogram_levels_r": [*Audiogram.standard("N4").levels],
        "audiogram_cfs": [*FREQUENCIES],
    }
    entries = {"L1": {**entry, "audiogram_levels_l": [10]}, "L2": entry}
    (tmp_path / "listeners.json").write_text(json.dumps(entries))
    files = (tmp_path / "in.wav", out)
    assert run("simulate", *files, "--listener", write_listeners(tmp_path, a=listener)) == 0
    check_output(out, MSBG(listener, sample_rate=rate)(scene))
    options = ("--compensator", "wdrc", "--linked", "--listener")
    assert run("compensate", *files, *options, f"{tmp_path / 'listeners.json'}:L2") == 0
    check_output(out, load_compensator("wdrc", sample_rate=rate, linked=True)(scene, listener))
    (tmp_path / "two.csv").write_text("listener,left_500,right_500,ucl_right_500\na,60,40,75\n")
    listener = Listener({500: 60}, Audiogram({500: 40}, ucl={500: 75}))
    options = ("--compensator", "wdrc", "--limit-to-ear", "--spl", 80, "--listener")
    assert run("compensate", *files, *options, tmp_path / "two.csv") == 0
    gain = 10.0 ** ((80.0 - float(level_spl(scene.flatten()))) / 20.0)
    aid = load_compensator("wdrc", sample_rate=rate, limit_to_ear=True)
    check_output(out, aid(gain * scene, listener) / gain)


@pytest.mark.parametrize("ears", [1, 2])
def test_channels_are_the_microphones_of_a_checkpoint_that_takes_them(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], ears: int
) -> None:
    waveform, rate = read_audio(utterance)
    scene, out = waveform[:, :4000] * torch.linspace(1.0, 0.5, 4)[:, None], tmp_path / "out.wav"
    write_audio(tmp_path / "in.wav", scene, rate)
    config = MappingConfig(channels=4, blocks=1, microphones=4 // ears, ears=ears)
    aid = MappingCompensator(config=config, sample_rate=rate).requires_grad_(False)
    torch.nn.init.normal_(aid.weight_decoder.leave.bias)  # type: ignore[union-attr]
    save_compensator(aid, tmp_path / "aid")
    command = ["compensate", tmp_path / "in.wav", out, "--compensator", tmp_path / "aid"]
    ear: Any = "N2"
    options: list[Any] = ["--audiogram", "N2"]
    if ears == 2:
        ear = Listener("N2", "N4")
        options = ["--listener", write_listeners(tmp_path, a=ear)]
    command += options
    assert run(*command) == 0
    signals = scene.reshape(2, 2, -1) if ears == 2 else scene
    check_output(out, aid(signals, ear).reshape(ears, -1))
    if ears == 1:
        listener = write_listeners(tmp_path, a=Listener("N2", "N4"))
        assert run(*command[:5], "--listener", listener) == 2
        assert "microphones at one ear" in capsys.readouterr().err
    write_audio(tmp_path / "in.wav", scene[:3], rate)
    assert run(*command) == 2
    assert f"expected signals of {4 // ears} microphones per ear" in capsys.readouterr().err


def test_a_directional_aid_has_the_sliders_and_gains_of_its_hearing_aid(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    waveform, rate = read_audio(utterance)
    scene, out = waveform[:, :rate].expand(4, -1), tmp_path / "out.wav"
    write_audio(tmp_path / "in.wav", scene, rate)
    name = "hearing-aid-directional"
    options = ("--audiogram", "N3", "--compensator", name)
    assert run("compensate", tmp_path / "in.wav", out, *options, "--amplification", 0.5) == 0
    aid = load_compensator(name, sample_rate=rate)
    check_output(out, aid(scene.reshape(2, 2, -1), "N3", amplification=0.5))
    capsys.readouterr()
    assert run("export-gains", *options, "--to", "csv") == 0
    assert capsys.readouterr().out == export_gains(aid.aid, "N3", "csv")


def test_measured_uncomfortable_levels_of_one_ear(tmp_path: Path, utterance: Path) -> None:
    waveform, rate = read_audio(utterance)
    scene, out = waveform[:, :rate], tmp_path / "out.wav"
    write_audio(tmp_path / "in.wav", scene, rate)
    options = ("--compensator", "wdrc", "--limit-to-ear", "--spl", 80, "--ucl", "500:60,1000:65")
    assert run("compensate", tmp_path / "in.wav", out, *options, "--audiogram", "n3") == 0
    gain = 10.0 ** ((80.0 - float(level_spl(scene[0]))) / 20.0)
    aid = load_compensator("wdrc", sample_rate=rate, limit_to_ear=True)
    ear = Audiogram.standard("N3", ucl={500: 60, 1000: 65})
    # In float32, the resampled output depends on the number of threads and on the processor.
    check_output(out, aid(gain * scene, ear) / gain, atol=1e-5)


@pytest.mark.parametrize(("ear", "warnings"), [("N4", 0), ("N3", 1)])
def test_a_compensator_for_another_ear_warns_once(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], ear: str, warnings: int
) -> None:
    model = MappingCompensator(config=MappingConfig(channels=8, blocks=1))
    about = {"audiogram": Audiogram.standard("N4").to_dict()}
    save_checkpoint(tmp_path / "mine", "mapping-compensator", model, model.config.to_dict(), about)
    options = ("--audiogram", ear, "--compensator", tmp_path / "mine")
    assert run("compensate", utterance, tmp_path / "out.wav", *options) == 0
    assert capsys.readouterr().err.count("was trained for one ear") == warnings


@pytest.mark.parametrize(("right", "count"), [("N4", 0), ("N3", 1), (None, 0)])
def test_a_listener_with_another_ear_than_the_trained_one_warns(
    tmp_path: Path, right: str | None, count: int
) -> None:
    model = MappingCompensator(config=MappingConfig(channels=8, blocks=1))
    save_compensator(model, tmp_path / "mine", "N4")
    listener = Listener(Audiogram.standard("N4"), Audiogram.standard(right) if right else None)
    assert len(warn_of_other_ears({"mine": str(tmp_path / "mine")}, listener)) == count


@pytest.mark.parametrize(
    "command",
    [
        "verify {speech} {speech} --audiogram N3 --target {aid}",
        "listen {speech} --audiogram N3 --compensator {aid} --seconds 1 --out {out}/page.html",
        "export-gains --audiogram N3 --to csv --compensator {aid}",
        "evaluate-simulator msbg --speech {folder} --audiograms standard --out {out} --items 1 "
        "--seconds 1 --jobs 1 --inputs compensated --compensator {aid}",
        "clarity {folder} {aid} --listeners {speech} --out {out}",
    ],
)
def test_every_command_warns_of_a_compensator_for_another_ear(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    model = MappingCompensator(config=MappingConfig(channels=8, blocks=1))
    about = {"audiogram": Audiogram.standard("N4").to_dict()}
    aid = tmp_path / "mine"
    save_checkpoint(aid, "mapping-compensator", model, model.config.to_dict(), about)
    (tmp_path / "speech").mkdir()
    (tmp_path / "speech" / utterance.name).write_bytes(utterance.read_bytes())
    places = {"speech": utterance, "folder": tmp_path / "speech", "out": tmp_path, "aid": aid}
    # The folder for ``clarity`` has no scenes, which it reports after the warning.
    expected_status = 2 if command.startswith("clarity") else 0
    assert run(*command.format(**places).split()) == expected_status
    assert capsys.readouterr().err.count("was trained for one ear") == 1


def test_a_name_that_is_too_long_with_that_of_its_ear_is_a_warning(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    for stem in ("a", "x" * 250):
        (tmp_path / "in" / f"{stem}.wav").write_bytes(utterance.read_bytes())
    ears = ("--audiogram", "N2", "--audiogram", "500:40")
    call = ("compensate", tmp_path / "in", tmp_path / "out", *ears, "--compensator", "nalr")
    assert run(*call) == 2
    assert "2 of 4 outputs failed" in capsys.readouterr().err


def test_folders_keep_their_tree_and_bad_files_are_reported(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in" / "a").mkdir(parents=True)
    for name in ("one.flac", "a/two.flac"):
        (tmp_path / "in" / name).write_bytes(utterance.read_bytes())
    (tmp_path / "in" / "a" / "broken.wav").write_text("this is no audio")
    call = ("compensate", tmp_path / "in", tmp_path / "out", "--audiogram", "N4", "--compensator")
    assert run(*call, "nobody") == 2 and not (tmp_path / "out").exists()
    assert "no checkpoint 'nobody'" in capsys.readouterr().err
    assert run(*call, "nalr") == 2
    printed = capsys.readouterr()
    assert "earlier run" not in printed.err
    assert "broken.wav: cannot be read" in printed.err and "1 of 3 outputs failed" in printed.err
    assert printed.out.count("players will clip") == 2
    written = {
        path.relative_to(tmp_path / "out").as_posix()
        for path in tmp_path.rglob("*.wav")
        if "out" in path.parts
    }
    assert written == {"one.wav", "a/two.wav"} and printed.out.count("dB SPL, output") == 2
    (tmp_path / "in" / "one.flac").write_text("this is no audio, either")
    assert run(*call, "nalr") == 2
    warning = f"{tmp_path / 'out' / 'one.wav'} is the output of an earlier run"
    assert warning in capsys.readouterr().err
    (tmp_path / "in" / "one.mp3").touch()
    assert run(*call, "nalr") == 2 and "2 files would be written to" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "level", "expected"),
    [
        ("compensate --audiogram N3 --compensator wdrc", 0.001, ""),
        ("compensate --audiogram N3 --compensator nalr", 1.0, "players will clip"),
        ("simulate --audiogram N5 --simulator neuro-msbg", 0.001, "no band above 8 kHz"),
    ],
)
def test_notes_about_clipping_and_a_missing_upper_band(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, level: float, expected: str
) -> None:
    noise = np.random.default_rng(0).standard_normal(24000)
    soundfile.write(tmp_path / "in.wav", level * noise, 48000, subtype="FLOAT")
    assert run(*command.split(), tmp_path / "in.wav", tmp_path / "out.wav") == 0
    text = capsys.readouterr().out
    for note in ("players will clip", "no band above 8 kHz"):
        assert (note in text) == (note == expected)


@pytest.mark.parametrize("more", [(), ("--no-clipping",)], ids=["", "softer"])
def test_the_line_says_how_to_read_an_output_at_its_level(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...]
) -> None:
    """An output of ``--spl`` keeps the scale of the file, so its samples are not pascals."""
    aided = tmp_path / "aided.wav"
    call = ("--audiogram", "N4", "--spl", "65")
    assert run("compensate", utterance, aided, *call, *more) == 0
    text = capsys.readouterr().out
    output_level = re.search(r"output ([\d.]+) dB SPL", text)
    scale = re.search(r"; (--full-scale-spl [\d.]+) reads the file at this level$", text.strip())
    assert output_level is not None and scale is not None
    perceived = tmp_path / "perceived.wav"
    assert run("simulate", aided, perceived, "--audiogram", "N4", *scale[1].split()) == 0
    text = capsys.readouterr().out
    assert f"input {output_level[1]} dB SPL" in text and "reads the file" not in text


def test_an_output_that_the_limit_of_the_aid_distorts_is_named(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The gain of CAMFIT for a steep loss is up to 100 dB at the onsets of high sounds."""
    call = ("compensate", utterance, tmp_path / "out.wav", "--spl", "65", "--compensator", "camfit")
    assert run(*call, "--audiogram", "S2") == 0
    note = "% of the samples exceeded the aid's limit of 110 dB SPL and are distorted"
    assert note in capsys.readouterr().out
    assert run(*call, "--audiogram", "N2") == 0
    assert "distorted" not in capsys.readouterr().out


def test_the_band_that_a_simulator_of_a_user_lacks_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = "def ear(waveform, audiogram): return 0.5 * waveform\near.sample_rate = 22050\n"
    (tmp_path / "mine.py").write_text(code)
    noise = 0.001 * np.random.default_rng(0).standard_normal(24000)
    soundfile.write(tmp_path / "in.wav", noise, 48000, subtype="FLOAT")
    simulator = f"{tmp_path / 'mine.py'}:ear"
    files = tmp_path / "in.wav", tmp_path / "out.wav"
    assert run("simulate", "--audiogram", "N3", "--simulator", simulator, *files) == 0
    assert "no band above 11.025 kHz" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("call", "beginning"),
    [
        ("help", "usage: hlsim COMMAND"),
        ("help simulate", "usage: hlsim simulate"),
        ("-V", f"hlsim {hlsim.__version__}"),
    ],
)
def test_help_and_the_version_are_printed(
    capsys: pytest.CaptureFixture[str], call: str, beginning: str
) -> None:
    assert run(*call.split()) == 0
    assert capsys.readouterr().out.startswith(beginning)


def test_n7_is_offered_where_it_is_accepted() -> None:
    for command in ("simulate", "listen", "demo", "train-compensator"):
        assert "N1 to N6" in " ".join(make_parser(command).format_help().split())
    for command in ("compensate", "haspi-report", "live"):
        assert "N1 to N7" in " ".join(make_parser(command).format_help().split())


def test_help_names_only_options_of_the_command() -> None:
    for command in ("verify", "evaluate-compensator"):
        help_ = make_parser(command).format_help()
        assert "--ucl" in help_ and "--listener" not in help_


def test_a_missing_extra_names_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "pip install 'hlsim[eval]'" in error_of(capsys, "demo", "--out", tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [ZeroDivisionError, RuntimeError, MemoryError, RecursionError])
def test_an_unexpected_exception_is_one_line_with_a_traceback_on_request(
    tmp_path: Path,
    utterance: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: type[Exception],
) -> None:
    monkeypatch.setattr("hlsim.cli.processing._process", Mock(side_effect=error("some\nlines")))
    call = ("simulate", utterance, tmp_path / "out.wav", "--audiogram", "N3")
    monkeypatch.delenv("HLSIM_TRACEBACK", raising=False)
    text = error_of(capsys, *call)
    assert "some lines" in text and ("out of memory" if error is MemoryError else "HLSIM_") in text
    monkeypatch.setenv("HLSIM_TRACEBACK", "1")
    assert run(*call) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback") and lines[-1] == text


def test_names_that_stdout_cannot_encode_are_escaped(
    tmp_path: Path, utterance: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in").mkdir()
    for name in ("\u03b1.flac", "\u03b2.flac"):
        (tmp_path / "in" / name).write_bytes(utterance.read_bytes())
    (tmp_path / "in" / "\u03b3.wav").write_text("this is no audio")
    for stream in ("stdout", "stderr"):
        monkeypatch.setattr(sys, stream, io.TextIOWrapper(io.BytesIO(), encoding="cp1252"))
    options = ("--audiogram", "N3", "--compensator", "nalr")
    assert run("compensate", tmp_path / "in", tmp_path / "out", *options) == 2
    sys.stdout.seek(0)
    sys.stderr.seek(0)
    assert "\\u03b1.wav" in (text := sys.stdout.read()) and "\\u03b2.wav" in text
    assert "\\u03b3.wav" in sys.stderr.read()


def test_a_folder_that_exists_has_no_label(tmp_path: Path) -> None:
    folder = tmp_path / "lr=0.1"
    folder.mkdir()
    labels = _read_labels([str(folder), f"mine={folder}", "other=nalr"])
    assert labels == {str(folder): str(folder), "mine": str(folder), "other": "nalr"}


MANIFEST = """listener,ear,condition,clean,processed,audiogram
L1,l,unaided,clean.wav,clean.wav,N4
L1,l,aided,clean.wav,aided.wav,N4
L2,r,unaided,clean.wav,clean.wav,N2
L2,r,aided,clean.wav,broken.wav,N2
"""


def test_haspi_report_of_a_manifest(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("joblib", "matplotlib", "pystoi"):
        pytest.importorskip(module)
    samples, rate = soundfile.read(utterance)
    for name, gain in (("clean", 1.0), ("aided", 4.0)):
        second = gain * samples[rate : 2 * rate - (name == "aided")]
        soundfile.write(tmp_path / f"{name}.wav", second, rate, subtype="FLOAT")
    (tmp_path / "broken.wav").write_text("this is no audio")
    (tmp_path / "study.csv").write_text(MANIFEST)
    out = tmp_path / "out"
    call: tuple[Any, ...] = ("haspi-report", "--manifest", tmp_path / "study.csv", "--out", out)
    call += ("--jobs", "1", "--spl", "65", "--seed", "1")
    measures = ("--measures", "stoi")
    assert run(*call, *measures) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("aided") and (out / "report.html").as_uri() in printed.out
    warning = "both are cut to the shorter length"
    assert warning in json.loads((out / "report.json").read_text())["notes"][0]
    assert "1 of 4 outputs (one per item and condition) lack scores (one per" in printed.err
    assert "broken.wav: cannot be read" in printed.err.rpartition("the first is: ")[2]
    scores = [row["stoi"] for row in json.loads((out / "report.json").read_text())["rows"]]
    assert [score is None for score in scores] == [False, False, False, True]
    stored = (out / "scores.jsonl").read_text()
    assert run(*call, *measures) == 0 and (out / "scores.jsonl").read_text() == stored
    capsys.readouterr()
    for option, value in (("--measures", "loud"), ("--root", "none"), ("--baseline", "x")):
        assert value in error_of(capsys, *call, option, value)


def test_a_stopped_command_says_how_to_continue(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    utterance: Path,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr("hlsim.audio.scan_audio", Mock(side_effect=KeyboardInterrupt))
    assert run("simulate", utterance, tmp_path / "out.wav", "--audiogram", "N3") == 130
    assert "run the same command again" in capsys.readouterr().err
