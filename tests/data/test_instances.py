"""Instances: level, noise and alignment of what is given, and the same samples by every way."""

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import dbfs
from hlsim.data.instances import Instance, Plan, is_whole
from hlsim.data.plan import prepare
from hlsim.data.plan_settings import PlanSettings
from hlsim.dsp.active_level import active_level_db
from hlsim.dsp.resample import resample
from hlsim.files import sha256


def test_an_instance_is_the_file_at_its_level(plan: Path, voicebank: Path) -> None:
    opened = Plan(plan)
    assert (len(opened), opened.each, opened.rate, opened.root) == (24, 4, 16000, voicebank)
    levels = set()
    for index in range(0, 24, 4):
        utterance = opened.utterance(index)
        clean = read_audio(voicebank / utterance.clean)[0][0]
        noisy = read_audio(voicebank / utterance.noisy)[0][0]
        first, second = opened.instance(index), opened.instance(index + 1)
        gain = float((first.clean * clean).sum() / clean.square().sum())
        torch.testing.assert_close(first.clean, gain * clean, rtol=1e-5, atol=1e-7)
        torch.testing.assert_close(second.signal, gain * noisy, rtol=1e-5, atol=1e-7)
        assert torch.equal(first.signal, first.clean) and torch.equal(second.clean, first.clean)
        level = active_level_db(first.clean, 16000) + 94.0
        assert level == pytest.approx(float(opened.rows[index]["level"]), abs=0.01)
        assert 55.0 <= level <= 75.0
        levels.add(round(level, 1))
        assert torch.equal(first.thresholds, second.thresholds)
        assert not torch.equal(first.thresholds, opened.instance(index + 2).thresholds)
    assert len(levels) > 4


def test_noise_is_mixed_at_the_files_rate(tmp_path: Path) -> None:
    """Noise above the instances' band counts in its level; below it the SNR is higher by what is lost."""
    time = torch.arange(48000) / 48000
    (tmp_path / "s").mkdir()
    speech = 0.1 * torch.sin(2 * torch.pi * 500 * time)
    write_audio(tmp_path / "s" / "a.wav", speech, 48000)
    for name in ("x", "y"):
        (tmp_path / "n" / name).mkdir(parents=True)
        both = torch.sin(2 * torch.pi * 2000 * time) + torch.sin(2 * torch.pi * 15000 * time)
        write_audio(tmp_path / "n" / name / "a.wav", 0.1 * both, 48000)
    settings = PlanSettings(
        tmp_path / "s", noise=tmp_path / "n", train_snrs=(6.0,), test_snrs=(1.0,)
    )
    prepare(settings, tmp_path / "out", jobs=1)
    opened = Plan(tmp_path / "out")
    clean, noisy = opened.pair(0)
    assert clean.shape == (16000,)
    inner = slice(800, -800)
    snr = float(dbfs(clean[inner]) - dbfs((noisy - clean)[inner]))
    pauses = (
        float(dbfs(speech)) - opened.utterance(0).active_level
    )  # a tone has none, but it begins
    assert snr == pytest.approx(6.0 + 3.01 + pauses, abs=0.02)
    assert torch.equal(opened.pair(0)[1], Plan(tmp_path / "out").pair(0)[1])


def test_files_come_back(tmp_path: Path) -> None:
    instance = Instance(torch.randn(50), torch.randn(50), torch.arange(8.0), torch.randn(50))
    path = tmp_path / "a.safetensors"
    path.write_bytes(instance.to_bytes())
    read = Instance.read(path)
    for name, value in vars(instance).items():
        assert torch.equal(getattr(read, name), value)
    assert instance.to_bytes() == path.read_bytes() and is_whole(path)
    for size in (0, 7, 100, path.stat().st_size - 1):
        path.write_bytes(instance.to_bytes()[:size])
        assert not is_whole(path)
        with pytest.raises(ValueError, match="no instance"):
            Instance.read(path)
    assert not is_whole(tmp_path / "none")


def test_what_has_changed_since(plan: Path, voicebank: Path, tmp_path: Path) -> None:
    opened = Plan(plan / "manifest.csv")
    path = voicebank / opened.utterance(0).noisy
    write_audio(path, torch.ones(5), 16000)
    with pytest.raises(ValueError, match="has changed since it was prepared"):
        opened.instance(0)
    for part in ("clean", "noisy"):  # both alike, but of another length
        write_audio(voicebank / f"{part}_testset_wav" / "p232_002.wav", torch.ones(12799), 16000)
    with pytest.raises(ValueError, match=r"p232_002.wav: has changed since it was prepared"):
        opened.instance(20)
    with pytest.raises(ValueError, match="no such file"):
        Plan(plan, root=tmp_path).instance(0)
    text = (
        (plan / "manifest.csv")
        .read_text()
        .replace("clean_testset_wav/p232_001", "../vbd/clean_testset_wav/p232_001")
    )
    (plan / "manifest.csv").write_text(text)
    with pytest.raises(
        ValueError, match=r"manifest.csv: has changed since it was prepared; 'hlsim prepare' makes"
    ):
        Plan(plan)
    about = json.loads((plan / "plan.json").read_text())
    about["manifest_sha256"] = sha256(plan / "manifest.csv")
    (plan / "plan.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match="leads out of"):
        Plan(plan).instance(16)
    (plan / "instances.csv").write_text(
        "".join((plan / "instances.csv").read_text().splitlines(True)[:-1])
    )
    with pytest.raises(ValueError, match="23 instances of 6 utterances; allowed: 4 of each"):
        Plan(plan)
    with pytest.raises(ValueError, match="not prepared"):
        Plan(tmp_path)


def test_another_root_and_rate(voicebank: Path, tmp_path: Path) -> None:
    prepare(PlanSettings(voicebank, rate=22050), tmp_path / "out", jobs=1)
    moved = tmp_path / "moved"
    voicebank.rename(moved)
    clean, _ = Plan(tmp_path / "out", root=moved).pair(0)
    waveform, rate = read_audio(moved / "clean_trainset_28spk_wav" / "p226_001.wav")
    expected: Tensor = resample(waveform[0], rate, 22050)
    ratio = clean / expected
    assert clean.shape == expected.shape and float(ratio[expected.abs() > 1e-3].std()) < 1e-3
    assert Audiogram(tuple(Plan(tmp_path / "out").thresholds(0).tolist())).severity in (
        "mild",
        "moderate",
        "severe",
    )
