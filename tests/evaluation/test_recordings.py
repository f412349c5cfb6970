"""Recorded speech scored from folders and from a manifest."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from torch import Tensor

from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.cli.main import main
from hlsim.evaluation import haspi_report
from hlsim.evaluation.measures import REFERENCES
from hlsim.evaluation.recorded_items import RecordedItem, read_recordings
from hlsim.files import sha256
from hlsim.metrics import HaspiReference, haspi
from hlsim.shortcuts import example_speech

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
        expected = float(haspi(output, first_channel(clean), N4, **options))
        assert row.haspi == pytest.approx(expected, abs=5e-6)
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


def test_clean_speech_is_prepared_once_for_all_conditions_and_listeners(
    corpus: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = []

    class CountedReference(HaspiReference):
        def __init__(self, *arguments: Any, **settings: Any) -> None:
            prepared.append(arguments)
            super().__init__(*arguments, **settings)

    monkeypatch.setitem(REFERENCES, "haspi", CountedReference)
    ears = corpus / "ears.csv"
    ears.write_text("listener,hl_500,hl_4000\nL1,20,40\nL2,50,60\n")
    table = haspi_report(**folders(corpus), audiograms=ears, seed=9).table
    assert len(table) == 8 and table.haspi.nunique() == 8
    assert len(prepared) == 2  # files


def test_a_stored_score_has_the_precision_that_is_asked_for(corpus: Path) -> None:
    paths = {"clean": corpus / "clean", "after": corpus / "after"}
    settings = {**paths, "audiogram": N4, "store": corpus / "scores.jsonl", "jobs": 1}
    single = haspi_report(**settings).table.haspi
    double = haspi_report(**settings, precision=64)
    exact = []
    for row in double.table.itertuples():
        clean = corpus / "clean" / f"{row.name}.flac"
        output = first_channel(corpus / "after" / f"{row.name}.wav")
        options: dict[str, Any] = {"sample_rate": read_audio(clean)[1], "noise": "seeded"}
        options |= {"seed": int(sha256(clean)[:8], 16), "whole_khz": True}
        exact.append(float(haspi(output, first_channel(clean), N4, **options)))
    assert list(double.table.haspi) == exact
    assert list(single) != exact
    assert list(haspi_report(**settings).table.haspi) == list(single)
    assert double.settings["precision"] == 64
    with pytest.raises(ValueError, match="expected precision 32 or 64"):
        haspi_report(**settings, precision=16)


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


@pytest.mark.usefixtures("quick_scores")
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
        (
            "L1,left,aided",
            "l1,left,aided",
            "line 3: the listener 'l1' differs from 'L1' only in case",
        ),
        ("left,aided", "left,Aided", "line 5: the condition 'aided' differs from 'Aided' only"),
        (",snr,", ",spl,", "expected no column spl, .* pass the option --spl"),
        (",5,N3", ",x,N3", "line 2: expected a number in dB in the column snr, .* got 'x'"),
        (",5,N3", ",-inf,N3", "line 2: expected a number in dB in the column snr"),
        ("L1,left", "L1,top", "line 2: .*got 'top'"),
        ("before/a", "../a", "line 2: expected the path of a file below"),
        ("condition,", "treatment,", "line 2: there is no column condition, only listener, ear, "),
        ("listener,ear", "ear,Ear", "the column ear appears twice"),
        (",audiogram\n", ",ear_of\n", "line 2: there is no audiogram of listener 'L1'"),
    ],
)
def test_the_line_of_an_invalid_row_is_named(
    corpus: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        read_recordings(write_manifest(corpus, MANIFEST.replace(old, new)))


def test_the_ears_of_a_manifest_may_be_in_a_file_of_their_own(corpus: Path) -> None:
    ears = corpus / "ears.csv"
    unused = LEVELS.replace("80", "NR")  # Only ears that are used are validated.
    manifest = write_manifest(corpus, MANIFEST.replace(",audiogram\n", ",remark\n"))
    ears.write_text(f"{HEADER}\nL1,left,{LEVELS}\nL2,R,{LEVELS}\nL3,left,{unused}\n")
    assert {r.audiogram for r in read_recordings(manifest, audiograms=ears)[0]} == {N4}
    ears.write_text(f"{HEADER}\nL1,left,{LEVELS}\nL2,left,{LEVELS}\n")
    # The default is for listeners that the table does not have.
    for default in (None, N4):
        with pytest.raises(ValueError, match="line 4: there is no audiogram of listener 'L2'"):
            read_recordings(manifest, audiogram=default, audiograms=ears)


def test_thresholds_between_the_eight_frequencies_are_in_the_key(corpus: Path) -> None:
    files = corpus / "clean" / "a.b.flac"
    ears = [Audiogram((20.0, 20.0), (500.0, 4000.0))]
    ears.append(Audiogram((20.0, 90.0, 20.0), (500.0, 1500.0, 4000.0)))
    keys = {RecordedItem("a", files, {"x": files}, ear).digest("x") for ear in ears}
    assert len(keys) == 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "expected the ear of the files in folders .* got none"),
        ({"audiogram": N4, "audiograms": "standard"}, "got both; pass one"),
        ({"audiogram": N4, "conditions": {"A": "after"}}, "got both; name all folders"),
        ({"audiogram": N4, "before": None, "after": None}, "expected either a manifest"),
        ({"audiogram": N4, "root": "."}, "--root. has no effect on folders"),
        ({"audiogram": N4, "full_scale_spl": 300.0}, "full_scale_spl"),
        ({"audiogram": N4, "measures": ["loudness"]}, "unknown measures: loudness"),
        ({"audiogram": N4, "baseline": "unaided"}, "no condition 'unaided'"),
        ({"audiogram": N4, "better_ear": True}, "one left and one right ear .* ears unknown; add"),
        ({"audiogram": N4, "manifest": "study.csv"}, "expected either a manifest, or"),
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


BY_FREQUENCY = dict(zip(N4.frequencies, N4.levels, strict=True))


@pytest.mark.parametrize("ear", ["n4", [*N4.levels], BY_FREQUENCY])
def test_an_ear_may_have_any_form(corpus: Path, ear: Any) -> None:
    report = haspi_report(**folders(corpus), audiogram=ear, measures=["stoi"])
    assert report.items[0].audiogram == N4


def test_a_file_that_was_replaced_is_scored_again_whatever_its_time(corpus: Path) -> None:
    path = corpus / "after" / "a.b.wav"
    settings = {**folders(corpus), "audiogram": N4, "measures": ["stoi"]}
    store, state = corpus / "scores.jsonl", path.stat()
    before = haspi_report(**settings, store=store).table
    waveform, rate = read_audio(path)
    write_audio(path, waveform.roll(100, -1), rate)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    after = haspi_report(**settings, store=store).table
    assert (before["stoi"] != after["stoi"]).tolist() == [False, True, False, False]


def test_links_to_one_clean_file_are_items_of_their_own(corpus: Path) -> None:
    clean = corpus / "clean" / "p2" / "c.flac"
    (corpus / "clean" / "d.flac").symlink_to(clean)
    for folder in ("before", "after"):
        path = corpus / folder / "p2" / "c.wav"
        (corpus / folder / "d.wav").write_bytes(path.read_bytes())
    report = haspi_report(**folders(corpus), audiogram=N4, measures=["stoi"])
    assert report.table["name"].unique().tolist() == ["a.b", "d", "p2/c"]
    assert report.comparisons[0].overall.n == 3


def test_a_clean_file_is_one_item_however_its_path_is_written(corpus: Path) -> None:
    rows = ["condition,clean,processed,audiogram,listner"]
    paths = "clean/a.b.flac", f"{corpus}/clean/a.b.flac", "./after/../clean//a.b.flac"
    rows += [f"{number},{path},after/a.b.wav,N4,L1" for number, path in enumerate(paths)]
    (corpus / "study.csv").write_text("\n".join(rows))
    with pytest.warns(UserWarning, match="columns of the manifest that are not used: listner;"):
        ((recording,), _) = read_recordings(corpus / "study.csv")
    assert (recording.name, [*recording.outputs]) == ("clean/a.b", ["0", "1", "2"])


def write_ears(folder: Path, noises: dict[tuple[str, str, int], float], item: str = "") -> Path:
    """Write a manifest of one utterance per number, and its files.

    Args:
        folder: Folder of the files.
        noises: Level of the noise by condition, ear and number of the utterance; NaN breaks a file.
        item: Text of the column ``item``.
    """
    clean = example_speech()[:16000]
    rows = ["listener,ear,condition,clean,processed,item,audiogram"]
    for (condition, ear, number), noise in noises.items():
        name = f"{condition}-{ear}-{number}.wav"
        generator = torch.Generator().manual_seed(number)
        write_audio(folder / f"c{number}.wav", clean * (1.0 + number), 16000)
        signal = clean + noise * torch.randn(16000, generator=generator)
        soundfile.write(folder / name, signal.numpy(), 16000, subtype="FLOAT")
        rows.append(f"A,{ear},{condition},c{number}.wav,{name},{item},N1")
    path = folder / "study.csv"
    path.write_text("\n".join(rows))
    return path


BOTH_EARS = {
    (condition, ear, number): noise
    for condition in ("unaided", "aid")
    for ear, noise in (("left", 0.01), ("right", 0.5))
    for number in range(3)
}


def test_an_utterance_that_lacks_the_score_of_an_ear_is_left_out(tmp_path: Path) -> None:
    noises = {**BOTH_EARS, ("aid", "left", 1): math.nan}
    del noises["aid", "left", 0]
    path = write_ears(tmp_path, noises)
    report = haspi_report(manifest=path, measures=["stoi"], better_ear=True, jobs=1)
    (comparison,) = report.comparisons
    assert (comparison.overall.n, comparison.left_out) == (1, 2)
    assert abs(comparison.overall.delta) < 0.01
    assert report.failures.item.tolist() == [0, 1]
    assert report.failures.failure.str.startswith("left ear: ").all()
    assert "add its file" in report.failures.failure.iloc[0]
    assert report.table.stoi.isna().sum() == 2


def test_facts_are_those_of_the_better_ear_under_the_last_condition_with_scores(
    tmp_path: Path,
) -> None:
    swapped = {"left": 0.5, "right": 0.01}
    noises = {key: swapped[key[1]] for key in BOTH_EARS}
    del noises["aid", "left", 0]
    path = write_ears(tmp_path, noises)
    table = haspi_report(manifest=path, measures=["stoi"], better_ear=True, jobs=1).table
    assert set(table.ear) == {"right"} and table.clean_level.notna().all()
    assert [failure is None for failure in table.failure] == [True, False] + [True] * 4


def test_ears_that_all_lack_a_score_are_an_error(tmp_path: Path) -> None:
    noises = {key: math.nan if key[1] == "left" else noise for key, noise in BOTH_EARS.items()}
    path = write_ears(tmp_path, noises)
    with pytest.raises(ValueError, match=r"none of 3 items could be scored; .*left ear: "):
        haspi_report(manifest=path, measures=["stoi"], better_ear=True, jobs=1)


@pytest.mark.parametrize("better_ear", [False, True])
def test_different_clean_files_with_one_label_are_different_items(
    tmp_path: Path, better_ear: bool
) -> None:
    path = write_ears(tmp_path, BOTH_EARS, item="sentence 1")
    report = haspi_report(manifest=path, measures=["stoi"], better_ear=better_ear, jobs=1)
    assert report.comparisons[0].overall.n == (3 if better_ear else 6)


def test_both_ears_may_have_clean_files_of_their_own(tmp_path: Path) -> None:
    text = write_ears(tmp_path, BOTH_EARS, item="s").read_text()
    rows = [row for row in text.split("\n") if "-1.wav" not in row and "-2.wav" not in row]
    (tmp_path / "right.wav").write_bytes((tmp_path / "c0.wav").read_bytes())
    rows = [row.replace("c0.wav", "right.wav") if "right" in row else row for row in rows]
    path = tmp_path / "two.csv"
    path.write_text("\n".join(rows))
    report = haspi_report(manifest=path, measures=["stoi"], better_ear=True, jobs=1)
    assert report.table.item.nunique() == 1
    path.write_text("\n".join(rows[:2]))
    with pytest.raises(ValueError, match="A s has the ears left; add the missing rows"):
        haspi_report(manifest=path, measures=["stoi"], better_ear=True, jobs=1)


def test_ears_of_different_sentences_are_no_pair(tmp_path: Path) -> None:
    path = write_ears(tmp_path, BOTH_EARS, item="sentence 1")
    lines = path.read_text().split("\n")
    rows = [row for row in lines if "left-0" in row or "right-1" in row]
    path.write_text("\n".join([lines[0], *rows]))
    speech = example_speech()
    write_audio(tmp_path / "c1.wav", speech[24000:40000], 16000)
    settings: dict[str, Any] = {"measures": ["stoi"], "better_ear": True, "jobs": 1}
    with pytest.raises(ValueError, match=r"same speech .* of A sentence 1, but .*c0\.wav"):
        haspi_report(manifest=path, **settings)
    # The sound arrives at the other ear 0.6 ms later and 6 dB softer.
    write_audio(tmp_path / "c1.wav", 0.5 * speech[:16000].roll(10), 16000)
    assert haspi_report(manifest=path, **settings).table.item.nunique() == 1


def test_items_are_not_identified_by_joined_or_rounded_texts(tmp_path: Path) -> None:
    rows = [
        ("A B", "C", "5"),
        ("A", "B C", "5"),
        ("A", "B C", "5.0000001"),
        ("A", "B C", ""),
    ]
    path = tmp_path / "study.csv"
    lines = [f"{a},{item},{snr},aid,c.wav,p.wav,N3" for a, item, snr in rows]
    path.write_text("listener,item,snr,condition,clean,processed,audiogram\n" + "\n".join(lines))
    assert len(read_recordings(path)[0]) == 4


@pytest.mark.parametrize(
    ("text", "snr"),
    [("5", 5.0), ("-2,5", -2.5), ("5 dB", 5.0), ("inf", math.inf), ("", math.nan)],
)
def test_texts_of_an_snr(tmp_path: Path, text: str, snr: float) -> None:
    path = tmp_path / "study.csv"
    path.write_text(f"condition;clean;processed;snr;audiogram\naid;c.wav;p.wav;{text};N3\n")
    ((recording,), _) = read_recordings(path)
    assert recording.snr == pytest.approx(snr, nan_ok=True)


@pytest.mark.parametrize("text", ["dB", "-inf", "nan", "five"])
def test_an_snr_that_is_no_number_is_an_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "study.csv"
    path.write_text(f"condition,clean,processed,snr,audiogram\naid,c.wav,p.wav,{text},N3\n")
    with pytest.raises(ValueError, match="expected a number in dB in the column snr"):
        read_recordings(path)


def test_speech_in_quiet_is_a_null_in_json(tmp_path: Path) -> None:
    path = write_ears(tmp_path, {("aid", "left", 0): 0.01})
    text = path.read_text().replace(",audiogram", ",audiogram,snr").replace(",N1", ",N1,inf")
    path.write_text(text)
    report = haspi_report(manifest=path, measures=["stoi"], jobs=1)
    assert report.to_dict()["rows"][0]["snr"] is None
    json.dumps(report.to_dict(), allow_nan=False)


def test_both_channels_of_a_file_have_one_gain(tmp_path: Path) -> None:
    speech = example_speech()[:16000]
    for name in ("c.wav", "p.wav"):
        write_audio(tmp_path / name, torch.stack([speech, 0.1 * speech]), 16000)
    rows = [f"L,{ear},aid,c.wav,p.wav,N3" for ear in ("left", "right")]
    path = tmp_path / "study.csv"
    path.write_text("listener,ear,condition,clean,processed,audiogram\n" + "\n".join(rows))
    table = haspi_report(manifest=path, measures=["stoi"], spl=65.0, jobs=1).table
    left, right = table.clean_level
    assert left - right == pytest.approx(20.0, abs=1e-3)
    assert 10 * math.log10((10 ** (left / 10) + 10 ** (right / 10)) / 2) == pytest.approx(65.0)


def test_thresholds_of_a_manifest_have_the_names_of_a_table_of_ears(tmp_path: Path) -> None:
    path = tmp_path / "study.csv"
    path.write_text("Condition,CLEAN,Processed,500 Hz,4k\naid,c.wav,p.wav,60,80\n")
    with pytest.warns(UserWarning, match="--audiogram.* is not used"):
        ((recording,), _) = read_recordings(path, audiogram=N4)
    assert recording.audiogram == Audiogram([60, 80], [500, 4000])


def test_outputs_that_are_late_are_named(tmp_path: Path) -> None:
    speech = example_speech()[:16000]
    generator = torch.Generator().manual_seed(0)
    for name, lag in (("clean", 0), ("after", 512), ("before", -100)):
        signal = speech.roll(lag) + (0.0 if name == "clean" else 0.5) * speech.std() * torch.randn(
            16000, generator=generator
        )
        write_audio(tmp_path / name / "a.wav", signal, 16000)
    report = haspi_report(**folders(tmp_path), audiogram=N4, measures=["stoi"])
    assert report.table.lag_ms.tolist() == [-6.25, 32.0]
    (note,) = report.notes
    assert "2 of 2 outputs" in note
    assert "1 under after (median +32.0 ms)" in note


def test_outputs_of_other_sentences_are_named(
    corpus: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(0).standard_normal(16000)
    speech = {"own": example_speech()[:16000], "other": 0.02 * torch.from_numpy(noise).float()}
    for folder, sounds in {
        "clean": ("own", "own"),
        "right": ("own", "own"),
        "mixed up": ("own", "other"),
    }.items():
        for number, sound in enumerate(sounds):
            write_audio(corpus / "study" / folder / f"{number}.wav", speech[sound], 16000)
    command = ["haspi-report", "--clean", f"{corpus}/study/clean", "--audiogram", "N4"]
    command += ["--condition", f"right={corpus}/study/right", "--jobs", "1"]
    command += ["--condition", f"mixed up={corpus}/study/mixed up", "--measures", "stoi"]
    assert main([*command, "--out", f"{corpus}/study/report"]) == 0
    note = "1 of 4 outputs are not similar to their clean speech"
    assert (
        f"hlsim: {note}" in (printed := capsys.readouterr().err) and "1 under mixed up" in printed
    )
    assert note in (corpus / "study" / "report" / "report.md").read_text()


def test_folders_of_many_systems_are_scored_for_all_ears_of_a_table(corpus: Path) -> None:
    ears = corpus / "ears.csv"
    ears.write_text("listener,ear,hl_500,hl_4000\nL1,left,20,40\nL2,right,50,60\n")
    systems = {"noisy": corpus / "before", "A": corpus / "after", "B": corpus / "after"}
    settings: dict[str, Any] = {"measures": ["stoi"], "jobs": 1}
    report = haspi_report(corpus / "clean", conditions=systems, audiograms=ears, **settings)
    assert report.names == ["noisy", "A", "B"]
    names = ["L1 left a.b", "L1 left p2/c", "L2 right a.b", "L2 right p2/c"]
    assert report.table.name.drop_duplicates().tolist() == names
    assert (report.table.listener == report.table.name.str[:2]).all()
    assert [(c.before, c.after) for c in report.comparisons if c.planned] == [("noisy", "B")]
    ears.write_text("hl_500,hl_4000\n20,40\n50,60\n")
    unnamed = haspi_report(corpus / "clean", conditions=systems, audiograms=ears, **settings)
    assert unnamed.table.listener.unique().tolist() == ["row 1", "row 2"]
    ears.write_text("listener,hl_500,hl_4000\nA,20,40\nA,50,60\n")
    with pytest.raises(ValueError, match="got several of listener 'A'"):
        haspi_report(corpus / "clean", conditions=systems, audiograms=ears, **settings)


def test_conditions_have_the_order_of_rows_even_if_the_first_item_lacks_one(corpus: Path) -> None:
    pandas = pytest.importorskip("pandas")
    rows = [
        {"condition": name, "clean": f"clean/{item}.flac", "processed": f"after/{item}.wav"}
        for name in ("unaided", "NAL-R", "mine")
        for item in ("a.b", "p2/c")
    ]
    del rows[2]  # NAL-R's output of the first item
    settings: dict[str, Any] = {"root": corpus, "audiogram": N4, "measures": ["stoi"], "jobs": 1}
    report = haspi_report(manifest=pandas.DataFrame(rows), **settings)
    assert report.names == ["unaided", "NAL-R", "mine"]
    planned = [(c.before, c.after) for c in report.comparisons if c.planned]
    assert planned == [("unaided", "mine")]


def test_a_frame_of_pandas_is_a_manifest(corpus: Path) -> None:
    pandas = pytest.importorskip("pandas")
    path = write_manifest(corpus, MANIFEST)
    frame = pandas.read_csv(path)
    frame["snr"] = [5.0, 5.0, math.nan, math.nan, math.nan]
    recordings, conditions = read_recordings(frame, corpus)
    assert conditions == ["unaided", "aided", "loud"]
    assert [r.snr for r in recordings] == pytest.approx([5.0, math.nan], nan_ok=True)
    assert [list(r.outputs) for r in recordings] == [
        ["unaided", "aided"],
        ["unaided", "aided", "loud"],
    ]
    frame["listener"] = None
    assert {r.listener for r in read_recordings(frame, corpus)[0]} == {""}
    with pytest.raises(ValueError, match="the manifest: expected a table with rows"):
        read_recordings(frame[:0])
    with pytest.raises(ValueError, match="the manifest, row 1: expected a value"):
        read_recordings(frame.assign(condition=["a", "", "b", "c", "d"]), corpus)
