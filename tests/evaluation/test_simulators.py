"""Items, truth and tables of the comparison of simulators."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from compensators import NALR
from hlsim import MSBG, Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation import simulators
from hlsim.evaluation.fidelity import snr_db
from hlsim.evaluation.fidelity_items import LEVELS, draw_items, treat
from hlsim.evaluation.simulators import evaluate_simulators, weights_hash
from hlsim.evaluation.truth import pyclarity_msbg

pytest.importorskip("clarity")
pytest.importorskip("pesq")


@pytest.fixture
def ears(tmp_path: Path) -> Path:
    path = tmp_path / "ears.csv"
    rows = [Audiogram.standard(name).to_row() for name in ("N3", "N5")]
    path.write_text("\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]))
    return path


@pytest.mark.parametrize(("name", "level"), [("NH", 65.0), ("N2", 50.0), ("N3", 80.0)])
def test_truth_is_the_exact_model(speech: list[tuple[Tensor, int]], name: str, level: float) -> None:
    waveform, rate = speech[0]
    signal = set_level(waveform[0, : 2 * rate], level)
    ear = Audiogram.standard(name)
    assert snr_db(pyclarity_msbg(signal, ear, rate), MSBG(ear, sample_rate=rate)(signal)) > 40.0


def test_items_are_the_same_for_a_seed_and_cover_what_they_say(speech_dir: Path, ears: Path) -> None:
    draw = [
        draw_items(speech_dir / "valid", speech_dir / "train", ears, items=40, seconds=2.0, seed=seed)
        for seed in (0, 0, 1)
    ]
    assert all(torch.equal(a.signal, b.signal) for a, b in zip(draw[0], draw[1], strict=True))
    assert not torch.equal(draw[0][0].signal, draw[2][0].signal)
    about = [item.about for item in draw[0]]
    assert {entry["level"] for entry in about} == set(LEVELS)
    assert {entry["condition"] for entry in about} == {"clean", "noisy"}
    assert {entry["severity"] for entry in about} >= {"none", "severe"}
    for item in draw[0]:
        assert float(level_spl(item.signal)) == pytest.approx(item.about["level"], abs=0.01)
        assert torch.equal(item.clean, item.signal) == (item.about["condition"] == "clean")
        assert item.ear.severity == item.about["severity"]


def test_inputs_are_what_their_names_say(speech_dir: Path, ears: Path) -> None:
    drawn = draw_items(speech_dir / "valid", None, ears, items=2, seconds=1.5, seed=0, levels=(65.0,))
    inputs = ("as-is", "louder", "nal-r", "compressed", "compensated")
    halved = torch.nn.Module()
    halved.forward = lambda waveform, ear: 0.5 * waveform  # type: ignore[method-assign]
    treated = list(treat(drawn, inputs, halved))
    assert [item.about["input"] for item in treated] == [*inputs] * 2
    for own, (as_is, louder, amplified, compressed, compensated) in zip(
        drawn, (treated[:5], treated[5:]), strict=True
    ):
        assert torch.equal(as_is.signal, own.signal) and torch.equal(amplified.clean, own.clean)
        assert float(level_spl(louder.signal)) == pytest.approx(85.0, abs=0.01)
        assert torch.equal(amplified.signal, NALR(own.ear)(own.signal))
        assert torch.equal(compensated.signal, 0.5 * own.signal)
        # compression brings frames' levels nearer to each other, down to 30 dB below the mean
        frames = [item.signal.unfold(0, 400, 400).square().mean(-1).log10() for item in (as_is, compressed)]
        loud = frames[0] > frames[0].max() - 2.0
        spread = [float(levels[loud].std()) for levels in frames]
        assert spread[1] < 0.7 * spread[0]
    with pytest.raises(ValueError, match="allowed: as-is, louder, nal-r, compressed, and compensated with a"):
        next(treat(drawn, ["compensated"]))


class Unimpaired(torch.nn.Module):
    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        return waveform


def test_files_and_an_identity_is_no_simulator(tmp_path: Path, speech_dir: Path, ears: Path) -> None:
    out = tmp_path / "out"
    result = evaluate_simulators(
        {"exact": MSBG(sample_rate=16000), "identity": Unimpaired()},
        speech=speech_dir / "valid",
        audiograms=ears,
        out=out,
        teacher="msbg",
        items=4,
        seconds=1.5,
        inputs=("as-is", "louder"),
    )
    exact, identity = (result["simulators"][name]["items"] for name in ("exact", "identity"))
    assert len(exact) == 8 and {row["input"] for row in exact} == {"as-is", "louder"}
    assert min(row["snr"] for row in exact) > 100.0 > max(row["snr"] for row in identity)
    assert json.loads((out / "fidelity.json").read_text()) == json.loads(json.dumps(result))
    assert {path.name for path in out.iterdir()} == {
        "fidelity.json",
        "fidelity.md",
        "fidelity.html",
        "spectrograms.png",
        "scores.jsonl",
    }
    text = (out / "fidelity.md").read_text()
    assert "## Speech as it is" in text and "| exact | 4 |" in text and "## identity: 20 db louder" in text
    page = (out / "fidelity.html").read_text()
    assert "data:image/png" in page and page.count("<svg") + page.count("svg+xml") == 8


def test_a_stopped_comparison_goes_on_and_a_new_simulator_is_scored_alone(
    tmp_path: Path, speech_dir: Path, ears: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"speech": speech_dir / "valid", "audiograms": ears, "teacher": "msbg", "seconds": 1.0}
    whole = evaluate_simulators({"a": Unimpaired()}, **options, items=3, out=tmp_path / "whole")
    scored: list[int] = []
    original = simulators._scores

    def counted(*signals: Tensor) -> dict[str, float | None]:
        if len(scored) == 2:
            raise KeyboardInterrupt
        scored.append(1)
        return original(*signals)

    monkeypatch.setattr(simulators, "_scores", counted)
    with pytest.raises(KeyboardInterrupt):
        evaluate_simulators({"a": Unimpaired()}, **options, items=3, out=tmp_path / "parts")
    assert not (tmp_path / "parts" / "fidelity.json").exists()
    scored[:] = [1]  # one call is left before it stops again
    assert evaluate_simulators({"a": Unimpaired()}, **options, items=3, out=tmp_path / "parts") == whole
    monkeypatch.setattr(simulators, "_scores", original)
    both = {"a": Unimpaired(), "b": MSBG(sample_rate=16000)}
    result = evaluate_simulators(both, **options, items=3, out=tmp_path / "parts")
    assert result["simulators"]["a"] == whole["simulators"]["a"]
    assert len((tmp_path / "parts" / "scores.jsonl").read_text().splitlines()) == 6


def test_modules_that_differ_in_a_setting_differ_in_their_scores_name() -> None:
    modules = [
        MSBG(sample_rate=16000),
        MSBG(sample_rate=16000, rescale_active=True),
        MSBG(Audiogram.standard("N3"), sample_rate=16000),
        NALR(sample_rate=16000),
        NALR(Audiogram.standard("N3"), sample_rate=16000),
    ]
    assert len({weights_hash(module) for module in modules}) == len(modules)
    assert weights_hash(MSBG(sample_rate=16000)) == weights_hash(modules[0])


class Own(torch.nn.Module):
    """A module whose settings are no numbers."""

    def __init__(self, gains: Any) -> None:
        super().__init__()
        self._gains = gains


def test_settings_of_any_kind_tell_modules_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = (
        [1.0],
        [2.0],
        {"a": 1.0},
        {"a": 2.0},
        None,
        np.ones(2),
        np.zeros(2),
        torch.ones(3),
        torch.float32,
    )
    hashes = [weights_hash(Own(gains)) for gains in kinds]
    assert len(set(hashes)) == len(hashes)
    assert hashes == [weights_hash(Own(gains)) for gains in kinds]
    # what a class of one's own does counts too
    monkeypatch.setattr("inspect.getsource", lambda kind: "changed")
    assert weights_hash(Own([1.0])) != hashes[0]


def test_unknown_teacher(tmp_path: Path, speech_dir: Path, ears: Path) -> None:
    with pytest.raises(ValueError, match="allowed: pyclarity, msbg"):
        evaluate_simulators({}, speech=speech_dir, audiograms=ears, out=tmp_path, teacher="nobody")
