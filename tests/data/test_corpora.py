"""Layouts of corpora, and the splits of speakers."""

from pathlib import Path

import pytest

from hlsim.data.corpora import (
    Fault,
    assign_splits,
    detect_layout,
    find_below,
    find_utterances,
    walk_audio,
)
from hlsim.data.manifest import Utterance


def tree(root: Path, *paths: str) -> Path:
    for path in paths:
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).touch()
    return root


def found(corpus: Path, table: Path | None = None) -> tuple[list[Utterance], list[Fault]]:
    everything = list(find_utterances(corpus, detect_layout(corpus), table))
    return (
        [one for one in everything if isinstance(one, Utterance)],
        [one for one in everything if isinstance(one, Fault)],
    )


def test_voicebank_demand(tmp_path: Path) -> None:
    corpus = tree(
        tmp_path,
        *(
            f"{kind}_trainset_28spk_wav/p226_00{i}.wav"
            for kind in ("clean", "noisy")
            for i in (1, 2)
        ),
        *(f"{kind}_trainset_56spk_wav/p234_001.wav" for kind in ("clean", "noisy")),
        *(f"{kind}_testset_wav/p232_001.wav" for kind in ("clean", "noisy")),
        "clean_trainset_28spk_wav/p226_003.wav",
        "noisy_testset_wav/p257_009.wav",
        "clean_testset_wav/notes.txt",
    )
    (corpus / "logfiles").mkdir()
    (corpus / "logfiles" / "log_trainset_28spk.txt").write_text(
        "p226_002 office 15\np226_009 bus x\n\n"
    )
    (corpus / "log_testset.txt").write_text("p232_001 living 17.5\n")
    utterances, faults = found(corpus)
    assert [(u.id, u.speaker, u.split, u.noise, u.snr) for u in utterances] == [
        ("p226_001", "p226", "train", "", None),
        ("p226_002", "p226", "train", "office", 15.0),
        ("p234_001", "p234", "train", "", None),
        ("p232_001", "p232", "test", "living", 17.5),
    ]
    assert utterances[2].clean == "clean_trainset_56spk_wav/p234_001.wav"
    assert utterances[2].noisy == "noisy_trainset_56spk_wav/p234_001.wav"
    assert [(f.path, f.reason.split()[:3]) for f in faults] == [
        ("clean_trainset_28spk_wav/p226_003.wav", ["no", "noisy", "counterpart"]),
        ("noisy_testset_wav/p257_009.wav", ["no", "clean", "counterpart"]),
    ]


@pytest.mark.parametrize("inner", ["", "LibriSpeech/"])
def test_librispeech(tmp_path: Path, inner: str) -> None:
    names = (
        "train-clean-100/103/1240/103-1240-0000.flac",
        "dev-clean/84/1/84-1-0003.flac",
        "test-other/7/2/7-2-0001.flac",
    )
    corpus = tree(
        tmp_path,
        *(inner + name for name in names),
        f"{inner}README.TXT",
        f"{inner}train-clean-100/x.trans.txt",
    )
    utterances, faults = found(corpus)
    assert not faults
    assert sorted((u.id, u.speaker, u.split, u.clean) for u in utterances) == [
        ("103-1240-0000", "103", "train", inner + names[0]),
        ("7-2-0001", "7", "test", inner + names[2]),
        ("84-1-0003", "84", "valid", inner + names[1]),
    ]


def test_any_folder(tmp_path: Path) -> None:
    corpus = tree(
        tmp_path,
        "b/x/1.wav",
        "a/1.flac",
        "a/1.wav",
        "top.ogg",
        "a/.hidden.wav",
        ".git/2.wav",
        "a/n.txt",
    )
    utterances, faults = found(corpus)
    assert {(u.id, u.speaker, u.split) for u in utterances} == {
        ("a/1", "a", ""),
        ("b/x/1", "b/x", ""),
        ("top", "unknown", ""),
    }
    assert [f.path for f in faults] == ["a/1.wav"] and "second file of the name a/1" in faults[
        0
    ].reason
    assert list(walk_audio(corpus)) == ["top.ogg", "a/1.flac", "a/1.wav", "b/x/1.wav"]


def test_a_folder_with_splits_and_pairs(tmp_path: Path) -> None:
    corpus = tree(
        tmp_path,
        "train/clean/s1/1.wav",
        "train/noisy/s1/1.wav",
        "train/clean/s1/2.wav",
        "dev/noisy/s2/1.wav",
        "dev/clean/s3/9.txt",
    )
    utterances, faults = found(corpus)
    assert [(u.clean, u.noisy, u.speaker, u.split) for u in utterances] == [
        ("train/clean/s1/1.wav", "train/noisy/s1/1.wav", "s1", "train")
    ]
    assert {f.path: f.reason for f in faults} == {
        "train/clean/s1/2.wav": "no noisy counterpart train/noisy/s1/2.wav",
        "dev/noisy/s2/1.wav": "no clean counterpart dev/clean/s2/1.wav",
    }


def test_files_without_a_speaker_are_one_a_split(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_text("file,split\n1.wav,train\n2.wav,test\n3.wav,\n")
    corpus = tree(tmp_path / "c", "train/1.wav", "valid/1.wav", "test/1.wav", "test/2.wav", "1.wav")
    for (utterances, _), expected in (
        (found(corpus), {"unknown", "unknown train", "unknown valid", "unknown test"}),
        (found(corpus, table), {"unknown", "unknown train", "unknown test"}),
    ):
        speakers = {u.speaker: {u.split} for u in utterances}
        assert set(speakers) == expected
        splits = assign_splits(speakers, test_share=0.1, valid_share=0.0, seed=0)
        assert splits["unknown train"] == "train" and splits["unknown test"] == "test"


def test_a_second_file_of_a_name_is_a_fault(tmp_path: Path) -> None:
    for name, place in (("libri", "train-clean-100/1/2"), ("vbd", "clean_testset_wav")):
        corpus = tree(tmp_path / name, f"{place}/1-2.flac", f"{place}/1-2.wav")
        tree(corpus, "noisy_testset_wav/1-2.flac", "noisy_testset_wav/1-2.wav")
        utterances, faults = found(corpus)
        assert [u.clean for u in utterances] == [f"{place}/1-2.flac"]
        assert [(f.path, f.reason) for f in faults] == [
            (f"{place}/1-2.wav", "a second file of the name 1-2")
        ]


def test_a_folder_above_whose_name_ends_in_clean_is_none_of_a_pair(tmp_path: Path) -> None:
    utterances, faults = found(tree(tmp_path, "vctk-clean/clean/1.wav", "vctk-clean/noisy/1.wav"))
    assert [(u.clean, u.noisy) for u in utterances] == [
        ("vctk-clean/clean/1.wav", "vctk-clean/noisy/1.wav")
    ]
    assert list(faults) == []


def test_links_to_folders_are_told_of(tmp_path: Path) -> None:
    tree(tmp_path / "far", "1.wav")
    for name, inner in (
        ("any", "b"),
        ("libri", "train-clean-100/b"),
        ("vbd", "clean_testset_wav/b"),
    ):
        corpus = tree(
            tmp_path / name, f"{Path(inner).parent}/a/s-1.wav", "noisy_testset_wav/a/s-1.wav"
        )
        (corpus / inner).symlink_to(tmp_path / "far")
        _, faults = found(corpus)
        assert [(f.path, f.reason.split(";")[0]) for f in faults] == [(inner, "a link to a folder")]
        assert [
            f.path
            for f in find_below(tmp_path, name, detect_layout(corpus))
            if isinstance(f, Fault)
        ] == [f"{name}/{inner}"]


def test_a_table_says_more(tmp_path: Path) -> None:
    corpus = tree(tmp_path / "corpus", "a/1.wav", "a/2.wav", "n/1.wav")
    table = tmp_path / "table.csv"
    table.write_text(
        "\ufefffile,id,speaker,split,noisy,noise,snr\na/1.wav,one,ann,test,n/1.wav,bus,7.5\na/2.wav,,,,,,\n"
    )
    utterances, _ = found(corpus, table)
    assert [(u.id, u.speaker, u.split, u.noisy, u.noise, u.snr) for u in utterances] == [
        ("one", "ann", "test", "n/1.wav", "bus", 7.5),
        ("a/2", "a", "", "", "", None),
    ]
    for text, said in (
        ("id\nx\n", "line 2: no file named"),
        ("file,split\na/1.wav,dev\n", "line 2: split 'dev'"),
        ("file,snr\na/1.wav,loud\n", "line 2: snr 'loud'"),
        ("file\na/1.wav\n\na/1.wav\n", "line 4: a second row of a/1"),
        ("file\n../a/1.wav\n", "leads out of"),
    ):
        table.write_text(text)
        with pytest.raises(ValueError, match=said):
            found(corpus, table)
    with pytest.raises(ValueError, match="cannot be read as CSV"):
        found(corpus, tmp_path / "none.csv")


def test_speakers_are_in_one_split() -> None:
    speakers = {f"s{i}": {""} for i in range(20)}
    options = {"test_share": 0.1, "valid_share": 0.2, "seed": 0}
    splits = assign_splits(speakers, **options)
    counts = {
        split: sum(own == split for own in splits.values()) for split in ("train", "valid", "test")
    }
    assert counts == {"train": 14, "valid": 4, "test": 2}
    assert splits == assign_splits(dict(reversed(speakers.items())), **options)
    assert splits != assign_splits(speakers, **options | {"seed": 1})
    assert assign_splits({"a": {""}}, **options) == {"a": "train"}
    given = assign_splits(
        {"a": {"train"}, "b": {"test"}, "c": {"train"}, "d": {"train"}}, **options
    )
    mixed = assign_splits({"a": {"", "test"}, "b": {""}}, **options | {"valid_share": 0.0})
    assert mixed == {"a": "test", "b": "train"}
    assert assign_splits({"a": {"test"}}, **options) == {
        "a": "test"
    }  # none to take validation from
    assert given["b"] == "test" and sorted(given.values()) == ["test", "train", "train", "valid"]
    with pytest.raises(ValueError, match=r"speaker a is in test and train; allowed: one split"):
        assign_splits({"a": {"train", "test"}}, **options)


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such folder"):
        detect_layout(tmp_path / "nowhere")
