"""Checkpoints: complete, hashed, without pickle."""

import hashlib
import json
import os
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from compensators import HearingAid, HearingAidConfig, MappingCompensator, load_compensator
from compensators.beamformer import AdaptiveBeamformer, BeamformingAid
from hlsim import NeuroMSBG, list_pretrained, load_pretrained
from hlsim.checkpoint import read_record, save_checkpoint
from hlsim.evaluation.digits import DigitListener
from hlsim.neuro import NeuroConfig

FILES = {"model.safetensors", "config.json", "README.md"}
SMALL = NeuroConfig(channels=4, blocks=1)


def save(folder: Path, model: NeuroMSBG, **about: Any) -> Path:
    save_checkpoint(folder, "neuro-msbg", model, model.config.to_dict(), about)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    model = NeuroMSBG(SMALL)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    return save(tmp_path / "small", model)


def test_the_folder_of_a_training_is_preferred_to_a_shipped_name(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "neuro-msbg").mkdir()
    folder.rename(tmp_path / "neuro-msbg" / "checkpoint")
    monkeypatch.chdir(tmp_path)
    for name in ("neuro-msbg", "./neuro-msbg"):
        assert load_pretrained(name).config == SMALL


def change(folder: Path, **changes: Any) -> None:
    """Change the record; a changed configuration gets its hash."""
    path = folder / "config.json"
    if "config" in changes:
        text = json.dumps(changes["config"], sort_keys=True)
        changes["config_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_save_and_load_are_bit_equal(tmp_path: Path, folder: Path) -> None:
    first = load_pretrained(folder)
    save(tmp_path / "run" / "checkpoint", first)
    # the folder of a training is as good as that of its checkpoint
    second = load_pretrained(tmp_path / "run", sample_rate=44100, full_scale_spl=100.0)
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


def test_saving_again_writes_two_files_and_keeps_all_others(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # safetensors: a length, then JSON; no pickle
    assert (folder / "model.safetensors").read_bytes()[8:9] == b"{"
    save(folder, NeuroMSBG(SMALL), seed=7)
    assert "| seed | 7 |" in (folder / "README.md").read_text()
    (folder / "README.md").write_text("mine")
    save(folder, NeuroMSBG(SMALL), seed=1)
    assert read_record(folder)["about"] == {"seed": 1}
    assert (folder / "README.md").read_text() == "mine"
    with monkeypatch.context() as patch, pytest.raises(ValueError, match="disk full"):
        patch.setattr(Path, "write_text", Mock(side_effect=OSError("disk full")))
        save(folder, NeuroMSBG(NeuroConfig(channels=8, blocks=1)))
    load_pretrained(folder)
    assert {path.name for path in folder.iterdir()} == FILES


@pytest.mark.parametrize("error", [OSError("locked"), KeyboardInterrupt()])
@pytest.mark.parametrize("failing", range(5))
def test_a_checkpoint_can_be_loaded_after_a_save_that_stopped_at_any_point(
    folder: Path, monkeypatch: pytest.MonkeyPatch, failing: int, error: BaseException
) -> None:
    """Both of two saves stop at the same point; the process ends there without cleaning up."""
    operations = {"replace": os.replace, "unlink": os.unlink}
    calls: list[str] = []

    def stop(name: str) -> Any:
        def operation(*arguments: Any, **options: Any) -> None:
            if ".hlsim-" in str(arguments[-1]) or options.get("dir_fd"):
                return operations[name](*arguments, **options)  # cleans up a temporary folder
            calls.append(name)
            if len(calls) == failing + 1:
                raise error
            operations[name](*arguments, **options)

        return operation

    old, models = load_pretrained(folder), [NeuroMSBG(SMALL) for _ in range(2)]
    for model in models:
        calls.clear()
        with monkeypatch.context() as patch, suppress(ValueError, KeyboardInterrupt, OSError):
            for name in operations:
                patch.setattr(os, name, stop(name))
            save(folder, model)
        # three replacements, the removal of the older weights, and the card
        assert len(calls) == min(failing + 1, 5)
        weights = load_pretrained(folder).state_dict()
        candidates = [candidate.state_dict() for candidate in (old, *models)]
        equal = [all(torch.equal(weights[n], c[n]) for n in c) for c in candidates]
        assert any(equal)
    save(folder, models[0])
    assert {path.name for path in folder.iterdir()} == FILES


def test_weights_that_are_not_finite_are_not_saved(folder: Path) -> None:
    model = load_pretrained(folder)
    next(model.parameters()).flatten()[0] = torch.nan
    with pytest.raises(ValueError, match="expected finite weights, got NaN or infinity in"):
        save(folder, model)
    load_pretrained(folder)


def test_settings_of_a_network_that_are_not_saved_cause_a_warning(tmp_path: Path) -> None:
    model = NeuroMSBG(SMALL, sample_rate=44100, full_scale_spl=100.0)
    expected = "does not store sample_rate=44100, full_scale_spl=100.0; pass this when you load it"
    with pytest.warns(UserWarning, match=expected):
        model.save_pretrained(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        NeuroMSBG(SMALL).save_pretrained(tmp_path)
        DigitListener().save_pretrained(tmp_path)


@pytest.mark.parametrize("config", [{"channels": 8}, "small", HearingAidConfig, SMALL])
@pytest.mark.parametrize(
    "build",
    [MappingCompensator, HearingAid, BeamformingAid, AdaptiveBeamformer, DigitListener, NeuroMSBG],
)
def test_a_configuration_of_another_type_is_an_error(build: Any, config: Any) -> None:
    if (build, config) != (NeuroMSBG, SMALL):
        with pytest.raises(ValueError, match=r"expected config to be a \w+Config, got "):
            build(config=config)


def test_changed_weights_are_rejected(folder: Path) -> None:
    path = folder / "model.safetensors"
    weights = path.read_bytes()
    for place in (0, 100, len(weights) - 1):
        path.write_bytes(weights[:place] + bytes([weights[place] ^ 1]) + weights[place + 1 :])
        with pytest.raises(ValueError, match="SHA-256"):
            load_pretrained(folder)
    path.unlink()
    with pytest.raises(ValueError, match=r"cannot read model\.safetensors"):
        load_pretrained(folder)


def test_a_changed_configuration_is_rejected_whatever_the_order_of_names(folder: Path) -> None:
    path = folder / "config.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"config": record["config"] | {"window": 64}}))
    with pytest.raises(ValueError, match=r"config\.json: .*SHA-256"):
        load_pretrained(folder)
    path.write_text(json.dumps(record | {"config": dict(reversed(record["config"].items()))}))
    load_pretrained(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"config": None}, "do not fit"),
        ({"config": {"layers": 3}}, "do not fit"),
        ({"config": {"channels": "many"}}, "do not fit"),
        ({"config": SMALL.to_dict() | {"channels": 5}}, "do not fit"),
        ({"kind": "mapping-compensator"}, "expected a checkpoint of kind neuro-msbg"),
        ({"kind": [3]}, "expected a checkpoint of kind neuro-msbg"),
    ],
)
def test_other_models_are_rejected(folder: Path, changes: dict[str, Any], message: str) -> None:
    change(folder, **changes)
    with pytest.raises(ValueError, match=f"{folder}: .*{message}"):
        load_pretrained(folder)


@pytest.mark.parametrize("load", [load_pretrained, load_compensator])
def test_a_rate_out_of_range_is_no_fault_of_the_checkpoint(load: Any) -> None:
    with pytest.raises(ValueError, match=r"^expected a sample rate"):
        load("hearing-aid", sample_rate=8000)


@pytest.mark.parametrize("text", ["[" * 200_000, "7", "\xff", "{"])
def test_records_that_cannot_be_read_are_rejected(folder: Path, text: str) -> None:
    (folder / "config.json").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=f"^{folder}: cannot read"):
        load_pretrained(folder)


def test_errors_suggest_what_can_be_loaded() -> None:
    unknown: list[Any] = ["no-such", "../checkpoints/neuro-msbg2", "", ".", 3, None]
    for name in unknown:
        with pytest.raises(ValueError, match=r"expected .*neuro-msbg, "):
            load_pretrained(name)
    with pytest.raises(ValueError, match="load it with load_compensator"):
        load_pretrained("compensator-general")
    with pytest.raises(ValueError, match=r"'neuro-msgb' \(did you mean neuro-msbg\?\)"):
        load_pretrained("neuro-msgb")


@pytest.mark.parametrize(("name", "loader"), list_pretrained().items())
def test_what_ships_is_loaded_by_what_is_listed(name: str, loader: str) -> None:
    {"load_pretrained": load_pretrained, "load_compensator": load_compensator}[loader](name)
