"""Loading of compensators by name, and saving of trained ones in folders."""

from pathlib import Path
from typing import Any

from compensators.beamformer import BeamformingAid
from compensators.directional import behind_front_end
from compensators.hearing_aid import LOUDNESS_RANGE, HearingAid
from compensators.mapping import MappingCompensator
from compensators.nalr import NALR, NALRP
from compensators.wdrc import CAMFIT, WDRC
from hlsim.audiogram import Audiogram, as_audiogram
from hlsim.audiogram.value import EarLike
from hlsim.calibration import NEURO_RATE, PASCAL_SPL
from hlsim.checkpoint import read_checkpoint, read_record
from hlsim.checks import check_flag, check_number, check_rate

Trained = MappingCompensator | HearingAid | BeamformingAid

TRAINED: dict[str, type[Trained]] = {
    aid.kind: aid for aid in (MappingCompensator, HearingAid, BeamformingAid)
}
"""Class of each kind of compensator with weights, by the name of the kind in ``config.json``."""

UNTRAINED: dict[str, type[NALR | WDRC]] = {
    "nalr": NALR,
    "nalrp": NALRP,
    "wdrc": WDRC,
    "camfit": CAMFIT,
}
"""Class of each compensator without a checkpoint, by its name."""


def load_compensator(
    name: str | Path,
    *,
    sample_rate: int = NEURO_RATE,
    full_scale_spl: float = PASCAL_SPL,
    linked: bool = False,
    limit_to_ear: bool = False,
    loudness: float = 0.0,
) -> Trained | NALR | WDRC:
    """Load a hearing aid by name, in evaluation mode and without gradients of its weights.

    Nothing is downloaded.

    Args:
        name: A prescription, ``"nalr"``, ``"nalrp"`` (for profound losses) or ``"camfit"`` (with
            compression); ``"wdrc"``, NAL-R with compression; a checkpoint that ships with hlsim,
            such as ``"hearing-aid"``; or the folder of a checkpoint or of a training run. If an aid
            was trained for one ear, ``trained_for`` returns this ear.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.
        linked: Give two ears, (..., 2, time), gains from their mean power, so that the differences
            in level between them stay if their audiograms are equal. ``WDRC``, ``CAMFIT`` and
            ``HearingAid`` support this, also behind a front end.
        limit_to_ear: Limit the level of the output in each band below the uncomfortable level of
            the ear, see ``HearingAid``, in the same aids.
        loudness: Loudness of the output for the impaired ear, in dB relative to a normal ear, -40
            to 0. Only ``HearingAid`` supports it, also behind a front end.

    Raises:
        ValueError: There is no such checkpoint, it is of another kind or has changed since it was
            saved, the rate or a level is out of range, ``linked`` or ``limit_to_ear`` is neither
            True nor False, or a setting is given for an aid that does not support it.

    >>> import hlsim
    >>> aid = load_compensator("hearing-aid")
    >>> output = aid(hlsim.example_speech(), "N3")
    """
    check_rate(sample_rate)
    check_flag("linked", linked)
    check_flag("limit_to_ear", limit_to_ear)
    check_number("loudness", loudness, *LOUDNESS_RANGE)
    levels: dict[str, Any] = {"sample_rate": sample_rate, "full_scale_spl": full_scale_spl}
    compensator: Trained | NALR | WDRC
    if str(name) in UNTRAINED:
        compensator = UNTRAINED[str(name)](**levels)
    else:
        compensator = read_checkpoint(name, [*TRAINED.values()], **levels)
    compensator.eval()
    amplifier = behind_front_end(compensator)
    settings = {"linked": linked, "limit_to_ear": limit_to_ear, "loudness": loudness}
    for setting, value in settings.items():
        if hasattr(amplifier, setting):
            setattr(amplifier, setting, value)
        elif value:
            raise ValueError(
                f"{name} has no setting {setting}; load an aid that has it, such as hearing-aid, "
                f"or leave out {setting}"
            )
    return compensator


def save_compensator(model: Trained, folder: str | Path, audiogram: EarLike | None = None) -> None:
    """Save a trained compensator as a folder, which ``load_compensator`` loads.

    A checkpoint that is already there is replaced. A card, README.md, is written too, unless the
    folder has one that hlsim did not write. The sample rate, ``full_scale_spl``, ``linked``,
    ``limit_to_ear`` and ``loudness`` are not saved, see ``save_pretrained``.

    Args:
        model: Compensator to save.
        folder: Folder of the checkpoint.
        audiogram: Ear for which the compensator was trained, such as ``"N3"``; None if it was
            trained for all ears.

    Raises:
        ValueError: The model is no ``MappingCompensator``, ``HearingAid`` or ``BeamformingAid``, a
            weight is NaN or infinite, the ear is not valid, or the folder cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_compensator(HearingAid(), f"{folder}/mine")
    ...     aid = load_compensator(f"{folder}/mine")
    """
    if not isinstance(model, Trained):
        raise ValueError(
            "expected a MappingCompensator, a HearingAid or a BeamformingAid to save, got "
            f"{type(model).__name__}"
        )
    ear = None if audiogram is None else as_audiogram(audiogram).to_dict()
    model.save_pretrained(folder, about={"audiogram": ear})


def trained_for(name: str | Path) -> Audiogram | None:
    """Return the ear for which a compensator was trained, or None if there is no single one.

    This is so for aids for all ears, prescriptions and checkpoints of simulators.

    Args:
        name: Name or folder, as in ``load_compensator``.

    Raises:
        ValueError: There is no such checkpoint, its ``config.json`` cannot be read, or the record
            of the ear is not valid.

    >>> trained_for("hearing-aid") is None
    True
    """
    if str(name) in UNTRAINED:
        return None
    about = read_record(name).get("about", {})
    try:
        audiogram = about.get("audiogram")
        return None if audiogram is None else Audiogram(**audiogram)
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{name}: expected levels and frequencies as about.audiogram in config.json, or null "
            f"for all ears, got {about!r}; correct the file ({error})"
        ) from error
