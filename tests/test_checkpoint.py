"""Checkpoints: complete, hashed, without pickle."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from compensators import load_compensator
from hlsim import NeuroMSBG, list_pretrained, load_pretrained
from hlsim.checkpoint import (
    checkpoint_about,
    checkpoint_digest,
    checkpoints_folder,
    find_checkpoint,
    save_checkpoint,
    shipped_checkpoints,
)
from hlsim.neuro import NeuroConfig

SMALL = NeuroConfig(channels=4, blocks=1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    model = NeuroMSBG(SMALL)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    save(tmp_path / "small", model, card="# small\n")
    return tmp_path / "small"


def save(folder: Path, model: NeuroMSBG, about: Any = None, card: str = "") -> None:
    save_checkpoint(folder, "neuro-msbg", model, model.config.to_dict(), about or {}, card)


def change(folder: Path, **changes: Any) -> None:
    """Change the record; a changed configuration gets its hash."""
    path = folder / "config.json"
    if "config" in changes:
        text = json.dumps(changes["config"], sort_keys=True)
        changes["config_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_save_and_load_are_bit_equal(tmp_path: Path, folder: Path) -> None:
    first = load_pretrained(folder)
    save(tmp_path / "again", first)
    second = load_pretrained(tmp_path / "again", sample_rate=44100, full_scale_spl=100.0)
    assert first.config == second.config == SMALL
    assert (second.sample_rate, second.full_scale_spl) == (44100, 100.0)
    assert not second.training and not any(p.requires_grad for p in second.parameters())
    weights, again = first.state_dict(), second.state_dict()
    assert weights.keys() == again.keys()
    assert all(torch.equal(weights[name], again[name]) for name in weights)


@pytest.mark.parametrize(
    ("load", "name"), [(load_pretrained, "neuro-msbg"), (load_compensator, "compensator-general")]
)
def test_loading_draws_no_random_numbers_and_in_inference_mode_gives_a_gradient_later(
    load: Any, name: str
) -> None:
    before = torch.get_rng_state()
    with torch.inference_mode():
        model = load(name)
    assert torch.equal(torch.get_rng_state(), before)
    assert not any(tensor.is_inference() for tensor in (*model.parameters(), *model.buffers()))
    waveform = (0.02 * torch.randn(2000)).requires_grad_()
    model(waveform, torch.full((8,), 40.0)).square().sum().backward()
    assert waveform.grad is not None and bool(waveform.grad.any())


def test_a_checkpoint_is_three_files_without_pickle(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    assert names == {"model.safetensors", "config.json", "README.md"}
    assert not list(folder.parent.glob(".*"))
    # safetensors: a length, then JSON
    assert (folder / "model.safetensors").read_bytes()[8:9] == b"{"


def test_saving_again_keeps_the_card_and_files_of_the_user(folder: Path) -> None:
    save(folder, NeuroMSBG(SMALL), {"seed": 1})
    assert (folder / "README.md").read_text() == "# small\n"
    assert checkpoint_about(folder) == {"seed": 1}
    load_pretrained(folder)
    (folder / "notes.txt").write_text("mine")
    for target in (folder, folder / "notes.txt"):
        with pytest.raises(ValueError, match=r"notes\.txt"):
            save(target, NeuroMSBG(SMALL))
    assert (folder / "notes.txt").read_text() == "mine"


def test_changed_and_missing_weights_are_rejected(folder: Path) -> None:
    path = folder / "model.safetensors"
    weights = path.read_bytes()
    for place in (0, 100, len(weights) - 1):
        path.write_bytes(weights[:place] + bytes([weights[place] ^ 1]) + weights[place + 1 :])
        with pytest.raises(ValueError, match="SHA-256"):
            load_pretrained(folder)
    path.unlink()
    with pytest.raises(ValueError, match=r"model\.safetensors"):
        load_pretrained(folder)


def test_a_changed_configuration_is_rejected_whatever_the_order_of_names(folder: Path) -> None:
    path = folder / "config.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"config": record["config"] | {"window": 64}}))
    with pytest.raises(ValueError, match=r"config\.json: .*SHA-256"):
        load_pretrained(folder)
    path.write_text(json.dumps(record | {"config": dict(reversed(record["config"].items()))}))
    load_pretrained(folder)


@pytest.mark.parametrize("config", [None, [], {"layers": 3}, {"channels": "many"}, {"channels": 5}])
def test_configurations_that_do_not_fit_are_rejected(folder: Path, config: Any) -> None:
    if config == {"channels": 5}:
        config = SMALL.to_dict() | config
    change(folder, config=config)
    with pytest.raises(ValueError, match=str(folder)):
        load_pretrained(folder)


@pytest.mark.parametrize("text", ["[" * 200_000, "7", "\xff", "{"])
def test_records_that_cannot_be_read_are_rejected(folder: Path, text: str) -> None:
    (folder / "config.json").write_text(text, encoding="latin-1")
    for read in (load_pretrained, checkpoint_about, checkpoint_digest):
        with pytest.raises(ValueError, match=f"^{folder}: cannot read the checkpoint"):
            read(folder)


def test_other_kinds_are_rejected(folder: Path) -> None:
    for kind in ("mapping-compensator", None, [], {"x": 1}):
        change(folder, kind=kind)
        with pytest.raises(ValueError, match="expected a checkpoint of kind 'neuro-msbg'"):
            load_pretrained(folder)


def test_errors_suggest_what_can_be_loaded(folder: Path) -> None:
    unknown: list[Any] = ["no-such", "../checkpoints/neuro-msbg2", "", ".", 3, None]
    for name in unknown:
        with pytest.raises(ValueError, match="expected neuro-msbg, ") as caught:
            load_pretrained(name)
        assert "compensator" not in str(caught.value)
    with pytest.raises(ValueError, match="load it with load_compensator"):
        load_pretrained("compensator-general")
    folder.rename(folder.with_name("checkpoint"))
    with pytest.raises(ValueError, match=f"use '{folder.parent}/checkpoint'"):
        load_pretrained(folder.parent)


def test_names_do_not_lead_out_of_the_folder_that_ships(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "package"
    for place in (package / "checkpoints" / "good", package, package / "beside"):
        place.mkdir(parents=True, exist_ok=True)
        (place / "config.json").write_text("{}")
    monkeypatch.setattr("hlsim.checkpoint.checkpoints_folder", lambda: package / "checkpoints")
    monkeypatch.chdir(tmp_path)
    assert find_checkpoint("good") == package / "checkpoints" / "good"
    for name in ("..", "../beside", ".", ""):
        with pytest.raises(ValueError, match="expected good, or a folder"):
            find_checkpoint(name)


@pytest.mark.parametrize("name", sorted(shipped_checkpoints()))
def test_what_ships_has_its_hash_and_is_loaded_by_what_is_listed(name: str) -> None:
    record = json.loads((checkpoints_folder() / name / "config.json").read_text())
    text = json.dumps(record["config"], sort_keys=True)
    assert hashlib.sha256(text.encode()).hexdigest() == record["config_sha256"]
    functions = {"load_pretrained": load_pretrained, "load_compensator": load_compensator}
    functions[list_pretrained()[name]](name)
