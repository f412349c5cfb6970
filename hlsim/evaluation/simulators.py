"""How faithful simulators are to MSBG: the same items through the truth and each of them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import MILDER, Audiogram, draw_thresholds, read_audiograms
from hlsim.calibration import level_spl
from hlsim.data.clips import Clips
from hlsim.data.variation import mix
from hlsim.evaluation.fidelity import (
    fidelity_markdown,
    pesq_wb,
    raw_mse,
    snr_db,
    stoi,
    summarise,
    third_octave_error_db,
)
from hlsim.evaluation.truth import pyclarity_msbg
from hlsim.msbg import MSBG
from hlsim.neuro.config import NEURO_RATE

RATE = NEURO_RATE
LEVELS = (50.0, 60.0, 65.0, 70.0, 80.0)
"""Levels in dB SPL that the items take in turn."""

SNRS_DB = (2.5, 7.5, 12.5, 17.5)
"""Signal-to-noise ratios of the noisy items, the paper's test set."""

Report = Callable[[int, int], None]


def evaluate_simulators(
    simulators: Mapping[str, nn.Module],
    *,
    speech: str | Path,
    audiograms: str | Path,
    out: str | Path,
    noise: str | Path | None = None,
    teacher: str = "pyclarity",
    items: int = 240,
    seconds: float = 3.0,
    seed: int = 0,
    progress: Report | None = None,
) -> dict[str, Any]:
    """Compare simulators with MSBG and write ``fidelity.json`` and ``fidelity.md``.

    Half of the ears are those of the file, a quarter the milder standard ones (NH, N1, N2, S1), a quarter drawn; levels
    are 50 to 80 dB SPL; with ``noise`` every second item is noisy. All is drawn from the seed.

    Args:
        simulators: by name, at 16 kHz and 94 dB SPL full scale.
        speech, noise: folders of recordings.
        audiograms: CSV file of ears.
        out: folder for the two files.
        teacher: ``"pyclarity"``, the reference itself, or ``"msbg"``, hlsim's own.
        items: how many.
        seconds: length of an item; PESQ and STOI want 2 or more.
        progress: called with the items done and all.

    Returns: what ``fidelity.json`` holds.

    Raises:
        ValueError: data that cannot be used, or an unknown teacher.
        MissingExtraError: pyclarity, pystoi or pesq is not installed.
    """
    if teacher not in ("pyclarity", "msbg"):
        raise ValueError(f"teacher {teacher!r}; allowed: pyclarity, msbg")
    if items < 1:
        raise ValueError(f"{items} items; allowed: 1 or more")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    exact = MSBG(sample_rate=RATE)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in simulators}
    for number, (clean, signal, ear, about) in enumerate(
        _items(speech, noise, audiograms, items, seconds, seed)
    ):
        with torch.no_grad():
            truth = pyclarity_msbg(signal, ear, RATE) if teacher == "pyclarity" else exact(signal, ear)
            true = {
                "stoi_true": stoi(clean, truth, RATE).value,
                "pesq_true": pesq_wb(clean, truth, RATE).value,
            }
            for name, simulator in simulators.items():
                heard = simulator(signal, ear).double()
                rows[name].append(about | true | _scores(clean, truth, heard))
        if progress is not None:
            progress(number + 1, items)
    result = {
        "teacher": teacher,
        "items": items,
        "seconds": seconds,
        "seed": seed,
        "simulators": {name: {"summary": summarise(table), "items": table} for name, table in rows.items()},
    }
    for name, text in (("fidelity.json", json.dumps(result, indent=1)), ("fidelity.md", _markdown(result))):
        partial = folder / f".{name}.part"
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, folder / name)
    return result


def _scores(clean: Tensor, truth: Tensor, heard: Tensor) -> dict[str, float | None]:
    return {
        "snr": snr_db(truth, heard),
        "raw_mse": raw_mse(truth, heard),
        "band_error": third_octave_error_db(truth, heard, RATE),
        "stoi_sim": stoi(clean, heard, RATE).value,
        "pesq_sim": pesq_wb(clean, heard, RATE).value,
    }


def _items(
    speech: str | Path,
    noise: str | Path | None,
    audiograms: str | Path,
    items: int,
    seconds: float,
    seed: int,
) -> Sequence[tuple[Tensor, Tensor, Audiogram, dict[str, Any]]]:
    """Clean and presented signal in pascals, ear, and the item's description."""
    generator = torch.Generator().manual_seed(seed)
    clips = Clips(speech, sample_rate=RATE, seconds=seconds)
    noises = Clips(noise, sample_rate=RATE, seconds=seconds, repeat=True) if noise is not None else None
    measured = [ear for _, ear in read_audiograms(audiograms)]
    chosen = []
    for i in range(items):
        clean = clips.draw(1, generator)
        condition = "noisy" if noises is not None and i % 2 else "clean"
        signal = clean
        if noises is not None and condition == "noisy":
            ratio = torch.tensor([SNRS_DB[(i // 2) % len(SNRS_DB)]])
            signal = mix(clean, noises.draw(1, generator), ratio)
        # counters of different periods, so that every ear meets every level and condition
        level = LEVELS[(i // 2) % len(LEVELS)]
        turn = (i // 2) % 4
        if turn < 2:
            ear = measured[int(torch.randint(len(measured), (), generator=generator))]
        elif turn == 2:
            ear = Audiogram.standard(MILDER[(i // 8) % len(MILDER)])
        else:
            ear = Audiogram(tuple(draw_thresholds(1, generator).squeeze(0).tolist()))
        gain = 10.0 ** ((level - float(level_spl(signal))) / 20.0)
        about = {
            "severity": ear.severity,
            "level": level,
            "condition": condition,
            "audiogram": list(ear.thresholds),
        }
        chosen.append(((clean * gain).squeeze(0), (signal * gain).squeeze(0), ear, about))
    return chosen


def _markdown(result: Mapping[str, Any]) -> str:
    lines = [
        f"Against {'pyclarity' if result['teacher'] == 'pyclarity' else 'the exact MSBG'}: {result['items']} items of "
        f"{result['seconds']:g} s, seed {result['seed']}.",
    ]
    for name, entry in result["simulators"].items():
        lines += [f"\n## {name}\n", fidelity_markdown(entry["summary"])]
    return "\n".join(lines) + "\n"
