"""Recorded speech scored from folders and from a manifest."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.evaluation import haspi_report
from hlsim.evaluation.recordings import read_manifest
from hlsim.evaluation.store import content_hash
from hlsim.metrics import haspi

pytest.importorskip("pandas")

N4 = Audiogram.standard("N4")
HEADER = "file," + ",".join(N4.to_row())
LEVELS = ",".join(N4.to_row().values())


@pytest.fixture
def corpus(tmp_path: Path, speech_dir: Path) -> Path:
    """Folders clean, before and after with two files of 0.8 s, one in a subfolder, at two rates."""
    for name, source in (("a.b", "train/flite-slt-01"), ("p2/c", "valid/espeak-us-annie-01")):
        waveform, rate = read_audio(speech_dir / f"{source}.flac")
        clean = waveform[:, rate : rate + 8 * rate // 10]
        noisy = clean + 0.002 * torch.randn(clean.shape)
        signals = {
            "clean": (".flac", clean),
            "before": (".wav", noisy),
            "after": (".wav", 8 * noisy),
        }
        for folder, (suffix, signal) in signals.items():
            path = tmp_path / folder / f"{name}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_audio(path, signal, rate)
    return tmp_path


def folders(corpus: Path) -> dict[str, Path]:
    return {name: corpus / name for name in ("clean", "before", "after")}


def first_channel(path: Path) -> Tensor:
    return read_audio(path)[0][0].double()


def test_a_score_is_that_of_the_metric(corpus: Path) -> None:
    report = haspi_report(
        **folders(corpus), audiogram=N4, seed=4, full_scale_spl=90.0, jobs=1, measures=("haspi",)
    )
    assert list(report.table.name) == ["a.b", "a.b", "p2/c", "p2/c"]
    for row in report.table.itertuples():
        clean = corpus / "clean" / f"{row.name}.flac"
        seed = (4 + int(content_hash(clean)[:8], 16)) % 2**32
        output = first_channel(corpus / row.condition / f"{row.name}.wav")
        settings: dict[str, Any] = {"sample_rate": row.sample_rate, "full_scale_spl": 90.0}
        settings |= {"noise": "seeded", "seed": seed, "whole_khz": True}
        score = haspi(output, first_channel(clean), N4, **settings)
        assert (row.haspi, row.seed) == (float(score), seed)
        level = 90.0 + 10.0 * math.log10(float(output.square().mean()))
        assert row.level == pytest.approx(level, abs=1e-9)
    comparison = report.headline
    assert comparison is not None and comparison.overall.delta > 0.2
    assert comparison.level_change == pytest.approx(20.0 * math.log10(8.0), abs=1e-4)


def test_one_condition_alone_is_scored_without_a_comparison(corpus: Path) -> None:
    report = haspi_report(corpus / "clean", after=corpus / "after", audiogram=N4, spl=65.0, jobs=1)
    assert report.names == ["after"] and report.comparisons == [] and report.headline is None
    assert report.table.clean_level.tolist() == pytest.approx([65.0, 65.0])
    assert report.table.haspi.notna().all()


def test_a_run_with_the_same_store_reads_its_scores(corpus: Path) -> None:
    store = corpus / "scores.jsonl"
    first = haspi_report(**folders(corpus), audiogram=N4, jobs=1, store=store)
    lines = store.read_bytes()
    again = haspi_report(**folders(corpus), audiogram=N4, jobs=1, store=store)
    assert again.table.equals(first.table) and store.read_bytes() == lines
    haspi_report(**folders(corpus), audiogram=Audiogram.standard("N2"), jobs=1, store=store)
    assert store.read_bytes().count(b"\n") == 2 * lines.count(b"\n")


def stereo(corpus: Path) -> None:
    write_audio(corpus / "after/p2/c.wav", torch.ones(2, 17640) * 0.1, 22050)


def shorter(corpus: Path) -> None:
    signal = first_channel(corpus / "after/p2/c.wav").float()
    write_audio(corpus / "after/p2/c.wav", signal[None, 3000:], 22050)  # by 0.14 s


def faster(corpus: Path) -> None:
    signal = first_channel(corpus / "after/p2/c.wav").float()
    write_audio(corpus / "after/p2/c.wav", signal[None], 24000)


def broken(corpus: Path) -> None:
    (corpus / "after/p2/c.wav").write_bytes(b"RIFF and nothing more")


def silent(corpus: Path) -> None:
    write_audio(corpus / "after/p2/c.wav", torch.zeros(1, 17640), 22050)


@pytest.mark.parametrize("damage", [stereo, shorter, faster, broken, silent])
def test_a_file_that_cannot_be_scored_is_a_failure_with_its_name(
    corpus: Path, damage: Callable[[Path], None]
) -> None:
    damage(corpus)
    report = haspi_report(**folders(corpus), audiogram=N4, jobs=1, measures=("stoi",))
    (failure,) = report.failures.itertuples()
    assert (failure.name, failure.condition) == ("p2/c", "after")
    assert "after" in failure.failure and "\n" not in failure.failure
    assert report.table.stoi.notna().sum() == 3


def test_lengths_that_differ_by_little_are_cut_to_the_shorter(corpus: Path) -> None:
    path = corpus / "after/p2/c.wav"
    write_audio(path, first_channel(path).float()[None, :-200], 22050)
    with pytest.warns(UserWarning, match="both are cut"):
        report = haspi_report(**folders(corpus), audiogram=N4, jobs=1, measures=("haspi", "stoi"))
    assert report.failures.empty
    assert report.table.seconds.tolist() == pytest.approx([0.8, 0.8, 0.8, 0.8 - 200 / 22050])


def write_manifest(corpus: Path, text: str) -> Path:
    path = corpus / "study.csv"
    path.write_text(text.replace("A,", "clean/a.b.flac,").replace("C,", "clean/p2/c.flac,"))
    return path


MANIFEST = """listener,ear,condition,clean,processed,snr,audiogram
L1,left,unaided,A,before/a.b.wav,5,N3
L1,left,aided,A,after/a.b.wav,5,N3
L2,right,unaided,C,before/p2/c.wav,0,S2
L2,right,aided,C,after/p2/c.wav,0,S2
L2,right,loud,C,gone.wav,0,S2
"""


def test_a_manifest_names_ears_levels_and_conditions(corpus: Path) -> None:
    path = write_manifest(corpus, MANIFEST)
    report = haspi_report(manifest=path, measures=("stoi",), baseline="aided", spl=65.0, jobs=1)
    assert report.names == ["aided", "unaided", "loud"]
    assert [(c.before, c.after, c.overall.n) for c in report.comparisons] == [
        ("aided", "unaided", 2)
    ]
    items = report.table.drop_duplicates("item")
    assert list(items.name) == ["L1 left clean/a.b 5 dB", "L2 right clean/p2/c 0 dB"]
    assert items.clean_level.tolist() == pytest.approx([65.0, 65.0])
    assert items.audiogram.tolist() == [
        list(Audiogram.standard(name).thresholds) for name in ("N3", "S2")
    ]
    reasons = dict(zip(report.failures.name, report.failures.failure, strict=True))
    assert "is recorded under loud" in reasons["L1 left clean/a.b 5 dB"]
    assert "gone.wav" in reasons["L2 right clean/p2/c 0 dB"]


def test_the_better_ear_counts(corpus: Path) -> None:
    rows = ["listener,ear,condition,clean,processed,audiogram"]
    files = {"unaided": ("after", "before"), "aided": ("before", "after")}
    for condition, (left, right) in files.items():
        rows.append(f"L1,left,{condition},A,{left}/a.b.wav,N5")
        rows.append(f"L1,right,{condition},A,{right}/a.b.wav,N5")
    path = write_manifest(corpus, "\n".join(rows))
    ears = haspi_report(manifest=path, jobs=1)
    better = haspi_report(manifest=path, jobs=1, better_ear=True)
    assert len(better.table) == 2 and list(better.table.name) == ["L1 clean/a.b"] * 2
    for row in better.table.itertuples():
        of_condition = ears.table[ears.table.condition == row.condition]
        best = of_condition.loc[of_condition.haspi.idxmax()]
        assert (row.haspi, row.level) == (best.haspi, best.level)
    assert set(better.table.ear) == {"right"}, "the better ear under the last condition"
    assert better.groups["ears"].table.equals(ears.table)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"5,N3\n": "5,N9\n"}, "line 2: .*N9"),
        ({"A,before": "../A,before"}, "line 2: .*not a path below"),
        ({"L1,left,aided": "L1,left,unaided"}, "line 3: a second row of L1 left"),
        ({"N3\nL2": "N4\nL2"}, "line 3: the audiogram differs"),
        ({",5,N3": ",x,N3"}, "line 2: the SNR is 'x'"),
        ({"L1,left": "L1,top"}, "line 2: the ear is 'top'"),
        ({"condition,": "given,"}, "needs rows with the columns condition"),
        ({",snr,": ",spl,"}, "the level as an option"),
        ({",audiogram\n": ",ear_of\n"}, "line 2: no audiogram of listener 'L1'"),
    ],
)
def test_a_wrong_row_is_named_by_its_line(
    corpus: Path, changes: dict[str, str], message: str
) -> None:
    text = MANIFEST
    for old, new in changes.items():
        text = text.replace(old, new)
    with pytest.raises(ValueError, match=message):
        read_manifest(write_manifest(corpus, text))


def test_audiograms_may_stand_in_a_file_of_their_own(corpus: Path) -> None:
    ears = corpus / "ears.csv"
    unused = LEVELS.replace("80", "NR")  # only the ears of the files are validated
    ears.write_text(f"{HEADER}\na.b.wav,{LEVELS}\np2/c,{LEVELS}\nother,{unused}\n")
    by_file = haspi_report(**folders(corpus), audiograms=ears, measures=("stoi",), jobs=1)
    assert by_file.table.audiogram.tolist() == [list(N4.thresholds)] * 4
    ears.write_text(f"{HEADER}\na.b.wav,{LEVELS}\n")
    with pytest.raises(ValueError, match=r"ears\.csv: no audiogram for p2/c"):
        haspi_report(**folders(corpus), audiograms=ears)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"audiogram": N4, "seed": -1},
        {"audiogram": N4, "full_scale_spl": 300.0},
        {"audiogram": N4, "measures": ("loudness",)},
        {"audiogram": N4, "measures": ()},
        {"audiogram": N4, "baseline": "unaided"},
        {"audiogram": N4, "better_ear": True},
        {"audiogram": N4, "after": None},
        {"audiogram": N4, "manifest": "study.csv"},
    ],
)
def test_settings_that_cannot_be_are_rejected_before_scoring(
    corpus: Path, settings: dict[str, Any]
) -> None:
    with pytest.raises(ValueError):
        haspi_report(**{**folders(corpus), **settings}, jobs=1)


def test_folders_need_the_same_names(corpus: Path) -> None:
    (corpus / "after" / "a.b.wav").unlink()
    with pytest.raises(ValueError, match=r"after: no file for a\.b \(1 of 2\)"):
        haspi_report(**folders(corpus), audiogram=N4)


def test_nothing_scored_is_an_error(corpus: Path) -> None:
    for path in (corpus / "clean").rglob("*.flac"):
        path.write_bytes(b"no audio")
    with pytest.raises(ValueError, match="none of 2 items could be scored"):
        haspi_report(**folders(corpus), audiogram=N4, jobs=1)
