"""Random clips of recordings: length, position, repetition, sample rate, and rejected files."""

from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from torch import Tensor

from hlsim.audio import write_audio
from hlsim.data.clips import Clips, hash_source


def folder_with(tmp_path: Path, **waves: Tensor) -> Path:
    for name, wave in waves.items():
        write_audio(tmp_path / f"{name}.wav", wave, 16000)
    return tmp_path


def ramp(samples: int) -> Tensor:
    """Signal that rises from just above 0 to 1."""
    return torch.arange(1, samples + 1, dtype=torch.float32) / samples


def test_clips_are_pieces_of_the_recordings(tmp_path: Path) -> None:
    clips = Clips(
        folder_with(tmp_path, a=ramp(4000), b=-0.5 * ramp(3000)), sample_rate=16000, seconds=0.1
    )
    assert (len(clips), clips.samples) == (2, 1600)
    step = 1.0 / 32767  # kept as 16-bit samples, peak at 1
    for index, whole in enumerate((ramp(4000), -ramp(3000))):
        torch.testing.assert_close(clips.read_recording(index), whole, atol=step, rtol=0)
        torch.testing.assert_close(clips.cut_clip(index, 0.0), whole[:1600], atol=step, rtol=0)
        torch.testing.assert_close(clips.cut_clip(index, 1.0), whole[-1600:], atol=step, rtol=0)


def test_short_recordings_end_in_silence_or_are_repeated(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, a=ramp(700))
    once = torch.cat((ramp(700), torch.zeros(900)))
    for repeat, expected in ((False, once), (True, ramp(700).repeat(3)[:1600])):
        clip = Clips(folder, sample_rate=16000, seconds=0.1, repeat=repeat).cut_clip(0, 0.0)
        torch.testing.assert_close(clip, expected, atol=1e-4, rtol=0)


def test_other_rates_are_resampled_and_the_first_channel_is_taken(tmp_path: Path) -> None:
    time = torch.arange(24000) / 48000
    stereo = torch.stack((torch.sin(2 * torch.pi * 500 * time), torch.randn(24000)))
    write_audio(tmp_path / "a.wav", 0.3 * stereo, 48000)
    clip = Clips(tmp_path, sample_rate=16000, seconds=0.5).cut_clip(0, 0.0)
    expected = torch.sin(2 * torch.pi * 500 * torch.arange(8000) / 16000)
    assert clip.shape == (8000,)
    torch.testing.assert_close(clip[200:-200], expected[200:-200], atol=3e-2, rtol=0)


def test_no_drawn_clip_is_silent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hlsim.data.clips.MAX_FAILURES", 300)
    wave = torch.zeros(40000)
    wave[20000:24000] = torch.randn(4000).clamp(-1, 1)
    folder = folder_with(tmp_path, a=wave)
    drawn = Clips(folder, sample_rate=16000, seconds=0.1).draw(20, torch.Generator())
    assert float(drawn.square().mean(-1).min()) > 1e-7
    folder_with(tmp_path, a=torch.eye(1, 40000)[0].flip(0))  # Only the last place is not silent.
    with pytest.raises(ValueError, match=r"300 draws .*a\.wav"):
        Clips(folder, sample_rate=16000, seconds=1.0).draw(1, torch.Generator().manual_seed(0))


def test_recordings_of_which_nothing_can_be_drawn_are_named(tmp_path: Path) -> None:
    folder_with(tmp_path, a=ramp(4000), right=torch.stack((torch.zeros(4000), ramp(4000))))
    a, right = tmp_path / "a.wav", tmp_path / "right.wav"
    for source, reason in ((right, "its first channel"), ((a, a), "its difference from clean")):
        clips = Clips([source], sample_rate=16000, seconds=0.1)
        with pytest.warns(UserWarning, match=f"left out: .*{reason}.* is silent"):
            clips.read_recording(0)


def test_memory_is_limited_and_changes_no_draw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = folder_with(tmp_path, a=ramp(2000), b=-ramp(3000), c=ramp(4000))
    unlimited = Clips(folder, sample_rate=16000, seconds=0.1)
    expected = unlimited.draw(20, torch.Generator().manual_seed(3))
    assert len(unlimited._recordings) == 3
    monkeypatch.setattr("hlsim.data.clips.MAX_SAMPLES_IN_MEMORY", 5000)
    limited = Clips(folder, sample_rate=16000, seconds=0.1)
    assert torch.equal(limited.draw(20, torch.Generator().manual_seed(3)), expected)
    assert sum(map(len, limited._recordings.values())) <= 5000


def test_noise_of_pairs_is_noisy_minus_clean(tmp_path: Path) -> None:
    noise = 0.1 * torch.randn(4000)
    for name, clean in (("a", ramp(4000)), ("b", -ramp(4000))):
        write_audio(tmp_path / f"{name}.wav", clean, 16000)
        write_audio(tmp_path / f"{name} noisy.wav", clean + noise, 16000)
    write_audio(tmp_path / "c.wav", ramp(3999), 16000)  # shorter than its noisy version
    pairs = [(tmp_path / f"{a}.wav", tmp_path / f"{b} noisy.wav") for a, b in ("aa", "bb", "cb")]
    clips = Clips(pairs, sample_rate=16000, seconds=0.25, repeat=True)
    with pytest.warns(UserWarning, match=r"b noisy.wav"):
        drawn = clips.draw(20, torch.Generator().manual_seed(0))
    for clip in drawn:
        torch.testing.assert_close(clip, noise / noise.abs().max(), atol=1e-3, rtol=0)


@pytest.mark.parametrize("change", ["another sentence", "softer", "louder", "late"])
def test_a_noisy_file_that_does_not_contain_its_clean_version_is_left_out(
    tmp_path: Path, change: str
) -> None:
    generator = np.random.default_rng(0)
    clean, other, noise = torch.from_numpy(generator.standard_normal((3, 4000))).float() / 4
    softer, louder = 0.3 * clean, 2.0 * clean
    late = clean.roll(40)
    contents = {"another sentence": other, "softer": softer, "louder": louder, "late": late}
    write_audio(tmp_path / "a.wav", clean, 16000)
    write_audio(tmp_path / "a noisy.wav", clean + noise, 16000)  # at 0 dB
    write_audio(tmp_path / "b noisy.wav", contents[change] + 0.1 * noise, 16000)
    pairs = [(tmp_path / "a.wav", tmp_path / f"{name} noisy.wav") for name in "ab"]
    clips = Clips(pairs, sample_rate=16000, seconds=0.25)
    with pytest.warns(UserWarning, match=r"b noisy.wav: expected the clean speech plus noise"):
        drawn = clips.draw(20, torch.Generator().manual_seed(0))
    for clip in drawn:
        torch.testing.assert_close(clip, noise / noise.abs().max(), atol=1e-3, rtol=0)


def test_a_file_that_cannot_be_used_causes_one_warning_and_another_draw(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, a=ramp(4000), b=torch.zeros(4000), d=-ramp(4000))
    (tmp_path / "c.wav").write_text("no recording")
    soundfile.write(tmp_path / "e.wav", ramp(4000).numpy(), 8000)
    clips = Clips(folder, sample_rate=16000, seconds=0.1)
    with pytest.warns(UserWarning) as warned:
        first = clips.draw(30, torch.Generator().manual_seed(2))
    messages = sorted(str(warning.message) for warning in warned)
    assert len(messages) == 3
    for message, name in zip(messages, "bce", strict=True):
        assert f"{tmp_path / name}.wav: " in message
    assert first.shape == (30, 1600) and bool((first > 0.5).any()) and bool((first < -0.5).any())
    # Draws depend on the generator, and not on whether the bad files are already known.
    assert torch.equal(first, clips.draw(30, torch.Generator().manual_seed(2)))
    assert not torch.equal(first, clips.draw(30, torch.Generator().manual_seed(3)))


@pytest.mark.parametrize("limit", [2**30, 100_000])
def test_the_hash_of_recordings_changes_with_each_and_not_with_their_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int
) -> None:
    """The lower limit is below the size of the files, so that pieces of them are read."""
    monkeypatch.setattr("hlsim.data.clips._MAX_HASHED_BYTES", limit)
    files = [tmp_path / name for name in ("a.wav", "b.wav")]
    for seed, file in enumerate(files):
        signal = torch.randn(40_000, generator=torch.Generator().manual_seed(seed))
        write_audio(file, signal.clamp(-1, 1), 16000)
    hashes = {hash_source(tmp_path), hash_source(files)}
    assert len(hashes) == 1
    tmp_path.rename(tmp_path.with_name("moved"))
    tmp_path.with_name("moved").rename(tmp_path)
    hashes |= {
        hash_source(files[::-1]),
        hash_source(files[:1]),
        hash_source([(files[0], files[1])]),
    }
    contents = files[0].read_bytes()
    for edited in (contents[:-1], contents[:-1] + b"x", contents[:5000] + b"x" + contents[5001:]):
        files[0].write_bytes(edited)
        hashes.add(hash_source(tmp_path))
    files[1].unlink()
    hashes.add(hash_source(files))
    assert len(hashes) == 8
