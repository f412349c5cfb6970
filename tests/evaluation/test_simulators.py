"""Items, truth and tables of the comparison of simulators."""

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim import MSBG, Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.fidelity import snr_db
from hlsim.evaluation.simulators import LEVELS, _items, evaluate_simulators
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
    draw = [_items(speech_dir / "valid", speech_dir / "train", ears, 40, 2.0, seed) for seed in (0, 0, 1)]
    assert all(torch.equal(a[1], b[1]) for a, b in zip(draw[0], draw[1], strict=True))
    assert not torch.equal(draw[0][0][1], draw[2][0][1])
    about = [item[3] for item in draw[0]]
    assert {entry["level"] for entry in about} == set(LEVELS)
    assert {entry["condition"] for entry in about} == {"clean", "noisy"}
    assert {entry["severity"] for entry in about} >= {"none", "severe"}
    for clean, signal, ear, entry in draw[0]:
        assert float(level_spl(signal)) == pytest.approx(entry["level"], abs=0.01)
        assert torch.equal(clean, signal) == (entry["condition"] == "clean")
        assert ear.severity == entry["severity"]


def test_files_and_an_identity_is_no_simulator(tmp_path: Path, speech_dir: Path, ears: Path) -> None:
    class Unimpaired(torch.nn.Module):
        def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
            return waveform

    out = tmp_path / "out"
    result = evaluate_simulators(
        {"exact": MSBG(sample_rate=16000), "identity": Unimpaired()},
        speech=speech_dir / "valid",
        audiograms=ears,
        out=out,
        teacher="msbg",
        items=6,
        seconds=1.5,
    )
    exact, identity = (result["simulators"][name]["items"] for name in ("exact", "identity"))
    assert min(row["snr"] for row in exact) > 100.0 > max(row["snr"] for row in identity)
    assert json.loads((out / "fidelity.json").read_text()) == json.loads(json.dumps(result))
    assert {path.name for path in out.iterdir()} == {"fidelity.json", "fidelity.md"}


def test_unknown_teacher(tmp_path: Path, speech_dir: Path, ears: Path) -> None:
    with pytest.raises(ValueError, match="allowed: pyclarity, msbg"):
        evaluate_simulators({}, speech=speech_dir, audiograms=ears, out=tmp_path, teacher="nobody")
