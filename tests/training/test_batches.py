"""Batches depend on seed and index alone, whether drawn from folders or from a manifest."""

import itertools
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from hlsim.audio import write_audio

pytest.importorskip("lightning")

from hlsim import Audiogram
from hlsim.calibration import level_spl
from hlsim.data.manifest import Utterance, write_manifest
from hlsim.evaluation.items import draw_aid_items
from hlsim.training.batches import BatchData, TrainingData, make_data
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe

SMALL = SimulatorRecipe(batch=2, seconds=0.25, validation_items=8)
HUM_HZ = 1000.0


def load(data: TrainingData, recipe: SimulatorRecipe = SMALL) -> BatchData:
    return make_data(data, recipe)


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
    recipe = CompensatorRecipe(batch=40, noisy=0.5, snr=(-10.0, -10.0), sounds=0.0, equalised=0.0)
    signals = make_data(data, recipe, None).training[0]["signal"]
    noisy = share_of_hum(signals) > 0.5
    assert 8 < int(noisy.sum()) < 32 and float(share_of_hum(signals[~noisy]).max()) < 0.1


@pytest.mark.parametrize("workers", [0, 2])
def test_each_device_loads_batches_of_its_own(manifest: Path, workers: int) -> None:
    data = load(TrainingData.from_manifest(manifest, workers=workers))
    data.trainer = SimpleNamespace(global_step=3, global_rank=1)  # type: ignore[assignment]
    batches = list(itertools.islice(data.train_dataloader(), 3))
    for batch, index in zip(batches, (3 * 64 + 1, 4 * 64 + 1, 5 * 64 + 1), strict=True):
        assert torch.equal(batch["signal"], data.training[index]["signal"])
    assert not torch.equal(batches[0]["signal"], data.training[3 * 64]["signal"])


def test_validation_is_on_other_speech_where_there_is_some(manifest: Path) -> None:
    pair = tuple(manifest.parent / kind / "3.wav" for kind in ("clean", "noisy"))
    valid = TrainingData.from_manifest(manifest, noise=None, valid_noise=None).validation()
    assert valid.speech == [pair[0]] and valid.noise == [pair]
    folder = manifest.parent / "noisy"
    data = TrainingData.from_manifest(manifest, valid_speech=folder, noise=folder)
    assert data.validation().speech == data.noise == folder
    rows = manifest.read_text().replace("valid", "train")
    manifest.write_text(rows)
    data = TrainingData.from_manifest(manifest)
    assert data.validation().speech == data.speech
    manifest.write_text(rows.replace("train", "test"))
    with pytest.raises(ValueError, match="an empty list"):
        load(TrainingData.from_manifest(manifest))
    speech = manifest.parent / "clean"
    with pytest.raises(ValueError, match="both training and validation"):
        load(TrainingData(speech, valid_speech=manifest.parent / "noisy/../clean"))


def test_noise_among_the_clean_speech_causes_a_warning(manifest: Path) -> None:
    corpus = manifest.parent
    with pytest.warns(UserWarning, match="4 of 8 files are used as clean speech.*'noisy'"):
        load(TrainingData(corpus))
    with pytest.warns(UserWarning, match="4 of 8 files are used as clean speech.*'noisy'"):
        ears = [("N3", Audiogram.standard("N3"))]
        draw_aid_items(corpus, None, ears, items=1, seconds=0.5, seed=0, levels=[65.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(TrainingData(corpus / "noisy"))


def test_other_files_are_another_training(manifest: Path) -> None:
    data = TrainingData.from_manifest(manifest)
    assert data.identity() == TrainingData.from_manifest(manifest, workers=3).identity()
    assert data.identity() != replace(data, noise=manifest.parent / "noisy").identity()
    before = data.identity()
    write_audio(manifest.parent / "noisy" / "3.wav", hum(9600), 16000)
    assert data.identity() != before


@pytest.mark.parametrize("name", ["audiograms", "valid_audiograms"])
def test_other_ears_are_another_training(manifest: Path, name: str) -> None:
    table = manifest.parent / "ears.csv"
    data = replace(TrainingData.from_manifest(manifest), **{name: table})
    identities = set()
    for row in ("20,40", "80,90"):
        table.write_text(f"hl_500,hl_4000\n{row}\n")
        identities.add(data.identity())
    assert len(identities) == 2


def test_paths_of_a_manifest_stay_below_its_root_behind_links(manifest: Path) -> None:
    (manifest.parent / "link").symlink_to("/")
    manifest.write_text("path\nlink/../clean/1.wav\n")
    assert TrainingData.from_manifest(manifest).speech == [manifest.parent / "clean" / "1.wav"]


@pytest.mark.parametrize(
    ("treated", "low", "high"),
    [(True, 50.0, 80.0), pytest.param(False, 85.0, 90.0, marks=pytest.mark.slow)],
)
def test_validation_is_fixed_and_has_the_levels_of_speech_before_treatment(
    manifest: Path, treated: bool, low: float, high: float
) -> None:
    recipe = replace(SMALL, validation_items=62, treated=treated, levels=(85.0, 90.0))
    data = TrainingData.from_manifest(manifest)
    first, again, other = (
        torch.cat([batch["signal"] for batch in load(data, settings).validation])
        for settings in (recipe, recipe, replace(recipe, seed=1))
    )
    levels = level_spl(first)
    assert first.shape == (64, 32000)
    assert low - 0.01 <= float(levels.min()) < float(levels.max()) <= high + 0.01
    assert torch.equal(first, again) and not torch.equal(first, other)
