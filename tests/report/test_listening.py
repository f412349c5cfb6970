"""Chosen items as heard: which are chosen, and that what is heard is MSBG at the right level."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim import MSBG
from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.evaluation import HaspiReport, ItemScore
from hlsim.report.previous.listening import choose_items, heard, listening_section

pytest.importorskip("matplotlib")


@pytest.fixture
def clean(speech_dir: Path) -> Tensor:
    """0.5 s at 16 kHz, (time,)."""
    return read_audio(speech_dir / "train" / "flite-slt-01.flac")[0][0, 16000:24000]


@pytest.fixture
def item(tmp_path: Path, clean: Tensor) -> ItemScore:
    """Full scale at 100 dB SPL; the second condition is four times as strong."""
    write_audio(tmp_path / "clean.wav", clean, 16000)
    write_audio(tmp_path / "aided.wav", clean * 4, 16000)
    return ItemScore(
        file="a",
        audiogram=Audiogram.standard("N3"),
        clean_level=70.0,
        levels={"unaided": 70.0, "lost": None, "aided": 82.0},
        scores={"haspi": {"unaided": 0.2, "aided": 0.6}},
        sample_rate=16000,
        seconds=0.5,
        seed=0,
        full_scale_spl=100.0,
        clean=tmp_path / "clean.wav",
        processed={
            "unaided": tmp_path / "clean.wav",
            "aided": tmp_path / "aided.wav",
            "lost": tmp_path / "lost.wav",
        },
    )


def test_heard_is_msbg_in_pascals(item: ItemScore, clean: Tensor) -> None:
    signals, rate = heard(item)
    pascals = clean * 10 ** (6 / 20)
    assert rate == 16000 and list(signals) == ["original", "unaided, as heard", "aided, as heard"]
    torch.testing.assert_close(signals["original"], pascals)
    ear = MSBG(item.audiogram, sample_rate=16000)
    torch.testing.assert_close(signals["unaided, as heard"], ear(pascals))
    torch.testing.assert_close(signals["aided, as heard"], ear(4 * pascals))


def test_items_are_spread_from_rise_to_fall(item: ItemScore) -> None:
    changes = [0.1, -0.3, 0.5, 0.2, 0.0]
    items = [
        replace(item, file=str(change), scores={"haspi": {"unaided": 0.4, "aided": 0.4 + change}})
        for change in changes
    ]
    report = HaspiReport(items)
    assert [one.file for _, one in choose_items(report, 3)] == ["0.5", "0.1", "-0.3"]
    assert [one.file for _, one in choose_items(report, 1)] == ["0.5"]
    assert len(choose_items(report, 99)) == 5 and choose_items(report, 0) == []
    assert choose_items(report, 2)[1][0] == "rank 5 of 5, change -0.300"
    unknown = HaspiReport([replace(one, clean=None) for one in items])
    assert choose_items(unknown, 3) == [] and listening_section(unknown, 3) is None


def test_players_of_an_item_have_one_gain(item: ItemScore, tmp_path: Path) -> None:
    section = listening_section(HaspiReport([item]), 1)
    assert section is not None
    (own,) = section.sections
    waves = []
    for number, player in enumerate(own.players):
        (tmp_path / f"{number}.flac").write_bytes(player.data)
        waves.append(read_audio(tmp_path / f"{number}.flac")[0][0])
    signals, _ = heard(item)
    expected = [float(signal.square().mean().sqrt()) for signal in signals.values()]
    ratios = [
        float(wave.square().mean().sqrt()) / own for wave, own in zip(waves, expected, strict=True)
    ]
    assert ratios == pytest.approx([ratios[0]] * 3, rel=1e-2)
    assert max(float(wave.abs().max()) for wave in waves) == pytest.approx(0.9, abs=1e-3)
    level = 94 + 20 * math.log10(expected[2])
    assert own.players[2].label == f"aided, as heard ({level:.0f} dB SPL)"
    assert [picture.alt for picture in own.pictures] == [f"Spectrogram: {name}" for name in signals]


def test_what_msbg_does_not_take_is_said(item: ItemScore) -> None:
    section = listening_section(HaspiReport([replace(item, audiogram=Audiogram.standard("N7"))]), 1)
    assert section is not None and not section.sections[0].players
    assert "Not to be heard here: " in section.sections[0].paragraphs[0]


def test_silence_before_the_speech_is_said(item: ItemScore, clean: Tensor, tmp_path: Path) -> None:
    late = torch.cat([torch.zeros(131200), clean])
    for name in ("clean", "aided"):
        write_audio(tmp_path / f"{name}.wav", late, 16000)
    section = listening_section(HaspiReport([item]), 1)
    assert section is not None and not section.sections[0].players
    assert section.sections[0].paragraphs == ["Not to be heard here: the first 8 s are silent"]
