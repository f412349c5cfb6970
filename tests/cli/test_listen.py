"""The command ``listen`` writes one page with a player per file."""

import html
import re
from pathlib import Path

import pytest
import torch

import hlsim
from hlsim.audio import write_audio
from hlsim.cli.main import main


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    pytest.importorskip("matplotlib")
    speech = hlsim.example_speech()[8000:24000]
    write_audio(tmp_path / "one.wav", speech, 16000)
    write_audio(tmp_path / "two <b>.wav", torch.stack([speech, 0.1 * speech]), 16000)
    return [str(tmp_path / "one.wav"), str(tmp_path / "two <b>.wav")]


def test_a_page_plays_what_each_ear_perceives_without_and_with_an_aid(
    tmp_path: Path, files: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new folder" / "page.html"
    options = "--audiogram N2 --audiogram n4 --compensator nalr --spl 65 --seconds 0.5 --out"
    assert main(["listen", *files, *options.split(), str(out)]) == 0
    assert out.as_uri() in capsys.readouterr().out
    page = out.read_text()
    assert page.count("<audio controls") == 2 * 5 and "two &lt;b&gt;.wav" in page
    text = html.unescape(re.sub(r"<[^>]+>", " ", page))
    for label in ("original", "N2 unaided", "N2 with nalr", "N4 unaided", "N4 with nalr"):
        assert label in text
    assert text.count("65 dB SPL, 0.5 s of 1.0 s") == 2
    levels = ", ".join(f"{level:g}" for level in hlsim.Audiogram.standard("N4").thresholds)
    assert f"N4: {levels} dB HL" in text


def test_an_error_names_the_file_whose_played_part_is_silent(
    tmp_path: Path, files: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    speech = hlsim.example_speech()[8000:24000]
    late = tmp_path / "late.wav"
    write_audio(late, torch.cat((torch.zeros(16000), speech)), 16000)
    options = "--audiogram N2 --simulator attenuation --seconds 0.5 --out"
    assert main(["listen", *files, str(late), *options.split(), str(tmp_path / "page.html")]) == 2
    assert (
        f"{late}: the first 0.5 s are silent; play more of it (--seconds)"
        in capsys.readouterr().err
    )


def test_options_of_an_aid_need_an_aid(
    tmp_path: Path, files: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    call = ["listen", files[0], "--audiogram", "N2", "--out", str(tmp_path / "page.html")]
    assert main([*call, "--noise-reduction", "1"]) == 2
    assert "without an aid; name one by --compensator" in capsys.readouterr().err
