"""Recorded speech scored from folders and from a manifest."""

import math
from pathlib import Path
from typing import Any

import pytest
import soundfile
import torch
from torch import Tensor

from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.evaluation import haspi_report
from hlsim.evaluation.recordings import _read_manifest
from hlsim.files import sha256
from hlsim.metrics import haspi

pytest.importorskip("pandas")

N4 = Audiogram.standard("N4")
HEADER = "listener,ear," + ",".join(N4.to_row())
LEVELS = ",".join(N4.to_row().values())


@pytest.fixture
def corpus(tmp_path: Path, speech_dir: Path) -> Path:
    """Write two files of 0.8 s, one in a subfolder, at two rates, to clean, before and after."""
    for name, source in (("a.b", "train/flite-slt-01"), ("p2/c", "valid/espeak-us-annie-01")):
        waveform, rate = read_audio(speech_dir / f"{source}.flac")
        clean = waveform[:, rate : rate + 8 * rate // 10]
        noisy = clean + 0.002 * torch.randn(clean.shape)
        for folder, signal in (("clean", clean), ("before", noisy), ("after", 8 * noisy)):
            path = tmp_path / folder / f"{name}{'.flac' if folder == 'clean' else '.wav'}"
            path.parent.mkdir(parents=True, exist_ok=True)
            if folder == "clean":
                soundfile.write(path, signal.T.numpy(), rate)
            else:
                write_audio(path, signal, rate)
    return tmp_path


def folders(corpus: Path) -> dict[str, Any]:
    return {name: corpus / name for name in ("clean", "before", "after")} | {"jobs": 1}


def first_channel(path: Path) -> Tensor:
    return read_audio(path)[0][0].double()


def test_a_score_is_that_of_the_metric_and_is_read_again(corpus: Path) -> None:
    store = corpus / "scores.jsonl"
    settings = {**folders(corpus), "seed": 4, "full_scale_spl": 90.0, "store": store}
    report = haspi_report(**settings, audiogram=N4)
    assert list(report.table.name) == ["a.b", "a.b", "p2/c", "p2/c"]
    for row in report.table.itertuples():
        clean = corpus / "clean" / f"{row.name}.flac"
        seed = (4 + int(sha256(clean)[:8], 16)) % 2**32
        output = first_channel(corpus / row.condition / f"{row.name}.wav")
        options: dict[str, Any] = {"sample_rate": read_audio(clean)[1], "full_scale_spl": 90.0}
        options |= {"noise": "seeded", "seed": seed, "whole_khz": True}
        assert row.haspi == float(haspi(output, first_channel(clean), N4, **options))
        level = 90.0 + 10.0 * math.log10(float(output.square().mean()))
        assert row.level == pytest.approx(level, abs=1e-9)
    comparison = report.headline
    assert comparison is not None and comparison.overall.delta > 0.2
    assert comparison.level_change == pytest.approx(20.0 * math.log10(8.0), abs=1e-4)
    lines = store.read_bytes()
    assert haspi_report(**settings, audiogram=N4).table.equals(report.table)
    assert store.read_bytes() == lines
    haspi_report(**settings, audiogram=Audiogram.standard("N2"))
    assert store.read_bytes().count(b"\n") == 2 * lines.count(b"\n")


def test_a_single_condition_is_scored_without_a_comparison(corpus: Path) -> None:
    settings: dict[str, Any] = {"audiogram": N4, "spl": 65.0, "jobs": 1}
    settings["measures"] = ["stoi", "stoi"]
    manifest = write_manifest(corpus, "condition,clean,processed\nmine,A,after/a.b.wav\n")
    for report in (
        haspi_report(corpus / "clean", after=corpus / "after", **settings),
        haspi_report(manifest=manifest, **settings),
    ):
        assert report.comparisons == [] and report.headline is None and len(report.names) == 1
        assert report.table.clean_level.to_numpy() == pytest.approx(65.0)
        assert report.table.stoi.notna().all()


@pytest.mark.parametrize("damage", ["two channels", "shorter", "another rate", "broken", "silent"])
def test_a_file_that_cannot_be_scored_is_a_failure(corpus: Path, damage: str) -> None:
    path = corpus / "after/p2/c.wav"
    signal = first_channel(path).float()
    signals = {
        "two channels": (signal.expand(2, -1), 22050),
        "shorter": (signal[3000:], 22050),  # by 0.14 s
        "another rate": (signal, 24000),
        "silent": (0.0 * signal, 22050),
    }
    if damage == "broken":
        path.write_bytes(b"RIFF and nothing more")
    else:
        write_audio(path, *signals[damage])
    report = haspi_report(**folders(corpus), audiogram=N4, measures=("stoi",))
    (failure,) = report.failures.itertuples()
    assert (failure.name, failure.condition) == ("p2/c", "after")
    assert "\n" not in failure.failure
    assert report.table.stoi.notna().sum() == 3


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
    pairs = [(c.before, c.after, c.overall.n) for c in report.comparisons]
    assert pairs == [("aided", "unaided", 2)]
    items = report.table.drop_duplicates("item")
    assert list(items.name) == ["L1 left clean/a.b 5 dB", "L2 right clean/p2/c 0 dB"]
    assert items.clean_level.tolist() == pytest.approx([65.0, 65.0])
    ears = [list(Audiogram.standard(name).thresholds) for name in ("N3", "S2")]
    assert items.audiogram.tolist() == ears
    reasons = dict(zip(report.failures.name, report.failures.failure, strict=True))
    assert "is recorded under loud" in reasons["L1 left clean/a.b 5 dB"]
    assert "gone.wav" in reasons["L2 right clean/p2/c 0 dB"]


def test_the_better_ear_counts(corpus: Path) -> None:
    rows = ["listener,ear,condition,clean,processed,audiogram"]
    for condition, left, right in (("unaided", "after", "before"), ("aided", "before", "after")):
        rows.append(f"L1,left,{condition},A,{left}/a.b.wav,N5")
        rows.append(f"L1,right,{condition},A,{right}/a.b.wav,N5")
    path = write_manifest(corpus, "\n".join(rows))
    ears = haspi_report(manifest=path, jobs=1)
    better = haspi_report(manifest=path, jobs=1, better_ear=True)
    assert list(better.table.name) == ["L1 clean/a.b"] * 2
    for row in better.table.itertuples():
        both = ears.table[ears.table.condition == row.condition]
        best = both.loc[both.haspi.idxmax()]
        assert (row.haspi, row.level) == (best.haspi, best.level)
    assert set(better.table.ear) == {"right"}, "the better ear in the last condition"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("5,N3\n", "5,N9\n", "line 2: .*N9"),
        (
            "L1,left,aided",
            "L1,left,unaided",
            "line 3: expected one row of L1 left .* under condition unaided",
        ),
        ("L1,left,aided", "L1,left,", "line 3: expected a value in the column condition"),
        ("N3\nL2", "N4\nL2", "line 3: expected the audiogram of earlier rows of L1 left"),
        (",snr,", ",spl,", "expected no column spl, .* pass the option --spl"),
        (",5,N3", ",x,N3", "line 2: could not convert string to float: 'x'"),
        ("L1,left", "L1,top", "line 2: .*got 'top'"),
        ("before/a", "../a", "line 2: expected the path of a file below"),
        ("condition,", "treatment,", "line 2: expected a value in the column condition"),
        (",audiogram\n", ",ear_of\n", "line 2: there is no audiogram of listener 'L1'"),
    ],
)
def test_the_line_of_an_invalid_row_is_named(
    corpus: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        _read_manifest(write_manifest(corpus, MANIFEST.replace(old, new)))


def test_the_ears_of_a_manifest_may_be_in_a_file_of_their_own(corpus: Path) -> None:
    ears = corpus / "ears.csv"
    unused = LEVELS.replace("80", "NR")  # Only ears that are used are validated.
    manifest = write_manifest(corpus, MANIFEST.replace(",audiogram\n", ",remark\n"))
    ears.write_text(f"{HEADER}\nL1,left,{LEVELS}\nL2,R,{LEVELS}\nL3,left,{unused}\n")
    assert {r.audiogram for r in _read_manifest(manifest, audiograms=ears)} == {N4}
    ears.write_text(f"{HEADER}\nL1,left,{LEVELS}\nL2,left,{LEVELS}\n")
    with pytest.raises(ValueError, match="line 4: there is no audiogram of listener 'L2'"):
        _read_manifest(manifest, audiograms=ears)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "expected either a manifest"),
        ({"audiogram": N4, "full_scale_spl": 300.0}, "full_scale_spl"),
        ({"audiogram": N4, "measures": ["loudness"]}, "unknown measures: loudness"),
        ({"audiogram": N4, "baseline": "unaided"}, "no condition 'unaided'"),
        ({"audiogram": N4, "better_ear": True}, "one left and one right ear"),
        ({"audiogram": N4, "manifest": "study.csv"}, "expected either a manifest"),
    ],
)
def test_invalid_settings_are_rejected_before_scoring(
    corpus: Path, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        haspi_report(**{**folders(corpus), **settings})


def test_folders_that_do_not_match_or_have_no_audio(corpus: Path) -> None:
    path = corpus / "before" / "a.b.wav"
    twin = path.with_suffix(".flac")
    twin.write_bytes(path.read_bytes())
    with pytest.raises(ValueError, match="differ in their extension; keep one"):
        haspi_report(**folders(corpus), audiogram=N4)
    twin.unlink()
    (corpus / "after" / "a.b.wav").rename(corpus / "after" / "d.wav")
    with pytest.raises(
        ValueError,
        match=r"after: expected files with the same names, but only one of them has a\.b",
    ):
        haspi_report(**folders(corpus), audiogram=N4)
    (corpus / "after" / "d.wav").rename(corpus / "after" / "a.b.wav")
    for path in (corpus / "clean").rglob("*.flac"):
        path.write_bytes(b"no audio")
    with pytest.raises(ValueError, match="none of 2 items could be scored"):
        haspi_report(**folders(corpus), audiogram=N4)
