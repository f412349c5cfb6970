"""Compensators compared with their rivals: measures, conditions, groups, and the page."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from compensators import NALR, NALRP, MappingCompensator
from compensators.config import MappingConfig
from hlsim import MSBG, Audiogram, HearingLossLoss, load_pretrained
from hlsim.audio import write_audio
from hlsim.calibration import level_spl, set_level
from hlsim.checkpoint import save_checkpoint
from hlsim.cli.main import main
from hlsim.data.manifest import Utterance, write_manifest
from hlsim.evaluation import Item
from hlsim.evaluation.compensators import evaluate_compensators
from hlsim.evaluation.conditions import Unaided, load_enhancers, load_rival
from hlsim.evaluation.digits import DigitTest, reception_threshold
from hlsim.evaluation.measures import NORMAL, PERCEPTION, _band_error_db, network_loss
from hlsim.report.compensators_page import compensators_page
from tests.helpers import measure_aids_briefly

for module in ("matplotlib", "joblib", "pandas"):
    pytest.importorskip(module)

N3 = Audiogram.standard("N3")


class Gain(nn.Module):
    """Gain in dB for all ears but S1, for which it fails."""

    def __init__(self, gain_db: float = 20.0) -> None:
        super().__init__()
        self.register_buffer("gain", torch.tensor(10.0 ** (gain_db / 20.0)))

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        if audiogram == Audiogram.standard("S1"):
            raise RuntimeError("no\nsuch ear")
        return waveform * self.gain


@pytest.fixture
def options(
    speech_dir: Path, quick_scores: None, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Any]:
    """Return settings of an evaluation that takes seconds."""
    measure_aids_briefly(monkeypatch)
    folders = {"speech": speech_dir / "valid", "noise": speech_dir / "train"}
    settings = {"seconds": 0.7, "levels": (60.0, 75.0), "gain_ears": ("N3",)}
    return {**folders, **settings, "jobs": 1}


def test_perception_is_that_of_the_exact_model_and_of_the_loss(
    speech: list[tuple[Tensor, int]],
) -> None:
    clean = set_level(speech[0][0][0, :12800], 65.0)
    noisy = clean + set_level(torch.randn(12800), 65.0)
    item, output = Item("", clean, noisy, N3), 3.0 * noisy
    values = PERCEPTION.compute(item, output)
    network = load_pretrained("neuro-msbg")
    losses = {"msbg": values["loss_msbg"]}
    losses[network] = network_loss(network).compute(item, output)["loss_neuro"]
    with torch.no_grad():
        error = level_spl(MSBG(N3)(output)) - level_spl(MSBG(NORMAL)(noisy))
        assert values["loudness_error"] == pytest.approx(float(error), abs=1e-3)
        for simulator, loss in losses.items():
            expected = HearingLossLoss(N3, criterion="bands", simulator=simulator)(output, clean)
            assert loss == pytest.approx(float(expected), rel=1e-4)
    with pytest.raises(ValueError, match="audible"):
        _band_error_db(clean, 1e-9 * clean, 16000)


ENHANCERS = """
def half(waveform, sample_rate):
    return waveform / 2
half.fingerprint = "1"
def late(waveform, sample_rate):
    return waveform.roll(320, -1)
"""


def test_conditions_groups_and_page(
    tmp_path: Path, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    # ``test_command`` draws pictures.
    monkeypatch.setattr("hlsim.report.plots._draw_svg", lambda *_: b"<svg></svg>")
    Path("my_enhancer.py").write_text(ENHANCERS)
    enhancers = ["my_enhancer:half"]
    aid = Gain()
    aid.limit_to_ear = True
    study = evaluate_compensators(
        {"mine": aid}, **options, audiogram=N3, items=2, enhancers=enhancers, listen=1
    )
    assert study.settings["limited_to_ear"] == ["mine"]
    assert study.settings["audiogram"] == N3.to_dict()
    names = ["unaided", "NAL-R", "half + NAL-R", "WDRC", "half + WDRC"]
    names += ["NAL-R at mine's level", "equaliser at mine's level", "half + mine", "mine"]
    assert study.names == names and len(study.table) == 2 * len(names)
    level = study.wide("level")
    assert (level["mine"] - level["unaided"]).to_numpy() == pytest.approx(20.0, abs=1e-3)
    assert (level["half + mine"] - level["mine"]).to_numpy() == pytest.approx(-6.02, abs=0.01)
    for rival in ("NAL-R at mine's level", "equaliser at mine's level"):
        assert level[rival].to_numpy() == pytest.approx(level["mine"].to_numpy(), abs=1e-3)
    errors = study.wide("band_error")  # The equaliser of a plain gain is that gain.
    equalised = errors["equaliser at mine's level"].to_numpy()
    assert equalised == pytest.approx(errors["mine"].to_numpy(), abs=0.5)
    assert set(study.groups) >= {"clean", "noisy"}
    for group in study.groups.values():
        (planned,) = (c for c in group.comparisons if c.planned)
        assert (planned.measure, planned.before, planned.after) == ("haspi", names[5], "mine")
    page = compensators_page(study)
    assert page.verdict.startswith("On clean speech, mine ")
    assert [section.title for section in page.sections][:2] == ["Scores", "Listen"]
    (example,) = page.sections[1].sections
    assert len(example.player.sounds) == 4, "normal ear, unaided, NAL-R at the same level, mine"
    assert "my_enhancer:half" in page.markdown() and page.html().count("<audio") == 4


@pytest.mark.slow
def test_short_recordings_have_the_stated_level_in_gain_curves(
    tmp_path: Path, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = torch.randn(16000, generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr("hlsim.evaluation.compensators.perceive_items", lambda *_: [])
    curves = []
    for times in (1, 4):
        folder = tmp_path / str(times)
        write_audio(folder / "clip.wav", 0.1 * clip.tile(times), 16000)
        settings = {**options, "speech": folder, "noise": None, "items": 1, "audiogram": N3}
        curves.append(evaluate_compensators({"mine": Gain()}, **settings).details["gain_curves"])
    short, long = (next(row for row in rows if row["aid"] == "WDRC") for rows in curves)
    difference = np.subtract(short["gain_db"], long["gain_db"])
    assert float(np.median(np.abs(difference))) < 0.5  # about 1.7 with silence after the clip


@pytest.mark.slow
def test_another_prescription_may_be_the_rival(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hlsim.report.plots._draw_svg", lambda *_: b"<svg></svg>")
    study = evaluate_compensators(
        {"mine": Gain()}, **options, audiogram=N3, items=2, rival="for-ear", loudness={65: -4}
    )
    usual = evaluate_compensators({"mine": Gain()}, **options, audiogram=N3, items=2)
    for name in ("unaided", "mine"):  # whose errors are 4 dB higher than against normal loudness
        errors = [table.wide("loudness_error")[name].to_numpy() for table in (study, usual)]
        assert errors[0] - errors[1] == pytest.approx(4.0, abs=1e-6)
    tones, usual_tones = (
        torch.tensor([row["loudness_error_db"] for row in table.details["steady_tones"]][:1])
        for table in (study, usual)
    )
    torch.testing.assert_close(tones, usual_tones + 4.0)
    relative = study.wide("level_over_nal_r")
    assert not relative["NAL-R"].any() and abs(relative["mine"]).min() > 0.1
    assert study.names == usual.names  # N3 gets NAL-R by the rule
    planned = [c.before for group in study.groups.values() for c in group.comparisons if c.planned]
    assert planned == ["NAL-R at mine's level"] * 2
    with pytest.raises(ValueError, match="NAL-R is always evaluated"):
        evaluate_compensators({"NAL-R": Gain()}, **options, rival="camfit")
    with pytest.raises(ValueError, match="expected rival to be"):
        evaluate_compensators({"mine": Gain()}, **{**options, "rival": "nal-nl2"})


@pytest.mark.slow
def test_a_profound_ear_has_another_rival_than_the_others(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("hlsim.report.plots._draw_svg", lambda *_: b"<svg></svg>")
    ears = tmp_path / "ears.csv"
    ears.write_text("hl_500,hl_2000\n80,95\n")
    study = evaluate_compensators(
        {"mine": Gain()}, **options, audiograms=ears, items=2, rival="for-ear", loudness={65: -4}
    )
    rival = "prescription for the ear"
    assert study.names[1:5] == ["NAL-R", rival, "WDRC", f"{rival} at mine's level"]
    for kind in ("gain_curves", "steady_tones", "wearing"):
        aids = [row["aid"] for row in study.details[kind]]  # for N3, which gets NAL-R
        assert "NAL-R" in aids and rival not in aids
    page = compensators_page(study)
    assert f"{rival} at the same level" in page.verdict
    assert "Loudness error from -4 dB at 65 (dB)" in page.markdown()
    _, chosen = load_rival("for-ear", [N3, Audiogram([95.0] * 8)])
    sound = torch.randn(1000)
    for ear, prescription in ((N3, NALR()), (Audiogram([95.0] * 8), NALRP())):
        assert torch.equal(chosen(sound, ear), prescription(sound, ear))


@pytest.mark.slow
def test_thresholds_in_noise_are_measured_for_each_ear_and_aid(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = DigitTest.draw(30, simulator="attenuation")
    expected = reception_threshold(["N2", "N4"], Gain(), simulator="attenuation", triplets=30)
    monkeypatch.setattr(DigitTest, "draw", lambda seed: quick)
    options["gain_ears"] = ("N2", "N4")
    study = evaluate_compensators({"mine": Gain()}, **options, items=1, srt=True)
    rows = study.details["reception_thresholds"]
    names = ["unaided", "NAL-R", "WDRC", "mine"]
    assert [(row["ear"], row["aid"]) for row in rows] == [
        (ear, name) for ear in ("N2", "N4") for name in names
    ]
    thresholds = [row["threshold_db"].value for row in rows]
    assert thresholds[::4] == expected.unaided.value.tolist()
    assert expected.aided is not None and thresholds[3::4] == expected.aided.value.tolist()
    assert [row["benefit_db"].value for row in rows[:4]] == [
        thresholds[0] - x for x in thresholds[:4]
    ]
    page = compensators_page(study)
    (section,) = (section for section in page.sections if section.title == "Digits in noise")
    value, low, high = rows[3]["threshold_db"]
    assert f"{value:.1f} [{low:.1f}, {high:.1f}]" in page.markdown()
    assert len(section.tables) == len(section.pictures) == 1
    assert b"<svg" in section.pictures[0].data


def test_a_delayed_enhancer_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "plugin.py").write_text(ENHANCERS)
    with pytest.raises(ValueError, match="delays by 20"):
        load_enhancers([f"{tmp_path}/plugin.py:late"])


@pytest.mark.slow
def test_an_item_counts_only_if_every_condition_has_its_values(
    ears_file: Path, options: dict[str, Any]
) -> None:
    options["noise"] = None
    study = evaluate_compensators({"mine": Gain()}, **options, audiograms=ears_file, items=7)
    failures = study.failures
    assert set(failures.ear) == {"S1"} and failures.failure.str.contains("no such ear").all()
    assert set(study.groups["clean"].table.ear) == {"N2", "N3", "N4", "N5", "N6", "S2"}
    page = compensators_page(study).markdown()
    assert "no such ear" in page
    assert "leave out 1 item without all values" in page


@pytest.mark.slow
def test_only_a_further_compensator_is_evaluated(tmp_path: Path, options: dict[str, Any]) -> None:
    store = tmp_path / "scores.jsonl"
    values = 5  # of each output: HASPI, HASQI, levels, perception, the network's loss
    aids: list[tuple[dict[str, nn.Module], int]] = [
        ({"a": Gain()}, 6),
        ({"a": Gain()}, 6),
        ({"a": Gain(), "b": Gain(10.0)}, 9),
    ]
    for compensators, outputs in aids:
        evaluate_compensators(compensators, **options, audiogram=N3, items=1, store=store)
        assert store.read_text().count("\n") == values * outputs


@pytest.mark.slow
def test_the_gap_is_undefined_without_a_loss(options: dict[str, Any]) -> None:
    options["noise"] = None
    study = evaluate_compensators({"mine": Gain(0.0)}, **options, audiogram=NORMAL, items=2)
    assert study.table.loss_msbg[study.table.condition == "unaided"].eq(0.0).all()
    text = compensators_page(study).markdown()
    assert "nan" not in text.replace("pronan", "") and "n/a" in text


def test_invalid_settings_are_rejected(options: dict[str, Any]) -> None:
    for changes in (
        {"compensators": {}},
        {"compensators": {"NAL-R": Unaided()}},
        {"compensators": {"mine": NALR(sample_rate=44100)}},
        {"compensators": {"mine": NALR(full_scale_spl=100.0)}},
        {"items": 0},
        {"seconds": 0.01},
        {"audiogram": "N7"},
        {"audiogram": 3},
        {"enhancers": ["no_such:module"]},
        {"audiograms": "ears.csv"},
        {"root": "."},
    ):
        settings = {"compensators": {"mine": Unaided()}, "audiogram": N3, **options, **changes}
        with pytest.raises(ValueError):
            evaluate_compensators(**settings)


def test_an_evaluation_without_any_loudness_error_names_the_reason(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any) -> Tensor:
        raise ValueError("the simulator is broken")

    monkeypatch.setattr("hlsim.evaluation.measures.perceive", fail)
    options |= {"noise": None, "items": 1, "audiogram": N3}
    with pytest.raises(ValueError, match=r"has a value of loudness_error; .*simulator is broken"):
        evaluate_compensators({"mine": Unaided()}, **options)


def test_command(
    options: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = MappingCompensator(config=MappingConfig(channels=8, blocks=1))
    about = {"audiogram": Audiogram.standard("N4").to_dict()}
    save_checkpoint(tmp_path / "n4", "mapping-compensator", model, model.config.to_dict(), about)
    command = ["evaluate-compensator", f"mine={tmp_path / 'n4'}", "--speech", options["speech"]]
    command += ["--items", "2", "--seconds", "0.7", "--out", tmp_path / "out", "--jobs", "1"]
    command += ["--audiogram", "N3"]
    assert main([str(part) for part in command]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("On clean speech, mine") and "report.html" in printed.out
    warning = "mine was trained for one ear, 55, 55, 55"
    assert f"hlsim: warning: {warning}" in printed.err and "60 of 60 scores" in printed.err
    assert warning in (tmp_path / "out" / "report.md").read_text()


class Sum(nn.Module):
    """Aid that adds the signals of two microphones of each ear."""

    takes_microphones = True

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        assert not self.training
        if waveform.shape[:-1] != (2, 2):
            raise ValueError("expected 2 microphones at 2 ears")
        return waveform.sum(0)


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    """Manifest of a scene whose rear microphones have the noise with the opposite sign."""
    generator = np.random.default_rng(0)
    clean, noise = (0.05 * torch.from_numpy(generator.normal(size=(2, 2, 16000)))).float()
    write_audio(tmp_path / "clean.wav", clean, 16000)
    write_audio(tmp_path / "mixture.wav", torch.cat((clean + noise, clean - noise)), 16000)
    row = Utterance("clean.wav", "mixture.wav", split="test", reference="1 2")
    write_manifest(tmp_path / "manifest.csv", [row])
    return tmp_path / "manifest.csv"


@pytest.mark.slow
def test_aids_with_several_microphones_are_compared_in_recorded_scenes(
    manifest: Path, options: dict[str, Any]
) -> None:
    options |= {"speech": None, "noise": None, "manifest": manifest}
    study = evaluate_compensators({"mine": Sum()}, **options, audiogram=N3, items=2)
    conditions = {condition.name: condition for condition in study.conditions}
    items: Any = study.items
    for item in items:
        assert item.signal.shape == (2, 2, 11200)
        output = conditions["mine"].output(item)  # the sum, in which there is no noise
        torch.testing.assert_close(output, 2.0 * item.clean, atol=1e-4, rtol=1e-3)
        assert torch.equal(conditions["unaided"].output(item), item.reference_signal)
        rival = conditions["NAL-R at mine's level"].output(item)
        torch.testing.assert_close(level_spl(rival), level_spl(output))
        prescribed = NALR(N3)(item.reference_signal)
        assert float(torch.cosine_similarity(rival, prescribed, -1)) > 0.999
    assert "mine has several microphones" in compensators_page(study).markdown()


def test_aids_with_several_microphones_need_their_recordings(
    manifest: Path, options: dict[str, Any]
) -> None:
    with pytest.raises(ValueError, match="mine has several microphones; expected a manifest"):
        evaluate_compensators({"mine": Sum()}, **options, audiogram=N3)
    options |= {"manifest": manifest}
    with pytest.raises(ValueError, match=r"either speech, .* or a manifest"):
        evaluate_compensators({"mine": Sum()}, **options, audiogram=N3)
    options |= {"speech": None, "noise": None}
    manifest.write_text(manifest.read_text().replace("1 2", "1"))
    write_audio(manifest.parent / "clean.wav", torch.ones(16000), 16000)
    with pytest.raises(ValueError, match="expected 2 microphones at 2 ears"):
        evaluate_compensators({"mine": Sum()}, **options, audiogram=N3, items=1)
    manifest.write_text(manifest.read_text().replace("test", "train"))
    with pytest.raises(ValueError, match="the split test or valid"):
        evaluate_compensators({"mine": Sum()}, **options, audiogram=N3, items=1)
