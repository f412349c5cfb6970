"""Judging compensators: the items, what is measured of each, gain curves, and the report."""

import contextlib
import json
import math
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from compensators import NALR, MappingCompensator, MappingConfig
from hlsim import MSBG, Audiogram, HearingLossLoss, load_pretrained
from hlsim.calibration import level_spl, set_level
from hlsim.cli.main import main
from hlsim.evaluation.previous import compensators, judging, measurements
from hlsim.evaluation.previous.compensators import evaluate_compensators
from hlsim.evaluation.previous.items import INPUT_LEVELS, draw_judged_items, read_ears
from hlsim.evaluation.previous.judging import (
    Equaliser,
    Keys,
    Trial,
    Unaided,
    band_error_db,
    judge,
    peak_spl,
)
from hlsim.evaluation.previous.measurements import insertion_gain
from hlsim.evaluation.statistics import paired_comparison
from hlsim.losses.band_levels import band_edges
from hlsim.metrics import registry
from hlsim.pretrained import find_checkpoint, save_checkpoint
from hlsim.report.previous.compensators import FILES, write_compensators
from tests import pyclarity

pytest.importorskip("matplotlib")
pytest.importorskip("joblib")


class Gain(nn.Module):
    """So many dB more, whatever the ear."""

    def __init__(self, gain_db: float = 20.0) -> None:
        super().__init__()
        self.register_buffer("gain", torch.tensor(10.0 ** (gain_db / 20.0)))

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        return waveform * self.gain


class Broken(nn.Module):
    """Fails for S1, and gives NaN for S2."""

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        if audiogram == Audiogram.standard("S1"):
            raise RuntimeError("no\nsuch ear")
        return waveform * math.nan if audiogram == Audiogram.standard("S2") else waveform


@pytest.fixture
def ears_csv(tmp_path: Path) -> Path:
    path = tmp_path / "ears.csv"
    rows = [{"listener": "L1", "ear": side, **Audiogram.standard("N3").to_row()} for side in "lr"]
    path.write_text("\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]))
    return path


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores of no meaning in place of HASPI and HASQI, the exact MSBG in pyclarity's, one tone: seconds, not minutes."""

    def score(share: float, clean: Tensor, aided: Tensor, *ear_and_settings: Any) -> float:
        if not torch.isfinite(aided).all():
            raise ValueError("processed holds samples that are NaN or infinite")
        return share * float(aided.abs().mean() / (aided.abs().mean() + 0.1))

    monkeypatch.setattr(measurements, "TONES", (1000,))
    for name, share in (("haspi", 1.0), ("hasqi", 0.5)):
        measure = registry.MEASURES[name]._replace(score=partial(score, share))
        monkeypatch.setitem(registry.MEASURES, name, measure)


def test_ears_are_the_standard_ones_and_those_of_the_file(ears_csv: Path) -> None:
    ears = read_ears(ears_csv)
    assert [name for name, _ in ears] == [
        "N2",
        "N3",
        "N4",
        "N5",
        "N6",
        "S1",
        "S2",
        "S3",
        "L1 l",
        "L1 r",
    ]
    assert ears[0][1] == Audiogram.standard("N2") and ears[-1][1] == Audiogram.standard("N3")


def test_ears_of_one_name_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "ears.csv"
    names = ("A", "B", "A", "N3", "", "A")
    rows = [
        {"listener": name, **Audiogram((10.0 * i,) * 8).to_row()} for i, name in enumerate(names)
    ]
    path.write_text("\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]))
    own = read_ears(path)[8:]
    assert [name for name, _ in own] == ["A", "B", "A, row 3", "N3, row 4", "row 5", "A, row 6"]
    assert [ear for _, ear in own] == [Audiogram((10.0 * i,) * 8) for i in range(6)]


@pytest.mark.parametrize("count", [8, 9, 10, 11])
def test_every_ear_meets_every_level_and_ratio(speech_dir: Path, count: int) -> None:
    ears = [(f"{i}", Audiogram((float(i),) * 8)) for i in range(count)]
    train, valid = speech_dir / "train", speech_dir / "valid"
    # short items: only how they are shared out counts
    drawn = draw_judged_items(valid, train, ears, items=2 * 12 * count, seconds=0.05, seed=0)
    for condition, combinations in (("clean", 3), ("noisy", 12)):
        about = [item.about for item in drawn if item.about["condition"] == condition]
        met = {(entry["name"], entry["level"], entry["snr"]) for entry in about}
        assert len(about) == 12 * count and len(met) == combinations * count


@pytest.mark.parametrize(
    "levels", [(55.0, 75.0), (50.0, 60.0, 70.0, 80.0), (40.0, 50.0, 60.0, 70.0, 80.0, 90.0)]
)
def test_levels_of_an_even_number_meet_every_ratio(
    speech_dir: Path, levels: tuple[float, ...]
) -> None:
    ears = [(f"{i}", Audiogram((float(i),) * 8)) for i in range(8)]
    many = {"items": 2 * 8 * 24, "seconds": 0.05, "seed": 0, "levels": levels}
    drawn = draw_judged_items(speech_dir / "valid", speech_dir / "train", ears, **many)
    met = {
        (item.about["level"], item.about["snr"]) for item in drawn if item.about["snr"] is not None
    }
    assert len(met) == 4 * len(levels)


def test_speech_has_its_level_and_noise_comes_on_top(speech_dir: Path) -> None:
    ears = [("N3", Audiogram.standard("N3"))]
    drawn, again, other = (
        draw_judged_items(
            speech_dir / "valid", speech_dir / "train", ears, items=8, seconds=1.0, seed=seed
        )
        for seed in (0, 0, 1)
    )
    for item in drawn:
        assert float(level_spl(item.clean)) == pytest.approx(item.about["level"], abs=0.01)
        if item.about["snr"] is None:
            assert torch.equal(item.clean, item.signal)
        else:
            snr = float(level_spl(item.clean) - level_spl(item.signal - item.clean))
            assert snr == pytest.approx(item.about["snr"], abs=0.01)
    assert all(torch.equal(a.signal, b.signal) for a, b in zip(drawn, again, strict=True))
    assert not torch.equal(drawn[0].signal, other[0].signal)


def test_figures_are_those_of_the_measures_and_the_loss(speech_dir: Path) -> None:
    pytest.importorskip("clarity")
    ear = Audiogram.standard("N3")
    (_, item) = draw_judged_items(
        speech_dir / "valid", speech_dir / "train", [("N3", ear)], items=2, seconds=0.8, seed=0
    )
    neuro = load_pretrained("neuro-msbg")
    trial = Trial(item, {"NAL-R": NALR()}, neuro, 7, {"NAL-R": Keys("most", "of network")})
    judged, aided = judge(trial, ["most", "of network"]), NALR()(item.signal, ear)
    assert isinstance(judged["most"], dict) and [*judged["of network"]] == ["loss_neuro"]
    figures = judged["most"] | judged["of network"]
    signals = (item.clean.double().numpy(), aided.double().numpy())
    haspi, (hasqi, *_) = (
        score(*signals, ear, 16000, 7) for score in (pyclarity.haspi, pyclarity.hasqi)
    )
    assert (figures["haspi"], figures["hasqi"]) == pytest.approx((haspi, hasqi), abs=1e-6)
    for name, simulator in (("neuro", neuro), ("msbg", "msbg")):
        loss = HearingLossLoss(ear, criterion="bands", simulator=simulator)
        assert figures[f"loss_{name}"] == pytest.approx(float(loss(aided, item.clean)), rel=1e-4)
    assert figures["level"] == pytest.approx(float(level_spl(aided)), abs=1e-3)
    assert figures["heard"] == pytest.approx(
        float(level_spl(MSBG(ear, sample_rate=16000)(aided))), abs=1e-3
    )
    normal = MSBG(Audiogram.standard("NH"), sample_rate=16000)
    assert figures["normal"] == pytest.approx(float(level_spl(normal(item.signal))), abs=1e-3)
    assert figures["normal_clean"] == pytest.approx(float(level_spl(normal(item.clean))), abs=1e-3)
    assert figures["normal"] > figures["normal_clean"] + 1.0  # 2.5 dB SNR


def test_errors_of_bands_and_peaks(speech: list[tuple[Tensor, int]]) -> None:
    waveform = set_level(speech[0][0][0, :32000], 65.0)
    assert band_error_db(waveform, waveform) == 0.0
    assert band_error_db(0.1 * waveform, waveform) == pytest.approx(20.0, abs=0.01)
    with pytest.raises(ValueError, match="audible"):
        band_error_db(waveform, 1e-9 * waveform)
    assert peak_spl(torch.tensor([0.0, -1.0, 0.5])) == pytest.approx(94.0)
    assert peak_spl(torch.tensor([10.0])) == pytest.approx(114.0)


def test_gain_curves(speech: list[tuple[Tensor, int]]) -> None:
    utterances = torch.stack([speech[i][0][0, :24000] for i in (0, 2)])
    ear = Audiogram((50.0,) * 8)
    np.testing.assert_allclose(
        insertion_gain(Gain(6.0), ear, utterances, INPUT_LEVELS), 6.0, atol=1e-3
    )
    # a linear filter has one curve: its own response
    prescribed = NALR()
    curves = np.array(insertion_gain(prescribed, ear, utterances, INPUT_LEVELS))
    np.testing.assert_allclose(curves[1:], curves[:1].repeat(2, 0), atol=0.01)
    taps = prescribed.taps(torch.tensor(ear.thresholds))
    hz = np.fft.rfftfreq(4096, 1 / 16000)
    response = 20.0 * np.log10(np.abs(np.fft.rfft(taps.numpy(), 4096)))
    edges = band_edges()
    for gain, low, high in zip(curves[1], edges[:-1], edges[1:], strict=True):
        inside = response[(hz >= 0.8 * low - 62.5) & (hz <= 1.2 * high + 62.5)]
        assert inside.min() - 0.1 <= gain <= inside.max() + 0.1
    # a limit bends the curve of loud speech
    limited = MappingCompensator(MappingConfig(limit_spl=80.0)).eval()
    soft, _, loud = (
        np.mean(curve) for curve in insertion_gain(limited, ear, utterances, INPUT_LEVELS)
    )
    assert loud < soft - 6.0
    with pytest.raises(ValueError, match="at 50 dB SPL holds samples that are NaN"):
        insertion_gain(Gain(math.nan), ear, utterances, INPUT_LEVELS)
    with pytest.raises(
        ValueError, match=r"at 50 dB SPL: TypeError: .*takes 2 positional arguments"
    ):
        insertion_gain(nn.ReLU(), ear, utterances, INPUT_LEVELS)
    with pytest.raises(ValueError, match=r"is \(1,\); allowed: a tensor of the input's shape, \("):
        insertion_gain(First(), ear, utterances, INPUT_LEVELS)


def compare(modules: dict[str, nn.Module], out: Path, **options: Any) -> dict[str, Any]:
    """Judged and written, as the command does it."""
    done = evaluate_compensators(modules, store=out / "scores.jsonl", **options)
    write_compensators(done.result, done.reports, out)
    return done.result


def without_times(result: dict[str, Any]) -> dict[str, Any]:
    """All but what the machine's speed decides."""
    return {**result, "wearing": [{**own, "cpu_ms": 0.0} for own in result["wearing"]]}


@pytest.mark.usefixtures("quick")
def test_report(tmp_path: Path, speech_dir: Path, ears_csv: Path) -> None:
    out = tmp_path / "out"
    limited = Gain(40.0)
    limited.config = MappingConfig(limit_spl=100.0)  # type: ignore[assignment]
    shown: list[tuple[int, int]] = []
    result = compare(
        {"loud": limited, "broken": Broken()},
        speech=speech_dir / "valid",
        noise=speech_dir / "train",
        audiograms=ears_csv,
        out=out,
        items=14,
        seconds=0.3,
        gain_ears=("N2",),
        jobs=1,
        progress=lambda done, total: shown.append((done, total)),
    )
    # without aid, with two prescriptions, and each compensator beside two at its level
    assert shown[-1] == (126, 126)
    # both items of S1 and of S2 are left out, with the reason; the two at the level of what failed fail too
    own = [failure for failure in result["failures"] if failure["compensator"] == "broken"]
    assert len(result["failures"]) == 3 * len(own) == 12
    reasons = [(failure["name"], failure["reason"]) for failure in own]
    assert reasons[:2] == [("S1", "RuntimeError: no such ear")] * 2
    assert [name for name, _ in reasons[2:]] == ["S2"] * 2 and "NaN" in reasons[2][1]
    assert {row["name"] for row in result["rows"]}.isdisjoint({"S1", "S2"})
    clean = [row for row in result["rows"] if row["condition"] == "clean"]
    group = result["groups"]["clean"]
    assert group["n"] == len(clean) == 5 and result["groups"]["noisy"]["n"] == 5

    def column(condition: str, name: str) -> np.ndarray:
        return np.array([row["figures"][condition][name] for row in clean])

    own = group["conditions"]["loud"]
    assert own["haspi_mean"] == pytest.approx(column("loud", "haspi").mean())
    off = column("loud", "heard") - column("loud", "normal")
    assert (own["heard_off"], own["heard_off_abs"]) == pytest.approx(
        (off.mean(), np.abs(off).mean())
    )
    assert set(own["by_level"]) == {"50", "65", "80"} and set(own["by_severity"]) <= {
        "moderate",
        "severe",
    }
    (against,) = [
        c
        for c in group["comparisons"]
        if (c["measure"], c["before"], c["after"]) == ("haspi", "NAL-R", "loud")
    ]
    expected = paired_comparison(column("NAL-R", "haspi"), column("loud", "haspi"))
    assert (against["t"], against["w"], against["cohens_d"]) == (
        expected.t,
        expected.w,
        expected.cohens_d,
    )
    assert against["p_t_holm"] >= expected.p_t
    gap = result["gap"]["clean"]["loud"]
    assert gap["loss_neuro"] == pytest.approx(column("loud", "loss_neuro").mean())
    assert gap["neuro_to_msbg"] == pytest.approx(gap["loss_neuro"] / gap["loss_msbg"] - 1.0)
    # the hard ones are those of low scores unaided
    low = [row for row in result["rows"] if row["figures"]["unaided"]["haspi"] < 0.6]
    assert result["groups"]["hard"]["n"] == len(low) > 0
    # 40 dB more takes 65 dB SPL and up beyond 100
    peaks = [row["figures"]["loud"]["peak"] for row in result["rows"]]
    assert result["peaks"]["loud"]["over"] == sum(peak > 100.0 for peak in peaks) > 0
    assert result["peaks"]["NAL-R"]["over"] is None

    assert {path.name for path in out.iterdir()} == {"scores.jsonl", *FILES}
    assert json.loads((out / "compensators.json").read_text()) == json.loads(json.dumps(result))
    text = (out / "compensators.md").read_text()
    # clean and noisy for each ear; those of which all failed were met too, three of the ten were not
    assert "14 items of 0.3 s, 7 ears in turn" in text
    assert f"| loud | 100 | {max(peaks):.2f} | {result['peaks']['loud']['over']} of 10 |" in text
    assert (
        "| severe, HASQI: NAL-R to loud |" in text and "**broken: change, and paired tests" in text
    )
    assert "RuntimeError: no such ear" in text and "| N2, loud, 50 dB SPL | +40.0 |" in text
    tones = {own["compensator"]: own for own in result["steady_tones"]}
    assert [*tones] == ["unaided", "NAL-R", "WDRC", "loud", "broken"] and tones["loud"][
        "levels"
    ] == [
        50,
        65,
        80,
    ]
    assert tones["broken"]["heard_off_db"] == tones["unaided"]["heard_off_db"]
    off = tones["loud"]["heard_off_db"][0][0]
    assert off > tones["unaided"]["heard_off_db"][0][0] + 40.0  # recruitment
    rows = [
        line.split(" | ") for line in text.splitlines() if line.startswith("| N2, loud, 50 dB SPL")
    ]
    assert len(rows) == 2 and rows[1][1] == f"{off:+.1f}"
    # as loud as the compensator; a gain without a filter is the flat equaliser, but for its ends
    for row in result["rows"]:
        figures = row["figures"]
        at_level = [figures[f"{aid} at loud's level"] for aid in ("NAL-R", "equaliser")]
        assert [own["level"] for own in at_level] == pytest.approx(
            [figures["loud"]["level"]] * 2, abs=1e-3
        )
        assert at_level[1]["peak"] == pytest.approx(figures["loud"]["peak"], abs=0.1)
    # each is compared with what a user would pick instead, and with nothing else
    assert result["beside"]["loud"] == [
        *("unaided", "NAL-R", "WDRC", "NAL-R at loud's level", "equaliser at loud's level")
    ]
    start = text.index("**loud: change, and paired tests")
    rivals = [line.split(" | ")[0] for line in text[start:].splitlines()[4:14]]
    names = ("unaided", "NAL-R", "WDRC", "NAL-R at its level", "equaliser at its level")
    assert rivals == [f"| {name}, {measure}" for measure in ("HASPI", "HASQI") for name in names]
    assert "to equaliser" not in text and "loud to broken" not in text
    assert "On clean speech loud " in text and " NAL-R made as loud" in text
    noisy = [row for row in result["rows"] if row["condition"] == "noisy"]
    under = [row["figures"]["loud"]["haspi"] for row in noisy if row["snr"] < 8.0]
    over = [row["figures"]["loud"]["haspi"] for row in noisy if row["snr"] > 8.0]
    by_snr = result["groups"]["noisy"]["conditions"]["loud"]["by_snr"]
    for part, scores in (("under", under), ("over", over)):
        assert (by_snr[part]["n"], by_snr[part]["haspi_mean"]) == (
            len(scores),
            pytest.approx(np.mean(scores)),
        )
    assert f"| {np.mean(under):.3f} / {np.mean(over):.3f} |" in text
    worn = [own["compensator"] for own in result["wearing"]]
    assert (
        worn == ["NAL-R", "WDRC", "loud", "broken"]
        and "| N2, loud | 0.0 | +40.0 | +40.0 | -" in text
    )
    page = (out / "compensators.html").read_text()
    assert "Steady tones" in page
    assert page.count("data:image/svg+xml") > 2 and "Paired tests" in page and "Gain curves" in page


@pytest.mark.usefixtures("quick")
def test_a_stopped_run_goes_on_and_new_weights_are_judged_anew(
    tmp_path: Path, speech_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options: dict[str, Any] = {
        "speech": speech_dir / "valid",
        "audiogram": Audiogram.standard("N4"),
        "items": 3,
        "seconds": 0.3,
        "jobs": 1,
    }
    whole = compare({"own": Gain()}, **options, out=tmp_path / "whole")
    original, calls = judging.judge, []

    def counted(trial: Trial, missing: list[str]) -> Any:
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append([name for name, keys in trial.keys.items() if {*keys} & {*missing}])
        return original(trial, missing)

    monkeypatch.setattr(compensators, "judge", counted)
    parts = tmp_path / "parts"
    with pytest.raises(KeyboardInterrupt):
        compare({"own": Gain()}, **options, out=parts)
    assert [path.name for path in parts.iterdir()] == ["scores.jsonl"]
    calls[:] = [[]]  # one more is left before it stops again
    assert without_times(compare({"own": Gain()}, **options, out=parts)) == without_times(whole)
    calls.clear()
    with pytest.raises(KeyboardInterrupt):
        compare({"own": Gain(10.0)}, **options, out=parts)
    # of the others all is known
    assert calls == [["NAL-R at own's level", "equaliser at own's level", "own"]] * 2

    # under another simulator nothing is new but the surrogate gap
    calls.clear()
    measured: list[int] = []
    monkeypatch.setattr(compensators, "judge", original)
    monkeypatch.setattr(judging, "_figures", lambda *arguments: measured.append(1))
    folder = find_checkpoint("neuro-msbg-cnn")
    other = compare({"own": Gain()}, **options, simulator=folder, out=parts)
    assert not measured
    assert f"with the Neuro-MSBG {folder}." in (parts / "compensators.md").read_text()
    for before, after in zip(whole["rows"], other["rows"], strict=True):
        for name, figures in before["figures"].items():
            assert {
                key for key, value in figures.items() if value != after["figures"][name][key]
            } == {"loss_neuro"}
    assert whole["ears"] == ["55 55 55 65 70 75 80 80 dB HL"] and whole["groups"].keys() <= {
        "clean",
        "hard",
    }
    assert {curve["ear"] for curve in whole["gain_curves"]} == {*whole["ears"]}


class First(Gain):
    def forward(self, waveform: Tensor, ear: Audiogram) -> Tensor:
        return waveform[:1]


class MutesSoftSpeech(Gain):
    def forward(self, waveform: Tensor, ear: Audiogram) -> Tensor:
        return super().forward(waveform, ear) * (level_spl(waveform) > 57.0)


@pytest.mark.usefixtures("quick")
def test_what_an_aid_mutes_counts_against_it(tmp_path: Path, speech_dir: Path) -> None:
    options: dict[str, Any] = {
        "speech": speech_dir / "valid",
        "items": 2,
        "seconds": 0.3,
        "jobs": 1,
    }
    options |= {"audiogram": Audiogram.standard("N2"), "levels": (50.0, 65.0), "out": tmp_path}
    result = compare({"own": MutesSoftSpeech()}, **options)
    soft, loud = (row["figures"] for row in result["rows"])
    assert not result["failures"] and soft["own"]["haspi"] == 0.0 < soft["unaided"]["haspi"]
    assert loud["own"]["haspi"] > 0.0


class OneAtATime(Gain):
    def forward(self, waveform: Tensor, ear: Audiogram) -> Tensor:
        assert waveform.dim() == 1
        return super().forward(waveform, ear)


@pytest.mark.usefixtures("quick")
def test_an_ear_without_a_loss_and_a_module_for_one_signal(
    tmp_path: Path, speech_dir: Path
) -> None:
    options: dict[str, Any] = {
        "speech": speech_dir / "valid",
        "items": 2,
        "seconds": 0.3,
        "jobs": 1,
    }
    result = compare(
        {"own": OneAtATime()}, **options, audiogram=Audiogram.standard("NH"), out=tmp_path
    )
    # nothing is lost of clean speech as it is: no loss to be relative to
    unaided = result["gap"]["clean"]["unaided"]
    assert (
        unaided["loss_msbg"] == 0.0
        and unaided["neuro_to_msbg"] is None
        and unaided["item_median"] is None
    )
    assert "n/a" in (tmp_path / "compensators.md").read_text()


ENHANCER = """
def half(waveform, sample_rate):
    assert sample_rate == 16000
    return waveform / 2
"""


@pytest.mark.usefixtures("quick")
def test_an_enhancer_before_each_aid(
    tmp_path: Path,
    speech_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name, text in (("my_enhancer", ENHANCER), ("my_enhancer_2", ENHANCER.replace("2", "4"))):
        (tmp_path / f"{name}.py").write_text(text)
    options: dict[str, Any] = {
        "speech": speech_dir / "valid",
        "audiogram": Audiogram.standard("N3"),
    }
    options |= {"items": 1, "seconds": 0.3, "jobs": 1, "out": tmp_path / "out"}
    result = compare({"own": Gain(20.0)}, enhancers=["my_enhancer:half"], **options)
    (row,) = result["rows"]
    for aid in ("NAL-R", "own"):
        difference = row["figures"][f"half + {aid}"]["level"] - row["figures"][aid]["level"]
        assert difference == pytest.approx(20.0 * math.log10(0.5), abs=1e-3)
    assert "half + NAL-R" in result["beside"]["own"] and result["beside"]["half + NAL-R"] == [
        "NAL-R"
    ]
    text = (tmp_path / "out" / "compensators.md").read_text()
    assert "Enhancer my_enhancer:half (sha256 " in text and "| half + own, HASPI |" in text
    # one of another source has scores of its own
    stored = len((tmp_path / "out" / "scores.jsonl").read_text().splitlines())
    compare({"own": Gain(20.0)}, enhancers=["my_enhancer_2:half"], **options)
    assert len((tmp_path / "out" / "scores.jsonl").read_text().splitlines()) == stored + 2 * 3
    command = [
        "evaluate-compensator",
        "nalr",
        "--speech",
        str(speech_dir / "valid"),
        "--audiogram",
        "N3",
    ]
    command += ["--out", str(tmp_path / "none"), "--enhancer"]
    for name, said in (
        ("my_enhancer", "allowed: package.module:name"),
        ("my_enhancer:nobody", "enhancer my_enhancer:nobody: cannot be had"),
    ):
        with contextlib.suppress(SystemExit):
            assert main([*command, name]) == 2
        assert said in capsys.readouterr().err
    with pytest.raises(ValueError, match="one a name after the colon"):
        compare({"own": Gain()}, enhancers=["my_enhancer:half", "my_enhancer_2:half"], **options)


def test_an_equaliser_has_the_gains_that_it_is_given() -> None:
    edges = band_edges()
    gains = np.interp(np.linspace(0.0, 1.0, len(edges) - 1), [0.0, 0.4, 1.0], [0.0, 10.0, 40.0])
    noise = torch.randn(1, 48000)
    made = insertion_gain(Equaliser(gains.tolist()), Audiogram.standard("N3"), noise, (65.0,))
    # a band is as loud as its loudest part where the gain rises steeply
    np.testing.assert_allclose(made[0], gains, atol=1.0)
    again = Equaliser(gains.tolist())(noise.roll(800, -1), Audiogram.standard("N5"))
    np.testing.assert_allclose(
        again[0, 2000:-2000],
        Equaliser(gains.tolist())(noise, Audiogram.standard("N3"))[0, 1200:-2800],
        atol=1e-3,
    )


def test_nothing_to_judge(tmp_path: Path, speech_dir: Path) -> None:
    ear, folder = Audiogram.standard("N3"), speech_dir / "valid"
    options: dict[str, Any] = {"speech": folder, "out": tmp_path / "out", "jobs": 1}
    with pytest.raises(ValueError, match="named 'NAL-R'; allowed: other names"):
        compare({"NAL-R": Unaided()}, **options, audiogram=ear)
    with pytest.raises(ValueError, match="either audiograms, a CSV file of ears, or audiogram"):
        compare({"own": Unaided()}, **options)
    with pytest.raises(ValueError, match="0 compensators; allowed: 1 or more"):
        compare({}, **options, audiogram=ear)
    with pytest.raises(ValueError, match="audiogram is str; allowed: an Audiogram"):
        compare({"own": Unaided()}, **options, audiogram="N3")
    with pytest.raises(ValueError, match="'own' is function; allowed"):
        compare({"own": lambda waveform, ear: waveform}, **options, audiogram=ear)  # type: ignore[dict-item]
    # HASPI takes nothing under 0.7 s
    with pytest.raises(
        ValueError, match=r"none of 1 items could be judged; the first: .*needs 0.7 s"
    ):
        compare({"own": Unaided()}, **options, audiogram=ear, items=1, seconds=0.5)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("quick")
def test_command(tmp_path: Path, speech_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "evaluate-compensator",
        "mine=nalr",
        "--speech",
        str(speech_dir / "valid"),
        "--jobs",
        "1",
    ]
    command += ["--items", "2", "--seconds", "0.3", "--out", str(tmp_path / "out")]
    assert main([*command, "--audiogram", "N3"]) == 0
    said = capsys.readouterr()
    assert "| mine | 2 |" in said.out and "12 of 12 outputs" in said.err
    assert "trained for one ear" not in said.out + said.err
    model = MappingCompensator(MappingConfig(channels=8, blocks=1))
    about = {"audiogram": Audiogram.standard("N4").to_dict()}
    save_checkpoint(tmp_path / "n4", "mapping-compensator", model, model.config.to_dict(), about)
    assert main([command[0], f"mine={tmp_path / 'n4'}", *command[2:], "--audiogram", "N3"]) == 0
    said = capsys.readouterr()
    note = "mine was trained for one ear, 55, 55, 55, 65, 70, 75, 80, 80 dB HL, and is meant for no other."
    assert f"hlsim: warning: {note}" in said.err and note in said.out
    for arguments, line in (
        (command, "give either audiograms"),
        ([*command[:2], "mine=nalr", *command[2:], "--audiogram", "N3"], "one a label"),
        ([command[0], "nobody", *command[2:], "--audiogram", "N3"], "nobody"),
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err.strip()
        assert len(error.splitlines()) == 1 and error.startswith("hlsim: error: ") and line in error
