"""Checkpoints: a folder of safetensors, a JSON configuration with its hash, and a model card. No pickle."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import safetensors
import safetensors.torch
import torch
from torch import nn

from hlsim.calibration import PASCAL_SPL
from hlsim.files import whole_folder
from hlsim.neuro.config import NEURO_RATE, ModelConfig, NeuroConfig
from hlsim.neuro.model import NeuroMSBG

Model = TypeVar("Model", bound=nn.Module)
Config = TypeVar("Config", bound=ModelConfig)
Settings = Mapping[str, Any]

WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "README.md"

SIMULATOR = "neuro-msbg"
"""What ``config.json`` of a checkpoint of a simulator calls it."""

_LOADERS = {SIMULATOR: "hlsim.load_pretrained"}
_LOADERS |= dict.fromkeys(("mapping-compensator", "hearing-aid"), "compensators.load_compensator")
_MODELS = {
    "msbg": "hlsim.MSBG",
    "nalr": "compensators.NALR",
    "wdrc": "compensators.WDRC",
}  # that need no checkpoint


def load_pretrained(
    name: str | Path, *, sample_rate: int = NEURO_RATE, full_scale_spl: float = PASCAL_SPL
) -> NeuroMSBG:
    """A trained Neuro-MSBG, frozen and in eval mode. Nothing is downloaded.

    Args:
        name: of a checkpoint that ships with hlsim, e.g. ``"neuro-msbg"``, or a checkpoint folder.
        sample_rate: of its inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of RMS 1.0.

    Raises:
        ValueError: no such checkpoint, one of another kind, or one that has changed since it was saved.
    """

    def build(config: NeuroConfig) -> NeuroMSBG:
        return NeuroMSBG(
            config, sample_rate=sample_rate, full_scale_spl=full_scale_spl, compute_prior=False
        )

    model = read_checkpoint(name, {SIMULATOR: NeuroConfig}, build)
    return model.eval().requires_grad_(False)


def list_pretrained() -> dict[str, str]:
    """The checkpoints that ship with hlsim, and the function that loads each."""
    return {name: _LOADERS[_record(folder)["kind"]] for name, folder in shipped().items()}


def read_checkpoint(
    name: str | Path,
    kinds: Mapping[str, type[Config]],
    build: Callable[[Config], Model],
    also: Sequence[str] = (),
) -> Model:
    """A model built from a checkpoint's configuration, with its weights, on torch's default device, or the CPU where that
    is ``meta``.

    Args:
        kinds: the configuration of each kind that is taken.

    Raises ValueError as ``load_pretrained``."""
    folder = find_checkpoint(name, kinds, also)
    record = _record(folder)
    try:
        weights = (folder / WEIGHTS).read_bytes()
    except OSError as error:
        raise ValueError(f"{folder}: not readable as a checkpoint ({error})") from error
    found = record.get("kind")
    if not isinstance(found, str) or found not in kinds:
        hint = f" ({_LOADERS[str(found)]} loads the former)" if str(found) in _LOADERS else ""
        raise ValueError(
            f"{folder}: a checkpoint of kind {found!r}; needed here: {' or '.join(map(repr, kinds))}{hint}"
        )
    settings: Any = record.get("config")
    changed = "changed since it was saved"
    if hashlib.sha256(weights).hexdigest() != record.get("sha256"):
        raise ValueError(
            f"{folder / WEIGHTS}: {changed}, its SHA-256 differs from {CONFIG}'s; get it anew"
        )
    if record.get("config_sha256") != _digest(settings):
        raise ValueError(
            f"{folder / CONFIG}: {changed} or of another version, the SHA-256 of its 'config' is not its "
            "'config_sha256'; get it anew"
        )
    try:
        config = kinds[found].from_dict(settings)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{folder / CONFIG}: {error}") from error
    device = torch.get_default_device()
    try:
        # it may be trained through later, torch.device("meta") would keep no weights, and the random start is not kept
        with torch.inference_mode(False), torch.device("cpu"), torch.random.fork_rng(devices=[]):
            model = build(config)
            model.load_state_dict(safetensors.torch.load(weights))
    except (TypeError, RuntimeError, safetensors.SafetensorError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{folder}: weights and configuration do not fit ({reason})") from error
    with torch.inference_mode(False):
        return model if device.type == "meta" else model.to(device)


def find_checkpoint(
    name: str | Path, kinds: Collection[str] | None = None, also: Sequence[str] = ()
) -> Path:
    """The folder of a checkpoint that ships with hlsim, or another.

    Raises:
        ValueError: there is none, or it is neither a name nor a path; the message lists those of the kinds that ship, and
            what the caller takes ``also``.
    """
    if not isinstance(name, str | os.PathLike):
        raise ValueError(f"checkpoint is {type(name).__name__}; allowed: a name or a folder")
    if (Path(name) / CONFIG).is_file():
        return Path(name)
    if str(name) in (ours := shipped()):
        return ours[str(name)]
    names = ", ".join([*also, *shipped(kinds)]) or "none ships"
    inner = Path(name) / "checkpoint"  # as a training leaves it
    hint = f", but {str(inner)!r} is one" if (inner / CONFIG).is_file() else ""
    if str(name) in _MODELS:
        hint = f": it is {_MODELS[str(name)]}"
    raise ValueError(
        f"no checkpoint {str(name)!r}{hint}; allowed: {names}, or a folder with {CONFIG}"
    )


def checkpoint_digest(name: str | Path) -> str:
    """The SHA-256 of a checkpoint's weights, as it tells it. Raises ValueError where there is none, or it is broken."""
    return str(_record(find_checkpoint(name)).get("sha256"))


def checkpoint_about(name: str | Path) -> dict[str, Any]:
    """How a checkpoint was trained, as it tells it. Raises ValueError where there is none, or it is broken."""
    about = _record(find_checkpoint(name)).get("about")
    return dict(about) if isinstance(about, dict) else {}


def shipped(kinds: Collection[str] | None = None) -> dict[str, Path]:
    """The checkpoints that ship with hlsim, name and folder; all kinds by default."""
    folders = (path.parent for path in sorted(checkpoints_folder().glob(f"*/{CONFIG}")))
    return {
        folder.name: folder
        for folder in folders
        if kinds is None or _record(folder).get("kind") in kinds
    }


def checkpoints_folder() -> Path:
    """Where the checkpoints that ship lie: in the installed package, or beside it in a source tree."""
    package = Path(__file__).parent
    installed = package / "checkpoints"
    return installed if installed.is_dir() else package.parent / "checkpoints"


def save_checkpoint(
    folder: str | Path,
    kind: str,
    model: nn.Module,
    config: Settings,
    about: Settings,
    card: str = "",
) -> None:
    """Write a checkpoint folder, whole or not at all; an older one of the same name is replaced.

    Args:
        about: how it was trained: data, seed, command, time, metrics, version. Stored beside the configuration.
        card: text of its README.md; an existing card is kept where this is empty.

    Raises:
        ValueError: the folder holds something else.
    """
    target = check_replaceable(folder)
    state = {
        name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()
    }
    weights, settings = safetensors.torch.save(state), dict(config)
    hashes = {"sha256": hashlib.sha256(weights).hexdigest(), "config_sha256": _digest(settings)}
    record = {"kind": kind, "config": settings, **hashes, "about": dict(about)}
    with whole_folder(target) as staging:
        (staging / WEIGHTS).write_bytes(weights)
        (staging / CONFIG).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        if card:
            (staging / CARD).write_text(card, encoding="utf-8")
        elif (target / CARD).is_file():
            shutil.copy(target / CARD, staging / CARD)


def check_replaceable(folder: str | Path) -> Path:
    """The folder, or ValueError where it is a file or holds anything but a checkpoint: it will be replaced as a whole."""
    target = Path(folder)
    if target.exists() and not target.is_dir():
        raise ValueError(f"{target}: not a folder; allowed: a new folder, or that of a checkpoint")
    found = {path.name for path in target.iterdir()} if target.is_dir() else set()
    if others := sorted(found - {WEIGHTS, CONFIG, CARD}):
        raise ValueError(
            f"{target}: holds something else ({others[0]}); allowed: a new folder, or that of a checkpoint alone"
        )
    return target


def _record(folder: Path) -> dict[str, Any]:
    try:
        record = json.loads((folder / CONFIG).read_text(encoding="utf-8"))
        if not isinstance(record, dict):
            raise ValueError(f"{CONFIG} holds no names with values")
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{folder}: not readable as a checkpoint ({error})") from error
    return record


def _digest(config: Any) -> str:
    """The SHA-256 of a configuration, whatever the order of its names."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()
