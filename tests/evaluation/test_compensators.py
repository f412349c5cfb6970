"""Compensators beside their rivals: measures, conditions, groups, what counts, and the page."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from compensators import MappingCompensator
from compensators.config import MappingConfig
from hlsim import MSBG, Audiogram, HearingLossLoss, load_pretrained
from hlsim.calibration import level_spl, set_level
from hlsim.cli.main import main
from hlsim.evaluation import Item, measurements, measures
from hlsim.evaluation.aids import EqualiserLike, Unaided, equalise_bands
from hlsim.evaluation.compensators import evaluate_compensators
from hlsim.evaluation.measurements import insertion_gain
from hlsim.evaluation.measures import PERCEPTION, band_error_db, network_loss, peak_spl
from hlsim.losses.band_levels import band_edges
from hlsim.pretrained import save_checkpoint
from hlsim.report.compensators import compensators_page

for module in ("matplotlib", "joblib", "pandas"):
    pytest.importorskip(module)

N3 = Audiogram.standard("N3")


class Gain(nn.Module):
    """A gain in dB, whatever the ear; it fails for S1."""

    def __init__(self, gain_db: float = 20.0) -> None:
        super().__init__()
        self.register_buffer("gain", torch.tensor(10.0 ** (gain_db / 20.0)))

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        if audiogram == Audiogram.standard("S1"):
            raise RuntimeError("no\nsuch ear")
        return waveform * self.gain


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Meaningless scores in place of HASPI and HASQI, and one tone: seconds, not minutes."""

    def score(name: str, share: float) -> Any:
        return lambda item, output: {name: share * float(output.std() / (output.std() + 0.1))}

    monkeypatch.setattr(measurements, "TONES", (1000,))
    for name, share in (("haspi", 1.0), ("hasqi", 0.5)):
        measure = replace(measures.MEASURES[name], compute=score(name, share))
        monkeypatch.setitem(measures.MEASURES, name, measure)


@pytest.fixture
def options(speech_dir: Path) -> dict[str, Any]:
    folders = {"speech": speech_dir / "valid", "noise": speech_dir / "train"}
    return {**folders, "seconds": 0.4, "jobs": 1, "gain_ears": ("N3",)}


def test_perception_is_that_of_the_exact_model_and_of_the_loss(
    speech: list[tuple[Tensor, int]],
) -> None:
    clean = set_level(speech[0][0][0, :12800], 65.0)
    noisy = clean + set_level(torch.randn(12800), 65.0)
    item, output = Item("", clean, noisy, N3), 3.0 * noisy
    values = PERCEPTION.compute(item, output)
    ear, normal = MSBG(N3, sample_rate=16000), MSBG(Audiogram.standard("NH"), sample_rate=16000)
    with torch.no_grad():
        levels = {
            "perceived_level": ear(output),
            "normal_level": normal(noisy),
            "normal_clean_level": normal(clean),
        }
        for name, signal in levels.items():
            assert values[name] == pytest.approx(float(level_spl(signal)), abs=1e-3)
        network = load_pretrained("neuro-msbg-light")
        for simulator, loss in (
            ("msbg", values["loss_msbg"]),
            (network, network_loss(network).compute(item, output)["loss_neuro"]),
        ):
            expected = HearingLossLoss(N3, criterion="bands", simulator=simulator)(output, clean)
            assert loss == pytest.approx(float(expected), rel=1e-4)


def test_band_errors_and_peaks(speech: list[tuple[Tensor, int]]) -> None:
    waveform = set_level(speech[0][0][0, :32000], 65.0)
    assert band_error_db(0.1 * waveform, waveform, 16000) == pytest.approx(20.0, abs=0.01)
    with pytest.raises(ValueError, match="audible"):
        band_error_db(waveform, 1e-9 * waveform, 16000)
    assert peak_spl(torch.tensor([0.0, -10.0, 0.5])) == pytest.approx(114.0)


def test_an_equaliser_has_the_mean_gain_of_its_aid() -> None:
    edges = band_edges()
    gains = np.interp(np.linspace(0.0, 1.0, len(edges) - 1), [0.0, 0.4, 1.0], [0.0, 10.0, 40.0])

    class Filter(nn.Module):
        def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
            return equalise_bands(waveform, gains.tolist())

    noise = torch.randn(1, 48000)
    measured = insertion_gain(Filter(), N3, noise, (65.0,))
    # a band is as loud as its loudest part where the gain rises steeply
    np.testing.assert_allclose(measured[0], gains, atol=1.0)
    equaliser = EqualiserLike(Filter(), noise, (50.0, 80.0))
    assert equaliser.gains_db(N3) == pytest.approx(measured[0], abs=0.06)
    limited = MappingCompensator(MappingConfig(limit_spl=80.0)).eval()
    soft, loud = insertion_gain(limited, N3, noise, (50.0, 80.0))
    assert np.mean(loud) < np.mean(soft) - 6.0


@pytest.mark.usefixtures("quick")
def test_conditions_groups_and_page(
    tmp_path: Path, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my_enhancer.py").write_text(
        "def half(waveform, sample_rate):\n    return waveform / 2\nhalf.fingerprint = '1'\n"
    )
    study = evaluate_compensators(
        {"mine": Gain()},
        **options,
        audiogram=N3,
        items=4,
        enhancers=["my_enhancer:half"],
        notes=["A note."],
    )
    names = ["unaided", "NAL-R", "half + NAL-R", "WDRC", "half + WDRC"]
    names += ["NAL-R at mine's level", "equaliser at mine's level", "half + mine", "mine"]
    assert study.names == names and len(study.table) == 4 * len(names)
    level = study.wide("level")
    gained = level["mine"] - level["unaided"]
    assert gained.to_numpy() == pytest.approx(20.0, abs=1e-3)
    assert (level["half + mine"] - level["mine"]).to_numpy() == pytest.approx(-6.02, abs=0.01)
    for rival in ("NAL-R at mine's level", "equaliser at mine's level"):
        assert level[rival].to_numpy() == pytest.approx(level["mine"].to_numpy(), abs=1e-3)
    # the equaliser of a plain gain is that gain
    band_error = study.wide("band_error")
    assert band_error["equaliser at mine's level"].to_numpy() == pytest.approx(
        band_error["mine"].to_numpy(), abs=0.5
    )
    assert set(study.groups) >= {"clean", "noisy"}
    for group in study.groups.values():
        (planned,) = (c for c in group.comparisons if c.planned)
        assert (planned.measure, planned.before, planned.after) == ("haspi", names[5], "mine")
    page = compensators_page(study, listen=1)
    assert page.verdict.startswith("On clean speech, mine ") and "A note." in page.markdown()
    assert [section.title for section in page.sections][:2] == ["Scores", "Listen"]
    (example,) = page.sections[1].sections
    assert len(example.players) == 4, "clean speech, unaided, NAL-R at the same level, mine"
    assert "my_enhancer:half" in page.markdown() and page.html().count("<audio") == 4


@pytest.mark.usefixtures("quick")
def test_an_item_that_one_condition_fails_on_counts_nowhere_and_is_listed(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    ears = tmp_path / "ears.csv"
    ears.write_text(f"{','.join(N3.to_row())}\n{','.join(N3.to_row().values())}\n")
    options["noise"] = None
    study = evaluate_compensators({"mine": Gain()}, **options, audiograms=ears, items=7)
    failed = study.failures
    assert set(failed.ear) == {"S1"} and failed.failure.str.contains("no such ear").all()
    assert set(study.groups["clean"].table.ear) == {"N2", "N3", "N4", "N5", "N6", "S2"}
    assert "no such ear" in compensators_page(study, listen=0).markdown()


@pytest.mark.usefixtures("quick")
def test_a_further_compensator_is_judged_alone(tmp_path: Path, options: dict[str, Any]) -> None:
    store = tmp_path / "scores.jsonl"

    def lines(**aids: nn.Module) -> int:
        before = store.read_text().count("\n") if store.exists() else 0
        evaluate_compensators(aids, **options, audiogram=N3, items=1, store=store)
        return store.read_text().count("\n") - before

    values = 5  # of each output: HASPI, HASQI, levels, perception, the network's loss
    assert lines(a=Gain()) == values * 6
    assert lines(a=Gain()) == 0
    assert lines(a=Gain(), b=Gain(10.0)) == values * 3


@pytest.mark.usefixtures("quick")
def test_where_nothing_is_lost_the_gap_is_not_relative(options: dict[str, Any]) -> None:
    options["noise"] = None
    study = evaluate_compensators(
        {"mine": Gain(0.0)}, **options, audiogram=Audiogram.standard("NH"), items=2
    )
    unaided = study.table[study.table.condition == "unaided"]
    assert unaided.loss_msbg.eq(0.0).all()
    text = compensators_page(study, listen=0).markdown()
    assert "nan" not in text.replace("pronan", "") and "n/a" in text


@pytest.mark.parametrize(
    "changes",
    [
        {"compensators": {}},
        {"compensators": {"NAL-R": Unaided()}},
        {"compensators": {"mine": lambda waveform, ear: waveform}},
        {"audiogram": None},
        {"items": 0},
        {"levels": (130.0,)},
        {"seed": -1},
        {"audiogram": Audiogram.standard("N7")},
        {"enhancers": ["no_such:module"]},
        {"items": 1, "seconds": 0.5, "noise": None},  # HASPI needs 0.7 s
    ],
)
def test_what_cannot_be_judged_is_rejected(
    options: dict[str, Any], changes: dict[str, Any]
) -> None:
    settings = {"compensators": {"mine": Unaided()}, "audiogram": N3, **options, **changes}
    with pytest.raises(ValueError):
        evaluate_compensators(**settings)


@pytest.mark.usefixtures("quick")
def test_command(tmp_path: Path, speech_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = MappingCompensator(MappingConfig(channels=8, blocks=1))
    about = {"audiogram": Audiogram.standard("N4").to_dict()}
    save_checkpoint(tmp_path / "n4", "mapping-compensator", model, model.config.to_dict(), about)
    command = ["evaluate-compensator", f"mine={tmp_path / 'n4'}", "--speech", speech_dir / "valid"]
    command += ["--items", "2", "--seconds", "0.4", "--out", tmp_path / "out", "--jobs", "1"]

    def run(*more: str) -> tuple[int, str, str]:
        status = main([str(part) for part in (*command, *more)])
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    status, out, err = run("--audiogram", "N3", "--listen", "0")
    assert status == 0 and out.startswith("On clean speech, mine") and "report.html" in out
    assert "hlsim: warning: mine was trained for one ear, 55, 55, 55" in err
    assert "60 of 60 values" in err
    assert run()[0] == 2, "no ear is named"
