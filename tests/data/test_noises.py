"""Noises: disjoint types and SNRs, one draw an utterance, and an SNR that is what it says."""

from pathlib import Path
from typing import Any

import pytest
import soundfile
import torch
from torch import Tensor

from hlsim.audio import read_stretch, write_audio
from hlsim.calibration import dbfs
from hlsim.data import noises as module
from hlsim.data.corpora import Fault
from hlsim.data.manifest import Utterance
from hlsim.data.noises import Noises, mix_at
from hlsim.data.plan_settings import PlanSettings
from hlsim.dsp.active_level import active_level_db


def find_noises(
    root: Path, folder: str, splits: tuple[str, ...], **options: Any
) -> tuple[Noises, list[Fault]]:
    return module.find_noises(root, folder, splits, PlanSettings(root, **options))


def many(root: Path, *names: str) -> Path:
    for number, name in enumerate(names):
        path = root / "noise" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        generator = torch.Generator().manual_seed(number)
        write_audio(path, 0.1 * torch.randn(1600, generator=generator), 16000)
    return root


def test_ten_types_are_eight_and_two(tmp_path: Path) -> None:
    root = many(tmp_path, *(f"type{i:02d}/{j}.wav" for i in range(12) for j in range(2)))
    noises, faults = find_noises(root, "noise", ("train", "test"))
    train, test = (set(noises.files[split]) for split in ("train", "test"))
    assert (len(train), len(test), train & test, faults) == (8, 2, set(), [])
    assert set(noises.files["valid"]) == train
    other, _ = find_noises(root, "noise", ("train", "test"), seed=1)
    assert set(other.files["test"]) != test

    chosen = [noises.choose(Utterance(f"u{i}", "s", "train", "c.wav"), 0) for i in range(300)]
    assert {u.noise.split("/")[1] for u in chosen} == train
    assert {u.snr for u in chosen} == {0.0, 5.0, 10.0, 15.0}
    assert all(u.noise_start == 0.0 for u in chosen)
    # a draw depends on the id and the seed, not on the others
    assert noises.choose(Utterance("u7", "s", "train", "c.wav"), 0) == chosen[7]
    assert noises.choose(Utterance("u7", "s", "train", "c.wav"), 1) != chosen[7]
    tested = [noises.choose(Utterance(f"u{i}", "s", "test", "c.wav"), 0) for i in range(60)]
    assert {u.noise.split("/")[1] for u in tested} == test
    assert {u.snr for u in tested} == {2.5, 7.5, 12.5, 17.5}


def test_fewer_types_and_folders_of_splits(tmp_path: Path) -> None:
    root = many(tmp_path / "few", "a.wav", "b.wav", "c.wav")
    noises, _ = find_noises(root, "noise", ("train", "test"))
    assert sorted(map(len, (noises.files["train"], noises.files["test"]))) == [1, 2]
    root = many(tmp_path / "split", "train/a/1.wav", "train/b/1.wav", "test/c/1.wav")
    noises, _ = find_noises(root, "noise", ("train", "test", "valid"))
    assert {split: set(own) for split, own in noises.files.items()} == {
        "train": {"a", "b"},
        "valid": {"a", "b"},
        "test": {"c"},
    }
    many(tmp_path / "split", "rain/1.wav")
    noises, faults = find_noises(root, "noise", ("train", "test"))
    assert faults == [Fault("noise/rain/1.wav", "beside the folders of splits; move it into one")]
    assert set(noises.files["train"]) == {"a", "b"}


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no noise in it"):
        find_noises(tmp_path, "noise", ("train",))
    one = many(tmp_path / "one", "a/1.wav")
    with pytest.raises(ValueError, match="no noise for test"):
        find_noises(one, "noise", ("train", "test"))
    both = many(tmp_path / "both", "train/a/1.wav", "test/a/2.wav")
    with pytest.raises(ValueError, match="a for training and test; allowed: disjoint types"):
        find_noises(both, "noise", ("train", "test"))
    with pytest.raises(ValueError, match="SNRs 5 dB for training and test"):
        find_noises(one, "noise", ("train",), test_snrs=(5.0, 7.5))
    (one / "noise" / "broken.wav").write_text("x")
    write_audio(
        one / "noise" / "stereo.wav", torch.stack((torch.zeros(160), torch.ones(160))), 16000
    )
    soundfile.write(
        one / "noise" / "tiny.wav", torch.full((160,), 1e-39).numpy(), 16000, subtype="FLOAT"
    )
    (one / "noise" / "linked").symlink_to(both / "noise")
    noises, faults = find_noises(one, "noise", ("train",))
    assert set(noises.files["train"]) == {"a"}
    reasons = {fault.path: fault.reason for fault in faults}
    assert reasons["noise/stereo.wav"] == "silent first channel"
    assert reasons["noise/tiny.wav"] == "first channel as good as silent, its peak is 1e-39"
    assert reasons["noise/linked"].startswith("a link to a folder")
    assert reasons["noise/broken.wav"].startswith("not readable as audio")


@pytest.mark.parametrize("snr", [-5.0, 2.5, 15.0])
def test_the_snr_is_that_of_the_active_level(speech: list[tuple[Tensor, int]], snr: float) -> None:
    for number, (waveform, rate) in enumerate(speech):
        clean = waveform[0]
        noise = torch.randn(len(clean), generator=torch.Generator().manual_seed(number))
        level = active_level_db(clean, rate)
        added = mix_at(clean, noise, snr, level) - clean
        assert level - float(dbfs(added)) == pytest.approx(snr, abs=1e-3)
        assert float(torch.nn.functional.cosine_similarity(added, noise, 0)) == pytest.approx(
            1.0, abs=1e-4
        )
    assert bool(torch.isfinite(mix_at(clean, torch.zeros_like(clean), snr, level)).all())


def test_no_noise_starts_in_a_pause(tmp_path: Path) -> None:
    noise = torch.cat((torch.zeros(32000), 0.1 * torch.ones(4000), torch.zeros(16000)))
    (tmp_path / "noise").mkdir()
    write_audio(tmp_path / "noise" / "taps.wav", noise, 16000)
    noises, _ = find_noises(tmp_path, "noise", ("train",))
    ((_, starts),) = noises.files["train"]["taps"]
    assert starts[0] == 1.6 and starts[-1] == 2.2 and len(starts) == 7
    for start in starts:
        piece, rate = read_stretch(tmp_path / "noise" / "taps.wav", start, 0.5)
        assert (piece.shape, rate) == ((1, 8000), 16000) and bool(piece.any())


def test_a_recording_begins_again_where_it_ends(tmp_path: Path) -> None:
    write_audio(tmp_path / "a.wav", torch.arange(100.0) / 100, 16000)
    piece, _ = read_stretch(tmp_path / "a.wav", 90 / 16000, 250 / 16000)
    assert torch.equal(piece[0], torch.arange(90, 340).remainder(100) / 100)
    for name, said in (
        ("none.wav", "not readable"),
        ("bad.wav", "not readable"),
        ("empty.wav", "empty"),
    ):
        (tmp_path / "bad.wav").write_text("x")
        soundfile.write(tmp_path / "empty.wav", torch.zeros(0).numpy(), 16000)
        with pytest.raises(ValueError, match=said):
            read_stretch(tmp_path / name, 0.0, 0.1)
