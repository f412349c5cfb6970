"""``hlsim demo``: an aid for one ear, trained through the frozen Neuro-MSBG and then scored."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from compensators import NALR, load_compensator
from hlsim.audio import find_audio, read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.evaluation.aid_properties import measure_aids, measure_gain_curve
from hlsim.evaluation.aids import AtLevelOf, Unaided
from hlsim.evaluation.comparison import compare
from hlsim.evaluation.items import INPUT_LEVELS, ear_name
from hlsim.evaluation.measures import LEVELS, MEASURES, NORMAL, PERCEPTION, perceive
from hlsim.evaluation.parallel import Progress, one_thread
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.study import Condition, Item
from hlsim.metrics import HaspiReference
from hlsim.neuro.config import NEURO_RATE
from hlsim.report.demo import (
    NAL_R,
    NAL_R_AT_LEVEL,
    TRAINED,
    UNAIDED,
    demo_page,
    result_table,
)
from hlsim.report.page import write_page
from hlsim.report.players import NORMAL_EAR
from hlsim.training.batches import TrainingData
from hlsim.training.compensator import train_compensator
from hlsim.training.recipes import CompensatorRecipe

_SPEECH_LEVEL = 65.0
"""Level of the utterances in dB SPL, without an aid and as input of the aids."""

_MIN_SCORED = 8
"""Smallest number of utterances to score."""

_BUNDLED = Path(__file__).parent / "data" / "speech"
_MAX_SECONDS = 5.0  # of an utterance that is scored, so that HASPI takes half as long


def demo(
    out: str | Path,
    audiogram: Audiogram,
    *,
    speech: str | Path | None = None,
    steps: int = 3000,
    seed: int = 0,
    jobs: int | None = 1,
    report: Callable[[str], None] = print,
    progress: Progress | None = None,
) -> str:
    """Train a hearing aid for one ear, and compare it with no aid and with NAL-R by HASPI.

    The folder ``out`` receives a page, ``report.html``, the sounds, and the trained checkpoint.

    Args:
        out: Folder of the results.
        audiogram: The ear.
        speech: Folder to use instead of the bundled speech; every third file is scored, and the
            others are trained on.
        steps: Number of training steps; 3000 take about three minutes on two cores.
        seed: Seed of every random draw.
        jobs: Number of processes that compute scores.
        report: Function that is called with lines about the current work.
        progress: Function that is called with the number of values so far and of all values.

    Returns:
        Verdict, table and address of the page, for a terminal.

    Raises:
        ValueError: Audio that cannot be used, fewer than 22 files in ``speech``, or a file to score
            that lasts less than 0.7 s.
    """
    folder = Path(out)
    training, scored = _split(speech)
    items = _read_items(scored, speech, audiogram, seed)
    ear = f"{ear_name(audiogram)} (pure-tone average {audiogram.pta:.0f} dB HL)"
    report(f"Training on {len(training)} utterances for the ear {ear}, {steps} steps")
    with one_thread():  # the steps are small: on a busy machine two threads wait for each other
        checkpoint = train_compensator(
            TrainingData(speech=training),
            CompensatorRecipe(seed=seed, steps=steps),
            out=folder / "training",
            audiogram=audiogram,
        )
    trained, nal_r = load_compensator(checkpoint), NALR()
    conditions = [
        Condition(UNAIDED, Unaided(), "unaided"),
        Condition(NAL_R, nal_r, "prescription"),
        Condition(NAL_R_AT_LEVEL, AtLevelOf(nal_r, trained), "same level", TRAINED),
        Condition(TRAINED, trained),
    ]
    report(f"Scoring {len(items)} other utterances under {len(conditions)} conditions")
    evaluation = Evaluation.run(
        items,
        conditions,
        [MEASURES["haspi"], LEVELS, PERCEPTION],
        store=None,
        settings={"seed": seed, "training_steps": steps},
        jobs=jobs,
        progress=progress,
    )
    planned = [("haspi", NAL_R_AT_LEVEL, TRAINED)]
    comparisons = compare(evaluation.table, ["haspi"], planned=planned)
    shortest = min(len(item.clean) for item in items)
    utterances = torch.stack([item.clean[:shortest] for item in items])
    aids = {NAL_R: nal_r, TRAINED: trained}
    curves = measure_aids(aids, {ear: audiogram}, measure_gain_curve, utterances, INPUT_LEVELS)
    evaluation = replace(
        evaluation,
        comparisons=[comparison for comparison in comparisons if comparison.planned],
        details={"gain_curves": curves},
    )
    outputs, perceived = _compute_signals(items, conditions)
    page = demo_page(evaluation, ear, outputs, perceived, _sentence(scored[-1]))
    path = write_page(page, evaluation.to_dict(), folder)
    _write_audio(folder / "audio", items, {"output": outputs, "perceived": perceived})
    return f"\n{page.verdict}\n\n{result_table(evaluation).text()}\n\n{path.as_uri()}"


def _split(speech: str | Path | None) -> tuple[list[Path], list[Path]]:
    """Return the files to train on and the files to score."""
    if speech is None:
        return find_audio(_BUNDLED / "train"), find_audio(_BUNDLED / "valid")
    files = find_audio(speech)
    scored = files[::3]
    if len(scored) < _MIN_SCORED:
        raise ValueError(
            f"expected {3 * _MIN_SCORED - 2} or more audio files, of which a third is scored, got "
            f"{len(files)} in {speech}; add files"
        )
    return [path for path in files if path not in scored], scored


def _read_items(
    files: list[Path], speech: str | Path | None, audiogram: Audiogram, seed: int
) -> list[Item]:
    """Read and check the utterances to score, each with a seed of its own."""
    facts = {"severity": audiogram.severity, "audiogram": list(audiogram.thresholds)}
    names = _name_files(files, _BUNDLED / "valid" if speech is None else Path(speech))
    items = []
    for number, (name, path) in enumerate(zip(names, files, strict=True)):
        waveform, rate = read_audio(path)
        clip = resample(waveform[0], rate, NEURO_RATE)[: round(_MAX_SECONDS * NEURO_RATE)]
        clean = set_level(clip, _SPEECH_LEVEL)
        try:
            HaspiReference(clean, sample_rate=NEURO_RATE, keep=False)
        except ValueError as error:
            raise ValueError(f"{path} cannot be scored: {error}") from error
        item_seed = (seed + number) % 2**32
        items.append(Item(name, clean, clean, audiogram, seed=item_seed, facts=facts))
    return items


def _name_files(files: list[Path], root: Path) -> list[str]:
    """Name files by their path below a folder, for several speakers may have a 001.wav."""
    names = ["-".join(path.relative_to(root).with_suffix("").parts) for path in files]
    return [name if names.count(name) == 1 else f"{name}-{i}" for i, name in enumerate(names)]


def _compute_signals(
    items: list[Item], conditions: list[Condition]
) -> tuple[dict[str, list[Tensor]], dict[str, list[Tensor]]]:
    """Compute the outputs of all items, and what the ear perceives of them.

    Returns:
        Two dictionaries, the outputs and the perceived signals: one signal per item, by condition.
        The second one begins with clean speech as a normal ear perceives it, under ``NORMAL_EAR``.
    """
    with torch.no_grad():
        outputs = {
            condition.name: [condition.output(item) for item in items] for condition in conditions
        }
    perceived = {NORMAL_EAR: [perceive(item.clean, NORMAL, NEURO_RATE) for item in items]}
    for name, signals in outputs.items():
        perceived[name] = [perceive(signal, items[0].ear, NEURO_RATE) for signal in signals]
    return outputs, perceived


def _write_audio(
    folder: Path, items: list[Item], signals: dict[str, dict[str, list[Tensor]]]
) -> None:
    """Write all signals with one gain per item, so that their loudness can be compared.

    Args:
        folder: Folder for the files.
        items: The utterances.
        signals: One signal per item, by condition, by kind of signal (``output``, ``perceived``).
    """
    for number, item in enumerate(items):
        files = {}
        for kind, signals_by_condition in signals.items():
            for condition, item_signals in signals_by_condition.items():
                name = re.sub(r"[^\w-]+", "-", f"{kind}-{condition}").strip("-")
                files[folder / f"{item.name}-{name}.wav"] = item_signals[number]
        peak = max(float(signal.abs().max()) for signal in files.values())
        for path, signal in files.items():
            write_audio(path, 0.9 * signal / peak, NEURO_RATE)


def _sentence(path: Path) -> str:
    """Return the words of a bundled utterance; an empty text for other files."""
    table = (_BUNDLED / "README.md").read_text(encoding="utf-8")
    row = re.search(rf"`valid/{re.escape(path.name)}` \| [^|]+ \| ([^|]+) \|", table)
    return row[1] if row and path.is_relative_to(_BUNDLED) else ""
