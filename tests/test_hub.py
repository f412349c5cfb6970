"""Models are saved, loaded and shared in the layout of the Hugging Face Hub, without a network."""

import inspect
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import hlsim
from hlsim.extras import MissingExtraError

CLASSES = {
    "neuro-msbg": hlsim.NeuroMSBG,
    "hearing-aid": hlsim.HearingAid,
    "compensator-general": hlsim.MappingCompensator,
}


class Hub:
    """Part of huggingface_hub's interface, with a folder instead of the network."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.requests: list[str] = []

    def HfApi(self, token: str | None = None) -> "Hub":
        return self

    def create_repo(self, name: str, *, private: bool | None, exist_ok: bool) -> Any:
        assert exist_ok
        self.requests.append(f"create {name}")
        return SimpleNamespace(repo_id=name)

    def upload_folder(self, *, repo_id: str, folder_path: Path, commit_message: str) -> str:
        self.requests.append(f"upload {repo_id}")
        shutil.copytree(folder_path, self.folder / repo_id)
        return f"https://huggingface.co/{repo_id}/commit/1"

    def snapshot_download(self, name: str, **options: Any) -> str:
        """Return a snapshot whose files are links to blobs, as in the cache of the Hub."""
        self.requests.append(f"download {name} {options['revision']}")
        snapshot = self.folder / "snapshots" / "abc"
        snapshot.mkdir(parents=True)
        for file in (self.folder / name).iterdir():
            assert file.name in options["allow_patterns"]
            (snapshot / file.name).symlink_to(file)
        return str(snapshot)


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:
    hub = Hub(tmp_path / "hub")
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    return hub


@pytest.fixture
def without_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)


def assert_same_weights(model: torch.nn.Module, other: torch.nn.Module) -> None:
    state, other_state = model.state_dict(), other.state_dict()
    assert state.keys() == other_state.keys()
    assert all(torch.equal(value, other_state[name]) for name, value in state.items())


@pytest.mark.parametrize("name", CLASSES)
@pytest.mark.usefixtures("without_hub")
def test_a_saved_model_is_loaded_bit_by_bit_without_the_package(name: str, tmp_path: Path) -> None:
    model = CLASSES[name].from_pretrained(name)
    model.save_pretrained(tmp_path, license="mit", datasets=["mine"])
    copy = CLASSES[name].from_pretrained(tmp_path, full_scale_spl=100.0)
    assert copy.full_scale_spl == 100.0 and not copy.training
    load = hlsim.load_pretrained if name.startswith("neuro") else hlsim.load_compensator
    for other in (copy, load(tmp_path), load(name)):
        assert_same_weights(model, other)
    noise = 0.01 * torch.arange(8000).float().sin()
    assert torch.equal(model(noise, "N3"), load(tmp_path)(noise, "N3"))


def test_the_card_has_the_metadata_of_the_hub(tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    model = hlsim.HearingAid()
    model.save_pretrained(tmp_path, license="cc-by-4.0", datasets=["mine"], about={"seed": 7})
    _, head, text = (tmp_path / "README.md").read_text().split("---\n", 2)
    assert yaml.safe_load(head) == {
        "library_name": "hlsim",
        "pipeline_tag": "audio-to-audio",
        "tags": ["hearing-loss", "hearing-aid"],
        "license": "cc-by-4.0",
        "datasets": ["mine"],
    }
    assert "| seed | 7 |" in text


def test_cards_of_shipped_models_have_it_too() -> None:
    yaml = pytest.importorskip("yaml")
    for name in hlsim.list_pretrained():
        card = Path(__file__).parents[1] / "checkpoints" / name / "README.md"
        metadata = yaml.safe_load(card.read_text(encoding="utf-8").split("---\n")[1])
        assert metadata["license"] == "cc-by-4.0" and metadata["datasets"], name
        assert metadata["pipeline_tag"] == "audio-to-audio" and metadata["tags"], name


def test_push_and_download_use_the_hub_once_each(hub: Hub) -> None:
    model = hlsim.load_compensator("hearing-aid")
    address = model.push_to_hub("me/aid", license="mit")
    assert address.endswith("me/aid/commit/1")
    assert 'license: "mit"' in (hub.folder / "me/aid/README.md").read_text()
    assert_same_weights(model, hlsim.HearingAid.from_pretrained("me/aid", revision="v1"))
    assert hub.requests == ["create me/aid", "upload me/aid", "download me/aid v1"]
    snapshot = hub.folder / "snapshots" / "abc"
    assert_same_weights(model, hlsim.load_compensator(snapshot))
    assert len(hub.requests) == 3


def test_names_that_are_no_repository_and_other_kinds_are_refused(hub: Hub) -> None:
    with pytest.raises(ValueError, match="no checkpoint 'hearing-ais'"):
        hlsim.HearingAid.from_pretrained("hearing-ais")
    with pytest.raises(ValueError, match="expected a checkpoint of kind hearing-aid"):
        hlsim.HearingAid.from_pretrained("neuro-msbg")
    with pytest.raises(ValueError, match="no checkpoint 'me/aid'"):
        hlsim.load_compensator("me/aid")  # which never downloads
    assert hub.requests == []


@pytest.mark.usefixtures("without_hub")
def test_the_missing_package_is_named() -> None:
    with pytest.raises(MissingExtraError, match=r"pip install 'hlsim\[hub\]'"):
        hlsim.HearingAid.from_pretrained("me/aid")
    with pytest.raises(MissingExtraError, match=r"pip install 'hlsim\[hub\]'"):
        hlsim.HearingAid().push_to_hub("me/aid")


def test_the_package_has_the_functions_that_are_called() -> None:
    huggingface_hub = pytest.importorskip("huggingface_hub")
    functions = {
        huggingface_hub.snapshot_download: "revision cache_dir token allow_patterns",
        huggingface_hub.HfApi.create_repo: "repo_id private exist_ok",
        huggingface_hub.HfApi.upload_folder: "repo_id folder_path commit_message",
    }
    for function, names in functions.items():
        assert {*names.split()} <= {*inspect.signature(function).parameters}
