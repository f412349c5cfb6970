"""The command ``prepare`` prints each layout and writes its manifest, or prints one error."""

from pathlib import Path

import pytest

from hlsim.cli.main import main

Lines = list[str]
TREES: dict[str, tuple[Lines, Lines, Lines]] = {  # files, options, what is printed
    "VoiceBank-DEMAND": (
        [
            f"{kind}_{part}_wav_16k/{name}.wav"
            for kind in ("clean", "noisy")
            for part, name in (("trainset_28spk", "p226_001"), ("testset", "p232_001"))
        ]
        + ["logfiles/log_testset.txt"],
        [],
        [
            "layout: VoiceBank-DEMAND",
            "split  speakers  utterances  pairs",
            "train         1           1      1",
            "test          1           1      1",
            "not used: 1 other files, .txt",
        ],
    ),
    "LibriSpeech": (
        [
            "train-clean-100/103/1240/a.flac",
            "train-clean-100/103/1240/a.txt",
            "dev-clean/84/1/b.flac",
        ],
        [],
        [
            "layout: LibriSpeech or LibriTTS",
            "split  speakers  utterances  pairs",
            "train         1           1      0",
            "valid         1           1      0",
            "not used: 1 other files, .txt",
        ],
    ),
    "split folders": (
        ["Train/clean/1.wav", "Train/noisy/1.wav", "Train/noise/1.wav"],
        [],
        [
            "layout: folders clean and noisy in train, valid, test",
            "split  speakers  utterances  pairs",
            "train   unknown           1      1",
            "not used: 1 audio files in Train/noise",
        ],
    ),
    "speakers": (
        ["id1/a/1.wav", "id1/b/1.wav", "id2/a/1.wav"],
        ["--folders", "speaker", "--valid-share", "0.5"],
        [
            "layout: folders speaker",
            "split  speakers  utterances  pairs",
            "train         1           2      0",
            "valid         1           1      0",
        ],
    ),
}


def make(root: Path, files: Lines) -> Path:
    for file in files:
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).touch()
    return root


@pytest.mark.parametrize("layout", TREES)
def test_prepare_prints_what_it_recognised(
    layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files, options, printed = TREES[layout]
    corpus, out = make(tmp_path / "corpus", files), tmp_path / "manifest.csv"
    for _ in range(2):
        assert main(["prepare", str(corpus), "--out", str(out), *options]) == 0
        *lines, last = capsys.readouterr().out.splitlines()
        assert lines == printed
        assert last.endswith(f"--manifest {out} --root {corpus}")
    rows = sum(int(line.split()[2]) for line in printed[2:] if "not used" not in line)
    assert len(out.read_text().splitlines()) == 1 + rows


@pytest.mark.parametrize(
    ("files", "options"),
    [
        (["id1/a/1.wav"], []),
        (["train/clean/1.wav", "train/noisy/1.wav"], ["--valid-share", "0.1"]),
        (["id1/1.wav"], ["--folders", "voices"]),
        (["id1/1.txt"], []),
    ],
)
def test_an_error_is_one_line_and_nothing_is_written(
    files: Lines, options: Lines, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corpus, out = make(tmp_path / "corpus", files), tmp_path / "manifest.csv"
    assert main(["prepare", str(corpus), "--out", str(out), *options]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith("hlsim: error: ")
    assert not out.exists()
