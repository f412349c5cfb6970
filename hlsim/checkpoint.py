"""Checkpoints: folders in which trained models are saved, and from which they are loaded.

A folder has three files: the weights (``model.safetensors``), the settings of the model with hashes
(``config.json``) and a model card (``README.md``). A fourth file, ``model.older.safetensors``,
exists while a model replaces an older one, or after this was interrupted. The weights are those
whose hash is in ``config.json``, so that one of the two models can be loaded at any time. No
pickles are read or written, so that loading runs no code of the folder. The *kind* of a checkpoint,
such as ``neuro-msbg`` or ``hearing-aid``, names the class of the saved model.
"""

import hashlib
import inspect
import json
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Self, cast

import safetensors
import safetensors.torch
import torch
from torch import nn

from hlsim.checks import suggest
from hlsim.extras import require
from hlsim.files import atomic_path, read_json, write_atomically
from hlsim.version import __version__

Settings = Mapping[str, Any]

WEIGHTS = "model.safetensors"
OLDER_WEIGHTS = "model.older.safetensors"
CONFIG = "config.json"
CARD = "README.md"

_WITHOUT_CHECKPOINT = (
    *("msbg", "msbg-unsmeared", "attenuation"),
    *("nalr", "nalrp", "wdrc", "camfit"),
)
"""Names of simulators and aids that have no checkpoint."""

SIMULATOR = "neuro-msbg"
"""Kind of the checkpoints of simulators."""

DIGIT_LISTENER = "digit-listener"
"""Kind of the checkpoints of networks that recognise the digits of the digit test.

All kinds other than this one and ``SIMULATOR`` are compensators.
"""

_LISTENER_LOADER = "hlsim.evaluation.digits.load_listener"

_LOADERS = {SIMULATOR: "load_pretrained", DIGIT_LISTENER: _LISTENER_LOADER}
"""Name of the function that loads a checkpoint, by kind. Other kinds: ``load_compensator``."""


def list_pretrained() -> dict[str, str]:
    """List the simulators and aids that ship with hlsim as checkpoints.

    Returns:
        Dict from the name of each checkpoint to the name of the function that loads it:
        ``load_pretrained`` for a simulator, ``load_compensator`` for an aid.

    >>> list_pretrained()["neuro-msbg"]
    'load_pretrained'
    """
    folders = sorted(path.parent for path in checkpoints_folder().glob(f"*/{CONFIG}"))
    loaders = {folder.name: _loader_name(read_record(folder)["kind"]) for folder in folders}
    return {name: loader for name, loader in loaders.items() if loader != _LISTENER_LOADER}


def _loader_name(kind: str) -> str:
    return _LOADERS.get(kind, "load_compensator")


def read_checkpoint(name: str | Path, classes: Sequence[Any], **options: Any) -> Any:
    """Load a model from a checkpoint, in evaluation mode and without gradients of its weights.

    The model is on torch's default device. If this is ``meta``, which stores no values, the model
    is on the CPU.

    Args:
        name: Name of a checkpoint that ships with hlsim, the folder of a checkpoint, or the folder
            of a training run, which contains it.
        classes: Classes of the accepted kinds of checkpoints, which extend ``HubModel``.
        options: Further arguments of the class of the checkpoint.

    Raises:
        ValueError: There is no such checkpoint, it is damaged, its kind is not accepted, or an
            option is not valid.

    >>> from hlsim.neuro import NeuroMSBG
    >>> read_checkpoint("neuro-msbg", [NeuroMSBG]).config.blocks
    1
    """
    class_of = {model_class.kind: model_class for model_class in classes}
    folder = _find_folder(name)
    record = read_record(folder)
    kind = str(record.get("kind"))
    if kind not in class_of:
        raise ValueError(
            f"{folder}: expected a checkpoint of kind {' or '.join(class_of)}, got {kind}; load it "
            f"with {_loader_name(kind)}"
        )
    weights = read_weights(folder)
    settings: Any = record.get("config")
    _check_hash(folder / CONFIG, _digest(settings), record.get("config_sha256"))
    try:
        # Gradients may flow through the model later, hence no inference mode. Initialisation must
        # not advance the caller's random numbers.
        with torch.inference_mode(False), torch.device("cpu"), torch.random.fork_rng(devices=[]):
            model_class = class_of[kind]
            config = model_class.config_class.from_dict(settings)
            model = model_class(config=config, **{**model_class.build_options, **options})
            model.load_state_dict(safetensors.torch.load(weights))
    except (TypeError, ValueError, RuntimeError, safetensors.SafetensorError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{folder}: weights, configuration and arguments do not fit: {reason}"
        ) from error
    model.eval().requires_grad_(False)
    device = torch.get_default_device()
    if device.type == "meta":
        return model
    with torch.inference_mode(False):
        return model.to(device)


def read_weights(folder: str | Path) -> bytes:
    """Read the weights of a checkpoint as bytes in safetensors' format.

    Args:
        folder: Folder of the checkpoint.

    Raises:
        ValueError: There is no checkpoint, the weights cannot be read, or they are not those that
            were saved with ``config.json``.

    >>> len(read_weights(checkpoints_folder() / "hearing-aid")) > 100_000
    True
    """
    recorded = read_record(folder).get("sha256")
    file, older_file = Path(folder) / WEIGHTS, Path(folder) / OLDER_WEIGHTS
    try:
        weights = file.read_bytes()
        if older_file.is_file() and hashlib.sha256(weights).hexdigest() != recorded:
            weights = older_file.read_bytes()
    except OSError as error:
        raise ValueError(f"{folder}: cannot read {WEIGHTS}: {error}") from error
    _check_hash(file, hashlib.sha256(weights).hexdigest(), recorded)
    return weights


def _check_hash(file: Path, digest: str, recorded: Any) -> None:
    """Raise ValueError unless the hash of a file is the recorded one.

    Args:
        file: File, for the message.
        digest: SHA-256 of the file or of the part that is validated.
        recorded: SHA-256 in ``config.json``.
    """
    if digest != recorded:
        raise ValueError(
            f"{file}: the file is damaged or was changed after saving, because its SHA-256 is not "
            f"that in {CONFIG}; download or save the checkpoint again"
        )


def read_record(name: str | Path) -> dict[str, Any]:
    """Read the record of a checkpoint of any kind, the contents of its ``config.json``.

    Args:
        name: Name of a checkpoint that ships with hlsim, the folder of a checkpoint, or the folder
            of a training run, which contains it.

    Returns:
        Dict with, among others, ``kind``; ``config``, the settings of the model; ``sha256``, which
        identifies the weights; and ``about``, the record of the training, whose entries depend on
        the checkpoint. A training by hlsim writes ``hlsim`` (its version), ``recipe`` (with the
        ``seed``), ``steps``, ``minutes`` and ``validation``.

    Raises:
        ValueError: There is no such checkpoint, or the file cannot be read.

    >>> read_record("neuro-msbg")["kind"]
    'neuro-msbg'
    """
    folder = _find_folder(name)
    try:
        return dict(read_json(folder / CONFIG))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{folder}: cannot read {CONFIG}: {error}") from error


def _find_folder(name: str | Path) -> Path:
    """Return the folder of a checkpoint.

    Args:
        name: Folder of the checkpoint, folder of a training run, whose subfolder ``checkpoint`` is
            then the checkpoint, or name of a checkpoint that ships with hlsim.

    Raises:
        ValueError: There is no such checkpoint.
    """
    path = Path(str(name))
    for folder in (path, path / "checkpoint", checkpoints_folder() / path):
        if (folder / CONFIG).is_file():
            return folder
    suggestion = suggest(str(name), [*list_pretrained(), *_WITHOUT_CHECKPOINT])
    raise ValueError(
        f"no checkpoint {str(name)!r}{suggestion}; expected {', '.join(list_pretrained())}, or a "
        f"folder with {CONFIG}; models without a checkpoint are {', '.join(_WITHOUT_CHECKPOINT)}"
    )


def checkpoints_folder() -> Path:
    """Return the folder of the checkpoints that ship with hlsim.

    The folder is inside an installed package, and beside the package in a source tree.

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
    card: Settings | None = None,
) -> None:
    """Save a model as a checkpoint, in place of an older one in the same folder.

    If writing fails, or the process is killed, the older checkpoint or the new one can be loaded.
    Other files in the folder stay. A card that lists ``about`` is written, unless the folder
    contains a card that was not written by this function.

    Args:
        folder: Folder to write.
        kind: Kind of the checkpoint, such as ``hearing-aid``.
        model: Model whose state dict is saved.
        config: Settings with which the model can be built again, as JSON values.
        about: Record of the training, such as data, seed, command and time, as JSON values.
        card: Further metadata of the card, such as ``{"license": "mit"}``.

    Raises:
        ValueError: A weight is NaN or infinite, or the folder cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_checkpoint(f"{folder}/mine", "linear", nn.Linear(1, 1), {}, {"seed": 0})
    ...     read_record(f"{folder}/mine")["about"]
    {'seed': 0}
    """
    state = {
        name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()
    }
    for name, tensor in state.items():
        if not bool(tensor.isfinite().all()):
            raise ValueError(
                f"expected finite weights, got NaN or infinity in {name}; load an earlier "
                "checkpoint, and train with a lower learning rate"
            )
    weights = safetensors.torch.save(state)
    hashes = {"sha256": hashlib.sha256(weights).hexdigest(), "config_sha256": _digest(config)}
    record = {"kind": kind, "config": config, **hashes, "about": about}
    target = Path(folder)
    try:
        older_weights = read_weights(target)
    except ValueError:  # There is no older checkpoint, or it is damaged.
        older_weights = None
    # The weights are replaced first, then the configuration with their hash.
    with atomic_path(target / CONFIG) as new_config, atomic_path(target / WEIGHTS) as new_weights:
        new_weights.write_bytes(weights)
        new_config.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        if older_weights is not None:
            write_atomically(target / OLDER_WEIGHTS, older_weights)
    (target / OLDER_WEIGHTS).unlink(missing_ok=True)
    _write_card(target, kind, about, card or {})


def _write_card(folder: Path, kind: str, about: Settings, metadata: Settings) -> None:
    """Write a card with a table of ``about``, unless there is a card that a person wrote.

    The card begins with the metadata by which the Hugging Face Hub lists models.

    Args:
        folder: Folder of the checkpoint.
        kind: Kind of the checkpoint.
        about: Record of the training.
        metadata: Further metadata, such as the licence.
    """
    path, table_head = folder / CARD, "| record | value |\n|---|---|"
    if path.exists() and table_head not in path.read_text(encoding="utf-8"):
        return
    task = "audio-classification" if kind == DIGIT_LISTENER else "audio-to-audio"
    common: dict[str, Any] = {
        "library_name": "hlsim",
        "pipeline_tag": task,
        "tags": ["hearing-loss", kind],
    }
    # A value in JSON is one in YAML, too.
    lines = [f"{key}: {json.dumps(value)}" for key, value in {**common, **metadata}.items()]
    head = "\n".join(lines)
    introduction = f"A {kind} for hlsim. Load this folder with `{_loader_name(kind)}`."
    rows = "\n".join(f"| {name} | {value} |" for name, value in about.items())
    text = f"---\n{head}\n---\n\n# {folder.name}\n\n{introduction}\n\n{table_head}\n{rows}\n"
    write_atomically(path, text)


def _digest(config: Any) -> str:
    """Compute the hexadecimal SHA-256 of settings in JSON's types, whatever the order of keys."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()


class HubModel:
    """Base class with methods that save, load and share a simulator or an aid.

    A repository of the Hugging Face Hub is a folder as ``save_checkpoint`` writes it. Only
    ``push_to_hub``, and ``from_pretrained`` of a repository that is no local folder, use the
    network; they need the extra ``hub``. The names of the methods are those of
    ``huggingface_hub.PyTorchModelHubMixin``, which is no base class here because hlsim works
    without this package.

    Subclasses define ``kind``, that of their checkpoints; ``config_class``, the class of their
    settings; and ``config``, the settings. They may define ``build_options``, arguments with which
    the class is built when a checkpoint is loaded.

    >>> import hlsim
    >>> with TemporaryDirectory() as folder:
    ...     hlsim.HearingAid().save_pretrained(folder, license="mit")
    ...     aid = hlsim.HearingAid.from_pretrained(folder)
    """

    kind: ClassVar[str]
    config_class: ClassVar[Any]
    build_options: ClassVar[Settings] = {}
    config: Any

    def save_pretrained(
        self,
        folder: str | Path,
        *,
        license: str | None = None,
        datasets: Sequence[str] = (),
        about: Settings | None = None,
    ) -> None:
        """Save the model as a checkpoint, in place of an older one in the same folder.

        The sample rate, ``full_scale_spl`` and other arguments of the constructor beside ``config``
        are not saved; pass them when the model is loaded. A warning names those, except ears, that
        differ from their default, because the loaded model has other outputs.

        Args:
            folder: Folder to write.
            license: Licence of the weights, such as ``"mit"``, for the card.
            datasets: Names of the corpora on which the model was trained, for the card.
            about: Record of the training for the card, such as ``{"seed": 0}``, as JSON values.

        Raises:
            ValueError: A weight is NaN or infinite, or the folder cannot be written.
        """
        assert isinstance(self, nn.Module)
        texts = [f"{name}={value!r}" for name, value in self.unsaved_settings().items()]
        if texts:
            warnings.warn(
                f"the checkpoint does not store {', '.join(texts)}; pass this when you load it",
                stacklevel=2,
            )
        card: dict[str, Any] = {}
        if license:
            card["license"] = license
        if datasets:
            card["datasets"] = [*datasets]
        record = {"hlsim": __version__, **(about or {})}
        save_checkpoint(folder, self.kind, self, self.config.to_dict(), record, card)

    def unsaved_settings(self) -> dict[str, Any]:
        """Return the settings that a checkpoint does not store and that differ from their default.

        They are the arguments of constructors that have to be passed by their names, except those
        that the model does not keep as an attribute.
        """
        constructors = [vars(base).get("__init__") for base in type(self).__mro__]
        parameters = [
            parameter
            for construct in constructors
            if construct is not None
            for parameter in inspect.signature(construct).parameters.values()
        ]
        defaults = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
        values = {name: getattr(self, name, default) for name, default in defaults.items()}
        return {name: value for name, value in values.items() if value != defaults[name]}

    @classmethod
    def from_pretrained(
        cls,
        name: str | Path,
        *,
        revision: str | None = None,
        cache_dir: str | Path | None = None,
        token: str | bool | None = None,
        **settings: Any,
    ) -> Self:
        """Load a model in evaluation mode, whose weights do not require a gradient.

        Args:
            name: Folder of a checkpoint or of a training run, name of a checkpoint that ships with
                hlsim, or ``user/name`` of a repository of the Hub, which is downloaded unless it is
                in the cache.
            revision: Branch, tag or commit of the repository.
            cache_dir: Folder of downloads instead of that of huggingface_hub.
            token: Token of a private repository.
            settings: Arguments of the class, such as ``sample_rate``.

        Raises:
            ValueError: There is no such checkpoint, it is damaged or of another kind, or a setting
                is out of range.
            OSError: The repository does not exist or cannot be downloaded.
            MissingExtraError: A repository is to be downloaded, and the extra ``hub`` is missing.
        """
        try:
            folder = _find_folder(name)
        except ValueError:
            if not re.fullmatch(r"[\w.-]+/[\w.-]+", str(name)):
                raise
            hub = require("huggingface_hub", "hub")
            files = [WEIGHTS, CONFIG, CARD]
            folder = hub.snapshot_download(
                str(name),
                revision=revision,
                cache_dir=cache_dir,
                token=token,
                allow_patterns=files,
            )
        return cast(Self, read_checkpoint(folder, [cls], **settings))

    def push_to_hub(
        self,
        name: str,
        *,
        private: bool | None = None,
        token: str | bool | None = None,
        commit_message: str = "Upload a model of hlsim",
        **card: Any,
    ) -> str:
        """Upload the model to a repository of the Hub, which is created if there is none.

        Args:
            name: ``user/name`` of the repository.
            private: Whether a new repository is private; None is the default of the account.
            token: Token with the right to write; by default that of ``hf auth login``.
            commit_message: Title of the commit.
            card: Arguments of ``save_pretrained`` other than the folder.

        Returns:
            Address of the commit.

        Raises:
            ValueError: A weight is NaN or infinite.
            OSError: The Hub cannot be reached, or refuses the upload.
            MissingExtraError: The extra ``hub`` is not installed.
        """
        api = require("huggingface_hub", "hub").HfApi(token=token)
        repository = api.create_repo(name, private=private, exist_ok=True).repo_id
        with TemporaryDirectory() as parent:
            folder = Path(parent) / repository.split("/")[-1]
            self.save_pretrained(folder, **card)
            return str(
                api.upload_folder(
                    repo_id=repository, folder_path=folder, commit_message=commit_message
                )
            )
