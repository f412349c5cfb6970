"""Noises for training and test: disjoint types, one of them and one SNR an utterance, and how they are mixed in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

import torch
from torch import Tensor

from hlsim.calibration import dbfs
from hlsim.data.checking import fault_of, read_sound
from hlsim.data.corpora import BAD_NAME, SPLIT_FOLDERS, Fault, linked_folders, walk_audio
from hlsim.data.manifest import Utterance, printable, storable
from hlsim.data.plan_settings import PlanSettings

_QUIET_DB = 30.0  # a stretch this far below its recording's level counts as a pause of the noise
_STEP, _STRETCH = (
    0.1,
    5,
)  # s from one possible start to the next, and how many of these are no pause
_BESIDE = "beside the folders of splits; move it into one"


Types = Mapping[str, list[tuple[str, Sequence[float]]]]
"""Files of noise by type: the path below the root, and the places where one may start, in seconds."""


@dataclass(frozen=True)
class Noises:
    """Noises and their SNRs in dB by split."""

    files: Mapping[str, Types]
    snrs: Mapping[str, Sequence[float]]

    def choose(self, utterance: Utterance, seed: int) -> Utterance:
        """The utterance with one type, file, start and SNR, drawn from the seed and its id."""
        draw = Random(f"{seed}:noise:{utterance.id}")
        types = self.files[utterance.split]
        path, starts = draw.choice(types[draw.choice(sorted(types))])
        snr = draw.choice(self.snrs[utterance.split])
        return replace(utterance, noise=path, snr=snr, noise_start=draw.choice(starts))


def find_noises(
    root: Path, folder: str, splits: Iterable[str], settings: PlanSettings
) -> tuple[Noises, list[Fault]]:
    """Noises below ``root / folder``, and what is at fault there.

    A type is the folder that holds a file, or the file's own name on top. Folders train, valid and test on top give the
    splits their types; otherwise they are drawn from the seed, ``train_types`` and ``test_types`` of them, or of fewer
    all, a fifth of them for test. Validation takes training's types and SNRs unless it has a folder.

    Raises:
        ValueError: no noise that can be used, too few types, or types or SNRs that are not disjoint.
    """
    snrs = {"train": settings.train_snrs, "valid": settings.train_snrs, "test": settings.test_snrs}
    if shared := ", ".join(f"{snr:g}" for snr in sorted({*snrs["train"]} & {*snrs["test"]})):
        raise ValueError(f"SNRs {shared} dB for training and test; allowed: disjoint sets")
    kinds: dict[str, dict[str, list[tuple[str, Sequence[float]]]]] = {}
    faults = list(linked_folders(root / folder, folder))
    for path in walk_audio(root / folder):
        folders = path.split("/")[:-1]
        split = SPLIT_FOLDERS.get("".join(folders[:1]), "")
        kind = "/".join(folders[bool(split) :]) or Path(path).stem
        name = f"{folder}/{path}" if folder else path
        if not storable(name):
            faults.append(Fault(printable(name), BAD_NAME))
            continue
        try:
            waveform, rate = read_sound(root, name, any_rate=True)
        except ValueError as error:
            faults.append(fault_of(root, name, error))
            continue
        kinds.setdefault(split, {}).setdefault(kind, []).append((name, _starts(waveform[0], rate)))
    if not kinds:
        raise ValueError(f"{root / folder}: no noise in it that can be used")
    if len(kinds) > 1:
        for name, _ in (file for members in kinds.pop("", {}).values() for file in members):
            faults.append(Fault(name, _BESIDE))
    files: dict[str, Types] = {**kinds}
    if set(kinds) == {""}:
        files = _drawn(kinds[""], settings.train_types, settings.test_types, settings.seed)
    if "valid" not in files and "train" in files:
        files["valid"] = files["train"]
    for split in splits:
        if split not in files:
            raise ValueError(
                f"{root / folder}: no noise for {split}; allowed: a folder {split} in it, or two types or more and no "
                "such folders"
            )
    if both := sorted(set(files.get("train", ())) & set(files.get("test", ()))):
        raise ValueError(
            f"{root / folder}: {', '.join(both)} for training and test; allowed: disjoint types"
        )
    return Noises(files, snrs), faults


def _drawn(types: Types, train: int, test: int, seed: int) -> dict[str, Types]:
    names = sorted(types)
    Random(f"{seed}:noise types").shuffle(names)
    if len(names) < train + test:
        test = min(test, round(len(names) / 5) or 1) if len(names) > 1 else 0
        train = len(names) - test
    chosen = {"train": names[:train], "test": names[train : train + test]}
    return {split: {name: types[name] for name in part} for split, part in chosen.items() if part}


def _starts(noise: Tensor, rate: int) -> tuple[float, ...]:
    """Seconds at which half a second begins that is no pause; the file counts as repeated where it ends."""
    step = round(_STEP * rate)
    if len(noise) < step:
        return (0.0,)
    powers = noise[: len(noise) // step * step].square().unflatten(0, (-1, step)).mean(-1).double()
    ahead = torch.stack([powers.roll(-k) for k in range(_STRETCH)]).mean(0)
    loud = ahead >= powers.mean() * 10.0 ** (-_QUIET_DB / 10.0)
    return tuple(round(_STEP * k, 1) for k in loud.nonzero().squeeze(-1).tolist())


def mix_at(speech: Tensor, noise: Tensor, snr: float, active_db: float) -> Tensor:
    """Speech with noise at an SNR in dB of the speech's active level, in dB relative to RMS 1.0, over the noise's RMS.

    Shape: (time,) twice -> (time,).
    """
    return speech + noise * 10.0 ** ((active_db - snr - float(dbfs(noise))) / 20.0)
