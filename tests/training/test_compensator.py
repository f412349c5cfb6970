"""A compensator learns, and only the parts that the recipe names are trained."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lightning")

from compensators import load_compensator, save_compensator
from compensators.beamformer import BeamformingAid
from compensators.config import BeamformerConfig
from hlsim import MSBG, Audiogram, HearingLossLoss
from hlsim.audio import write_audio
from hlsim.calibration import level_spl, set_level
from hlsim.checkpoint import read_record, read_weights, save_checkpoint
from hlsim.data.manifest import Utterance, write_manifest
from hlsim.neuro import NeuroConfig, NeuroMSBG
from hlsim.simulators import BUILT_IN
from hlsim.training.batches import Batch, TrainingData, make_data
from hlsim.training.compensator import CompensatorTraining, train_compensator
from hlsim.training.module import describe_simulator
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe
from tests.helpers import mostly_slow, write_table
from tests.training.gradients import check_gradients

SMALL = CompensatorRecipe(
    model={"channels": 8, "blocks": 1, "stride": [4, 3]},
    steps=1,
    batch=2,
    seconds=0.2,
    sounds=0.0,
    validate_every=10,
    validation_items=4,
)
SMALL_AID = replace(SMALL, kind="hearing-aid", model={"width": 8, "hidden": 8})
N3 = Audiogram.standard("N3")


def train(data: TrainingData, recipe: CompensatorRecipe, out: Path, **options: Any) -> Any:
    """Train through the exact MSBG or another simulator, and return the checkpoint's record."""
    settings = {"simulator": "msbg", "accelerator": "cpu"} | options
    return read_record(train_compensator(data, recipe, out=out, **settings))["about"]


def draw(recipe: CompensatorRecipe, data: TrainingData, count: int) -> Batch:
    return make_data(data, replace(recipe, batch=count), None).training[0]


@pytest.fixture
def noisy(data: TrainingData) -> TrainingData:
    """Data in which the speech is also the noise."""
    return TrainingData(data.speech, noise=data.speech, valid_speech=data.valid_speech)


@pytest.mark.parametrize(
    "recipe",
    mostly_slow(
        [
            SMALL,
            replace(SMALL_AID, weights={"coherent-bands": 1.0, "denoising": 10.0}, unreduced=0.5),
        ],
        [SMALL],
    ),
)
def test_an_aid_learns_from_random_weights(
    noisy: TrainingData, tmp_path: Path, recipe: CompensatorRecipe
) -> None:
    recipe = replace(recipe, steps=10, learning_rate=0.02)
    about = train(noisy, recipe, tmp_path, audiogram=N3)
    assert about["audiogram"] == N3.to_dict() and about["simulator"] == "msbg"
    assert about["validation"]["valid_loss"] < about["start_validation"]["valid_loss"]
    load_compensator(tmp_path / "checkpoint")


def test_one_ear_excludes_tables_of_ears(noisy: TrainingData, tmp_path: Path) -> None:
    for name in ("audiograms", "valid_audiograms"):
        with pytest.raises(ValueError, match=r"audiogram .* excludes the data's audiograms"):
            train(replace(noisy, **{name: "standard"}), SMALL, tmp_path, audiogram=N3)


@pytest.mark.slow
def test_another_simulator_needs_another_folder(data: TrainingData, tmp_path: Path) -> None:
    config = NeuroConfig(channels=4, blocks=1)
    simulator = tmp_path / "simulator"
    save_checkpoint(simulator, "neuro-msbg", NeuroMSBG(config), config.to_dict(), {})
    train(data, SMALL, tmp_path / "out", simulator=simulator)
    save_checkpoint(simulator, "neuro-msbg", NeuroMSBG(config), config.to_dict(), {})
    with pytest.raises(ValueError, match="differs in simulator_sha256;"):
        train(data, SMALL, tmp_path / "out", simulator=simulator)
    train(data, SMALL, tmp_path / "module", simulator=NeuroMSBG(config))
    other = NeuroMSBG(config)
    torch.nn.init.ones_(next(other.parameters()))
    with pytest.raises(ValueError, match="differs in simulator_sha256;"):
        train(data, SMALL, tmp_path / "module", simulator=other)


def test_every_built_in_simulator_and_its_settings_are_in_the_record() -> None:
    for name in BUILT_IN:
        assert describe_simulator("simulator", name) == {"simulator": name}
    smeared, unsmeared = (describe_simulator("teacher", MSBG(smearing=s)) for s in (True, False))
    assert smeared != unsmeared


def test_a_simulator_of_your_own_is_named_in_the_record(data: TrainingData, tmp_path: Path) -> None:
    about = train(data, SMALL, tmp_path, simulator="hlsim:MSBG")
    assert about["simulator"] == "hlsim:MSBG"


def test_the_version_of_a_module_of_your_own_is_in_the_record() -> None:
    class Half(torch.nn.Module):
        fingerprint = "version 1"

        def forward(self, waveform: torch.Tensor, audiogram: Audiogram) -> torch.Tensor:
            return 0.5 * waveform

    half = Half()
    first = describe_simulator("teacher", half)
    half.fingerprint = "version 2"
    assert first["teacher"] == "Half() (version 1)"
    assert describe_simulator("teacher", half)["teacher"] == "Half() (version 2)"


def test_a_training_does_not_continue_with_an_edited_simulator(
    data: TrainingData, tmp_path: Path
) -> None:
    code = tmp_path / "half.py"
    code.write_text("def half(waveform, audiogram):\n    return 0.5 * waveform\n")
    train(data, SMALL, tmp_path / "out", simulator=f"{code}:half")
    code.write_text(code.read_text().replace("0.5", "0.1"))
    with pytest.raises(ValueError, match="differs in simulator_code_sha256;"):
        train(data, SMALL, tmp_path / "out", simulator=f"{code}:half")
    code.write_text(code.read_text() + "half.fingerprint = 'version 1'\n")
    record = describe_simulator("simulator", f"{code}:half")
    assert record == {"simulator": f"{code}:half (version 1)"}


def test_a_training_does_not_continue_with_other_weights_of_a_simulator_of_your_own(
    data: TrainingData, tmp_path: Path
) -> None:
    weights = tmp_path / "weights.pt"
    code = tmp_path / "gain.py"
    code.write_text(f"""import torch

class Gain(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.load({str(weights)!r}))

    def forward(self, waveform, audiogram):
        return self.gain * waveform
""")
    torch.save(torch.tensor(0.5), weights)
    train(data, SMALL, tmp_path / "out", simulator=f"{code}:Gain")
    torch.save(torch.tensor(0.1), weights)
    with pytest.raises(ValueError, match="differs in simulator_sha256;"):
        train(data, SMALL, tmp_path / "out", simulator=f"{code}:Gain")


@pytest.mark.parametrize("simulator", ["attenuation", "hlsim:MSBG"])
def test_a_simulator_without_a_checkpoint_trains(
    simulator: str, data: TrainingData, tmp_path: Path
) -> None:
    assert train(data, SMALL, tmp_path, simulator=simulator)["simulator"] == simulator


def test_the_start_is_saved_if_training_makes_it_worse(data: TrainingData, tmp_path: Path) -> None:
    start = load_compensator("compensator-general")
    model = start.config.to_dict()  # type: ignore[union-attr]
    recipe = replace(SMALL, model=model, start="compensator-general", learning_rate=10.0)
    about = train(data, recipe, tmp_path)
    assert about["steps"] == 0
    assert about["start_sha256"] == read_record("compensator-general")["sha256"]
    saved = load_compensator(tmp_path / "checkpoint")
    for initial, final in zip(start.parameters(), saved.parameters(), strict=True):
        assert torch.equal(initial, final)


@pytest.mark.parametrize(
    "settings",
    [
        {"start": "nalr"},
        {"start": "neuro-msbg"},
        {"start": "compensator-general"},  # whose model is another
        {"kind": "hearing-aid", "model": {"channels": 2}},
    ],
)
def test_networks_that_cannot_be_trained(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        CompensatorTraining(replace(SMALL, **settings), simulator="msbg")


def test_mixed_precision_does_not_change_a_training(noisy: TrainingData, tmp_path: Path) -> None:
    recipe = replace(SMALL_AID, weights={"denoising": 1.0})
    records = [
        train(noisy, recipe, tmp_path / precision, precision=precision)
        for precision in ("32-true", "bf16-mixed")
    ]
    assert records[0]["start_validation"] == records[1]["start_validation"]
    weights = [read_weights(tmp_path / name / "checkpoint") for name in ("32-true", "bf16-mixed")]
    assert weights[0] == weights[1]


def test_a_general_compensator_draws_ears_and_noise(noisy: TrainingData, tmp_path: Path) -> None:
    rows = [Audiogram((level,) * 8).to_row() for level in (60.0, 61.0, 62.0)]
    sources = replace(noisy, audiograms=write_table(tmp_path / "ears.csv", rows))
    recipe = replace(SMALL, weights={"bands": 1.0, "paper": 0.5, "haspi": 0.3}, seconds=0.7)
    batch = draw(recipe, sources, 64)
    is_noisy = (batch["signal"] != batch["clean"]).any(-1)
    is_measured = batch["thresholds"].std(-1) < 1e-6
    assert 16 < int(is_noisy.sum()) < 48 and 16 < int(is_measured.sum()) < 48
    assert len(batch["thresholds"].unique(dim=0)) > 20
    module = CompensatorTraining(recipe, simulator="msbg")
    check_gradients(module, draw(recipe, sources, 2))
    assert all(name.startswith("network.") for name in module.state_dict())


@pytest.mark.parametrize(
    ("weights", "frozen"),
    [
        ({"denoising": 1.0, "intelligibility": 1.0}, {"correct"}),
        ({"coherent-bands": 1.0}, {"enter", "recur", "leave"}),
        ({"coherent-bands": 1.0, "denoising": 1.0}, set()),
    ],
)
def test_parts_of_a_hearing_aid_without_a_criterion_are_frozen(
    noisy: TrainingData, weights: dict[str, float], frozen: set[str]
) -> None:
    recipe = replace(SMALL_AID, seconds=0.8, noisy=1.0, weights=weights, unreduced=0.5)
    module = CompensatorTraining(recipe, simulator="msbg")
    module.compute_loss(draw(recipe, noisy, 2)).backward()
    trained = {
        name.split(".")[0]: parameter.requires_grad and parameter.grad is not None
        for name, parameter in module.network.named_parameters()
    }
    assert {name for name, is_trained in trained.items() if not is_trained} == frozen
    assert len(trained) == 4


def test_criteria_of_one_part_have_no_gradient_for_the_other(noisy: TrainingData) -> None:
    both = {"coherent-bands": 1.0, "intelligibility": 1.0}
    gradients = []
    for weights in (both, *({name: weight} for name, weight in both.items())):
        recipe = replace(SMALL_AID, seconds=0.8, noisy=1.0, weights=weights)
        module = CompensatorTraining(recipe, simulator="msbg")
        for weight in module.network.parameters():
            weight.data += 0.01 * torch.sin(torch.arange(weight.numel())).view_as(weight)
        module.compute_loss(draw(recipe, noisy, 2)).backward()
        gradients.append({name: part.grad for name, part in module.network.named_parameters()})
    for name, gradient in gradients[0].items():
        alone = gradients[1 if name.startswith("correct") else 2][name]
        assert alone is not None and torch.allclose(gradient, alone, rtol=1e-4, atol=1e-9), name


@pytest.mark.slow
def test_a_front_end_is_trained_in_scenes_before_an_aid(
    noisy: TrainingData, tmp_path: Path
) -> None:
    recipe = replace(
        SMALL,
        kind="beamforming-aid",
        model={"hidden": 8},
        start="hearing-aid",
        weights={"coherent-bands": 1.0, "interaural": 0.1},
    )
    batch = draw(recipe, noisy, 2)
    assert batch["signal"].shape == (2, 2, 2, 3200)
    wide = draw(replace(recipe, model={"spacing": 0.012}), noisy, 2)
    assert not torch.allclose(wide["clean"], batch["clean"], rtol=1e-3)
    trained = load_compensator(
        train_compensator(noisy, recipe, out=tmp_path, simulator="msbg", accelerator="cpu")
    )
    before = load_compensator("hearing-aid").state_dict()
    after = trained.aid.state_dict()
    assert all(torch.equal(weights, after[name]) for name, weights in before.items())
    module = CompensatorTraining(recipe, simulator="msbg")
    module.compute_loss(draw(recipe, noisy, 2)).backward()
    moved = [
        name for name, weights in module.network.named_parameters() if weights.grad is not None
    ]
    assert moved
    assert all(name.startswith("front_end.decide") for name in moved)
    start = tmp_path / "wide"
    save_compensator(BeamformingAid(config=BeamformerConfig(spacing=0.012)), start)
    with pytest.raises(ValueError, match=r"0\.012 m apart; copy the settings"):
        CompensatorTraining(replace(recipe, start=str(start), model={}), simulator="msbg")
    with pytest.raises(ValueError, match="interaural compares two ears"):
        replace(recipe, kind="hearing-aid")


def test_the_seed_decides_the_weights_of_a_new_front_end_before_a_start() -> None:
    recipe = CompensatorRecipe(
        kind="beamforming-aid", model={"hidden": 8}, start="hearing-aid", weights={"bands": 1.0}
    )
    weights = []
    for seed in (0, 0, 1):
        torch.rand(1)
        state = torch.random.get_rng_state()
        module = CompensatorTraining(replace(recipe, seed=seed), simulator="attenuation")
        assert torch.equal(torch.random.get_rng_state(), state)
        weights.append(module.network.front_end.decide[0].weight)
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])


@pytest.fixture
def scenes(tmp_path: Path) -> TrainingData:
    """Recorded scenes with three microphones at each of two ears."""
    generator = np.random.default_rng(0)
    clean = torch.from_numpy(0.1 * generator.normal(size=8000)).float()
    noisy = torch.from_numpy(0.1 * generator.normal(size=(6, 8000))).float() + clean
    write_audio(tmp_path / "clean.wav", clean, 16000)
    write_audio(tmp_path / "mixture.wav", noisy, 16000)
    row = Utterance("clean.wav", "mixture.wav", reference="1 2")
    write_manifest(tmp_path / "manifest.csv", [row])
    return TrainingData.from_manifest(tmp_path / "manifest.csv")


@pytest.mark.parametrize(
    ("settings", "shape"),
    [
        ({"model": {**SMALL.model, "microphones": 3, "ears": 2}}, (2, 3, 2, 3200)),
        ({}, (4, 3200)),  # each ear is an item
        ({"kind": "hearing-aid", "model": SMALL_AID.model}, (4, 3200)),
    ],
)
def test_compensators_are_trained_in_recorded_scenes(
    scenes: TrainingData, settings: dict[str, Any], shape: tuple[int, ...]
) -> None:
    recipe = replace(SMALL, **settings, levels=(60.0, 60.0))
    batch = draw(recipe, scenes, 2)
    assert batch["signal"].shape == shape
    clean = batch["clean"].reshape(2, 2, -1)
    torch.testing.assert_close(level_spl(clean), torch.full((2, 2), 60.0))
    module = CompensatorTraining(recipe, simulator="attenuation")
    check_gradients(module, batch)


def test_other_microphones_than_those_of_the_scenes_are_errors(
    scenes: TrainingData, data: TrainingData, tmp_path: Path
) -> None:
    recipe = replace(SMALL, model={**SMALL.model, "microphones": 4})
    with pytest.raises(ValueError, match=r"4 microphones .* got 3 for each of 2 ears"):
        draw(recipe, scenes, 2)
    with pytest.raises(ValueError, match="recorded scenes for 4 microphones"):
        draw(recipe, data, 2)
    with pytest.raises(ValueError, match="leave --noise"):
        TrainingData.from_manifest(tmp_path / "manifest.csv", noise=tmp_path)
    two_ears = replace(SMALL, model={**SMALL.model, "microphones": 2, "ears": 2})
    assert draw(two_ears, data, 2)["signal"].shape == (2, 2, 2, 3200)


def test_a_batch_of_one_needs_recorded_scenes_for_two_ears(
    scenes: TrainingData, data: TrainingData
) -> None:
    recorded = replace(SMALL, model={**SMALL.model, "microphones": 3, "ears": 2}, batch=1)
    assert make_data(scenes, recorded).training[0]["signal"].shape == (1, 3, 2, 3200)
    random = replace(recorded, model={**SMALL.model, "microphones": 2, "ears": 2})
    with pytest.raises(ValueError, match="batch is 1, expected 2 or more"):
        make_data(data, random)


def test_recorded_scenes_are_not_validated_on_other_speech(
    scenes: TrainingData, tmp_path: Path
) -> None:
    row = Utterance("clean.wav", "mixture.wav", split="valid", reference="1 2")
    write_manifest(tmp_path / "manifest.csv", [row])
    both = replace(
        TrainingData.from_manifest(tmp_path / "manifest.csv"),
        speech=scenes.speech,
        scenes=scenes.scenes,
    )
    for data in (scenes, both):
        with pytest.raises(ValueError, match=r"\(--valid-speech\) would have no effect"):
            make_data(replace(data, valid_speech=tmp_path), SMALL)
    other = TrainingData.from_manifest(tmp_path / "manifest.csv", valid_speech=tmp_path)
    assert other.valid_speech == tmp_path  # a simulator is validated on it
    # The files of one split are those of the other here.
    with pytest.raises(ValueError, match="both training and validation"):
        make_data(both, SMALL)


def test_settings_without_effect_are_named(scenes: TrainingData, data: TrainingData) -> None:
    recipe = replace(SMALL, babble=0.5, snr=(-5.0, 5.0), sounds=0.5)
    with pytest.warns(UserWarning, match="recipe: babble, snr, sounds without effect on recorded"):
        make_data(scenes, recipe)
    with pytest.warns(UserWarning, match="recipe: snr without effect on data without noise"):
        make_data(data, replace(recipe, babble=0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_data(data, SMALL)


def test_interaural_differences_need_clean_speech_for_each_ear(scenes: TrainingData) -> None:
    weights = {"coherent-bands": 1.0, "interaural": 0.1}
    recipe = replace(SMALL, model={**SMALL.model, "microphones": 3, "ears": 2}, weights=weights)
    with pytest.warns(UserWarning, match=r"clean\.wav: the clean speech is the same at both ears"):
        make_data(scenes, recipe)


def test_a_simulator_does_not_lose_the_noise_of_scenes_without_a_warning(
    scenes: TrainingData,
) -> None:
    with pytest.warns(UserWarning, match="without the noise of recorded scenes"):
        make_data(scenes, SimulatorRecipe(validation_items=4))


def test_sounds_have_no_noise_and_babble_is_made_of_other_voices(noisy: TrainingData) -> None:
    recipe = replace(SMALL_AID, equalised=0.0, noisy=1.0, sounds=0.4, unreduced=0.5)
    batch = draw(recipe, noisy, 64)
    is_click = batch["clean"].count_nonzero(dim=-1) <= 8  # Every second sound is a few clicks.
    assert 5 < int(is_click.sum()) < 21
    assert torch.equal(batch["signal"][is_click], batch["clean"][is_click])
    sliders = batch["noise_reduction"]
    assert set(sliders.tolist()) == {0.0, 1.0} and 0.3 < float(sliders.mean()) < 0.7
    speech = draw(replace(recipe, sounds=0.0, babble=1.0), noisy, 2)
    noise = speech["signal"] - speech["clean"]
    other_voices = speech["clean"].flip(0)
    assert (torch.cosine_similarity(noise, other_voices, -1) > 0.999).all()


@pytest.mark.parametrize("settings", [{"weights": {"denoising": 1.0}}, {"babble": 0.3}])
def test_noise_is_not_learned_without_noise(data: TrainingData, settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="noise"):
        make_data(data, replace(SMALL_AID, **settings), None)


@pytest.mark.parametrize("limit_to_ear", [False, True])
def test_a_recipe_may_limit_the_output_to_the_ear(limit_to_ear: bool) -> None:
    recipe = replace(SMALL_AID, start="hearing-aid", model={}, limit_to_ear=limit_to_ear)
    module = CompensatorTraining(recipe, simulator="msbg")
    tone = set_level(torch.sin(0.4 * torch.arange(4000.0)), 105.0).unsqueeze(0)
    ear = torch.full((1, 8), 40.0)
    batch = {"signal": tone, "clean": tone, "thresholds": ear}
    batch["noise_reduction"] = torch.zeros(1)
    expected = load_compensator("hearing-aid", limit_to_ear=limit_to_ear)
    loss = HearingLossLoss(simulator="msbg")(expected(tone, ear, 0.0), tone, ear)
    torch.testing.assert_close(module.compute_loss(batch), loss, check_dtype=False)
    other = load_compensator("hearing-aid", limit_to_ear=not limit_to_ear)
    assert (other(tone, ear) - expected(tone, ear)).abs().max() > 0.01
