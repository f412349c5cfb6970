"""The command ``prepare`` prints what it recognised, and writes a manifest or one line of error.

``tests/training/test_corpora.py`` tests the layouts.
"""

from pathlib import Path

import pytest

from hlsim.cli.main import main
from tests.helpers import touch_files

VOICEBANK = [
    f"{kind}_{part}_wav_16k/{name}.wav"
    for kind in ("clean", "noisy")
    for part, name in (("trainset_28spk", "p226_001"), ("testset", "p232_001"))
]
VOICEBANK_TEXT = """layout: VoiceBank-DEMAND
split  speakers  utterances  pairs
train         1           1      1
test          1           1      1"""

SPEAKERS = ["id1/a/1.wav", "id1/b/1.wav", "id2/a/1.wav"]
SPEAKERS_TEXT = """layout: folders speaker
split  speakers  utterances  pairs
train         1           2      0
valid         1           1      0"""


@pytest.mark.parametrize(
    ("files", "options", "text"),
    [
        ([*VOICEBANK, "logfiles/log_testset.txt"], "", VOICEBANK_TEXT),
        (SPEAKERS, "--folders speaker --valid-share 0.5", SPEAKERS_TEXT),
    ],
)
def test_prepare_prints_what_it_recognised(
    files: list[str], options: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corpus, out = touch_files(tmp_path / "corpus", files), tmp_path / "manifest.csv"
    assert main(["prepare", str(corpus), "--out", str(out), *options.split()]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert lines == text.splitlines()
    assert last.endswith(f"--manifest {out} --root {corpus}")
    assert len(out.read_text().splitlines()) == 1 + sum(int(row.split()[2]) for row in lines[2:4])
