"""Batches depend on seed, step and rank alone, whether drawn from folders or from a manifest."""

import itertools
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim.audio import write_audio

pytest.importorskip("lightning")

from hlsim.training.batches import TrainingData, compensator_data, simulator_data
from hlsim.training.corpora.manifest import Utterance, write_manifest
from hlsim.training.data_module import BatchData, Step
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe

SMALL_RECIPE = SimulatorRecipe(
    model={"channels": 4, "blocks": 1, "stride": [4, 3], "kernel": [3, 3]},
    batch=2,
    seconds=0.25,
    validate_every=4,
    validation_items=8,
)
HUM_HZ = 1000.0


def hum(samples: int) -> Tensor:
    return 0.1 * torch.sin(2 * torch.pi * HUM_HZ / 16000 * torch.arange(samples))


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    """Manifest of four speakers, one for validation. Noisy speech is clean speech plus a hum."""
    rows = []
    for number, split in enumerate(("train", "train", "train", "valid")):
        clean = torch.randn(9600) * torch.linspace(0, 0.1, 9600)
        for kind, signal in (("clean", clean), ("noisy", clean + hum(9600))):
            (tmp_path / kind).mkdir(exist_ok=True)
            write_audio(tmp_path / kind / f"{number}.wav", signal, 16000)
        speaker = f"s{number}"
        rows.append(Utterance(f"clean/{number}.wav", f"noisy/{number}.wav", speaker, split))
    write_manifest(tmp_path / "manifest.csv", rows)
    return tmp_path / "manifest.csv"


def share_of_hum(signals: Tensor) -> Tensor:
    """Share of the power that is at the frequency of the hum. Shape: (items, time) -> (items,)."""
    spectrum = torch.fft.rfft(signals).abs().square()
    hum_bin = round(HUM_HZ / 16000 * signals.shape[-1])
    return spectrum[:, hum_bin - 2 : hum_bin + 3].sum(-1) / spectrum.sum(-1)


def test_the_noise_of_a_manifest_is_noisy_minus_clean(manifest: Path) -> None:
    data = TrainingData.from_manifest(manifest)
    batches = simulator_data(data, SMALL_RECIPE)
    noise = batches.training.noise.draw(4, torch.Generator())  # type: ignore[attr-defined]
    assert float(share_of_hum(noise).min()) > 0.999
    recipe = CompensatorRecipe(batch=40, noisy=0.5, snr=(-10.0, -10.0), sounds=0.0, equalised=0.0)
    signals = compensator_data(data, recipe, None).training[Step(0)]["signal"]
    noisy = share_of_hum(signals) > 0.5
    assert 8 < int(noisy.sum()) < 32 and float(share_of_hum(signals[~noisy]).max()) < 0.1


def test_a_manifest_and_folders_of_the_same_files_draw_the_same(manifest: Path) -> None:
    listed = TrainingData.from_manifest(manifest, noise=manifest.parent / "noisy")
    folder = TrainingData(
        [manifest.parent / "clean" / f"{number}.wav" for number in range(3)],
        noise=manifest.parent / "noisy",
    )
    first, second = (
        simulator_data(data, SMALL_RECIPE).training[Step(5)] for data in (listed, folder)
    )
    for name, values in first.items():
        assert torch.equal(values, second[name])


def test_a_batch_depends_on_seed_step_and_rank_alone(manifest: Path) -> None:
    data = TrainingData.from_manifest(manifest)
    training = simulator_data(data, SMALL_RECIPE).training
    again = simulator_data(data, SMALL_RECIPE).training
    order = [Step(3), Step(0), Step(3, rank=1), Step(1)]
    signals = {step: training[step]["signal"] for step in order}
    for step in reversed(order):
        assert torch.equal(signals[step], again[step]["signal"])
    for first, second in itertools.combinations(order, 2):
        assert not torch.equal(signals[first], signals[second])


@pytest.mark.parametrize("workers", [0, 2])
def test_a_loader_gives_the_steps_in_order(manifest: Path, workers: int) -> None:
    data = simulator_data(TrainingData.from_manifest(manifest, workers=workers), SMALL_RECIPE)
    for step, batch in enumerate(itertools.islice(data.train_dataloader(), 3)):
        assert torch.equal(batch["signal"], data.training[Step(step)]["signal"])


@pytest.mark.parametrize("workers", [0, 2])
def test_an_error_of_a_worker_is_raised_as_it_is(manifest: Path, workers: int) -> None:
    speech = [manifest.parent / "missing.wav"]
    data = simulator_data(TrainingData(speech, valid_speech=manifest.parent), SMALL_RECIPE)
    data.workers = workers
    batch = next(iter(data.train_dataloader()))
    with pytest.raises(ValueError, match=r"^[^\n]*missing\.wav[^\n]*$"):
        data.on_before_batch_transfer(batch, 0)


def test_the_teacher_fills_in_what_is_missing(manifest: Path) -> None:
    data = simulator_data(TrainingData.from_manifest(manifest), SMALL_RECIPE)
    (batch,) = data.val_dataloader()
    assert batch["impaired"].shape == batch["signal"].shape == (8, 32000)
    drawn = data.on_after_batch_transfer(data.training[Step(0)], 0)
    assert drawn["impaired"].shape == drawn["signal"].shape
    batch = data.on_after_batch_transfer(drawn | {"impaired": torch.ones(1)}, 0)
    assert torch.equal(batch["impaired"], torch.ones(1))
    assert "impaired" not in BatchData(data.training).on_after_batch_transfer({"signal": batch}, 0)


def test_validation_is_on_other_speech_or_says_that_it_is_not(manifest: Path) -> None:
    data = TrainingData.from_manifest(manifest, noise=None, valid_noise=None)
    valid = data.validation()
    assert valid.speech == [manifest.parent / "clean" / "3.wav"]
    assert valid.noise == [
        (manifest.parent / "clean" / "3.wav", manifest.parent / "noisy" / "3.wav")
    ]
    rows = manifest.read_text().replace("valid", "train")
    manifest.write_text(rows)
    with pytest.warns(UserWarning, match="training speech is used for validation"):
        data = TrainingData.from_manifest(manifest)
    assert data.validation().speech == data.speech
    data = TrainingData.from_manifest(manifest, valid_speech=manifest.parent / "noisy")
    assert data.validation().speech == manifest.parent / "noisy"
    manifest.write_text(rows.replace("train", "test"))
    with pytest.raises(ValueError):
        TrainingData.from_manifest(manifest)


def test_other_files_are_another_training(manifest: Path) -> None:
    data = TrainingData.from_manifest(manifest)
    assert data.identity() == TrainingData.from_manifest(manifest, workers=3).identity()
    assert len(str(data.identity())) < 1000
    other = TrainingData(data.speech[:-1], data.noise)  # type: ignore[index]
    assert data.identity()["speech"] != other.identity()["speech"]
