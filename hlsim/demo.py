"""``hlsim demo``: a compensator for one ear, trained through the frozen Neuro-MSBG, judged on speech it never saw."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from compensators import NALR, MappingCompensator, load_compensator
from compensators.config import MappingConfig
from hlsim.audio import find_audio, read_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.resample import resample
from hlsim.evaluation.scores import HaspiReport, ItemScore
from hlsim.metrics.pyclarity import HaspiItem, check_pair, haspi_many
from hlsim.msbg import MSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.report.haspi import write_report
from hlsim.report.pictures import draw_spectrograms
from hlsim.training.batches import TrainingData
from hlsim.training.compensator import train_compensator
from hlsim.training.recipes import CompensatorRecipe

SPEECH_LEVEL = 65.0
"""Level in dB SPL at which the utterances are given to the unaided ear and to the compensators."""

FEWEST_SCORED = 8

_EMBEDDED = Path(__file__).parent / "data" / "speech"
_LONGEST = 5.0  # seconds of an utterance that are scored: HASPI takes half as long


def demo(
    out: str | Path,
    audiogram: Audiogram,
    *,
    speech: str | Path | None = None,
    minutes: float = 3.0,
    seed: int = 0,
    report: Callable[[str], None] = print,
) -> str:
    """Train, score, and write report, audio and pictures.

    Args:
        out: folder for the report (as ``write_report``), ``spectrograms.png``, ``audio/`` and ``training/``.
        audiogram: the ear.
        speech: folder to use instead of the embedded speech; every third file is scored and not trained on.
        minutes: of training.
        seed: of training and scoring.
        report: called with a line of progress.

    Returns: the report as Markdown.

    Raises:
        ValueError: unusable audio, one of under 0.7 s among the scored, or fewer than 22 files in ``speech``.
    """
    folder = Path(out)
    training, scored = _split(speech)
    utterances = [_read(path) for path in scored]
    for path, utterance in zip(scored, utterances, strict=True):  # not after minutes of training
        check_pair(utterance, utterance, NEURO_RATE, names=(str(path), str(path)))
    names = _names(scored, speech)
    recipe = CompensatorRecipe(seed=seed)
    report(f"training on {len(training)} utterances for {minutes:g} minutes, ear {_name(audiogram)}")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the steps are small: on a busy machine two threads wait for each other
    try:
        checkpoint = train_compensator(
            TrainingData(speech=training),
            recipe,
            out=folder / "training",
            audiogram=audiogram,
            max_minutes=minutes,
            report=report,
        )
    finally:
        torch.set_num_threads(threads)
    torch.manual_seed(seed)
    conditions: dict[str, nn.Module] = {
        "unaided": nn.Identity(),
        "nalr": NALR(),
        "initial": MappingCompensator(MappingConfig.from_dict(recipe.model)).eval(),
        "compensated": load_compensator(checkpoint),
    }
    report(f"scoring {len(scored)} other utterances by HASPI, {len(conditions)} conditions")
    with torch.no_grad():
        given = {
            name: [_give(model, utterance, audiogram) for utterance in utterances]
            for name, model in conditions.items()
        }
    haspi = {}
    for name, signals in given.items():
        pairs = zip(utterances, signals, strict=True)
        items = [
            HaspiItem(clean, aided, audiogram, NEURO_RATE, (seed + i) % 2**32)
            for i, (clean, aided) in enumerate(pairs)
        ]
        haspi[name] = haspi_many(items)
        report(f"  {name}: mean HASPI {_mean(haspi[name]):.3f}")

    ends = {"before": "unaided", "after": "compensated"}
    scores = [
        ItemScore(
            file=names[i],
            scores={"haspi": {end: haspi[name][i] for end, name in ends.items()}},
            clean_level=float(level_spl(utterances[i])),
            levels={end: float(level_spl(given[name][i])) for end, name in ends.items()},
            audiogram=audiogram,
            sample_rate=NEURO_RATE,
            seconds=len(utterances[i]) / NEURO_RATE,
            seed=(seed + i) % 2**32,
        )
        for i in range(len(scored))
    ]
    heard = _heard(given, utterances, audiogram)
    normal = [float(level_spl(signal)) for signal in heard["normal ear"]]
    table = [
        "| what the ear is given | HASPI mean | level given (dB SPL) | level heard, against a normal ear (dB) |",
        "|---|---|---|---|",
    ]
    extra: dict[str, object] = {"normal_heard_level_mean": _mean(normal)}
    for name, signals in given.items():
        levels = [float(level_spl(signal)) for signal in signals]
        differences = [
            float(level_spl(signal)) - own for signal, own in zip(heard[name], normal, strict=True)
        ]
        extra |= {f"{name}_mean": _mean(haspi[name]), f"{name}_level_mean": _mean(levels)}
        extra[f"{name}_heard_difference_db"] = _mean(differences)
        extra[f"{name}_haspi"] = haspi[name]
        table.append(
            f"| {name} | {_mean(haspi[name]):.3f} | {_mean(levels):.1f} | {_mean(differences):+.1f} |"
        )
    result = replace(HaspiReport(items=scores, seed=seed), extra=extra)
    write_report(result, folder)
    text = f"# {_name(audiogram)}\n\n{result.to_markdown()}\n" + "\n".join(table) + "\n"
    (folder / "report.md").write_text(text, encoding="utf-8")
    _write_audio(folder / "audio", names, utterances, heard)
    panel = {"original": utterances[0]} | {
        f"heard, {name}": heard[name][0] for name in ("unaided", "nalr", "compensated")
    }
    draw_spectrograms(panel, NEURO_RATE, folder / "spectrograms.png")
    report(f"report, audio and pictures are in {folder}")
    return text


def _split(speech: str | Path | None) -> tuple[list[Path], list[Path]]:
    if speech is None:
        return find_audio(_EMBEDDED / "train"), find_audio(_EMBEDDED / "valid")
    files = find_audio(speech)
    scored = files[::3]
    if len(scored) < FEWEST_SCORED:
        raise ValueError(
            f"{speech}: {len(files)} files; allowed: {3 * FEWEST_SCORED - 2} or more, a third is scored"
        )
    return [path for path in files if path not in scored], scored


def _read(path: Path) -> Tensor:
    waveform, rate = read_audio(path)
    clip = resample(waveform[0], rate, NEURO_RATE)[: round(_LONGEST * NEURO_RATE)]
    return set_level(clip, SPEECH_LEVEL)


def _names(files: list[Path], speech: str | Path | None) -> list[str]:
    """What each is called: its path below the folder, for several speakers may have a 001.wav."""
    root = _EMBEDDED / "valid" if speech is None else Path(speech)
    return ["-".join(path.relative_to(root).with_suffix("").parts) for path in files]


def _give(model: nn.Module, utterance: Tensor, audiogram: Audiogram) -> Tensor:
    given: Tensor = model(utterance) if isinstance(model, nn.Identity) else model(utterance, audiogram)
    return given


def _heard(
    given: dict[str, list[Tensor]], clean: list[Tensor], audiogram: Audiogram
) -> dict[str, list[Tensor]]:
    """Every condition through the exact MSBG, and the clean speech through it with no loss."""
    ear, normal = (MSBG(a, sample_rate=NEURO_RATE) for a in (audiogram, Audiogram.standard("NH")))
    with torch.no_grad():
        heard = {name: [ear(signal) for signal in signals] for name, signals in given.items()}
        return heard | {"normal ear": [normal(signal) for signal in clean]}


def _write_audio(folder: Path, names: list[str], clean: list[Tensor], heard: dict[str, list[Tensor]]) -> None:
    """Three files an utterance, all by one gain, so that their loudness can be compared."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        signals = {
            "original": clean[i],
            "heard-unaided": heard["unaided"][i],
            "heard-compensated": heard["compensated"][i],
        }
        peak = max(float(signal.abs().max()) for signal in signals.values())
        for kind, signal in signals.items():
            write_audio(folder / f"{name}-{kind}.wav", 0.9 * signal / peak, NEURO_RATE)


def _name(audiogram: Audiogram) -> str:
    levels = ", ".join(f"{level:g}" for level in audiogram.levels)
    return f"{levels} dB HL ({audiogram.severity})"


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
