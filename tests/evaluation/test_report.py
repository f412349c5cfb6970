"""The report's figures, its three files, and what folders it takes and refuses."""

import json
import math
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.evaluation import HaspiReport, ItemScore, folders, haspi_report, write_report
from hlsim.evaluation.haspi import haspi

for module in ("clarity", "joblib", "matplotlib"):
    pytest.importorskip(module)

N4 = Audiogram.standard("N4")
STATED = {
    "n",
    "before_mean",
    "before_std",
    "after_mean",
    "after_std",
    "delta",
    "t",
    "p_t",
    "w",
    "p_w",
    "cohens_d",
}


def make_report(n: int = 12, **options: object) -> HaspiReport:
    rng = np.random.default_rng(0)
    names = ("N1", "N3", "N4", "NH")
    items = [
        ItemScore(
            file=f"p1/{i:02}",
            before=float(low),
            after=float(min(1.0, low + high)),
            clean_level=65.0,
            before_level=64.0 + i,
            after_level=74.0 + i,
            audiogram=Audiogram.standard(names[i % 4]),
            sample_rate=16000,
            seconds=2.5,
            seed=i,
        )
        for i, (low, high) in enumerate(zip(rng.uniform(0, 0.6, n), rng.uniform(-0.05, 0.5, n), strict=True))
    ]
    return HaspiReport(items, **options)


def test_figures_are_scipys(tmp_path: Path) -> None:
    report = make_report()
    write_report(report, tmp_path / "out")
    data = json.loads((tmp_path / "out" / "report.json").read_text())
    before, after = ([item[key] for item in data["items"]] for key in ("before", "after"))
    assert data.keys() >= STATED
    assert data["n"] == 12
    assert data["t"] == stats.ttest_rel(after, before).statistic
    assert data["p_w"] == stats.wilcoxon(after, before).pvalue
    assert data["cohens_d"] == pytest.approx(data["t"] / math.sqrt(12))
    assert data["after_std"] == pytest.approx(np.std(after, ddof=1))
    assert (data["before_level_mean"], data["after_level_mean"], data["full_scale_spl"]) == (69.5, 79.5, 94.0)
    assert data["wilcoxon_zero_method"] == "wilcox"
    assert set(data["versions"]) == {"hlsim", "pyclarity", "numpy", "scipy"}
    assert data["versions"]["numpy"] == np.__version__
    assert data["items"][2]["severity"] == "severe" and data["items"][2]["file"] == "p1/02"


def test_markdown_is_the_papers_table() -> None:
    report = make_report(seed=3, extra={"nalr_mean": 0.5125})
    text, c = report.to_markdown(), report.comparison
    assert "| Metric | Before | After | Change (Δ) |" in text
    assert f"| {c.before_mean:.3f} ± {c.before_std:.3f} | {c.after_mean:.3f} ± {c.after_std:.3f} | +" in text
    assert f"t = +{c.t:.3f}, p " in text and f"W = {c.w:.1f}, p " in text and f"d = +{c.cohens_d:.3f}" in text
    assert "| 69.5 | 79.5 | +10.0 |" in text
    assert "HASPI rewards any gain" in text
    assert "none 3, mild 3, severe 6" in text
    assert "seed 3" in text and "nalr_mean: 0.5125" in text
    large = make_report(400)
    assert large.to_markdown().count("p < 0.00001") == 2


def test_undefined_tests_are_said_and_never_nan(tmp_path: Path) -> None:
    report = make_report(1)
    write_report(report, tmp_path)
    assert (tmp_path / "report.md").read_text(encoding="utf-8").count("not defined") == 3
    text = (tmp_path / "report.json").read_text()
    assert "NaN" not in text and json.loads(text)["t"] is None


def test_extra_keys_stand_beside_the_others() -> None:
    report = replace(make_report(), extra={"nalr_mean": 0.5, "initial_mean": 0.25})
    assert (report.to_dict()["nalr_mean"], report.to_dict()["initial_mean"], report.to_dict()["n"]) == (
        0.5,
        0.25,
        12,
    )
    with pytest.raises(ValueError, match="extra keys items, t are the report's own"):
        make_report(extra={"t": 1.0, "items": [], "other": 2})
    with pytest.raises(ValueError, match="no scores before"):
        HaspiReport([])


def test_picture_is_a_png(tmp_path: Path) -> None:
    write_report(make_report(), tmp_path / "a" / "b")
    data = (tmp_path / "a" / "b" / "before-after.png").read_bytes()
    width, height = struct.unpack(">II", data[16:24])
    assert data.startswith(b"\x89PNG\r\n\x1a\n") and data.endswith(b"IEND\xaeB`\x82")
    assert width > 800 and height > 400


def test_files_are_replaced_and_others_stay(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert write_report(make_report(4), out) == out
    (out / "heard.wav").write_text("audio")
    write_report(make_report(5), out)
    assert json.loads((out / "report.json").read_text())["n"] == 5
    assert sorted(p.name for p in out.iterdir()) == [
        "before-after.png",
        "heard.wav",
        "report.json",
        "report.md",
    ]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("broken", ["picture", "nan"])
def test_a_failure_leaves_the_earlier_report_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    out = tmp_path / "out"
    write_report(make_report(4), out)
    earlier = {p.name: p.read_bytes() for p in out.iterdir()}
    report = make_report(5)
    if broken == "picture":

        def fail(*_: object) -> None:
            raise OSError("disk full")

        monkeypatch.setattr("hlsim.evaluation.report.draw_report", fail)
    else:
        report = make_report(5, extra={"nalr_mean": math.nan})
    for target in (out, tmp_path / "new"):
        with pytest.raises(ValueError, match=r"disk full|JSON"):
            write_report(report, target)
    assert {p.name: p.read_bytes() for p in out.iterdir()} == earlier
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_out_must_be_a_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match="file: not a folder"):
            write_report(make_report(), out)


@pytest.fixture
def corpus(tmp_path: Path, speech_dir: Path) -> Path:
    """clean, before and after with two files of 0.8 s each, one in a subfolder, at two rates."""
    for name, source in (("a.b", "train/flite-slt-01"), ("p2/c", "valid/espeak-us-annie-01")):
        waveform, rate = read_audio(speech_dir / f"{source}.flac")
        clean = waveform[:, rate : rate + 8 * rate // 10]
        noise = 0.002 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(3))
        for folder, suffix, signal in (
            ("clean", ".flac", clean),
            ("before", ".wav", clean + noise),
            ("after", ".wav", 8.0 * (clean + noise)),
        ):
            path = tmp_path / folder / f"{name}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_audio(path, signal, rate)
    return tmp_path


def run(corpus: Path, audiogram: Audiogram | None = N4, **options: object) -> HaspiReport:
    return haspi_report(corpus / "clean", corpus / "before", corpus / "after", audiogram, jobs=1, **options)


def signal(path: Path) -> Tensor:
    return read_audio(path)[0][0]


def test_folders_are_scored_one_by_one(corpus: Path) -> None:
    seen: list[tuple[int, int]] = []
    report = run(
        corpus,
        out=corpus / "out",
        seed=4,
        full_scale_spl=90.0,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert [(item.file, item.seed, item.sample_rate) for item in report.items] == [
        ("a.b", 4, 16000),
        ("p2/c", 5, 22050),
    ]
    for item in report.items:
        clean = signal(corpus / "clean" / f"{item.file}.flac")
        for folder, score, level in (
            ("before", item.before, item.before_level),
            ("after", item.after, item.after_level),
        ):
            heard = signal(corpus / folder / f"{item.file}.wav")
            ours = haspi(clean, heard, N4, item.sample_rate, full_scale_spl=90.0, seed=item.seed)
            assert score == pytest.approx(ours, abs=1e-12)
            assert level == pytest.approx(
                90.0 + 10 * math.log10(float(heard.double().square().mean())), abs=1e-6
            )
        assert item.after_level - item.before_level == pytest.approx(20 * math.log10(8), abs=1e-4)
        assert item.seconds == 0.8
    assert report.comparison.delta > 0.2
    assert seen == [(done, 4) for done in range(1, 5)]
    assert json.loads((corpus / "out" / "report.json").read_text()) == report.to_dict()


def test_audiograms_of_a_csv(corpus: Path) -> None:
    header = "file," + ",".join(N4.to_row())
    rows = {"a.b.wav": Audiogram.standard("S3"), "p2/c": N4, "not/here.flac": N4}
    table = [header, *(",".join([name, *ear.to_row().values()]) for name, ear in rows.items())]
    (corpus / "ears.csv").write_text("\n".join(table))
    report = run(corpus, None, audiograms=corpus / "ears.csv")
    assert [item.audiogram for item in report.items] == [Audiogram.standard("S3"), N4]
    clean = signal(corpus / "clean" / "a.b.flac")
    ours = haspi(clean, signal(corpus / "after" / "a.b.wav"), Audiogram.standard("S3"), 16000, seed=0)
    assert report.items[0].after == pytest.approx(ours, abs=1e-12)


def stereo(corpus: Path) -> None:
    write_audio(
        corpus / "after" / "p2" / "c.wav", signal(corpus / "after" / "p2" / "c.wav").expand(2, -1), 22050
    )


def shorter(corpus: Path) -> None:
    write_audio(
        corpus / "before" / "p2" / "c.wav", signal(corpus / "before" / "p2" / "c.wav")[None, 1:], 22050
    )


def faster(corpus: Path) -> None:
    write_audio(corpus / "after" / "a.b.wav", signal(corpus / "after" / "a.b.wav")[None], 24000)


def silent(corpus: Path) -> None:
    write_audio(corpus / "after" / "a.b.wav", torch.zeros(1, 12800), 16000)


def short(corpus: Path) -> None:
    for path in (corpus / "clean" / "a.b.flac", corpus / "before" / "a.b.wav", corpus / "after" / "a.b.wav"):
        write_audio(path, signal(path)[None, :8000], 16000)


def quiet(corpus: Path) -> None:
    (corpus / "clean" / "p2" / "c.flac").unlink()
    write_audio(
        corpus / "clean" / "p2" / "c.wav", signal(corpus / "before" / "p2" / "c.wav")[None] * 1e-4, 22050
    )


def broken(corpus: Path) -> None:
    (corpus / "before" / "p2" / "c.wav").write_bytes(b"RIFF and nothing more")


def missing(corpus: Path) -> None:
    (corpus / "after" / "a.b.wav").unlink()


def surplus(corpus: Path) -> None:
    shutil.copytree(corpus / "before" / "p2", corpus / "before" / "p3")


def twice(corpus: Path) -> None:
    shutil.copy(corpus / "clean" / "a.b.flac", corpus / "before" / "a.b.flac")


def empty(corpus: Path) -> None:
    shutil.rmtree(corpus / "clean")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (stereo, r"after/p2/c.wav: 2 channels; allowed: 1, for one file is what one ear is given"),
        (shorter, r"clean/p2/c.flac has 17640 samples and .*before/p2/c.wav 17639"),
        (faster, r"after/a.b.wav has 24000 Hz and .*clean/a.b.flac 16000 Hz"),
        (silent, r"after/a.b.wav: silent"),
        (short, r"clean/a.b.flac lasts 0.5 s"),
        (quiet, r"clean/p2/c.wav is at -\d+.\d dB SPL with full_scale_spl 94"),
        (broken, r"before/p2/c.wav: not readable as audio"),
        (missing, r"after: 1 of 2 files missing, a.b; clean, before and after need the same names"),
        (surplus, r"clean: 1 of 3 files missing, p3/c;"),
        (twice, r"before/a.b.flac and .*before/a.b.wav: one name twice"),
        (empty, r"clean: no such folder"),
    ],
)
def test_bad_folders_are_refused_before_the_first_score(
    corpus: Path, monkeypatch: pytest.MonkeyPatch, damage: object, message: str
) -> None:
    def score(*_: object, **__: object) -> list[float]:
        raise AssertionError("scored before all files were checked")

    monkeypatch.setattr(folders, "haspi_many", score)
    assert callable(damage)
    damage(corpus)
    with pytest.raises(ValueError, match=message) as error:
        run(corpus, out=corpus / "out")
    assert "\n" not in str(error.value)
    assert not (corpus / "out").exists()


HEADER = "file," + ",".join(N4.to_row())
LEVELS = ",".join(N4.to_row().values())


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (f"{HEADER}\na.b,{LEVELS}\n", "ears.csv: no audiogram of 1 of 2 files, p2/c"),
        (f"{HEADER}\na.b,{LEVELS}\na.b.wav,{LEVELS}\n", "ears.csv, line 3: a second row of a.b.wav"),
        (f"{HEADER[5:]}\n{LEVELS}\n", "ears.csv, line 2: no file named"),
        (f"{HEADER}\na.b,{LEVELS.replace('55', '555')}\n", "ears.csv, line 2: audiogram levels 555"),
    ],
)
def test_bad_csv(corpus: Path, table: str, message: str) -> None:
    (corpus / "ears.csv").write_text(table)
    with pytest.raises(ValueError, match=message):
        run(corpus, None, audiograms=corpus / "ears.csv")


def test_bad_arguments(corpus: Path) -> None:
    with pytest.raises(ValueError, match="either audiogram"):
        run(corpus, None)
    with pytest.raises(ValueError, match="either audiogram"):
        run(corpus, N4, audiograms=corpus / "ears.csv")
    with pytest.raises(ValueError, match="audiogram is str"):
        run(corpus, "N4")
    with pytest.raises(ValueError, match="jobs is 0"):
        haspi_report(corpus / "clean", corpus / "before", corpus / "after", N4, jobs=0)
    with pytest.raises(ValueError, match="seed is -1"):
        run(corpus, seed=-1)
    with pytest.raises(ValueError, match="not a folder"):
        run(corpus, out=corpus / "clean" / "a.b.flac")
