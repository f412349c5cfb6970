"""Manifests are read as they were written, and contradictory ones are rejected."""

from pathlib import Path

import pytest

from hlsim.training.corpora.manifest import (
    Utterance,
    check_utterances,
    read_manifest,
    write_manifest,
)

UTTERANCES = [
    Utterance("a/1.wav", "b/1.wav", "ann", "train"),
    Utterance("a/ü, 2.wav", "", "bob", "valid"),
    Utterance("a/3.wav", "", "", "test"),
]


def test_a_manifest_is_read_as_it_was_written(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "1.wav").touch()
    for _ in range(2):  # the second time over the first
        write_manifest(tmp_path / "m.csv", UTTERANCES)
        assert read_manifest(tmp_path / "m.csv") == UTTERANCES
    assert (tmp_path / "m.csv").read_text().splitlines()[:2] == [
        "path,noisy,speaker,split",
        "a/1.wav,b/1.wav,ann,train",
    ]
    (tmp_path / "m.csv").rename(tmp_path / "a" / "m.csv")
    assert read_manifest(tmp_path / "a" / "m.csv", tmp_path) == UTTERANCES
    with pytest.raises(ValueError, match="--root"):
        read_manifest(tmp_path / "a" / "m.csv")


def test_all_columns_but_the_path_are_optional(tmp_path: Path) -> None:
    (tmp_path / "1.wav").touch()
    (tmp_path / "m.csv").write_text("seconds,path\n2.5,1.wav\n")
    assert read_manifest(tmp_path / "m.csv") == [Utterance("1.wav")]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "path,split\n",
        "file\n1.wav\n",
        "path,split\n1.wav,dev\n",
        "path,split\n1.wav,\n",
        "path,noisy\n1.wav,2.wav\n2.wav,\n",
        "path,noisy\n1.wav,1.wav\n",
        "path,noisy,split\n1.wav,2.wav,train\n1.wav,3.wav,test\n",
        "path,speaker,split\n1.wav,ann,train\n2.wav,ann,test\n",
        "path\nnoise/1.wav\n",
        "path\nRoom_Noises/1.wav\n",
    ],
)
def test_invalid_contradictory_and_noisy_manifests_are_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    (tmp_path / "1.wav").touch()
    with pytest.raises(ValueError, match=r"m\.csv"):
        read_manifest(tmp_path / "m.csv")


def test_similar_utterances_are_accepted() -> None:
    check_utterances(
        [
            Utterance("1.wav", "noisy/1.wav"),
            Utterance("1.wav", "noisy/1 louder.wav"),  # one clean file in several noises
            Utterance("2.wav", split="test"),  # unknown speakers in several splits
            Utterance("Noisette/3.wav", speaker="Noisette"),
        ]
    )
