"""Training a compensator: it learns, it goes on where it was stopped, and it says what it cannot use."""

import json
from pathlib import Path

import pytest
import torch

from compensators import HearingAid, MappingCompensator, load_compensator
from hlsim import Audiogram
from hlsim.neuro import NeuroConfig, NeuroMSBG
from hlsim.pretrained import CONFIG, save_checkpoint
from hlsim.training.batches import CompensatorBatches, TrainingData, compensator_data
from hlsim.training.compensator import CompensatorTraining, train_compensator
from hlsim.training.data_module import Batch
from hlsim.training.recipes import CompensatorRecipe

SMALL = {
    "model": {"channels": 8, "blocks": 1, "stride": [4, 3]},
    "batch": 2,
    "seconds": 0.4,
    "sounds": 0.0,
    "validate_every": 10,
    "validation_items": 4,
}


def train(data: TrainingData, out: Path, **options: object) -> tuple[Path, list[str]]:
    """A few steps through the exact MSBG."""
    lines: list[str] = []
    settings = {
        "simulator": "msbg",
        "accelerator": "cpu",
        "progress": False,
    } | options
    recipe = CompensatorRecipe.from_dict(SMALL | settings.pop("recipe", {}))  # type: ignore[operator]
    folder = train_compensator(data, recipe, out=out, report=lines.append, **settings)  # type: ignore[arg-type]
    return folder, lines


def test_twenty_steps_lower_the_loss(data: TrainingData, tmp_path: Path) -> None:
    ear = Audiogram.standard("N3")
    folder, lines = train(
        data, tmp_path, audiogram=ear, max_steps=20, recipe={"learning_rate": 1e-2}
    )
    about = json.loads((folder / CONFIG).read_text())["about"]
    assert lines[0].startswith("start: valid_loss")
    assert about["validation"]["valid_loss"] < 0.8 * about["start_valid_loss"]
    assert about["audiogram"] == ear.to_dict() and about["simulator"] == "msbg"

    recipe = CompensatorRecipe.from_dict(SMALL)
    module = CompensatorTraining(recipe, simulator="msbg")
    valid = compensator_data(data, recipe, ear).validation
    assert module.validate(valid)["valid_loss"] == pytest.approx(about["start_valid_loss"])
    loaded = load_compensator(folder)
    assert isinstance(loaded, MappingCompensator)
    module.compensator = loaded
    assert module.validate(valid)["valid_loss"] == pytest.approx(about["validation"]["valid_loss"])


def test_what_it_starts_with_is_validated_as_all_that_follows(
    data: TrainingData, tmp_path: Path
) -> None:
    first, _ = train(data, tmp_path / "first", max_steps=1)
    settings = {"start": str(first), "validation_items": 12}  # three batches
    _, lines = train(data, tmp_path / "second", max_steps=1, recipe=settings)
    start, begun = (line.split("valid_loss ")[1] for line in lines[:2])
    assert lines[1].startswith("step 0") and begun == start


def test_goes_on_where_it_was_stopped(data: TrainingData, tmp_path: Path) -> None:
    options = {"recipe": {"validate_every": 2, "seconds": 0.2}}
    whole, _ = train(data, tmp_path / "whole", max_steps=6, **options)

    def stop(line: str) -> None:
        if line.startswith("step 4"):
            raise KeyboardInterrupt

    recipe = CompensatorRecipe.from_dict(SMALL | options["recipe"])
    with pytest.raises(KeyboardInterrupt):
        train_compensator(
            data,
            recipe,
            out=tmp_path / "stopped",
            simulator="msbg",
            accelerator="cpu",
            report=stop,
            progress=False,
        )
    assert (tmp_path / "stopped" / "last.ckpt").is_file()
    resumed, lines = train(data, tmp_path / "stopped", max_steps=6, **options)
    assert not any(line.startswith("step 2") for line in lines) and any(
        "step 6" in line for line in lines
    )
    first, second = (
        torch.load(tmp_path / name / "last.ckpt", weights_only=True)["state_dict"]
        for name in ("whole", "stopped")
    )
    assert set(first) == set(second)
    for name, values in first.items():
        assert torch.equal(second[name], values)
    assert whole.name == resumed.name == "checkpoint"


def test_another_recipe_does_not_go_on(data: TrainingData, tmp_path: Path) -> None:
    options = {"recipe": {"seconds": 0.2}, "max_steps": 1}
    train(data, tmp_path, audiogram=Audiogram.standard("N3"), **options)
    with pytest.raises(ValueError, match="another recipe"):
        train(data, tmp_path, audiogram=Audiogram.standard("N4"), **options)


def test_another_simulator_in_the_same_folder_does_not_go_on(
    data: TrainingData, tmp_path: Path
) -> None:
    config = NeuroConfig(channels=4, blocks=1)
    options = {"recipe": {"seconds": 0.2}, "max_steps": 1, "simulator": tmp_path / "simulator"}
    for again in (False, True):
        save_checkpoint(
            tmp_path / "simulator", "neuro-msbg", NeuroMSBG(config), config.to_dict(), {}
        )
        if not again:
            train(data, tmp_path / "out", **options)
    with pytest.raises(ValueError, match=r"another recipe \(other simulator_sha256; "):
        train(data, tmp_path / "out", **options)


def test_general_one_draws_ears_and_noise(data: TrainingData, tmp_path: Path) -> None:
    rows = ["name," + ",".join(f"hl_{hz}" for hz in (250, 500, 1000, 2000, 3000, 4000, 6000, 8000))]
    rows += [f"ear{i}," + ",".join(str(60 + i) for _ in range(8)) for i in range(3)]
    ears = tmp_path / "ears.csv"
    ears.write_text("\n".join(rows) + "\n")
    noise = data.speech
    recipe = CompensatorRecipe.from_dict(SMALL | {"weights": {"bands": 1.0, "paper": 0.5}})
    module = CompensatorTraining(recipe, simulator="msbg")
    sources = TrainingData(data.speech, noise=noise, audiograms=ears)
    batches = CompensatorBatches(recipe, sources, None)
    batch = batches.draw(64, torch.Generator().manual_seed(0))
    clean, drawn = batch["clean"], batch["thresholds"]
    noisy = (batch["signal"] != clean).any(-1).float().mean()
    measured = (drawn.std(-1) < 1e-6).float().mean()
    assert 0.25 < noisy < 0.75 and 0.25 < measured < 0.75 and len(drawn.unique(dim=0)) > 20
    loss = module.training_loss(batches.draw(recipe.batch, torch.Generator().manual_seed(0)))
    loss.backward()
    assert all(
        p.grad is not None and bool(p.grad.isfinite().all()) for p in module.trained_parameters()
    )
    assert all(name.startswith("compensator.") for name in module.state_dict())


def test_haspi_joins_the_criteria(data: TrainingData) -> None:
    """Of speech, tones and clicks, of which there is no score; its clips last a second."""
    settings = {
        "weights": {"coherent-bands": 1.0, "haspi": 0.3},
        "seconds": 1.0,
        "sounds": 0.6,
        "batch": 6,
    }
    recipe = CompensatorRecipe.from_dict(SMALL | settings)
    module = CompensatorTraining(recipe, simulator="msbg")
    batch = CompensatorBatches(recipe, data, None).draw(6, torch.Generator().manual_seed(1))
    assert bool((batch["clean"].count_nonzero(dim=-1) <= 8).any())
    loss = module.training_loss(batch)
    loss.backward()
    assert bool(loss.isfinite())
    assert all(
        p.grad is not None and bool(p.grad.isfinite().all()) for p in module.trained_parameters()
    )


def test_a_hearing_aid_learns_to_amplify_and_to_take_noise_off(
    data: TrainingData, tmp_path: Path
) -> None:
    noisy = TrainingData(data.speech, noise=data.speech, valid_speech=data.valid_speech)
    settings = {
        "kind": "hearing-aid",
        "model": {"width": 16, "hidden": 16},
        "seconds": 0.5,
        "learning_rate": 0.01,
    }
    settings |= {
        "weights": {"coherent-bands": 1.0, "denoising": 10.0},
        "unreduced": 0.5,
        "noisy": 1.0,
    }
    folder, _ = train(noisy, tmp_path, max_steps=100, recipe=settings)
    about = json.loads((folder / CONFIG).read_text())["about"]
    assert about["validation"]["valid_loss"] < 0.9 * about["start_valid_loss"]
    assert isinstance(load_compensator(folder), HearingAid)

    recipe = CompensatorRecipe.from_dict(SMALL | settings)
    batches = CompensatorBatches(recipe, noisy, None)
    drawn = [batches.draw(8, torch.Generator().manual_seed(i))["noise_reduction"] for i in range(8)]
    assert set(torch.cat(drawn).tolist()) == {0.0, 1.0} and 0.3 < torch.cat(drawn).mean() < 0.7


def test_without_noise_reduction_it_is_trained_and_validated(data: TrainingData) -> None:
    settings = {"kind": "hearing-aid", "model": {"width": 8, "hidden": 8}, "unreduced": 1.0}
    recipe = CompensatorRecipe.from_dict(SMALL | settings)
    for batch in compensator_data(data, recipe, None).validation:
        assert batch["noise_reduction"].count_nonzero() == 0


@pytest.mark.parametrize(
    ("weights", "unreduced", "kept"),
    [
        ({"denoising": 1.0, "intelligibility": 1.0}, 0.0, {"correct"}),
        ({"coherent-bands": 1.0}, 1.0, {"enter", "recur", "leave"}),
        ({"coherent-bands": 1.0}, 0.5, {"enter", "recur", "leave"}),
        ({"coherent-bands": 1.0, "denoising": 1.0}, 0.5, set()),
    ],
)
def test_what_a_hearing_aid_is_not_trained_for_stays_as_it_is(
    data: TrainingData, weights: dict[str, float], unreduced: float, kept: set[str]
) -> None:
    settings = {
        "kind": "hearing-aid",
        "model": {"width": 8, "hidden": 8},
        "seconds": 0.8,
        "noisy": 1.0,
    }
    recipe = CompensatorRecipe.from_dict(
        SMALL | settings | {"weights": weights, "unreduced": unreduced}
    )
    module = CompensatorTraining(recipe, simulator="msbg")
    noisy = TrainingData(data.speech, noise=data.speech)
    batch = CompensatorBatches(recipe, noisy, None).draw(2, torch.Generator().manual_seed(0))
    module.training_loss(batch).backward()
    parts = {
        name.split(".")[0]: one.requires_grad and one.grad is not None
        for name, one in module.compensator.named_parameters()
    }
    assert {name for name, trained in parts.items() if not trained} == kept
    assert len(parts) == 4


def test_a_share_of_the_clips_are_tones_and_clicks(data: TrainingData) -> None:
    def clicks(sounds: float) -> int:
        recipe = CompensatorRecipe.from_dict(SMALL | {"equalised": 0.0, "sounds": sounds})
        batches = CompensatorBatches(recipe, data, None)
        clean = batches.draw(64, torch.Generator().manual_seed(0))["clean"]
        return int((clean.count_nonzero(dim=-1) <= 8).sum())

    # every second sound is a few clicks
    assert clicks(0.0) == 0 and 5 < clicks(0.4) < 21 and clicks(1.0) == 32


def test_sounds_have_no_noise_and_babble_is_the_others_voices(data: TrainingData) -> None:
    noisy = TrainingData(data.speech, noise=data.speech)

    def drawn(**settings: float) -> Batch:
        recipe = CompensatorRecipe.from_dict(SMALL | {"equalised": 0.0, "noisy": 1.0} | settings)
        return CompensatorBatches(recipe, noisy, None).draw(2, torch.Generator().manual_seed(0))

    sounds = drawn(sounds=1.0)
    assert torch.equal(sounds["signal"], sounds["clean"])
    speech = drawn(sounds=0.0, babble=1.0)
    noise, others = speech["signal"] - speech["clean"], speech["clean"].flip(0)
    assert (torch.cosine_similarity(noise, others, -1) > 0.999).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"sounds": 1.5},
            "sounds 1.5, equalised 0.7, noisy 0.5, babble 0.0, unreduced 0.0 in the recipe; allowed: 0 to 1",
        ),
        ({"lr": 0.1}, "unknown settings lr"),
        ({"weights": {"loudness": 1.0}}, "unknown criteria loudness"),
        (
            {"weights": {"haspi": 1.0}},
            "seconds 0.6 in the recipe; allowed: 0.7 or more with haspi, hasqi or",
        ),
        (
            {"kind": "hearing-aid", "weights": {"intelligibility": 1.0}, "seconds": 0.5},
            "0.7 or more with haspi, hasqi or intelligibility",
        ),
        ({"levels": [80.0, 50.0]}, "a lowest and a highest"),
        ({"batch": 0}, "counts from 1 up"),
        (
            {"seed": -(2**62)},
            "seed -4611686018427387904 in the recipe; allowed: whole numbers between",
        ),
        ({"weights": {"bands": 0.0}}, "above 0"),
        ({"model": {"layers": 2}}, "unknown network settings layers"),
        (
            {"kind": "vocoder"},
            "kind 'vocoder' in the recipe; allowed: mapping-compensator, hearing-aid",
        ),
        (
            {"weights": {"denoising": 1.0}},
            "kind 'mapping-compensator' in the recipe; allowed: no noise reduction but a hearing-aid's",
        ),
        ({"kind": "hearing-aid", "model": {"channels": 2}}, "unknown network settings channels"),
    ],
)
def test_bad_recipes(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CompensatorTraining(CompensatorRecipe.from_dict(settings), simulator="msbg")


@pytest.mark.parametrize(
    "settings",
    [{"weights": {"denoising": 1.0}}, {"weights": {"intelligibility": 1.0}}, {"babble": 0.3}],
)
def test_noise_is_not_learned_from_none(speech_dir: Path, settings: dict[str, object]) -> None:
    recipe = CompensatorRecipe.from_dict({"kind": "hearing-aid", "seconds": 1.0, **settings})
    with pytest.raises(
        ValueError, match=r"the recipe has [a-z]+, which requires noise; give a folder of noise"
    ):
        compensator_data(TrainingData(speech_dir / "train"), recipe, None)
