"""``hlsim demo``: an aid for one ear, trained through the frozen Neuro-MSBG, judged on other speech."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from compensators import NALR, MappingCompensator, load_compensator
from compensators.config import MappingConfig
from hlsim.audio import find_audio, read_audio, write_audio
from hlsim.audiogram import STANDARD, Audiogram
from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.evaluation.aids import AtLevelOf, Unaided
from hlsim.evaluation.comparison import compare
from hlsim.evaluation.items import INPUT_LEVELS
from hlsim.evaluation.measurements import gain_curves
from hlsim.evaluation.measures import LEVELS, MEASURES, PERCEPTION, perceive
from hlsim.evaluation.parallel import Progress, one_thread
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.study import Condition, Item
from hlsim.metrics.pair import check_pair
from hlsim.neuro.config import NEURO_RATE
from hlsim.report.demo import (
    NAL_R,
    NAL_R_AT_LEVEL,
    START,
    TRAINED,
    UNAIDED,
    demo_page,
    result_table,
)
from hlsim.report.page import write_page
from hlsim.report.results import loss_name
from hlsim.training.batches import TrainingData
from hlsim.training.compensator import train_compensator
from hlsim.training.recipes import CompensatorRecipe
from hlsim.version import __version__

SPEECH_LEVEL = 65.0
"""Level of the utterances in dB SPL, without an aid and as input of the aids."""

DEMO_STEPS = 3000
"""Number of training steps: about three minutes on two cores."""

FEWEST_SCORED = 8
"""Number of utterances that have to be scored."""

_EMBEDDED = Path(__file__).parent / "data" / "speech"
_LONGEST_SECONDS = 5.0  # of an utterance that is scored: HASPI takes half as long


def demo(
    out: str | Path,
    audiogram: Audiogram,
    *,
    speech: str | Path | None = None,
    steps: int = DEMO_STEPS,
    seed: int = 0,
    jobs: int | None = 1,
    report: Callable[[str], None] = print,
    progress: Progress | None = None,
) -> str:
    """Train an aid, score it beside others, and write a page and sounds into a folder.

    Args:
        out: folder of the results.
        audiogram: the ear.
        speech: folder to use instead of the embedded speech; every third file is scored and not trained on.
        steps: number of training steps.
        seed: seed of every random draw.
        jobs: number of processes that score.
        report: function that is called with lines about what is being done.
        progress: function that is called with the number of scored outputs and of all.

    Returns: the result in short, for a terminal.

    Raises:
        ValueError: audio that cannot be used, fewer than 22 files in ``speech``, or a scored one that lasts
            less than 0.7 s.
    """
    folder = Path(out)
    training, scored = _split(speech)
    items = _items(scored, speech, audiogram, seed)
    recipe = CompensatorRecipe(seed=seed, steps=steps)
    ear_name = _ear_name(audiogram)
    report(f"training on {len(training)} utterances, {steps} steps, ear {ear_name}")
    with one_thread():  # the steps are small: on a busy machine two threads wait for each other
        checkpoint = train_compensator(
            TrainingData(speech=training), recipe, out=folder / "training", audiogram=audiogram
        )
    torch.manual_seed(seed)
    start = MappingCompensator(MappingConfig.from_dict(recipe.model)).eval()
    trained, nal_r = load_compensator(checkpoint), NALR()
    conditions = [
        Condition(UNAIDED, Unaided(), "unaided"),
        Condition(NAL_R, nal_r, "prescription"),
        Condition(NAL_R_AT_LEVEL, AtLevelOf(nal_r, trained), "same level", TRAINED),
        Condition(START, start),
        Condition(TRAINED, trained),
    ]
    report(f"scoring {len(items)} other utterances under {len(conditions)} conditions")
    measures = [MEASURES["haspi"], LEVELS, PERCEPTION]
    settings = {"seed": seed, "training_steps": steps}
    evaluation = Evaluation.run(
        items, conditions, measures, store=None, settings=settings, jobs=jobs, progress=progress
    )
    shortest = min(len(item.clean) for item in items)
    utterances = torch.stack([item.clean[:shortest] for item in items])
    aids, ears = {NAL_R: nal_r, TRAINED: trained}, {ear_name: audiogram}
    planned = [("haspi", NAL_R_AT_LEVEL, TRAINED)]
    evaluation = replace(
        evaluation,
        comparisons=compare(evaluation.table, ["haspi"], planned=planned),
        details={"gain_curves": gain_curves(aids, ears, utterances, INPUT_LEVELS)},
    )
    perceived = _perceived(items, conditions)
    page = demo_page(evaluation, ear_name, perceived)
    path = write_page(page, evaluation.to_dict(), folder)
    _write_audio(folder / "audio", items, perceived)
    origin = f"hlsim {__version__}, torch {torch.__version__}, seed {seed}, {steps} training steps"
    text = result_table(evaluation).text()
    return f"\n{page.verdict}\n\n{text}\n\nMade with {origin}.\nThe page: {path}"


def _split(speech: str | Path | None) -> tuple[list[Path], list[Path]]:
    """Return the files to train on and the files to score."""
    if speech is None:
        return find_audio(_EMBEDDED / "train"), find_audio(_EMBEDDED / "valid")
    files = find_audio(speech)
    scored = files[::3]
    if len(scored) < FEWEST_SCORED:
        fewest = 3 * FEWEST_SCORED - 2
        raise ValueError(
            f"{speech} has {len(files)} files; the demo needs {fewest} or more, of which it scores a third"
        )
    return [path for path in files if path not in scored], scored


def _items(
    files: list[Path], speech: str | Path | None, audiogram: Audiogram, seed: int
) -> list[Item]:
    items = []
    facts = {"severity": audiogram.severity, "audiogram": list(audiogram.thresholds)}
    for number, (name, path) in enumerate(zip(_names(files, speech), files, strict=True)):
        clean = _read(path)
        check_pair(clean, clean, NEURO_RATE, names=(str(path), str(path)))
        own_seed = (seed + number) % 2**32
        items.append(Item(name, clean, clean, audiogram, seed=own_seed, facts=facts))
    return items


def _read(path: Path) -> Tensor:
    waveform, rate = read_audio(path)
    clip = resample(waveform[0], rate, NEURO_RATE)[: round(_LONGEST_SECONDS * NEURO_RATE)]
    return set_level(clip, SPEECH_LEVEL)


def _names(files: list[Path], speech: str | Path | None) -> list[str]:
    """Name files by their path below the folder, for several speakers may have a 001.wav."""
    root = _EMBEDDED / "valid" if speech is None else Path(speech)
    names = ["-".join(path.relative_to(root).with_suffix("").parts) for path in files]
    return [name if names.count(name) == 1 else f"{name}-{i}" for i, name in enumerate(names)]


def _perceived(items: list[Item], conditions: list[Condition]) -> dict[str, list[Tensor]]:
    """Return what the ear perceives of each item, by condition."""
    with torch.no_grad():
        return {
            condition.name: [
                perceive(condition.output(item), item.ear, NEURO_RATE) for item in items
            ]
            for condition in conditions
        }


def _write_audio(folder: Path, items: list[Item], perceived: dict[str, list[Tensor]]) -> None:
    """Write clean and perceived speech with one gain per item, so that loudness can be compared."""
    folder.mkdir(parents=True, exist_ok=True)
    for place, item in enumerate(items):
        signals = {"clean": item.clean}
        for name, several in perceived.items():
            signals[f"perceived-{name.replace(' ', '-')}"] = several[place]
        peak = max(float(signal.abs().max()) for signal in signals.values())
        for kind, signal in signals.items():
            write_audio(folder / f"{item.name}-{kind}.wav", 0.9 * signal / peak, NEURO_RATE)


def _ear_name(audiogram: Audiogram) -> str:
    levels = ", ".join(f"{level:g}" for level in audiogram.levels)
    standard = [name for name, values in STANDARD.items() if audiogram == Audiogram(values)]
    return f"{standard[0] if standard else f'{levels} dB HL'} ({loss_name(audiogram.severity)})"
