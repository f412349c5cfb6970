"""Checkpoints: folders in which trained models are saved, and from which they are loaded.

A folder has three files: the weights (``model.safetensors``), the settings of the model with hashes
(``config.json``) and a model card (``README.md``). No pickles are read or written, so that loading
runs no code of the folder. The *kind* of a checkpoint, such as ``neuro-msbg`` or ``hearing-aid``,
says which class of model it holds.
"""

import hashlib
import json
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import safetensors
import safetensors.torch
import torch
from torch import nn

from hlsim.files import atomic_path

Model = TypeVar("Model", bound=nn.Module)
Config = TypeVar("Config")
Settings = Mapping[str, Any]

WEIGHTS = "model.safetensors"
CONFIG = "config.json"
CARD = "README.md"

SIMULATOR = "neuro-msbg"
"""Kind of the checkpoints of simulators. All other kinds are compensators."""


def list_pretrained() -> dict[str, str]:
    """List the checkpoints that ship with hlsim.

    Returns:
        Name of the function that loads it (``load_pretrained`` for a simulator,
        ``load_compensator`` for an aid), by name of the checkpoint.

    >>> list_pretrained()["neuro-msbg"]
    'load_pretrained'
    """
    folders = shipped_checkpoints()
    return {name: _loader_name(_read_record(folder)["kind"]) for name, folder in folders.items()}


def _loader_name(kind: str) -> str:
    return "load_pretrained" if kind == SIMULATOR else "load_compensator"


def read_checkpoint(
    name: str | Path,
    kinds: Mapping[str, Callable[[Settings], Config]],
    build: Callable[[Config], Model],
    other_names: Sequence[str] = (),
) -> Model:
    """Load a model from a checkpoint.

    The model is on torch's default device, or on the CPU if that is ``meta``.

    Args:
        name: Name of a checkpoint that ships with hlsim, or the folder of a checkpoint.
        kinds: Accepted kinds of checkpoints. The value of each is a function from the settings in
            ``config.json`` to the object with which the model is built.
        build: Function from this object to the model, whose weights are then loaded.
        other_names: Names that the caller accepts in addition, for the error message.

    Raises:
        ValueError: There is no such checkpoint, it is damaged, or its kind is not accepted.

    >>> from hlsim.neuro import NeuroConfig, NeuroMSBG
    >>> kinds = {SIMULATOR: NeuroConfig.from_dict}
    >>> read_checkpoint("neuro-msbg-light", kinds, NeuroMSBG).config.blocks
    2
    """
    folder = find_checkpoint(name, kinds, other_names)
    record = _read_record(folder)
    kind = record.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        hint = f"; load it with {_loader_name(kind)}" if isinstance(kind, str) else ""
        expected = " or ".join(repr(accepted) for accepted in kinds)
        raise ValueError(f"{folder}: expected a checkpoint of kind {expected}, got {kind!r}{hint}")
    try:
        weights = (folder / WEIGHTS).read_bytes()
    except OSError as error:
        raise ValueError(f"{folder}: cannot read the checkpoint: {error}") from error
    settings: Any = record.get("config")
    digests = {
        WEIGHTS: (hashlib.sha256(weights).hexdigest(), record.get("sha256")),
        CONFIG: (_digest(settings), record.get("config_sha256")),
    }
    for file, (digest, recorded) in digests.items():
        if digest != recorded:
            raise ValueError(
                f"{folder / file}: the file is damaged or was changed after saving, because its "
                f"SHA-256 is not that in {CONFIG}; download or save the checkpoint again"
            )
    try:
        config = kinds[kind](settings)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{folder / CONFIG}: {error}") from error
    device = torch.get_default_device()
    try:
        # Gradients may flow through the model later, hence no inference mode. A default device
        # "meta" would discard the weights. Initialisation must not advance the caller's random
        # numbers.
        with torch.inference_mode(False), torch.device("cpu"), torch.random.fork_rng(devices=[]):
            model = build(config)
            model.load_state_dict(safetensors.torch.load(weights))
    except (TypeError, RuntimeError, safetensors.SafetensorError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{folder}: weights and configuration do not fit: {reason}") from error
    with torch.inference_mode(False):
        return model if device.type == "meta" else model.to(device)


def find_checkpoint(
    name: str | Path, kinds: Collection[str] | None = None, other_names: Sequence[str] = ()
) -> Path:
    """Return the folder of a checkpoint of any kind.

    Args:
        name: Folder of a checkpoint or, if there is no such folder, the name of a checkpoint that
            ships with hlsim.
        kinds: Kinds of checkpoints that the error message suggests; all by default. Only the
            message depends on them.
        other_names: Names that the error message suggests in addition.

    Raises:
        ValueError: There is no such checkpoint.

    >>> find_checkpoint("neuro-msbg").name
    'neuro-msbg'
    """
    folder = Path(str(name))
    if (folder / CONFIG).is_file():
        return folder
    checkpoints = shipped_checkpoints()
    if str(name) in checkpoints:
        return checkpoints[str(name)]
    if (folder / "checkpoint" / CONFIG).is_file():
        raise ValueError(
            f"no checkpoint {str(name)!r}; use {str(folder / 'checkpoint')!r}, where training "
            "saved it"
        )
    names = ", ".join([*other_names, *shipped_checkpoints(kinds)])
    raise ValueError(f"no checkpoint {str(name)!r}; expected {names}, or a folder with {CONFIG}")


def checkpoint_digest(name: str | Path) -> str:
    """Return the SHA-256 of a checkpoint's weights, which identifies it.

    Args:
        name: Name or folder of the checkpoint.

    Raises:
        ValueError: There is no such checkpoint.

    >>> len(checkpoint_digest("neuro-msbg"))
    64
    """
    return str(_read_record(find_checkpoint(name)).get("sha256"))


def checkpoint_about(name: str | Path) -> dict[str, Any]:
    """Return how a checkpoint was trained: data, seed, command, time, measures and version.

    Args:
        name: Name or folder of the checkpoint.

    Returns: Entries, each under its name; an empty dictionary if the checkpoint has no record.

    Raises:
        ValueError: There is no such checkpoint.

    >>> "minutes" in checkpoint_about("neuro-msbg")
    True
    """
    about = _read_record(find_checkpoint(name)).get("about")
    return dict(about) if isinstance(about, dict) else {}


def shipped_checkpoints(kinds: Collection[str] | None = None) -> dict[str, Path]:
    """Return the folders of the checkpoints that ship with hlsim, each under its name.

    Args:
        kinds: Kinds of checkpoints to include, such as ``hearing-aid``; all by default.

    >>> [*shipped_checkpoints(["hearing-aid"])]
    ['hearing-aid']
    """
    folders = [path.parent for path in sorted(checkpoints_folder().glob(f"*/{CONFIG}"))]
    if kinds is not None:
        folders = [folder for folder in folders if _read_record(folder).get("kind") in kinds]
    return {folder.name: folder for folder in folders}


def checkpoints_folder() -> Path:
    """Return the folder of the checkpoints that ship with hlsim.

    It is inside an installed package, and beside the package in a source tree.

    >>> checkpoints_folder().name
    'checkpoints'
    """
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
    """Save a model as a checkpoint, in place of an older one in the same folder.

    If writing fails, the folder stays as it was.

    Args:
        folder: Folder to write.
        kind: Kind of the checkpoint, such as ``hearing-aid``.
        model: Model whose state dict is saved.
        config: Settings with which the model can be built again, as JSON values.
        about: Record of the training: data, seed, command, time, measures and version.
        card: Text of README.md. If it is empty, the card of an older checkpoint is kept.

    Raises:
        ValueError: The folder contains other files, or cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_checkpoint(f"{folder}/mine", "linear", nn.Linear(1, 1), {}, {"seed": 0})
    ...     checkpoint_about(f"{folder}/mine")
    {'seed': 0}
    """
    target = check_replaceable(folder)
    state = {
        name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()
    }
    weights = safetensors.torch.save(state)
    settings = dict(config)
    hashes = {"sha256": hashlib.sha256(weights).hexdigest(), "config_sha256": _digest(settings)}
    record = {"kind": kind, "config": settings, **hashes, "about": dict(about)}
    with atomic_path(target) as temporary:
        temporary.mkdir()
        (temporary / WEIGHTS).write_bytes(weights)
        (temporary / CONFIG).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        if card:
            (temporary / CARD).write_text(card, encoding="utf-8")
        elif (target / CARD).is_file():
            shutil.copy(target / CARD, temporary / CARD)


def check_replaceable(folder: str | Path) -> Path:
    """Check that saving a checkpoint in a folder deletes nothing but an older checkpoint.

    Returns: The folder as a path.

    Raises:
        ValueError: The folder contains other files, or is a file itself.

    >>> check_replaceable("new/checkpoint").name
    'checkpoint'
    """
    target = Path(folder)
    if target.is_dir():
        names = {path.name for path in target.iterdir()}
        other_files = sorted(names - {WEIGHTS, CONFIG, CARD})
    else:
        other_files = [target.name] if target.exists() else []
    if other_files:
        raise ValueError(
            f"{target}: saving would delete the file {other_files[0]}; choose a new folder, or "
            "that of a checkpoint"
        )
    return target


def _read_record(folder: Path) -> dict[str, Any]:
    try:
        record = json.loads((folder / CONFIG).read_text(encoding="utf-8"))
        if not isinstance(record, dict):
            raise ValueError(f"{CONFIG} is not a JSON object")
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{folder}: cannot read the checkpoint: {error}") from error
    return record


def _digest(config: Any) -> str:
    """Compute the SHA-256 of a configuration, independent of the order of its settings."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()
