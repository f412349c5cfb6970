"""Reports of folders and of a manifest, from files to files."""

import json
import math
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.evaluation import HaspiReport, haspi_report
from hlsim.evaluation.store import content_hash
from hlsim.metrics import registry
from hlsim.metrics.pyclarity import pyclarity_score
from hlsim.report.previous.haspi import markdown, write_report
from hlsim.report.page import check_out

for module in ("joblib", "matplotlib"):
    pytest.importorskip(module)

N4 = Audiogram.standard("N4")


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


def run(
    corpus: Path, audiogram: Audiogram | None = N4, out: Path | None = None, **options: object
) -> HaspiReport:
    """As the command does, which joins both where there is a folder for the files."""
    if "manifest" not in options:
        options |= {name: corpus / name for name in ("clean", "before", "after")} | {
            "audiogram": audiogram
        }
    if out is None:
        return haspi_report(**options, jobs=1)
    report = haspi_report(**options, store=check_out(out) / "scores.jsonl", jobs=1)
    write_report(report, out)
    return report


def signal(path: Path) -> Tensor:
    return read_audio(path)[0][0]


def test_folders_are_scored_one_by_one(corpus: Path) -> None:
    pytest.importorskip("clarity")
    seen: list[tuple[int, int]] = []
    report = run(
        corpus,
        out=corpus / "out",
        seed=4,
        full_scale_spl=90.0,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert [(item.file, item.seed, item.sample_rate) for item in report.items] == [
        (name, (4 + int(content_hash(corpus / "clean" / f"{name}.flac")[:8], 16)) % 2**32, rate)
        for name, rate in (("a.b", 16000), ("p2/c", 22050))
    ]
    for item in report.items:
        clean = signal(corpus / "clean" / f"{item.file}.flac")
        for folder, score, level in (
            ("before", item.before, item.before_level),
            ("after", item.after, item.after_level),
        ):
            heard = signal(corpus / folder / f"{item.file}.wav")
            theirs = pyclarity_score("haspi", clean, heard, N4, item.sample_rate, 90.0, item.seed)
            assert score == pytest.approx(theirs, abs=1e-6)
            assert level == pytest.approx(
                90.0 + 10 * math.log10(float(heard.double().square().mean())), abs=1e-6
            )
        assert item.after_level - item.before_level == pytest.approx(20 * math.log10(8), abs=1e-4)
        assert item.seconds == 0.8
    assert report.comparison.delta > 0.2
    assert seen == [(done, 4) for done in range(1, 5)]
    assert json.loads((corpus / "out" / "report.json").read_text()) == report.to_dict()


def test_both_engines_make_one_report(corpus: Path) -> None:
    """At 16 and 22.05 kHz, which pyclarity takes as 22."""
    pytest.importorskip("clarity")
    store, measures = corpus / "scores.jsonl", ("haspi", "hasqi")
    ours, theirs = (
        run(corpus, measures=measures, engine=engine, store=store)
        for engine in ("hlsim", "pyclarity")
    )
    for measure in measures:
        assert ours.scores(measure) == pytest.approx(theirs.scores(measure), abs=1e-6)
    assert [report.to_dict()["engine"] for report in (ours, theirs)] == ["hlsim", "pyclarity"]
    said = (
        "(v2) by hlsim ",
        f"(v2) by pyclarity {theirs.versions['pyclarity']}, the rates rounded to whole kHz",
    )
    for report, text in zip((ours, theirs), said, strict=True):
        assert f"HASPI and HASQI {text}" in markdown(report)
    assert "pyclarity" not in ours.versions
    # each engine's own
    assert store.read_text().count("\n") == 2 * 2 * 4
    assert store.read_text().count('"engine": "hlsim"') == 2 * 4
    assert run(corpus, measures=measures, engine="hlsim", store=store) == ours


def test_audiograms_of_a_csv(corpus: Path) -> None:
    header = "file," + ",".join(N4.to_row())
    rows = {"a.b.wav": Audiogram.standard("S3"), "p2/c": N4, "not/here.flac": N4}
    table = [header, *(",".join([name, *ear.to_row().values()]) for name, ear in rows.items())]
    (corpus / "ears.csv").write_text("\n".join(table))
    report = run(corpus, None, audiograms=corpus / "ears.csv")
    assert [item.audiogram for item in report.items] == [Audiogram.standard("S3"), N4]
    clean = signal(corpus / "clean" / "a.b.flac")
    engine = registry.measure_by("hlsim", "haspi")
    after = signal(corpus / "after" / "a.b.wav")
    ours = engine.score(clean, after, Audiogram.standard("S3"), 16000, 94.0, report.items[0].seed)
    assert report.items[0].after == pytest.approx(ours, abs=1e-12)


def stereo(corpus: Path) -> None:
    write_audio(
        corpus / "after" / "p2" / "c.wav",
        signal(corpus / "after" / "p2" / "c.wav").expand(2, -1),
        22050,
    )


def shorter(corpus: Path) -> None:
    write_audio(
        corpus / "before" / "p2" / "c.wav",
        signal(corpus / "before" / "p2" / "c.wav")[None, 1:],
        22050,
    )


def faster(corpus: Path) -> None:
    write_audio(corpus / "after" / "a.b.wav", signal(corpus / "after" / "a.b.wav")[None], 24000)


def silent(corpus: Path) -> None:
    write_audio(corpus / "after" / "a.b.wav", torch.zeros(1, 12800), 16000)


def short(corpus: Path) -> None:
    for path in (
        corpus / "clean" / "a.b.flac",
        corpus / "before" / "a.b.wav",
        corpus / "after" / "a.b.wav",
    ):
        write_audio(path, signal(path)[None, :8000], 16000)


def quiet(corpus: Path) -> None:
    (corpus / "clean" / "p2" / "c.flac").unlink()
    write_audio(
        corpus / "clean" / "p2" / "c.wav",
        signal(corpus / "before" / "p2" / "c.wav")[None] * 1e-4,
        22050,
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


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """HASPI replaced by one that takes no time; the list has an entry a call."""
    calls: list[int] = []

    def score(*_: object, **__: object) -> float:
        calls.append(1)
        return 0.25 + 0.5 * (len(calls) % 2)

    measure = registry.MEASURES["haspi"]._replace(score=partial(registry._of_ear, score))
    monkeypatch.setitem(registry.MEASURES, "haspi", measure)
    return calls


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (missing, r"after: 1 of 2 files missing, a.b; clean, before and after need the same names"),
        (surplus, r"clean: 1 of 3 files missing, p3/c;"),
        (twice, r"before/a.b.flac and .*before/a.b.wav: one name twice"),
        (empty, r"clean: no such folder"),
    ],
)
def test_folders_that_differ_are_refused_before_the_first_score(
    corpus: Path, quick: list[int], damage: Callable[[Path], None], message: str
) -> None:
    damage(corpus)
    with pytest.raises(ValueError, match=message) as error:
        run(corpus, out=corpus / "out")
    assert "\n" not in str(error.value) and not quick
    assert not (corpus / "out").exists()


@pytest.mark.parametrize(
    ("damage", "file", "condition", "message"),
    [
        (
            stereo,
            "p2/c",
            "after",
            r"after/p2/c.wav: 2 channels; allowed: 1, for one file is what one ear is given",
        ),
        (
            shorter,
            "p2/c",
            "before",
            r"clean/p2/c.flac has 17640 samples and .*before/p2/c.wav 17639",
        ),
        (faster, "a.b", "after", r"after/a.b.wav has 24000 Hz and .*clean/a.b.flac 16000 Hz"),
        (silent, "a.b", "after", r"after/a.b.wav: silent"),
        (short, "a.b", "before", r"reference lasts 0.5 s; a score needs 0.7 s"),
        (quiet, "p2/c", "before", r"reference is at -\d+.\d dB SPL with full_scale_spl 94"),
        (broken, "p2/c", "before", r"before/p2/c.wav: not readable as audio"),
    ],
)
def test_what_cannot_be_scored_is_listed_and_the_rest_go_on(
    corpus: Path,
    quick: list[int],
    damage: Callable[[Path], None],
    file: str,
    condition: str,
    message: str,
) -> None:
    damage(corpus)
    report = run(corpus, out=corpus / "out")
    failure = report.failures[0]
    assert (failure.file, failure.condition, failure.measure) == (file, condition, "haspi")
    assert re.search(message, failure.reason) and "\n" not in failure.reason
    assert report.comparison.n == 1
    assert f"| {file} | {condition} | HASPI | " in (corpus / "out" / "report.md").read_text(
        encoding="utf-8"
    )


def test_nothing_scored_is_an_error(corpus: Path) -> None:
    silent(corpus)
    for path in (corpus / "before").rglob("*.wav"):
        path.write_bytes(b"no audio")
    (corpus / "after" / "p2" / "c.wav").write_bytes(b"no audio")
    with pytest.raises(
        ValueError,
        match=r"none of 2 items could be scored; the first, a\.b: .*not readable as audio",
    ):
        run(corpus, out=corpus / "out")
    assert not (corpus / "out").exists()


def test_a_second_run_scores_nothing(corpus: Path, quick: list[int]) -> None:
    first = run(corpus, out=corpus / "out")
    assert len(quick) == 4
    files = {p.name: p.read_bytes() for p in (corpus / "out").iterdir()}
    again = run(corpus, out=corpus / "out")
    assert len(quick) == 4 and again == first
    assert {p.name: p.read_bytes() for p in (corpus / "out").iterdir()} == files
    run(corpus, Audiogram.standard("N2"), out=corpus / "out")
    assert len(quick) == 8
    assert (
        run(corpus, store=corpus / "out" / "scores.jsonl").to_dict() == first.to_dict()
        and len(quick) == 8
    )


MANIFEST = """listener,ear,condition,clean,processed,snr,audiogram,spl
L1,left,unaided,clean/a.b.flac,before/a.b.wav,5,N3,65
L1,left,aided,clean/a.b.flac,after/a.b.wav,5,N3,65
L1,left,loud,clean/a.b.flac,after/a.b.wav,5,N3,65
L2,right,unaided,clean/p2/c.flac,before/p2/c.wav,0,S2,65
L2,right,aided,clean/p2/c.flac,after/p2/c.wav,0,S2,65
L2,right,loud,clean/p2/c.flac,gone.wav,0,S2,65
"""


def test_manifest_from_files_to_report(corpus: Path, quick: list[int]) -> None:
    (corpus / "study.csv").write_text(MANIFEST)
    report = run(
        corpus,
        manifest=corpus / "study.csv",
        measures=("haspi", "stoi"),
        baseline="aided",
        out=corpus / "out",
    )
    assert report.conditions == ("aided", "unaided", "loud") and report.measures == (
        "haspi",
        "stoi",
    )
    assert [(c.before, c.after, c.overall.n) for c in report.comparisons[:2]] == [
        ("aided", "unaided", 2),
        ("aided", "loud", 1),
    ]
    assert [item.clean_level for item in report.items] == [pytest.approx(65.0), pytest.approx(65.0)]
    assert report.items[1].levels["loud"] is None
    gain = 20 * math.log10(8)
    assert report.items[0].levels["aided"] - report.items[0].levels["unaided"] == pytest.approx(
        gain, abs=1e-4
    )
    assert {(f.file, f.condition) for f in report.failures} == {
        ("L2 right clean/p2/c 0 dB", "loud")
    }
    # a pair of files is scored once a measure, whatever the conditions are called
    assert len(quick) == 4
    page = (corpus / "out" / "report.html").read_text(encoding="utf-8")
    # the original and three conditions of the one item that has both of the headline's scores
    assert page.count("<audio") == 4


HEADER = "file," + ",".join(N4.to_row())
LEVELS = ",".join(N4.to_row().values())


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (f"{HEADER}\na.b,{LEVELS}\n", "ears.csv: no audiogram of 1 of 2 files, p2/c"),
        (
            f"{HEADER}\na.b,{LEVELS}\n\na.b.wav,{LEVELS}\n",
            "ears.csv, line 4: a second row of a.b.wav",
        ),
        (f"{HEADER[5:]}\n{LEVELS}\n", "ears.csv, line 2: no file named"),
        (
            f"{HEADER}\na.b,{LEVELS.replace('55', '555')}\n",
            "ears.csv, line 2: audiogram levels 555",
        ),
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
    (corpus / "study.csv").write_text(MANIFEST)
    for folders in ({}, {"clean": corpus}, {"clean": corpus, "manifest": corpus / "study.csv"}):
        with pytest.raises(
            ValueError, match="give either the folders clean, before and after, or a manifest"
        ):
            haspi_report(**folders)
    with pytest.raises(ValueError, match="no condition 'NAL'; allowed: unaided, aided, loud"):
        haspi_report(manifest=corpus / "study.csv", baseline="NAL")
    (corpus / "study.csv").write_text("\n".join(MANIFEST.splitlines()[:2]))
    with pytest.raises(ValueError, match="one condition only, unaided"):
        haspi_report(manifest=corpus / "study.csv")
