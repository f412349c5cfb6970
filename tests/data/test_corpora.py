"""Layouts of corpora are recognised, others are rejected, and manifests are checked."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from hlsim.data.layouts import find_corpus, hold_out_speakers, prepare, recognise
from hlsim.data.manifest import (
    Utterance,
    check_utterances,
    read_manifest,
    write_manifest,
)
from tests.helpers import touch_files


def voicebank(suffix: str = "", within: str = "", train: str = "trainset_28spk") -> list[str]:
    """Three utterances in the layout of VoiceBank-DEMAND."""
    names = {train: ("p226_001", "p227_001"), "testset": ("p232_001",)}
    return [
        f"{within}{kind}_{part}_wav{suffix}/{name}.wav"
        for kind in ("clean", "noisy")
        for part, stems in names.items()
        for name in stems
    ]


def splits_and_speakers(utterances: list[Utterance]) -> str:
    return ", ".join(
        sorted(f"{row.split} {row.speaker} {Path(row.path).stem}" for row in utterances)
    )


@pytest.mark.parametrize(
    "files",
    [
        voicebank(train="trainset"),
        voicebank("_16k", within="DS_10283_2791/"),
        voicebank("_16k", train="trainset_56spk"),
    ],
)
def test_voicebank_demand_is_recognised(files: list[str]) -> None:
    layout, utterances = recognise(files)
    assert layout == "VoiceBank-DEMAND"
    expected = "test p232 p232_001, train p226 p226_001, train p227 p227_001"
    assert splits_and_speakers(utterances) == expected
    for row in utterances:
        assert row.noisy == row.path.replace("clean_", "noisy_")


def test_a_corpus_at_two_rates_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"_wav/p.* and .*_wav_16k/p.* two folders for the split"):
        recognise([*voicebank(), *voicebank("_16k")])


def test_librispeech_and_libritts_are_recognised() -> None:
    names = "train-clean-100/103/1240/a.flac train-other-500/20/205/b.flac dev-clean/84/1/c.wav"
    files = [*names.split(), "test-other/367/1/d.flac"]
    layout, utterances = recognise([f"LibriSpeech/{file}" for file in files])
    assert layout == "LibriSpeech or LibriTTS"
    assert splits_and_speakers(utterances) == "test 367 d, train 103 a, train 20 b, valid 84 c"


@pytest.mark.parametrize(
    "names", ["train val test", "Training validation testing", "tr cv tt", "train dev TEST"]
)
def test_split_folders_are_recognised_by_any_of_their_names(names: str) -> None:
    files = [f"{name}/speaker{i}/session/1.wav" for i, name in enumerate(names.split())]
    _, utterances = recognise(files)
    expected = "test speaker2 1, train speaker0 1, valid speaker1 1"
    assert splits_and_speakers(utterances) == expected


def test_clean_and_noisy_folders_in_splits_are_pairs(tmp_path: Path) -> None:
    files = ["train/clean/1.wav", "train/noisy/1.flac", "test/Clean/s/2.wav", "test/Noisy/s/2.wav"]
    touch_files(tmp_path, [*files, "train/noise/1.wav", "readme.txt"])
    layout, utterances = find_corpus(tmp_path)
    assert layout == "folders clean and noisy in train, valid, test"
    assert utterances == [
        Utterance("test/Clean/s/2.wav", "test/Noisy/s/2.wav", "s", "test"),
        Utterance("train/clean/1.wav", "train/noisy/1.flac", "", "train"),
    ]


def test_scenes_of_the_clarity_challenges_are_recognised(tmp_path: Path) -> None:
    kinds = "mix_CH0 mix_CH1 mix_CH2 mix_CH3 target_CH1 target_anechoic_CH1 interferer_CH1"
    scenes = "train/scenes/S00001", "dev/scenes/S06001"
    files = [f"{scene}_{kind}.wav" for scene in scenes for kind in kinds.split()]
    touch_files(tmp_path, [*files, "train/targets/T010.wav"])
    touch_files(tmp_path, [f"eval/scenes/S1_{end}.wav" for end in ("mixed_CH1", "target_anechoic")])
    text = prepare(tmp_path, tmp_path / "m.csv")
    assert "layout: scenes of the Clarity challenges" in text and "left out" not in text
    microphones = [f"train/scenes/S00001_mix_CH{number}.wav" for number in (1, 2, 3)]
    clean = "train/scenes/S00001_target_anechoic_CH1.wav"
    rows = {row.split: row for row in read_manifest(tmp_path / "m.csv")}
    assert rows["train"] == Utterance(clean, "|".join(microphones), reference="1 2")
    assert rows["valid"].path == "dev/scenes/S06001_target_anechoic_CH1.wav"
    assert rows["test"].noisy == "eval/scenes/S1_mixed_CH1.wav"
    (tmp_path / rows["test"].noisy).unlink()
    prepare(tmp_path, tmp_path / "m.csv", microphones=[3, 1])
    assert read_manifest(tmp_path / "m.csv")[-1].noisy_files == microphones[::-2]
    with pytest.raises(ValueError, match=r"expected microphones \[4\] .*, got \[1, 2, 3\]"):
        prepare(tmp_path, tmp_path / "m.csv", microphones=[4])
    with pytest.raises(ValueError, match="a microphone is listed twice"):
        prepare(tmp_path, tmp_path / "m.csv", microphones=[3, 3])
    (tmp_path / clean).unlink()
    with pytest.raises(ValueError, match=r"of microphone 1 .* and clean speech"):
        prepare(tmp_path, tmp_path / "m.csv")


REJECTED = {
    "a microphone twice": [f"S1_{kind}_CH1.wav" for kind in ("mix", "mixed", "target_anechoic")],
    "no noisy folder": [name for name in voicebank("_16k") if "noisy_test" not in name],
    "a missing file": [name for name in voicebank() if name != "noisy_testset_wav/p232_001.wav"],
    "noise beside LibriSpeech": ["dev-clean/84/1/c.wav", "noise/1.wav"],
    "no split": ["train/a/1.wav", "test/b/1.wav", "extra/c/1.wav"],
    "LibriMix": ["train-100/mix_clean/a.wav", "train-100/s1/a.wav", "train-100/noise/a.wav"],
    "DNS in split folders": ["test/clean/clean_fileid_1.wav", "test/noisy/x_snr5_fileid_1.wav"],
    "noise in a split": ["train/noise/a.wav", "train/speech/b.wav"],
    "speakers without an option": ["id1/session/1.wav", "id2/session/1.wav"],
    "TIMIT": ["TRAIN/DR1/FCJF0/SA1.WAV", "TEST/DR1/FAKS0/SA1.WAV"],
    "no audio": ["readme.txt"],
    "dev and eval": ["train/a/1.wav", "dev/b/1.wav", "Eval/c/1.wav"],
    "train twice": ["train/a/1.wav", "training/b/1.wav", "test/c/1.wav"],
    "two files of a pair": ["train/clean/1.wav", "train/clean/1.flac", "train/noisy/1.wav"],
    "two noisy files": ["train/clean/1.wav", "train/noisy/1.wav", "train/noisy/1.mp3"],
}


@pytest.mark.parametrize("corpus", REJECTED)
def test_any_other_layout_is_rejected(corpus: str, tmp_path: Path) -> None:
    touch_files(tmp_path, REJECTED[corpus])
    with pytest.raises(ValueError, match=r"use a CSV file .*, or name the levels|no audio in it"):
        find_corpus(tmp_path)


def test_an_option_gives_the_meaning_of_folders() -> None:
    files = ["id1/session1/1.wav", "id1/session2/1.wav", "id2/session1/1.wav"]
    _, utterances = recognise(files, ["speaker"])
    assert [row.speaker for row in utterances] == ["id1", "id1", "id2"]
    _, utterances = recognise(["a/val/s1/1.wav", "b/train/s2/1.wav"], ["other", "split", "speaker"])
    assert splits_and_speakers(utterances) == "train s2 1, valid s1 1"
    _, utterances = recognise(["clean/s1/1.wav", "noisy/s1/1.wav"], ["condition", "speaker"])
    assert utterances == [Utterance("clean/s1/1.wav", "noisy/s1/1.wav", "s1", "train")]
    for folders in ("speakers", "speaker/speaker", "speaker/split", "other/other/speaker"):
        with pytest.raises(ValueError):
            recognise(files, folders.split("/"))


def test_held_out_speakers_validate_and_no_longer_train() -> None:
    utterances = [Utterance(f"s{i}/{j}.wav", "", f"s{i}") for i in range(10) for j in range(2)]
    rows = hold_out_speakers(utterances, 0.2)
    check_utterances(rows)
    assert rows == hold_out_speakers(utterances, 0.2)
    assert Counter(row.split for row in rows) == {"train": 16, "valid": 4}
    assert Counter(row.split for row in hold_out_speakers(utterances, 0.01))["valid"] == 2
    capitals = [replace(row, speaker=row.speaker.upper()) for row in utterances[::2]]
    with pytest.raises(ValueError, match="speaker s1 is in the splits"):
        check_utterances([utterances[3], replace(capitals[1], split="valid")])
    rows = hold_out_speakers([*utterances[1::2], *capitals], 0.2)
    assert Counter(row.split for row in rows) == {"train": 16, "valid": 4}
    check_utterances(rows)
    unknown_speakers = [Utterance("1.wav"), Utterance("2.wav")]
    for invalid_rows in (rows, utterances[:2], unknown_speakers):
        with pytest.raises(ValueError):
            hold_out_speakers(invalid_rows, 0.2)


@pytest.mark.parametrize("share", [-0.5, 1.0, 1.5, float("nan"), float("inf")])
def test_shares_outside_0_to_1_are_rejected(tmp_path: Path, share: float) -> None:
    touch_files(tmp_path, [f"train/{name}/1.wav" for name in ("ann", "bob", "eve")])
    with pytest.raises(ValueError, match="--valid-share"):
        prepare(tmp_path, tmp_path / "m.csv", valid_share=share)
    assert not (tmp_path / "m.csv").exists()


def test_prepare_lists_every_recording_or_counts_it(tmp_path: Path) -> None:
    corpus = touch_files(tmp_path / "corpus", ["train/ann/1.wav", "train/ann/1.flac"])
    (corpus / "train" / "bob").symlink_to(touch_files(tmp_path / "elsewhere", ["2.wav"]))
    assert "left out" not in prepare(corpus, corpus / "m.csv")
    names = [row.path for row in read_manifest(corpus / "m.csv")]
    assert names == ["train/ann/1.flac", "train/ann/1.wav", "train/bob/2.wav"]
    files = [f"train/{kind}/{name}.wav" for kind in ("clean", "noisy", "noise") for name in "12"]
    pairs = touch_files(tmp_path / "pairs", files)
    text = prepare(pairs, pairs / "m.csv")
    assert text.endswith("left out: 2 files of noise, such as train/noise/1.wav")


def test_prepare_writes_what_training_reads(tmp_path: Path) -> None:
    corpus = touch_files(tmp_path / "corpus", voicebank("_16k"))
    text = prepare(corpus, tmp_path / "m.csv", valid_share=0.5)
    rows = read_manifest(tmp_path / "m.csv", corpus)
    assert text.startswith("layout: VoiceBank-DEMAND")
    assert sorted(row.split for row in rows) == ["test", "train", "valid"]
    # A CSV file of the user is read in the same way.
    (corpus / "own.csv").write_text((tmp_path / "m.csv").read_text().replace("path,", "path, "))
    prepare(corpus / "own.csv", corpus / "manifest.csv")
    assert read_manifest(corpus / "manifest.csv") == rows
    with pytest.raises(ValueError, match="levels of folders are named"):
        prepare(corpus / "own.csv", corpus / "manifest.csv", folders=["speaker"])
    with pytest.raises(ValueError, match=r"ends in \.csv"):
        prepare(corpus / "own.csv", corpus / "clean_testset_wav_16k")


UTTERANCES = [
    Utterance("a/1.wav", "b/1.wav", "ann", "train"),
    Utterance("a/1.wav", "b/1 louder.wav", "ann", "train"),
    Utterance("Noisette/ü, 2.wav", "", "Noisette", "valid"),
    Utterance("a/3.wav", "", "", "test"),
    Utterance("a/4.wav", "", "", "train"),
]


def test_a_manifest_is_read_as_it_was_written(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "1.wav").touch()
    for _ in range(2):  # the second time over the first
        write_manifest(tmp_path / "m.csv", UTTERANCES)
        assert read_manifest(tmp_path / "m.csv") == UTTERANCES
    (tmp_path / "m.csv").rename(tmp_path / "a" / "m.csv")
    assert read_manifest(tmp_path / "a" / "m.csv", tmp_path) == UTTERANCES
    with pytest.raises(ValueError, match="--root"):
        read_manifest(tmp_path / "a" / "m.csv")
    (tmp_path / "m.csv").write_text("seconds,Path,SPLIT\n2.5,a/1.wav,test\n")
    with pytest.warns(UserWarning, match=r"columns of .*m\.csv that are not used: seconds;"):
        assert read_manifest(tmp_path / "m.csv") == [Utterance("a/1.wav", split="test")]
    with pytest.raises(ValueError, match="no manifest; choose another name"):
        write_manifest(tmp_path / "m.csv", UTTERANCES)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "path,split\n",
        "file\n1.wav\n",
        "path,split\n1.wav,dev\n",
        "path\n1.wav\n../2.wav\n",
        "path,noisy\n1.wav,/2.wav\n",
        "path,split,Split\n1.wav,train,valid\n",
        "path,noisy\n1.wav,1.wav\n",
        "path,split\n1.wav,train\na/.././1.wav,test\n",
        "path,noisy,split\n1.wav,2.wav,train\n1.wav,3.wav,test\n",
        "path,speaker,split\n1.wav,ann,train\n2.wav,ann,test\n",
        "path\nnoise/1.wav\n",
        "path\n1.wav\n./1.wav\n",
        "path,noisy\n1.wav,3.wav\n1.wav,3.wav\n",
        "path,noisy\n1.wav,3.wav\n2.wav,3.wav\n",
    ],
)
def test_invalid_contradictory_and_noisy_manifests_are_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    (tmp_path / "1.wav").touch()
    with pytest.raises(ValueError, match=r"m\.csv"):
        read_manifest(tmp_path / "m.csv")
