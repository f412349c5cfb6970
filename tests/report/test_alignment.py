"""Why signals are aligned: STOI and PESQ of the aligned pair are higher; and the picture of it."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.data.teacher import Teacher
from hlsim.dsp.resample import resample
from hlsim.report.alignment import draw_alignment


@pytest.mark.parametrize("method", ["structural", "impulse"])
def test_stoi_and_pesq_are_higher_when_aligned(
    speech: list[tuple[Tensor, int]], method: str
) -> None:
    for package in ("pystoi", "pesq"):
        pytest.importorskip(package)
    from hlsim.metrics.fidelity import pesq_wb, stoi

    waveform, rate = speech[0]
    clean = set_level(resample(waveform[0], rate, 16000), 65.0)
    for name in ("NH", "N2", "N4"):
        ear = torch.tensor(Audiogram.standard(name).thresholds)
        late, aligned = (
            Teacher(16000, alignment=alignment)(clean[None], ear[None])[0]
            for alignment in ("none", method)
        )
        better, worse = (stoi(clean, heard, 16000).value for heard in (aligned, late))
        assert better is not None and worse is not None and better > worse + 0.05
        better, worse = (pesq_wb(clean, heard, 16000).value for heard in (aligned, late))
        assert better is not None and worse is not None
        # PESQ aligns by itself, to its own steps; of a severe loss, 1.563 either way, it sees no difference
        assert abs(better - worse) < 0.001 if name == "N4" else better > worse + 0.03


@pytest.mark.parametrize("method", ["structural", "impulse"])
def test_the_picture(speech: list[tuple[Tensor, int]], tmp_path: Path, method: str) -> None:
    pytest.importorskip("matplotlib")
    waveform, rate = speech[0]
    ear = Audiogram.standard("N3")
    delay = draw_alignment(waveform[0], ear, rate, tmp_path / "a.png", method=method)
    assert (tmp_path / "a.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert delay / rate == pytest.approx(
        1239 / 44100 if method == "structural" else 1200 / 44100, abs=0.002
    )
    with pytest.raises(ValueError, match="samples to draw"):
        draw_alignment(waveform[0, :100], ear, rate, tmp_path / "b.png")
    with pytest.raises(ValueError, match="method 'none'; allowed: impulse, structural"):
        draw_alignment(waveform[0], ear, rate, tmp_path / "b.png", method="none")
    assert not (tmp_path / "b.png").exists()


@pytest.mark.parametrize("spl", [65.0, 20.0])
def test_the_legend_says_how_far_what_is_heard_was_raised(
    speech: list[tuple[Tensor, int]], tmp_path: Path, spl: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.axes import Axes

    legends: list[list[str]] = []
    monkeypatch.setattr(
        Axes,
        "legend",
        lambda axes, **options: legends.append([line.get_label() for line in axes.lines]),
    )
    waveform, rate = speech[0]
    signal, ear = set_level(waveform[0], spl), Audiogram.standard("N6")
    draw_alignment(signal, ear, rate, tmp_path / "a.png", method="structural")
    heard = Teacher(rate, alignment="none")(signal[None], torch.tensor(ear.thresholds)[None])[0]
    raised = spl - float(level_spl(heard))
    label = f"MSBG, raised by {raised:.0f} dB" if spl > 50.0 else "MSBG: nothing is heard"
    assert legends[0] == ["input", label] and legends[1][1].startswith(label[:10])
