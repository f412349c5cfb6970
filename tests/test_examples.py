"""The examples run, on small data."""

import csv
from pathlib import Path

import pytest
import torch

from compensators import HearingAid, load_compensator, save_compensator
from hlsim import MSBG, Audiogram, HearingLossLoss, example_speech
from hlsim.audio import read_audio, write_audio
from hlsim.calibration import level_spl, set_level
from hlsim.data.clips import Clips
from tests.helpers import EXAMPLES, load_example, load_figure, write_ears


def test_own_network_trains(
    tmp_path: Path, speech_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example, out = load_example("train_compensator.py"), tmp_path / "network.pt"
    example.main(str(speech_dir / "train"), str(out), "N4", "2")
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == [
        "step 0",
        "step 1",
    ]
    fresh, trained = example.MyNetwork(), example.MyNetwork()
    trained.load_state_dict(torch.load(out))
    ear, noise = Audiogram.standard("N4"), 0.03 * torch.randn(2, 8000)
    # Before training it equals the prescription, and after two steps it differs.
    torch.testing.assert_close(
        fresh(noise, ear), fresh.prescription(noise, ear), atol=1e-4, rtol=1e-3
    )
    assert float((trained(noise, ear) - fresh(noise, ear)).abs().max()) > 1e-4
    assert trained(noise[0], ear).shape == (8000,)


@pytest.mark.slow
def test_the_papers_last_table(
    tmp_path: Path, speech_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("matplotlib", "joblib"):
        pytest.importorskip(module)
    clean, rate = read_audio(speech_dir / "valid" / "flite-rms-01.flac")
    clean = clean[:, rate // 2 : rate // 2 + rate]
    corpus = tmp_path / "voicebank"
    for name, signal in (("clean", clean), ("noisy", clean + 0.01 * torch.randn_like(clean))):
        (corpus / f"{name}_testset_wav").mkdir(parents=True)
        write_audio(corpus / f"{name}_testset_wav" / "p232_001.wav", signal, rate)
    ears = write_ears(tmp_path / "ears.csv", "N2", "N3", "N5")
    out = tmp_path / "out"
    options = ["--audiograms", str(ears), "--compensators", "nalr", "--jobs", "1"]
    load_example("paper/haspi_table.py").main([str(corpus), str(out), *options])
    assert "HASPI 0." in capsys.readouterr().out
    with open(out / "table.csv", newline="") as file:
        table = list(csv.DictReader(file))
    # one utterance, two different ears of the file, two conditions
    assert len(table) == 4 and len({row["hl_1000"] for row in table}) == 2
    assert (out / "report" / "report.json").is_file()


@pytest.mark.slow
def test_sliders_trade_noise_for_level(
    speech_dir: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    example, valid = load_example("sliders.py"), str(speech_dir / "valid")
    monkeypatch.setattr(example, "STEPS", (0.0, 1.0))
    for score in ("haspi", "hasqi"):  # Only levels are compared.
        monkeypatch.setattr(example, score, lambda output, clean, ear: output.mean())
    ears = write_ears(tmp_path / "ears.csv", "N2")
    save_compensator(HearingAid(), tmp_path / "untrained")
    for name in ("hearing-aid", str(tmp_path / "untrained")):
        with torch.no_grad():
            example.main(valid, valid, str(ears), "2", name)
        rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
        levels = {tuple(row[:4]): float(row[6]) for row in rows}
        assert len(levels) == 10
        for condition in ("clean", "noisy"):
            whole = levels["| 1", "1", "0.1", condition]
            unamplified = levels["| 1", "0", "0.1", condition]
            assert unamplified < whole < levels["| 0", "1", "0.1", condition]
    for condition in ("clean", "noisy"):  # of the untrained aid, in which peaks are held
        assert levels["| 1", "1", "2", condition] < levels["| 1", "1", "0.1", condition]


@pytest.mark.slow
def test_delay_by_frequency(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    example = load_figure("delay.py")
    bursts = example.make_bursts()
    assert example.measure_delays(bursts.roll(-7, -1), bursts) == [-7] * len(example.HERTZ)
    monkeypatch.setattr(example, "draw", lambda path: None)
    example.main()
    assert len(capsys.readouterr().out.splitlines()) == 2 + len(example.TABLE_EARS)


@pytest.mark.slow
def test_pictures_of_perceived_speech(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    example = load_figure("heard.py")
    short = example.read_speech()[8000:12000]
    monkeypatch.setattr(example, "read_speech", lambda: short)
    monkeypatch.setattr(example, "AIDS", {"nalr": "NAL-R"})
    few = {"neuro-msbg": "load_pretrained", "hearing-aid": "load_compensator"}
    monkeypatch.setattr(example, "list_pretrained", lambda: few)
    example.main(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"heard.png", "family.png"}


@pytest.mark.slow
def test_parity(
    tmp_path: Path,
    speech_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("clarity")
    monkeypatch.syspath_prepend(EXAMPLES)
    ears = write_ears(tmp_path / "ears.csv", "N2")
    arguments = ["parity.py", str(speech_dir / "valid"), str(ears), "1"]
    monkeypatch.setattr("sys.argv", arguments)
    example = load_figure("parity.py")
    monkeypatch.setattr(
        example,
        "Clips",
        lambda speech, sample_rate, seconds: Clips(speech, sample_rate=sample_rate, seconds=0.5),
    )
    example.main()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(", ")[0] for line in lines] == ["44.1 kHz", "16 kHz"] * 2
    assert all("80 to 115 dB SPL" in line for line in lines[2:])
    assert all(float(line.split("worst ")[1].split()[0]) < 4e-2 for line in lines)


@pytest.mark.slow
def test_other_sounds(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    example = load_figure("other_sounds.py")
    ear, exact = Audiogram.standard("N3"), MSBG("N3", sample_rate=16000)
    # This simulator is 3 dB too loud.
    row = example.make_row(exact, lambda x, _: 2**0.5 * exact(x), ear)
    assert (row[0], row[2], row[3]) == ("+3.0 to +3.0", "+3.0, +3.0, +3.0", "8, 8, 8")
    monkeypatch.setattr(example, "EARS", ("N3",))
    monkeypatch.setattr("sys.argv", ["other_sounds.py"])
    example.main()
    table = capsys.readouterr().out.splitlines()
    assert len(table) == 3 and table[2].startswith("| N3 |")


@pytest.mark.slow
def test_the_default_criterion_is_valid(speech: list[tuple[torch.Tensor, int]]) -> None:
    """The example ranks some degradations of one synthetic voice as HASPI and HASQI do."""
    example = load_figure("validity.py")
    ear, generator = Audiogram.standard("N3"), torch.Generator().manual_seed(0)
    clean = set_level(speech[0][0][0, 8000:28000], 65.0)
    noise = set_level(example.draw_noise(clean, generator), 65.0)
    signals = example.degrade(clean, noise, generator)
    assert len(signals) == 18 and all(signal.shape == clean.shape for signal in signals.values())
    few = {
        name: signals[name]
        for name in (*example.NOISY, "low-pass 1000 Hz", "reverberation of 1 s", "sign")
    }
    gain_db = example.fit_equaliser(clean, ear)
    exact = MSBG(sample_rate=16000)
    amplified = example.apply_gains(clean, 10.0 ** (gain_db / 20.0))
    normal = level_spl(exact(clean, Audiogram.standard("NH")))
    assert float(level_spl(exact(amplified, ear))) == pytest.approx(float(normal), abs=1.0)
    loss = HearingLossLoss(simulator="msbg", reduction="none")
    for share in example.GAINS.values():
        scores = example.compute_scores(few, share * gain_db, ear, {"default": loss})
        haspi, hasqi, ordered, nearest = example.compare(scores, "default")
        assert ordered and nearest
        assert haspi > 0.5 and hasqi > 0.5
    worst = {name: -value for name, value in scores["default"].items()}
    assert not example.compare({**scores, "upside down": worst}, "upside down")[2]


@pytest.mark.slow
def test_benchmark_prints_a_table_of_each_kind(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("clarity")
    example = load_figure("benchmark.py")
    monkeypatch.setattr(example, "LOSS_SIMULATORS", ("neuro-msbg",))
    tables, simulators = ["simulators", "loss", "step"], ["--simulators", "neuro-msbg"]
    example.main(["--repeats", "1", "--seconds", "0.2", "--what", *tables, *simulators])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines if "forward (ms)" in line] == tables
    assert "1.0 (1.0 to 1.0)" in next(line for line in lines if line.startswith("| pyclarity"))


@pytest.mark.slow
def test_alignment_by_structure_and_by_an_impulse_agree(speech_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    source, target = speech_dir / "valid" / "flite-rms-01.flac", tmp_path / "alignment.png"
    structural_ms, impulse_ms = load_example("draw_alignment.py").main(str(source), str(target))
    assert structural_ms == pytest.approx(1239 / 44.1) and abs(impulse_ms - structural_ms) < 2.0
    assert target.read_bytes().startswith(b"\x89PNG")


def test_prompt_gains_give_the_output_of_the_network() -> None:
    example = load_figure("gains_over_time.py")
    ear, speech = Audiogram.standard("N3"), example_speech()[:32000]
    with torch.no_grad():
        reference = load_compensator("compensator-general")(speech, ear)
        kinds = (example.PromptGains, example.LaterGains, example.SteadyGains)
        errors = [level_spl(kind()(speech, ear) - reference) for kind in kinds]
    assert errors[0] < level_spl(reference) - 15.0
    assert errors[0] < errors[1] < errors[2]
