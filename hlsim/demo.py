"""``hlsim demo``: a compensator for one ear, trained through the frozen Neuro-MSBG, judged on speech it never saw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor, nn

from compensators import NALR, MappingCompensator, load_compensator
from compensators.config import MappingConfig
from hlsim.audio import find_audio, read_audio, write_audio
from hlsim.audiogram import STANDARD, Audiogram
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.dsp.resample import resample
from hlsim.evaluation.aids import AtLevelOf, Unaided
from hlsim.evaluation.items import INPUT_LEVELS
from hlsim.evaluation.measurements import gain_curves
from hlsim.evaluation.measures import NORMAL
from hlsim.evaluation.previous.haspi_report import HaspiReport
from hlsim.evaluation.previous.scores import ItemScore
from hlsim.files import write_whole
from hlsim.metrics.pair import check_pair
from hlsim.metrics.registry import MEASURES
from hlsim.msbg import MSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import one_thread
from hlsim.report.previous.demo import (
    AS_LOUD,
    NORMAL_EAR,
    PRESCRIBED,
    TRAINED,
    UNAIDED,
    Sounds,
    demo_front,
    result_table,
)
from hlsim.report.previous.haspi import write_report
from hlsim.report.previous.tables import loss_name
from hlsim.training.batches import TrainingData
from hlsim.training.compensator import train_compensator
from hlsim.training.recipes import CompensatorRecipe
from hlsim.version import __version__

SPEECH_LEVEL = 65.0
"""Level in dB SPL at which the utterances are given to the unaided ear and to the compensators."""

DEMO_STEPS = 3000
"""Number of training steps: about three minutes on two cores."""

FEWEST_SCORED = 8

_EMBEDDED = Path(__file__).parent / "data" / "speech"
_LONGEST = 5.0  # seconds of an utterance that are scored: HASPI takes half as long


def demo(
    out: str | Path,
    audiogram: Audiogram,
    *,
    speech: str | Path | None = None,
    steps: int = DEMO_STEPS,
    seed: int = 0,
    report: Callable[[str], None] = print,
) -> str:
    """Train, score, and write report, audio and pictures into a folder; returns the result in short, for a terminal.

    Args:
        speech: folder to use instead of the embedded speech; every third file is scored and not trained on.
        steps: number of training steps.
        report: called with a line of progress.

    Raises:
        ValueError: unusable audio, one of under 0.7 s among the scored, or fewer than 22 files in ``speech``.
    """
    folder = Path(out)
    training, scored = _split(speech)
    clean = [_read(path) for path in scored]
    for path, utterance in zip(scored, clean, strict=True):  # not after minutes of training
        check_pair(utterance, utterance, NEURO_RATE, names=(str(path), str(path)))
    recipe = CompensatorRecipe(seed=seed, steps=steps)
    report(f"training on {len(training)} utterances, {steps} steps, ear {_name(audiogram)}")
    data, where = TrainingData(speech=training), folder / "training"
    with one_thread():  # the steps are small: on a busy machine two threads wait for each other
        checkpoint = train_compensator(data, recipe, out=where, audiogram=audiogram)
    torch.manual_seed(seed)
    trained, nalr = load_compensator(checkpoint), NALR()
    start = MappingCompensator(MappingConfig.from_dict(recipe.model)).eval()
    # each with the name of its keys in report.json
    conditions: dict[str, tuple[str, nn.Module]] = {
        UNAIDED: ("unaided", Unaided()),
        PRESCRIBED: ("nalr", nalr),
        AS_LOUD: ("nalr_as_loud", AtLevelOf(nalr, trained)),
        "untrained start": ("initial", start),
        TRAINED: ("compensated", trained),
    }
    report(f"scoring {len(scored)} other utterances by HASPI, {len(conditions)} conditions")
    ear, normal = (MSBG(a, sample_rate=NEURO_RATE) for a in (audiogram, NORMAL))
    with torch.no_grad():
        given = {
            name: [model(one, audiogram) for one in clean]
            for name, (_, model) in conditions.items()
        }
        heard = {name: [ear(signal) for signal in signals] for name, signals in given.items()}
        heard[NORMAL_EAR] = [normal(utterance) for utterance in clean]
    seeds = [(seed + i) % 2**32 for i in range(len(scored))]
    haspi: dict[str, list[float]] = {}
    for name, signals in given.items():
        with one_thread():
            haspi[name] = [
                MEASURES["haspi"].score(
                    utterance, signal, audiogram, NEURO_RATE, PASCAL_SPL, own_seed
                )
                for utterance, signal, own_seed in zip(clean, signals, seeds, strict=True)
            ]
        report(f"  {name}: mean HASPI {fmean(haspi[name]):.3f}")
    levels, heard_levels = (
        {name: _levels(own) for name, own in of.items()} for of in (given, heard)
    )
    normally = fmean(heard_levels[NORMAL_EAR])
    heard_off = {name: fmean(heard_levels[name]) - normally for name in conditions}
    extra: dict[str, object] = {"normal_heard_level_mean": normally}
    for name, (key, _) in conditions.items():
        extra |= {f"{key}_mean": fmean(haspi[name]), f"{key}_level_mean": fmean(levels[name])}
        extra[f"{key}_heard_difference_db"] = heard_off[name]
    names = _names(scored, speech)
    scores = [
        ItemScore(
            file=names[i],
            scores={"haspi": {name: haspi[name][i] for name in conditions}},
            clean_level=float(level_spl(clean[i])),
            levels={name: levels[name][i] for name in conditions},
            audiogram=audiogram,
            sample_rate=NEURO_RATE,
            seconds=len(clean[i]) / NEURO_RATE,
            seed=seeds[i],
        )
        for i in range(len(scored))
    ]
    result = HaspiReport(items=scores, seed=seed, extra=extra)
    shortest = torch.stack([utterance[: min(map(len, clean))] for utterance in clean])
    curves = gain_curves(
        {PRESCRIBED: nalr, TRAINED: trained}, {_name(audiogram): audiogram}, shortest, INPUT_LEVELS
    )
    table = result_table(result, heard_off)
    front, picture = demo_front(result, table, Sounds(names, clean, given, heard), curves)
    write_report(result, folder, front=front)
    write_whole(folder / "spectrograms.png", picture)
    _write_audio(
        folder / "audio", names, clean, {key: heard[name] for name, (key, _) in conditions.items()}
    )
    origin = f"hlsim {__version__}, torch {torch.__version__}, seed {seed}, {steps} training steps"
    page = folder / "report.html"
    return f"\n{front.lead}\n\n{table.text()}\n\nMade with {origin}.\nThe page: {page}"


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
    names = ["-".join(path.relative_to(root).with_suffix("").parts) for path in files]
    return [name if names.count(name) == 1 else f"{name}-{i}" for i, name in enumerate(names)]


def _write_audio(
    folder: Path, names: list[str], clean: list[Tensor], heard: dict[str, list[Tensor]]
) -> None:
    """The original and what is heard of each condition, by one gain, so that their loudness can be compared."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        signals = {"original": clean[i], **{f"heard-{name}": own[i] for name, own in heard.items()}}
        peak = max(float(signal.abs().max()) for signal in signals.values())
        for kind, signal in signals.items():
            write_audio(folder / f"{name}-{kind}.wav", 0.9 * signal / peak, NEURO_RATE)


def _name(audiogram: Audiogram) -> str:
    levels = ", ".join(f"{level:g}" for level in audiogram.levels)
    standard = [name for name, own in STANDARD.items() if audiogram == Audiogram(own)]
    return f"{standard[0] if standard else f'{levels} dB HL'} ({loss_name(audiogram.severity)})"


def _levels(signals: list[Tensor]) -> list[float]:
    return [float(level_spl(signal)) for signal in signals]
