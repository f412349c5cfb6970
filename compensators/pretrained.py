"""A name or a folder to a compensator that is ready to use."""

from pathlib import Path

from compensators.config import HearingAidConfig, MappingConfig
from compensators.hearing_aid import HearingAid
from compensators.mapping import MappingCompensator
from compensators.nalr import NALR
from compensators.wdrc import WDRC
from compensators.wearable import Wearable
from hlsim.audiogram import Audiogram
from hlsim.calibration import PASCAL_SPL
from hlsim.neuro.config import NEURO_RATE
from hlsim.pretrained import checkpoint_about, read_checkpoint, save_checkpoint
from hlsim.version import __version__

Trained = MappingCompensator | HearingAid

CONFIGS: dict[str, type[MappingConfig | HearingAidConfig]] = {
    "mapping-compensator": MappingConfig,
    "hearing-aid": HearingAidConfig,
}
"""What ``config.json`` of a checkpoint calls the kind of compensator, and what it is made of."""

_UNTRAINED: dict[str, type[NALR | WDRC]] = {"nalr": NALR, "wdrc": WDRC}


def build_compensator(
    config: MappingConfig | HearingAidConfig,
    *,
    sample_rate: int = NEURO_RATE,
    full_scale_spl: float = PASCAL_SPL,
) -> Trained:
    """The compensator that a configuration is of, untrained."""
    if isinstance(config, HearingAidConfig):
        return HearingAid(config, sample_rate=sample_rate, full_scale_spl=full_scale_spl)
    return MappingCompensator(config, sample_rate=sample_rate, full_scale_spl=full_scale_spl)


def load_compensator(
    name: str | Path,
    *,
    sample_rate: int = NEURO_RATE,
    full_scale_spl: float = PASCAL_SPL,
    linked: bool = False,
) -> Trained | NALR | WDRC:
    """A compensator, frozen and in eval mode. Nothing is downloaded.

    Args:
        name: ``"nalr"``, the prescription; ``"wdrc"``, compression about it; a checkpoint that ships with hlsim; or a
            checkpoint folder. One that was trained for one ear is meant for no other: see ``trained_for``.
        sample_rate: of its inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of RMS 1.0.
        linked: a hearing aid's or WDRC's gains are linked between the ears, see ``compensators.wearable``.

    Raises:
        ValueError: no such checkpoint, one of another kind, one that has changed since it was saved, or ``linked`` of one
            that cannot.
    """
    loaded = _load(name, sample_rate, full_scale_spl)
    if linked and not isinstance(loaded, Wearable):
        raise ValueError(f"{name} links no gains between ears; allowed: wdrc, or a hearing aid")
    if isinstance(loaded, Wearable):
        loaded.linked = linked
    return loaded


def _untrained(name: str | Path) -> type[NALR | WDRC] | None:
    """Class of a compensator without checkpoint; its name may be written as ``NAL-R``."""
    return _UNTRAINED.get(str(name).lower().replace("-", ""))


def _load(name: str | Path, sample_rate: int, full_scale_spl: float) -> Trained | NALR | WDRC:
    if kind := _untrained(name):
        return kind(sample_rate=sample_rate, full_scale_spl=full_scale_spl).eval()

    def build(config: MappingConfig | HearingAidConfig) -> Trained:
        return build_compensator(config, sample_rate=sample_rate, full_scale_spl=full_scale_spl)

    return (
        read_checkpoint(name, CONFIGS, build, other_names=tuple(_UNTRAINED))
        .eval()
        .requires_grad_(False)
    )


def save_compensator(
    model: Trained, folder: str | Path, audiogram: Audiogram | None = None
) -> None:
    """Write a checkpoint that ``load_compensator`` reads, whole or not at all; an older one there is replaced.

    Rate and level are no part of it: ``load_compensator`` is told them. An older one's card stays, and is of that one.

    Args:
        audiogram: the one ear that it was trained for, see ``trained_for``; None for all ears.

    Raises:
        ValueError: another kind of model, or a folder that holds something else.
    """
    if not isinstance(model, Trained):
        allowed = "a MappingCompensator or HearingAid"
        raise ValueError(f"{type(model).__name__} cannot be saved; allowed: {allowed}")
    kind = next(kind for kind, config in CONFIGS.items() if isinstance(model.config, config))
    about = {
        "hlsim": __version__,
        "audiogram": audiogram.to_dict() if audiogram is not None else None,
    }
    save_checkpoint(folder, kind, model, model.config.to_dict(), about)


def trained_for(name: str | Path) -> Audiogram | None:
    """The one ear that a compensator was trained for; None for those of all ears.

    Raises:
        ValueError: no such checkpoint, or what it tells is no ear.
    """
    told = None if _untrained(name) else checkpoint_about(name).get("audiogram")
    return None if told is None else Audiogram.from_dict(told)
