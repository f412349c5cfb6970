"""The program: what it writes, and that bad input ends with status 2, one line and nothing half-written."""

import json
import signal
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from compensators import (
    NALR,
    HearingAid,
    MappingCompensator,
    MappingConfig,
    load_compensator,
    save_compensator,
)
from hlsim import MSBG, Audiogram, Listener
from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import FREQUENCIES
from hlsim.cli.main import main
from hlsim.pretrained import save_checkpoint


@pytest.fixture
def utterance(speech_dir: Path) -> Path:
    return sorted(speech_dir.glob("valid/*.flac"))[0]


def fails(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of a failing call."""
    assert main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1 and error.startswith("hlsim: error: ")
    return error


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of a call whose options cannot be read."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    assert end.value.code == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1 and error.startswith("hlsim")
    return error


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["simulate"], "hlsim simulate: error: the following arguments are required: IN"),
        (
            ["simulate", "a", "b", "--audiogram", "N3", "--loud"],
            "hlsim simulate: error: unrecognized",
        ),
        (["nothing"], "hlsim: error: argument COMMAND: invalid choice"),
        ([], "hlsim: error: the following arguments are required: COMMAND"),
    ],
)
def test_unreadable_options_are_one_line_without_the_usage(
    capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    error = refused(capsys, *arguments)
    assert error.startswith(said) and error.endswith(f"; see {said.split(':')[0]} --help")


@pytest.mark.parametrize(
    ("command", "option", "said"),
    [
        ("prepare", ["--valid-share", "2"], "got '2', expected a number from 0 to 1"),
        ("simulate", ["--full-scale-spl", "nan"], "got 'nan', expected a number"),
    ],
)
def test_values_of_another_kind(
    capsys: pytest.CaptureFixture[str], command: str, option: list[str], said: str
) -> None:
    assert f"argument {option[0]}: {said}" in refused(capsys, command, *option)


@pytest.mark.parametrize("simulator", ["msbg", "neuro-msbg"])
@pytest.mark.parametrize(("rate", "channels"), [(16000, 1), (44100, 2), (96000, 1)])
def test_simulate_keeps_rate_channels_and_length(
    tmp_path: Path, simulator: str, rate: int, channels: int
) -> None:
    samples = np.random.default_rng(0).standard_normal((rate // 2, channels)) * 0.02
    soundfile.write(tmp_path / "in.wav", samples, rate, subtype="FLOAT")
    arguments = ["simulate", str(tmp_path / "in.wav"), str(tmp_path / "out.wav")]
    assert main([*arguments, "--audiogram", "N3", "--simulator", simulator]) == 0
    heard, heard_rate = soundfile.read(tmp_path / "out.wav", always_2d=True)
    assert (heard_rate, heard.shape) == (rate, samples.shape)
    assert 0 < np.std(heard) < np.std(samples)


def test_simulate_is_the_model(tmp_path: Path, utterance: Path) -> None:
    out = tmp_path / "out.wav"
    levels = "30,35,40,50,55,60,65,70"
    options = ["--audiogram", levels, "--simulator", "msbg", "--full-scale-spl", "100"]
    assert main(["simulate", str(utterance), str(out), *options]) == 0
    samples, rate = soundfile.read(utterance, dtype="float32")
    ear = Audiogram(tuple(map(float, levels.split(","))))
    expected = MSBG(ear, sample_rate=rate, full_scale_spl=100.0)(torch.from_numpy(samples))
    heard, _ = soundfile.read(out, dtype="float32")
    np.testing.assert_allclose(heard, expected.numpy(), atol=1e-7)


def test_the_sliders_of_a_hearing_aid(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    waveform, rate = read_audio(utterance)
    aid = HearingAid(sample_rate=rate).eval()
    save_compensator(aid, tmp_path / "aid")
    call = ["compensate", str(utterance), str(tmp_path / "out.wav"), "--audiogram", "N3"]
    assert main([*call, "--noise-reduction", "0", "--amplification", "0"]) == 0  # of the default
    default = load_compensator("hearing-aid", sample_rate=rate)
    expected = default(waveform, Audiogram.standard("N3"), 0.0, 0.0)
    torch.testing.assert_close(read_audio(tmp_path / "out.wav")[0], expected, atol=1e-6, rtol=1e-5)
    own = [
        "--compensator",
        str(tmp_path / "aid"),
        "--noise-reduction",
        "0.5",
        "--amplification",
        "0",
    ]
    assert main([*call, *own]) == 0
    expected = aid(waveform, Audiogram.standard("N3"), 0.5, 0.0).detach()
    torch.testing.assert_close(read_audio(tmp_path / "out.wav")[0], expected, atol=1e-6, rtol=1e-5)
    capsys.readouterr()
    assert "noise_reduction of nalr, which has no such slider" in fails(
        capsys, *call, "--compensator", "nalr", "--noise-reduction", "1"
    )
    assert "expected a number from 0 to 1" in refused(
        capsys, *call, *own[:2], "--amplification", "2"
    )


def test_compensate_is_the_compensator(tmp_path: Path, utterance: Path) -> None:
    out = tmp_path / "out.wav"
    call = ["compensate", str(utterance), str(out), "--compensator", "nalr", "--audiogram"]
    assert main([*call, "N3", "--full-scale-spl", "100"]) == 0
    samples, rate = soundfile.read(utterance, dtype="float32")
    expected = NALR(Audiogram.standard("N3"), sample_rate=rate)(torch.from_numpy(samples))
    aided, _ = soundfile.read(out, dtype="float32")
    np.testing.assert_allclose(aided, expected.numpy(), atol=1e-7)
    assert np.std(aided) > 1.5 * np.std(samples)
    assert main([*call, "N7"]) == 0  # which no simulator takes


def listeners_csv(folder: Path, *listeners: tuple[str, Listener]) -> Path:
    rows = [row for name, listener in listeners for row in listener.to_rows(name)]
    lines = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
    (folder / "ears.csv").write_text("\n".join(lines))
    return folder / "ears.csv"


def test_two_ears_of_a_stereo_file(tmp_path: Path, utterance: Path) -> None:
    waveform, rate = read_audio(utterance)
    scene, out = torch.cat((waveform, 0.3 * waveform))[:, :rate], tmp_path / "out.wav"
    write_audio(tmp_path / "in.wav", scene, rate)
    both = Listener(Audiogram.standard("N2"), Audiogram.standard("N4"))
    names = {"audiogram_levels_l": both.left, "audiogram_levels_r": both.right}
    entry = {key: ear.levels for key, ear in names.items() if ear} | {"audiogram_cfs": FREQUENCIES}
    (tmp_path / "listeners.json").write_text(json.dumps({"L1": entry, "L2": entry}))
    heard = MSBG(both, sample_rate=rate)(scene)
    aided = load_compensator("wdrc", sample_rate=rate, linked=True)(scene, both)
    for command, listener, expected in (
        (["simulate", "--simulator", "msbg"], listeners_csv(tmp_path, ("a", both)), heard),
        (
            ["compensate", "--compensator", "wdrc", "--linked"],
            f"{tmp_path / 'listeners.json'}:L2",
            aided,
        ),
    ):
        assert (
            main([*command, str(tmp_path / "in.wav"), str(out), "--listener", str(listener)]) == 0
        )
        torch.testing.assert_close(read_audio(out)[0], expected, atol=1e-6, rtol=1e-5)


def test_listeners_that_a_file_cannot_be_given_to(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ear = Audiogram.standard("N3")
    path = listeners_csv(tmp_path, ("a", Listener(ear, ear)), ("b", Listener(None, ear)))
    call = ["compensate", utterance, tmp_path / "out.wav"]
    for listener, said in (
        (path, f"ears.csv: 2 listeners; allowed: {path}:NAME, with a NAME of a, b"),
        (f"{path}:c", f"no listener 'c'; allowed: {path}:NAME, with a NAME of a, b"),
        (
            f"{path}:b",
            "the left ear is missing; allowed: a listener with both, or --audiogram with the right ear's",
        ),
        (f"{path}:a", f"{utterance}: 1 channels; allowed with --listener: 2, left and right"),
        (tmp_path / "none.csv", "none.csv: cannot read audiograms: "),
    ):
        assert said in fails(capsys, *call, "--listener", listener)
    assert "1 channels; allowed with --linked: 2" in fails(
        capsys, *call, "--audiogram", "N3", "--linked"
    )
    write_audio(tmp_path / "in.wav", torch.ones(2, 4000), 16000)
    call[1] = tmp_path / "in.wav"
    linked = ("--linked", "--compensator", "nalr")
    assert "nalr links no gains" in fails(capsys, *call, "--audiogram", "N3", *linked)
    assert "not allowed with" in refused(capsys, *call, "--audiogram", "N3", "--listener", path)
    assert not (tmp_path / "out.wav").exists()


@pytest.mark.parametrize(("ear", "warned"), [("N4", 0), ("N3", 1)])
def test_a_compensator_of_another_ear_warns_once(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], ear: str, warned: int
) -> None:
    model = MappingCompensator(MappingConfig(channels=8, blocks=1))
    about = {"audiogram": Audiogram.standard("N4").to_dict()}
    save_checkpoint(tmp_path / "mine", "mapping-compensator", model, model.config.to_dict(), about)
    (tmp_path / "in").mkdir()
    for rate in (16000, 22050, 48000):
        soundfile.write(tmp_path / "in" / f"{rate}.wav", np.full(rate // 10, 0.01), rate)
    line = f"hlsim: warning: {tmp_path / 'mine'} was trained for one ear, 55, 55, 55, 65, 70, 75, 80, 80 dB HL"
    for source, target in ((utterance, "out.wav"), (tmp_path / "in", "out")):
        files = ["compensate", str(source), str(tmp_path / target)]
        assert main([*files, "--audiogram", ear, "--compensator", str(tmp_path / "mine")]) == 0
        assert capsys.readouterr().err.count(line) == warned


def _bad_files(folder: Path) -> dict[str, tuple[Path, str]]:
    tone = np.sin(np.arange(8000) / 10.0) * 0.1
    soundfile.write(folder / "slow.wav", tone, 8000)
    soundfile.write(folder / "empty.wav", np.zeros(0), 16000)
    soundfile.write(folder / "silent.wav", np.zeros(8000), 16000)
    soundfile.write(folder / "nan.wav", np.append(tone, np.nan), 16000, subtype="FLOAT")
    (folder / "broken.wav").write_text("this is no audio")
    return {
        "missing": (folder / "missing.wav", "no such file"),
        "broken": (folder / "broken.wav", "cannot be read as audio"),
        "empty": (folder / "empty.wav", "empty"),
        "silent": (folder / "silent.wav", "silent"),
        "nan": (folder / "nan.wav", "NaN"),
        "slow": (folder / "slow.wav", "8000 Hz"),
    }


@pytest.mark.parametrize("kind", ["missing", "broken", "empty", "silent", "nan", "slow"])
def test_bad_audio(tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str) -> None:
    path, reason = _bad_files(tmp_path)[kind]
    before = set(tmp_path.iterdir())
    error = fails(capsys, "simulate", path, tmp_path / "out.wav", "--audiogram", "N3")
    assert str(path) in error and reason in error
    assert set(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("audiogram", "reason"),
    [
        ("10,20,30,40,50,60,70", "7 levels and 8 frequencies"),
        ("10,20,30,40,50,60,70,130", "-10 to 120"),
        ("N7", "-10 to 100"),
        ("N9", "N1, N2, N3"),
        ("10,20,30,x,50,60,70,80", "allowed: a standard ear such as N3, or eight numbers"),
    ],
)
def test_bad_audiogram(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], audiogram: str, reason: str
) -> None:
    error = fails(capsys, "simulate", utterance, tmp_path / "out.wav", "--audiogram", audiogram)
    assert reason in error and not list(tmp_path.iterdir())


def test_levels_below_zero_need_no_sign_of_equality(tmp_path: Path, utterance: Path) -> None:
    out = tmp_path / "out.wav"
    call = ["simulate", str(utterance), str(out), "--simulator", "msbg", "--audiogram"]
    assert main([*call, "-10,-5,0,0,0,0,0,0"]) == 0 and out.is_file()


@pytest.mark.parametrize("command", ["simulate", "compensate"])
def test_files_that_cannot_be_in_and_out(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    given, plain = tmp_path / "in.flac", tmp_path / "plain"
    given.write_bytes(utterance.read_bytes())
    plain.touch()
    for source, target, said in (
        (given, plain / "o.wav", f"{plain}: not a folder; allowed"),
        (given, tmp_path / "none" / "o.wav", f"{tmp_path / 'none'}: no such folder; allowed"),
        (given, given, f"{given}: OUT is IN itself"),
        (given, tmp_path, f"{tmp_path}: a folder; allowed: a file, for IN is one"),
        (tmp_path, plain, f"{plain}: not a folder; allowed: a folder, there or not"),
        (tmp_path, tmp_path / "new", f"{tmp_path / 'new'}: in IN itself; allowed: another folder"),
        (tmp_path / "missing.wav", tmp_path / "missing.wav", "missing.wav: no such file"),
        (tmp_path / "missing.wav", tmp_path / "o.mp3", "o.mp3: expected the extension"),
    ):
        assert said in fails(capsys, command, source, target, "--audiogram", "N3")
    assert given.read_bytes() == utterance.read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"in.flac", "plain"}


def test_folders_keep_their_tree_and_what_cannot_be_read_is_told(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in" / "a").mkdir(parents=True)
    for name in ("one.flac", "a/two.flac"):
        (tmp_path / "in" / name).write_bytes(utterance.read_bytes())
    (tmp_path / "in" / "a" / "broken.wav").write_text("this is no audio")
    call = ["compensate", str(tmp_path / "in"), str(tmp_path / "out"), "--audiogram", "N3"]
    call += ["--compensator", "nalr"]
    assert main([*call[:-1], "nobody"]) == 2
    assert "no checkpoint 'nobody'" in capsys.readouterr().err and not (tmp_path / "out").exists()
    assert main(call) == 2
    told = capsys.readouterr()
    assert "left out" in told.err and "1 of 3 files were left out" in told.err
    assert main([*call[:1], str(utterance), str(tmp_path / "alone.wav"), *call[3:]]) == 0
    alone, _ = read_audio(tmp_path / "alone.wav")
    written = {
        path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.wav")
    }
    assert written == {"one.wav", "a/two.wav"}
    assert all(torch.equal(read_audio(tmp_path / "out" / name)[0], alone) for name in written)
    samples, _ = soundfile.read(utterance)
    level = 94.0 + 10.0 * np.log10(np.mean(samples**2))
    assert f"2 of 3: {tmp_path / 'out' / 'one.wav'}: {level:.1f} dB SPL in, " in told.out.replace(
        "3 of 3", "2 of 3"
    )
    for name in ("one.mono.wav", "one.wav"):  # the first stands between one.flac and one.wav
        (tmp_path / "in" / name).write_bytes(utterance.read_bytes())
    capsys.readouterr()
    assert "would both be" in fails(capsys, *call)
    inner = tmp_path / "in" / "a"
    (inner / "a").mkdir()
    for name in ("a/one.wav", "one.wav"):
        (inner / name).write_bytes(utterance.read_bytes())
    over = fails(capsys, "compensate", str(inner), str(inner.parent), *call[3:])
    assert "a file of IN would be lost; allowed: another OUT" in over
    assert (inner / "one.wav").read_bytes() == utterance.read_bytes()


def test_what_a_listener_would_not_expect_of_a_file_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(0).standard_normal(48000)
    files = [str(tmp_path / name) for name in ("in.wav", "out.wav")]
    for command, level, model, clipped, dull in (
        ("compensate", 0.001, "wdrc", False, False), ("compensate", 0.001, "compensator-general", False, True),
        ("compensate", 1.0, "nalr", True, False), ("simulate", 0.001, "neuro-msbg", False, True),
        ("simulate", 0.001, "msbg", False, False),
    ):  # fmt: skip
        soundfile.write(tmp_path / "in.wav", level * noise, 48000, subtype="FLOAT")
        kind, ear = {"compensate": ("--compensator", "N3"), "simulate": ("--simulator", "N5")}[
            command
        ]
        assert main([command, *files, "--audiogram", ear, kind, model]) == 0
        told = capsys.readouterr().err
        assert ("a player clips it" in told, "what IN has above 8 kHz is missing" in told) == (
            clipped,
            dull,
        )


@pytest.mark.parametrize("command", ["simulate", "compensate"])
def test_ogg_of_many_channels_is_refused_before_anything_is_loaded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    soundfile.write(tmp_path / "in.wav", np.full((1600, 6), 0.01), 16000)
    call = (command, tmp_path / "in.wav", tmp_path / "out.ogg", "--audiogram", "N3")
    loaded = {"simulate": "--simulator", "compensate": "--compensator"}[command]
    assert "ogg files hold up to 2 channels, got 6" in fails(capsys, *call, loaded, "no-such-model")


@pytest.mark.parametrize(
    "command",
    [
        ["train-compensator", "--speech", "s"],
        ["train-simulator", "--speech", "s", "--recipe", "c"],
        ["demo"],
    ],
)
def test_a_file_in_the_place_of_the_folder_for_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    plain = tmp_path / "plain"
    plain.touch()
    for out in (plain, plain / "below"):
        error = refused(capsys, *command, "--out", out)
        assert f"argument --out: {plain} is not a folder" in error


def test_options_that_contradict_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", tmp_path / "out"]
    error = refused(capsys, "haspi-report", "--spl", "65", "--full-scale-spl", "94", *out)
    assert "argument --full-scale-spl: not allowed with argument --spl" in error
    call = ["evaluate-simulator", "msbg", "msbg", "--speech", "s", "--audiograms", "a", *out]
    assert "have the same label" in fails(capsys, *call)
    call = [
        "evaluate-simulator",
        "msbg",
        "--speech",
        "s",
        "--audiograms",
        "a",
        "--compensator",
        "nalr",
        *out,
    ]
    assert "--compensator has no effect without --inputs compensated" in fails(capsys, *call)
    call = [
        "evaluate-compensator",
        "nalr",
        "--speech",
        "s",
        "--audiogram",
        "N3",
        "--gain-ears",
        "S3",
        *out,
    ]
    assert "--gain-ears has no effect with --audiogram" in fails(capsys, *call)
    pytest.importorskip("lightning")
    call = ["train-compensator", "--speech", "s", "--audiogram", "N4", "--audiograms", "a", *out]
    assert "--audiogram with --audiograms; allowed: one ear, or a CSV" in fails(capsys, *call)
    assert not list(tmp_path.iterdir())


def test_audiograms_that_do_not_ascend(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], speech_dir: Path
) -> None:
    table = tmp_path / "ears.csv"
    table.write_text("hl_500,hl_250,hl_1000\n10,20,30\n")
    out = tmp_path / "out"
    speech = speech_dir / "valid"
    error = fails(
        capsys,
        "evaluate-simulator",
        "msbg",
        "--speech",
        speech,
        "--audiograms",
        table,
        "--out",
        out,
    )
    assert f"{table}, line 2" in error and "ascending" in error


def test_unknown_and_changed_checkpoints(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from hlsim.pretrained import find_checkpoint

    call = ("simulate", utterance, tmp_path / "out.wav", "--audiogram", "N3", "--simulator")
    assert "neuro-msbg" in fails(capsys, *call, "no-such-model")
    changed = tmp_path / "changed"
    changed.mkdir()
    for file in find_checkpoint("neuro-msbg").iterdir():
        (changed / file.name).write_bytes(file.read_bytes())
    weights = bytearray((changed / "model.safetensors").read_bytes())
    weights[-1] ^= 1
    (changed / "model.safetensors").write_bytes(weights)
    assert "SHA-256" in fails(capsys, *call, changed)
    assert not (tmp_path / "out.wav").exists()


def test_unequal_file_lists(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("clean", "before", "after"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.flac").write_bytes(utterance.read_bytes())
    (tmp_path / "clean" / "b.flac").write_bytes(utterance.read_bytes())
    folders = [
        part for name in ("clean", "before", "after") for part in (f"--{name}", tmp_path / name)
    ]
    error = fails(capsys, "haspi-report", *folders, "--audiogram", "N4", "--out", tmp_path / "out")
    assert "b" in error and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("command", "module"),
    [
        (["train-simulator", "--recipe", "c", "--speech", "s", "--out", "o"], "lightning"),
        (["train-simulator", "--recipe", "c", "--speech", "s", "--out", "o"], "tensorboard"),
        (["train-compensator", "--speech", "s", "--out", "o"], "tensorboard"),
        (["demo", "--out", "o"], "tensorboard"),
        (
            ["evaluate-simulator", "msbg", "--speech", "s", "--audiograms", "a", "--out", "o"],
            "pystoi",
        ),
        (["demo", "--out", "o"], "matplotlib"),
    ],
)
def test_missing_extra_names_the_install_command(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: list[str],
    module: str,
) -> None:
    import sys

    monkeypatch.chdir(tmp_path)
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    error = fails(capsys, *command)
    extra = {"lightning": "train", "tensorboard": "train"}.get(module, "eval")
    assert module in error and f"pip install 'hlsim[{extra}]'" in error
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
    call = ["haspi-report", "--manifest", tmp_path / "study.csv", "--out", out, "--jobs", "1"]
    call += ["--measures", "stoi", "--spl", "65", "--listen", "1"]
    assert main([str(part) for part in call]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("aided") and "report.html" in printed.out
    assert "1 of 4 outputs lack scores" in printed.err and "4 of 4 outputs" in printed.err
    rows = json.loads((out / "report.json").read_text())["rows"]
    assert [row["stoi"] is None for row in rows] == [False, False, False, True]
    stored = (out / "scores.jsonl").read_text()
    assert main([str(part) for part in call]) == 0
    assert (out / "scores.jsonl").read_text() == stored
    capsys.readouterr()
    for extra, says in (
        (["--measures", "loud"], "there is no measure 'loud'"),
        (["--measure", "no.such:thing"], "cannot load the measure no.such:thing"),
        (["--root", tmp_path / "none"], "none: no such folder"),
        (["--baseline", "x"], "there is no condition 'x'"),
        (["--clean", tmp_path], "or a manifest"),
    ):
        assert says in fails(capsys, *call, *extra)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_stopped_command_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    utterance: Path,
    tmp_path: Path,
    number: int,
    status: int,
) -> None:
    def stopped(*_: object, **__: object) -> None:
        if number == signal.SIGINT:  # which a job in the background ignores
            raise KeyboardInterrupt
        signal.raise_signal(number)

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr("hlsim.audio.read_audio", stopped)
    assert (
        main(["compensate", str(utterance), str(tmp_path / "out.wav"), "--audiogram", "N3"])
        == status
    )
    assert "stopped; what was finished is kept" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_name_that_no_disk_takes_is_refused_first(
    tmp_path: Path, utterance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / ("a" * 240 + ".wav")
    assert "a name of more than" in fails(
        capsys, "simulate", utterance, out, "--audiogram", "N3", "--simulator", "none"
    )
