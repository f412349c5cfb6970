"""Checkpoints: whole, hashed, without pickle."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import pytest
import torch

from compensators import load_compensator
from hlsim import NeuroMSBG, list_pretrained, load_pretrained
from hlsim.files import repair_folder
from hlsim.neuro import NeuroConfig
from hlsim.pretrained import (
    checkpoint_about,
    checkpoint_digest,
    checkpoints_folder,
    find_checkpoint,
    save_checkpoint,
    shipped,
)

SMALL = NeuroConfig(channels=4, blocks=1)

loaders = pytest.mark.parametrize(
    ("load", "name"), [(load_pretrained, "neuro-msbg"), (load_compensator, "compensator-general")]
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    model = NeuroMSBG(SMALL)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    save_checkpoint(
        tmp_path / "small", "neuro-msbg", model, SMALL.to_dict(), {"seed": 0}, card="# small\n"
    )
    return tmp_path / "small"


def configure(folder: Path, config: Any) -> None:
    """Another configuration, with its hash."""
    path = folder / "config.json"
    digest = hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()
    changed = {"config": config, "config_sha256": digest}
    path.write_text(json.dumps(json.loads(path.read_text()) | changed))


def test_save_and_load_are_bit_equal(tmp_path: Path, folder: Path) -> None:
    first = load_pretrained(folder)
    save_checkpoint(tmp_path / "again", "neuro-msbg", first, first.config.to_dict(), {})
    second = load_pretrained(tmp_path / "again")
    assert first.config == second.config == SMALL
    for (name, a), (other, b) in zip(
        first.state_dict().items(), second.state_dict().items(), strict=True
    ):
        assert name == other and torch.equal(a, b)
    waveform, ear = 0.02 * torch.randn(2, 4000), torch.full((8,), 40.0)
    assert torch.equal(first(waveform, ear), second(waveform, ear))


def test_loaded_model_is_frozen(folder: Path) -> None:
    model = load_pretrained(folder, sample_rate=44100, full_scale_spl=100.0)
    assert not model.training and not any(p.requires_grad for p in model.parameters())
    assert (model.sample_rate, model.full_scale_spl) == (44100, 100.0)


@loaders
def test_loading_draws_no_random_numbers(load: Any, name: str) -> None:
    before = torch.get_rng_state()
    load(name)
    assert torch.equal(torch.get_rng_state(), before)


@loaders
def test_loaded_in_inference_mode_gives_a_gradient_later(load: Any, name: str) -> None:
    with torch.inference_mode():
        model = load(name)
    assert not any(tensor.is_inference() for tensor in (*model.parameters(), *model.buffers()))
    given = (0.02 * torch.randn(2000)).requires_grad_()
    model(given, torch.full((8,), 40.0)).square().sum().backward()
    assert bool(given.grad.any())


def test_folder_holds_three_files_and_no_pickle(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {
        "model.safetensors",
        "config.json",
        "README.md",
    }
    assert not list(folder.parent.glob(".*"))
    header = (folder / "model.safetensors").read_bytes()[8:200]
    assert header.startswith(b"{")  # safetensors: a length, then JSON


def test_saving_again_keeps_the_card_and_replaces_the_rest(folder: Path) -> None:
    save_checkpoint(folder, "neuro-msbg", NeuroMSBG(SMALL), SMALL.to_dict(), {"seed": 1})
    assert (folder / "README.md").read_text() == "# small\n"
    assert json.loads((folder / "config.json").read_text())["about"] == {"seed": 1}
    load_pretrained(folder)


def test_a_file_of_the_users_own_is_not_deleted(folder: Path) -> None:
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"small: holds something else \(notes.txt\); allowed"):
        save_checkpoint(folder, "neuro-msbg", NeuroMSBG(SMALL), SMALL.to_dict(), {"seed": 1})
    assert (folder / "notes.txt").read_text() == "mine" and json.loads(
        (folder / "config.json").read_text()
    )


def test_configurations_that_would_fill_memory_or_time(folder: Path) -> None:
    record = json.loads((folder / "config.json").read_text())
    for name, value in (("fft", 100_000), ("blocks", 200_000), ("channels", 10**9)):
        configure(folder, record["config"] | {name: value})
        with pytest.raises(ValueError, match=f"{name} {value}; allowed: whole numbers from"):
            load_pretrained(folder)
    for text in ("[" * 200_000, "7", "\xff", "{"):
        (folder / "config.json").write_text(text, encoding="latin-1")
        for read in (load_pretrained, checkpoint_about, checkpoint_digest):
            with pytest.raises(ValueError, match=r"small: not readable as a checkpoint \("):
                read(folder)
    for kind in ([], {"x": 1}):
        (folder / "config.json").write_text(json.dumps(record | {"kind": kind}))
        with pytest.raises(ValueError, match="a checkpoint of kind"):
            load_pretrained(folder)
    (folder / "config.json").write_text(json.dumps(record | {"about": 7}))
    assert checkpoint_about(folder) == {}
    load_pretrained(folder)


def test_failing_save_leaves_the_old_checkpoint(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_checkpoint(folder, "neuro-msbg", NeuroMSBG(SMALL), SMALL.to_dict(), {})
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == ["small"]


@pytest.mark.parametrize("place", [0, 100, -1])
def test_changed_weights(folder: Path, place: int) -> None:
    weights = bytearray((folder / "model.safetensors").read_bytes())
    weights[place] ^= 1
    (folder / "model.safetensors").write_bytes(weights)
    with pytest.raises(ValueError, match="SHA-256"):
        load_pretrained(folder)


def test_another_kind(folder: Path) -> None:
    record = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(record | {"kind": "mapping-compensator"}))
    with pytest.raises(ValueError, match="kind 'mapping-compensator'; needed here: 'neuro-msbg'"):
        load_pretrained(folder)


def test_what_is_loaded_or_made_otherwise_is_named() -> None:
    with pytest.raises(
        ValueError, match=r"'neuro-msbg' \(compensators\.load_compensator loads the former\)"
    ):
        load_pretrained("compensator-general")
    with pytest.raises(
        ValueError, match=r"no checkpoint 'msbg': it is hlsim\.MSBG; allowed: neuro-msbg"
    ):
        load_pretrained("msbg")


def test_configuration_that_does_not_fit(folder: Path) -> None:
    configure(folder, SMALL.to_dict() | {"channels": 5})
    with pytest.raises(ValueError, match="do not fit"):
        load_pretrained(folder)
    (folder / "config.json").write_text("no JSON")
    with pytest.raises(ValueError, match="not readable as a checkpoint"):
        load_pretrained(folder)


def test_changed_configuration(folder: Path) -> None:
    path = folder / "config.json"
    record = json.loads(path.read_text())
    assert NeuroConfig.from_dict(record["config"]).window != 64
    path.write_text(json.dumps(record | {"config": record["config"] | {"window": 64}}))
    with pytest.raises(
        ValueError, match="changed since it was saved or of another version"
    ) as caught:
        load_pretrained(folder)
    assert str(caught.value).startswith(str(path))
    path.write_text(
        json.dumps({name: value for name, value in record.items() if name != "config_sha256"})
    )
    with pytest.raises(ValueError, match="changed since it was saved or of another version"):
        load_pretrained(folder)
    path.write_text(json.dumps(record | {"config": dict(reversed(record["config"].items()))}))
    load_pretrained(folder)


@pytest.mark.parametrize("config", [None, [], {"layers": 3}, {"channels": "many"}])
def test_odd_configuration_is_named(folder: Path, config: Any) -> None:
    configure(folder, config)
    with pytest.raises(ValueError, match="allowed: ") as caught:
        load_pretrained(folder)
    told = str(caught.value)
    assert told.startswith(str(folder / "config.json")) and len(told.splitlines()) == 1


@pytest.mark.parametrize("name", sorted(shipped()))
def test_shipped_configurations_have_their_hash(name: str) -> None:
    record = json.loads((checkpoints_folder() / name / "config.json").read_text())
    text = json.dumps(record["config"], sort_keys=True)
    assert hashlib.sha256(text.encode()).hexdigest() == record["config_sha256"]


def test_missing_weights(folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    with pytest.raises(ValueError, match="not readable as a checkpoint"):
        load_pretrained(folder)


@pytest.mark.parametrize("name", ["no-such", "../checkpoints/neuro-msbg/../neuro-msbg2", "", "."])
def test_unknown_names(name: str) -> None:
    with pytest.raises(ValueError, match=r"allowed: .*neuro-msbg"):
        load_pretrained(name)


@pytest.mark.parametrize("name", [3, None, torch.nn.ReLU, ["neuro-msbg"]])
def test_what_is_no_name(name: Any) -> None:
    with pytest.raises(
        ValueError, match=rf"checkpoint is {type(name).__name__}; allowed: a name or a folder"
    ):
        load_pretrained(name)


def test_only_those_of_the_kind_are_listed() -> None:
    with pytest.raises(ValueError, match="allowed: neuro-msbg, ") as caught:
        load_pretrained("no-such")
    assert "compensator" not in str(caught.value)
    with pytest.raises(ValueError, match=r"allowed: compensator-general, .*neuro-msbg"):
        find_checkpoint("no-such")


def test_folder_of_a_training_names_the_checkpoint_in_it(folder: Path) -> None:
    folder.rename(folder.with_name("checkpoint"))
    with pytest.raises(
        ValueError, match=r"no checkpoint '.*', but '.*checkpoint' is one; allowed: "
    ):
        load_pretrained(folder.parent)


def test_what_ships_is_listed_with_what_loads_it() -> None:
    loaders = {
        "hlsim.load_pretrained": load_pretrained,
        "compensators.load_compensator": load_compensator,
    }
    listed = list_pretrained()
    assert {"neuro-msbg", "neuro-msbg-lstm", "compensator-general", "hearing-aid"} <= set(listed)
    for name, loader in listed.items():
        loaders[loader](name)


def test_shipped_checkpoint() -> None:
    assert find_checkpoint("neuro-msbg") == checkpoints_folder() / "neuro-msbg"
    model = load_pretrained("neuro-msbg")
    record = json.loads((checkpoints_folder() / "neuro-msbg" / "config.json").read_text())
    assert record["about"]["validation"]["valid_snr_median"] > 15.0
    card = (checkpoints_folder() / "neuro-msbg" / "README.md").read_text()
    assert "CC BY 4.0" in card and "evaluate-simulator" in card
    assert model.config.prior


def test_failing_rename_gives_the_old_checkpoint_its_name_back(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    replace, calls = os.replace, []

    def fail_second(source: Path, target: Path) -> None:
        calls.append(source)
        if len(calls) == 2:
            raise OSError("disk full")
        replace(source, target)

    monkeypatch.setattr(os, "replace", fail_second)
    with pytest.raises(OSError, match="disk full"):
        save_checkpoint(folder, "neuro-msbg", NeuroMSBG(SMALL), SMALL.to_dict(), {})
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in folder.parent.iterdir()] == ["small"]


@pytest.mark.parametrize("again", [False, True])
def test_a_kill_between_the_renames_loses_nothing(folder: Path, again: bool) -> None:
    parent = folder.parent
    folder.rename(parent / ".small.old")
    (parent / ".small.abcd_123").mkdir()
    (parent / ".small.er.abcd_123").mkdir()  # of another name
    if again:
        save_checkpoint(folder, "neuro-msbg", NeuroMSBG(SMALL), SMALL.to_dict(), {})
    else:
        repair_folder(folder)
    assert {path.name for path in parent.iterdir()} == {"small", ".small.er.abcd_123"}
    assert (folder / "README.md").read_text() == "# small\n"
    load_pretrained(folder)


def test_names_do_not_lead_out_of_the_folder_that_ships(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = tmp_path / "package" / "checkpoints"
    for place in (
        shipped / "good",
        shipped / "deep" / "er",
        shipped.parent,
        shipped.parent / "beside",
    ):
        place.mkdir(parents=True, exist_ok=True)
        (place / "config.json").write_text("{}")
    monkeypatch.setattr("hlsim.pretrained.checkpoints_folder", lambda: shipped)
    monkeypatch.chdir(tmp_path)
    assert find_checkpoint("good") == shipped / "good"
    for name in ("..", "../beside", "deep/er", "deep", ".", "", str(shipped / "none")):
        with pytest.raises(ValueError, match=r"allowed: good, or a folder with config\.json"):
            find_checkpoint(name)
