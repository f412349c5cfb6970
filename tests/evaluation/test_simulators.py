"""Items, truth and tables of the comparison of simulators."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from compensators import NALR
from hlsim import MSBG, Audiogram
from hlsim.calibration import level_spl
from hlsim.evaluation.previous import simulators
from hlsim.evaluation.previous.items import LEVELS, draw_items, treat
from hlsim.evaluation.previous.simulators import evaluate_simulators, summarise
from hlsim.report.previous.simulators import write_fidelity

pytest.importorskip("clarity")
pytest.importorskip("pesq")


@pytest.fixture
def ears(tmp_path: Path) -> Path:
    path = tmp_path / "ears.csv"
    rows = [Audiogram.standard(name).to_row() for name in ("N3", "N5")]
    path.write_text("\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]))
    return path


def test_items_are_the_same_for_a_seed_and_cover_what_they_say(
    speech_dir: Path, ears: Path
) -> None:
    draw = [
        draw_items(
            speech_dir / "valid", speech_dir / "train", ears, items=40, seconds=2.0, seed=seed
        )
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


@pytest.mark.parametrize("count", [2, 4, 5])
def test_every_kind_of_ear_meets_every_level_at_every_ratio(
    speech_dir: Path, ears: Path, count: int
) -> None:
    levels, each = [50.0, 55.0, 60.0, 70.0, 80.0][:count], 16 * count
    drawn = draw_items(
        speech_dir / "valid",
        speech_dir / "train",
        ears,
        items=2 * each,
        seconds=0.1,
        seed=0,
        levels=levels,
    )
    noisy = [item.about for item in drawn if item.about["condition"] == "noisy"]
    met = {(number % 4, about["level"], about["noise_snr"]) for number, about in enumerate(noisy)}
    assert len(met) == each == len(noisy)
    standard = {(tuple(about["audiogram"]), about["noise_snr"]) for about in noisy[2::4]}
    assert len({ear for ear, _ in standard}) == 4 and len(standard) > 4
    assert {item.about["noise_snr"] for item in drawn if item.about["condition"] == "clean"} == {
        None
    }


def test_inputs_are_what_their_names_say(speech_dir: Path, ears: Path) -> None:
    drawn = draw_items(
        speech_dir / "valid", None, ears, items=2, seconds=1.5, seed=0, levels=(65.0,)
    )
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
        frames = [
            item.signal.unfold(0, 400, 400).square().mean(-1).log10()
            for item in (as_is, compressed)
        ]
        loud = frames[0] > frames[0].max() - 2.0
        spread = [float(levels[loud].std()) for levels in frames]
        assert spread[1] < 0.7 * spread[0]
    with pytest.raises(
        ValueError, match="allowed: as-is, louder, nal-r, compressed, and compensated with a"
    ):
        next(treat(drawn, ["compensated"]))


def compare(simulators: dict[str, torch.nn.Module], out: Path, **options: Any) -> dict[str, Any]:
    """Evaluated and written, as the command does it."""
    done = evaluate_simulators(simulators, store=out / "scores.jsonl", **options)
    write_fidelity(done.result, done.heard, done.shown, out)
    return done.result


class Unimpaired(torch.nn.Module):
    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        return waveform


def test_files_and_an_identity_is_no_simulator(
    tmp_path: Path, speech_dir: Path, ears: Path
) -> None:
    out = tmp_path / "out"
    result = compare(
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
    assert (
        "## Speech as it is" in text
        and "| exact | 4 |" in text
        and "## identity: 20 dB louder" in text
    )
    assert text.splitlines()[2].startswith(
        "SNR in dB against hlsim's exact MSBG, median item (worst tenth): exact "
    )
    page = (out / "fidelity.html").read_text()
    # four a simulator; the original, the reference, and two a simulator
    assert page.count("data:image/svg+xml") == 2 * 4 + 2 + 2 * 2
    assert 'alt="Spectrogram: identity less reference"' in page


class FailsOnHardEars(torch.nn.Module):
    def __init__(self, how: str) -> None:
        super().__init__()
        self.how = how

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        if audiogram.severity != "severe":
            return waveform
        if self.how == "raise":
            raise RuntimeError("not that ear")
        return waveform * (0.0 if self.how == "silent" else torch.nan)


def test_what_a_simulator_fails_on_is_told(tmp_path: Path, speech_dir: Path, ears: Path) -> None:
    failing = {how: FailsOnHardEars(how) for how in ("raise", "nan", "silent")}
    result = compare(
        {"identity": Unimpaired(), **failing, "exact": MSBG(sample_rate=16000)},
        speech=speech_dir / "valid",
        audiograms=ears,
        out=tmp_path,
        teacher="msbg",
        items=8,
        seconds=1.5,
    )
    whole = {
        name: entry["inputs"]["as-is"]["overall"] for name, entry in result["simulators"].items()
    }
    hard = sum(row["severity"] == "severe" for row in result["simulators"]["identity"]["items"])
    assert 0 < hard < 8 and all(figures["n"] == 8 for figures in whole.values())
    assert [whole[name]["snr_n"] for name in whole] == [8, 8 - hard, 8 - hard, 8, 8]
    assert [whole[name]["stoi_n"] for name in whole] == [8, 8 - hard, 8 - hard, 8 - hard, 8]
    text = (tmp_path / "fidelity.md").read_text()
    failures = text[text.index("## Failures") :]
    assert failures.count("RuntimeError: not that ear") == failures.count("NaN or infinite") == hard
    assert failures.count("| silent |") == 2 * hard and "identity" not in failures
    assert (
        f"({8 - hard} of 8)" in text and "not that ear" in (tmp_path / "fidelity.html").read_text()
    )
    # against the first, over the items that both have
    exact = result["simulators"]["exact"]
    assert "snr_over_first" not in result["simulators"]["identity"]
    over = exact["snr_over_first"]["as-is"]
    snr = [
        [row["snr"] for row in result["simulators"][name]["items"]]
        for name in ("identity", "exact")
    ]
    gains = [after - before for before, after in zip(*snr, strict=True)]
    assert over["n"] == 8 and over["delta"] == pytest.approx(sum(gains) / 8)
    assert min(gains) < over["ci_low"] < over["delta"] < over["ci_high"] < max(gains)
    assert result["simulators"]["nan"]["snr_over_first"]["as-is"]["n"] == 8 - hard
    assert (
        "SNR (dB) less that of identity" in text and f"| exact | 8 | {over['delta']:+.3f} [" in text
    )
    # what failed is not stored, but tried again
    assert len((tmp_path / "scores.jsonl").read_text().splitlines()) == 5 * 8 - 2 * hard


def test_what_the_truth_fails_on_is_told_and_is_no_picture(
    tmp_path: Path, speech_dir: Path, ears: Path
) -> None:
    (tmp_path / "strict.py").write_text(
        "def teacher(waveform, audiogram):\n"
        "    if waveform.square().mean() < 1e-6:\n"
        "        raise ValueError('too soft')\n"
        "    return waveform\n"
    )
    teacher = f"{tmp_path}/strict.py:teacher"
    result = compare(
        {"identity": Unimpaired(), "exact": MSBG(sample_rate=16000)},
        teacher=teacher,
        speech=speech_dir / "valid",
        audiograms=ears,
        out=tmp_path,
        items=2,
        seconds=1.0,
        levels=(28.0,),
        inputs=("as-is", "louder"),
    )
    for simulator in result["simulators"].values():
        soft, loud = (simulator["inputs"][given]["overall"] for given in ("as-is", "louder"))
        assert (soft["n"], soft["snr_n"], loud["n"], loud["snr_n"]) == (2, 0, 2, 2)
    text = (tmp_path / "fidelity.md").read_text()
    assert text[text.index("## Failures") :].count("too soft") == 4
    assert "20 dB louder, clean, 28 dB SPL" in (tmp_path / "fidelity.html").read_text()
    with pytest.raises(ValueError, match=r"no item has a truth: .*too soft"):
        compare(
            {"identity": Unimpaired()},
            teacher=teacher,
            speech=speech_dir / "valid",
            audiograms=ears,
            out=tmp_path,
            items=1,
            seconds=1.0,
            levels=(28.0,),
        )


def test_a_stopped_comparison_goes_on_and_a_new_simulator_is_scored_alone(
    tmp_path: Path, speech_dir: Path, ears: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {
        "speech": speech_dir / "valid",
        "audiograms": ears,
        "teacher": "msbg",
        "seconds": 1.0,
    }
    whole = compare({"a": Unimpaired()}, **options, items=3, out=tmp_path / "whole")
    scored: list[int] = []
    original = simulators._scores

    def counted(*signals: Tensor) -> dict[str, float | None]:
        if len(scored) == 2:
            raise KeyboardInterrupt
        scored.append(1)
        return original(*signals)

    monkeypatch.setattr(simulators, "_scores", counted)
    with pytest.raises(KeyboardInterrupt):
        compare({"a": Unimpaired()}, **options, items=3, out=tmp_path / "parts")
    assert not (tmp_path / "parts" / "fidelity.json").exists()
    scored[:] = [1]  # one call is left before it stops again
    assert compare({"a": Unimpaired()}, **options, items=3, out=tmp_path / "parts") == whole
    monkeypatch.setattr(simulators, "_scores", original)
    both = {"a": Unimpaired(), "b": MSBG(sample_rate=16000)}
    result = compare(both, **options, items=3, out=tmp_path / "parts")
    assert result["simulators"]["a"] == whole["simulators"]["a"]
    assert len((tmp_path / "parts" / "scores.jsonl").read_text().splitlines()) == 6


def test_teachers_share_no_stored_scores(
    tmp_path: Path, speech_dir: Path, ears: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples" / "training")
    options = {
        "speech": speech_dir / "valid",
        "audiograms": ears,
        "items": 2,
        "seconds": 1.0,
        "out": tmp_path,
    }
    given = {"identity": Unimpaired()}
    exact = compare(given, teacher="msbg", **options)
    other = compare(given, teacher="dead_region:DeadRegion", **options)
    assert len((tmp_path / "scores.jsonl").read_text().splitlines()) == 4
    assert (other["teacher"], exact["teacher"]) == ("dead_region:DeadRegion", "msbg")
    text = (tmp_path / "fidelity.md").read_text()
    assert text.startswith("# Fidelity\n") and f"Against {other['teacher']}: 2 items" in text
    snr = [
        [item["snr"] for item in result["simulators"]["identity"]["items"]]
        for result in (exact, other)
    ]
    assert snr[0] != snr[1]


def test_unknown_teacher(tmp_path: Path, speech_dir: Path, ears: Path) -> None:
    with pytest.raises(ValueError, match="unknown teachers nobody"):
        compare({}, speech=speech_dir, audiograms=ears, out=tmp_path, teacher="nobody")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"inputs": ("as-is", "louder", "as-is")},
            "inputs as-is, louder, as-is; allowed: each once",
        ),
        ({"seconds": 0.01}, r"items of 0\.01 s; allowed: 0\.02 or more"),
    ],
)
def test_what_would_fail_or_count_twice_is_refused_before_the_work(
    tmp_path: Path, speech_dir: Path, ears: Path, options: dict[str, Any], said: str
) -> None:
    out = tmp_path / "out"
    call: dict[str, Any] = {
        "speech": speech_dir / "valid",
        "audiograms": ears,
        "teacher": "msbg",
        "items": 1,
    }
    with pytest.raises(ValueError, match=said):
        compare({"identity": Unimpaired()}, **call, out=out, **options)
    assert not out.exists()


def test_the_shortest_items_that_are_taken(tmp_path: Path, speech_dir: Path, ears: Path) -> None:
    result = compare(
        {"identity": Unimpaired()},
        speech=speech_dir / "valid",
        audiograms=ears,
        teacher="msbg",
        items=1,
        seconds=0.02,
        out=tmp_path / "out",
    )
    assert result["simulators"]["identity"]["inputs"]["as-is"]["overall"]["snr_n"] == 1


def rows() -> list[dict[str, object]]:
    rng = np.random.default_rng(1)
    out: list[dict[str, object]] = []
    for i in range(60):
        s, p = rng.uniform(0.3, 1.0), rng.uniform(1.0, 4.5)
        out.append(
            {
                "snr": float(rng.normal(18, 3)),
                "raw_mse": float(rng.uniform(0, 0.1)),
                "band_error": float(rng.uniform(0, 2)),
                "stoi_true": s,
                "stoi_sim": s + float(rng.normal(0, 0.02)),
                "pesq_true": p,
                "pesq_sim": None if i % 10 == 0 else p + float(rng.normal(0, 0.2)),
                "severity": ("severe", "none", "mild")[i % 3],
                "level": (80.0, 65)[i % 2],
                "condition": "clean" if i < 40 else None,
            }
        )
    return out


def test_summary_is_of_its_rows() -> None:
    data = rows()
    summary = summarise(data)
    overall = summary["overall"]
    snr = [row["snr"] for row in data]
    assert overall["n"] == 60 and overall["stoi_n"] == 60 and overall["pesq_n"] == 54
    assert overall["snr_median"] == pytest.approx(np.median(snr))
    assert overall["snr_worst_tenth"] == pytest.approx(np.percentile(snr, 10))
    assert overall["raw_mse"] == pytest.approx(np.mean([row["raw_mse"] for row in data]))
    assert overall["band_error_median"] == pytest.approx(
        np.median([row["band_error"] for row in data])
    )
    scored = [row for row in data if row["pesq_sim"] is not None]
    true, simulated = ([row[key] for row in scored] for key in ("pesq_true", "pesq_sim"))
    assert overall["pesq_srcc"] == pytest.approx(stats.spearmanr(true, simulated)[0])
    assert list(summary["severity"]) == ["none", "mild", "severe"]
    assert list(summary["level"]) == ["65", "80"]
    assert {key: figures["n"] for key, figures in summary["condition"].items()} == {"clean": 40}
    assert (
        summary["severity"]["mild"]
        == summarise([r for r in data if r["severity"] == "mild"])["overall"]
    )
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_summary_of_little() -> None:
    summary = summarise([{"snr": 12.0, "severity": "mild"}])
    assert summary["overall"]["snr_median"] == 12.0
    assert summary["overall"]["stoi_lcc"] is None and summary["overall"]["raw_mse"] is None
    assert summary["level"] == {} and summary["overall"]["stoi_n"] == 0
    with pytest.raises(ValueError, match="no items"):
        summarise([])
    with pytest.raises(ValueError, match="snr holds NaN or infinity"):
        summarise([{"snr": math.inf}])
