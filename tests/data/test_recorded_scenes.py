"""Tests of recorded scenes with several microphones, and of their manifests."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim.audio import write_audio
from hlsim.data.manifest import Utterance, check_utterances, read_manifest, write_manifest
from hlsim.data.recorded_scenes import SceneClips, SceneFiles
from hlsim.training.batches import TrainingData

RATE = 16000

pytestmark = pytest.mark.filterwarnings("ignore:.*cut to the shortest")


@pytest.fixture
def row(tmp_path: Path) -> Utterance:
    """Scene of 1 s whose channel n has the constant n / 10, and whose clean speech starts late."""
    clean = torch.cat((torch.zeros(RATE // 2), 0.05 * torch.ones(RATE // 2)))
    write_audio(tmp_path / "clean.wav", clean, RATE)
    for number, name in enumerate(("CH1.wav", "CH2.wav")):
        pair = torch.tensor([[0.1], [0.2]]) + 0.2 * number
        write_audio(tmp_path / name, pair.expand(2, RATE + 10), RATE)
    return Utterance("clean.wav", "CH1.wav|CH2.wav", reference="3 4")


def levels(signals: Tensor) -> list[float]:
    return [round(float(level), 2) for level in signals.mean(-1).flatten()]


def test_a_manifest_names_the_microphones_and_their_reference(
    tmp_path: Path, row: Utterance
) -> None:
    path = tmp_path / "manifest.csv"
    write_manifest(path, [row])
    assert path.read_text().splitlines() == [
        "path,noisy,speaker,split,reference",
        "clean.wav,CH1.wav|CH2.wav,,train,3 4",
    ]
    assert read_manifest(path) == [row]
    write_manifest(path, [Utterance("clean.wav")])  # replaces a manifest with references


@pytest.mark.parametrize(
    ("reference", "expected"),
    [
        ("3 4", [0.3, 0.4, 0.1, 0.2]),
        ("1 2", [0.1, 0.2, 0.3, 0.4]),
        ("2", [0.2, 0.1, 0.3, 0.4]),
    ],
)
def test_the_reference_is_the_first_microphone(
    tmp_path: Path, row: Utterance, reference: str, expected: list[float]
) -> None:
    files = SceneFiles.from_utterance(Utterance(row.path, row.noisy, reference=reference), tmp_path)
    with pytest.warns(UserWarning, match="16000 to 16010 samples; all are cut to the shortest"):
        clean, microphones, rate = files.read()
    ears = len(reference.split())
    assert clean.shape == (ears, RATE)
    assert microphones.shape == (4 // ears, ears, RATE) and rate == RATE
    assert levels(microphones) == expected


def test_clean_speech_of_clarity_has_its_level_in_the_room(tmp_path: Path) -> None:
    channels = 0.1 * torch.ones(2, RATE)
    for kind, gain in (("mix_CH1", 1.0), ("target_anechoic_CH1", 0.1), ("target_CH1", 0.5)):
        write_audio(tmp_path / f"S1_{kind}.wav", gain * channels, RATE)
    microphones = (tmp_path / "S1_mix_CH1.wav",)
    clean, _, _ = SceneFiles(tmp_path / "S1_target_anechoic_CH1.wav", microphones, (1, 2)).read()
    torch.testing.assert_close(clean, 0.5 * channels, atol=1e-4, rtol=0.0)
    # that of the reference's microphone, if there is one
    for kind, gain in (("mix_CH3", 1.0), ("target_CH3", 0.2)):
        write_audio(tmp_path / f"S1_{kind}.wav", gain * channels, RATE)
    both = (tmp_path / "S1_mix_CH3.wav", *microphones)
    clean, _, _ = SceneFiles(tmp_path / "S1_target_anechoic_CH1.wav", both, (1, 2)).read()
    torch.testing.assert_close(clean, 0.2 * channels, atol=1e-4, rtol=0.0)
    write_audio(tmp_path / "S1_target_CH3.wav", channels[:, : RATE // 2], RATE)
    with pytest.raises(ValueError, match=r"target_CH3\.wav with 16000 Hz and 8000 samples"):
        SceneFiles(tmp_path / "S1_target_anechoic_CH1.wav", both, (1, 2)).read()


def test_clips_of_scenes_have_clean_speech(tmp_path: Path, row: Utterance) -> None:
    scenes = SceneClips([SceneFiles.from_utterance(row, tmp_path)], sample_rate=RATE, seconds=0.1)
    clean, signals = scenes.draw_scenes(20, torch.Generator().manual_seed(0))
    assert clean.shape == (20, 2, 1600) and signals.shape == (20, 2, 2, 1600)
    assert bool(clean.any(-1).all())
    ratios = signals[0].mean(-1) / signals[0, 0, 0].mean()
    np.testing.assert_allclose(ratios, [[1.0, 4 / 3], [1 / 3, 2 / 3]], rtol=1e-3)


def test_pauses_of_speech_are_no_clips_of_scenes(tmp_path: Path, row: Utterance) -> None:
    # Half a second is a pause with the noise of the recording, 60 dB below the speech.
    clean = torch.full((RATE,), 0.5)
    clean[: RATE // 2] *= 1e-3
    write_audio(tmp_path / "clean.wav", clean, RATE)
    scenes = SceneClips([SceneFiles.from_utterance(row, tmp_path)], sample_rate=RATE, seconds=0.1)
    clips, _ = scenes.draw_scenes(20, torch.Generator().manual_seed(0))
    levels_db = 20.0 * clips.square().mean(-1).sqrt().log10()
    assert bool((levels_db > levels_db.max() - 20.0).all())


def test_short_scenes_are_repeated_in_all_channels(tmp_path: Path, row: Utterance) -> None:
    files = [SceneFiles.from_utterance(row, tmp_path)]
    scenes = SceneClips(files, sample_rate=RATE, seconds=2.5, repeat=True)
    recording, clip = scenes.read_recording(0), scenes.cut_clip(0, 0.0)
    assert torch.equal(clip, torch.cat([recording] * 3, -1)[:, : scenes.samples])


@pytest.mark.parametrize("reference", ["front", "0", "1 3", "2 3", "1 2 3"])
def test_wrong_references_are_errors(reference: str) -> None:
    with pytest.raises(ValueError, match="the number of a channel in the column 'reference'"):
        check_utterances([Utterance("clean.wav", "CH1.wav", reference=reference)])


def test_references_without_microphones_are_errors(tmp_path: Path, row: Utterance) -> None:
    for other in (Utterance("a.wav", "b.wav"), Utterance("a.wav", reference="3 4")):
        with pytest.raises(ValueError, match="same number of references"):
            check_utterances([row, other])
    with pytest.raises(ValueError, match="both as clean and as noisy"):
        check_utterances([row, Utterance("CH2.wav", "x.wav", reference="1 2")])
    with pytest.raises(ValueError, match="with channel 5 among them"):
        SceneFiles.from_utterance(Utterance(row.path, row.noisy, reference="5"), tmp_path).read()
    with pytest.raises(ValueError, match="expected a noisy version"):
        SceneFiles.from_utterance(Utterance(row.path), tmp_path)
    write_audio(tmp_path / "CH1.wav", torch.ones(2, 2 * RATE), RATE)
    with pytest.raises(ValueError, match=r"CH1\.wav with 16000 Hz and 32000 samples"):
        SceneFiles.from_utterance(row, tmp_path).read()


def test_several_channels_need_a_reference(tmp_path: Path, row: Utterance) -> None:
    files = SceneFiles.from_utterance(Utterance(row.path, "CH1.wav"), tmp_path)
    with pytest.raises(ValueError, match="expected one channel, got 2; name the reference"):
        files.read()


def test_a_microphone_that_is_listed_twice_is_an_error() -> None:
    with pytest.raises(ValueError, match="a microphone is listed twice"):
        check_utterances([Utterance("clean.wav", "CH1.wav|CH1.wav", reference="1")])


def test_several_noisy_files_without_a_reference_are_an_error() -> None:
    with pytest.raises(ValueError, match="need the number of the reference"):
        check_utterances([Utterance("clean.wav", "CH1.wav|CH2.wav")])


def test_references_that_differ_cause_a_warning(tmp_path: Path, row: Utterance) -> None:
    rows = [row, Utterance(row.path, row.noisy, reference="1 2")]
    scenes = [SceneFiles.from_utterance(scene, tmp_path) for scene in rows]
    with pytest.warns(UserWarning, match="not the same channel in all scenes"):
        SceneClips(scenes, sample_rate=RATE, seconds=0.5)


def test_another_reference_is_another_training(tmp_path: Path, row: Utterance) -> None:
    identities = set()
    for reference in ("1 2", "3 4"):
        scene = SceneFiles.from_utterance(
            Utterance(row.path, row.noisy, reference=reference), tmp_path
        )
        identities.add(TrainingData(speech=[scene.clean], scenes=[scene]).identity())
    assert len(identities) == 2
