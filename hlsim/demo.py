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
from hlsim.audiogram import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.resample import resample
from hlsim.evaluation import HaspiReport, ItemScore
from hlsim.evaluation.judging import NORMAL, Unaided
from hlsim.evaluation.scoring import HaspiItem, haspi_many
from hlsim.metrics.pair import check_pair
from hlsim.msbg import MSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import one_thread
from hlsim.report.haspi import markdown, write_report
from hlsim.report.pictures import draw_spectrograms
from hlsim.report.tables import Table
from hlsim.training.batches import TrainingData
from hlsim.training.compensator import train_compensator
from hlsim.training.recipes import CompensatorRecipe

SPEECH_LEVEL = 65.0
"""Level in dB SPL at which the utterances are given to the unaided ear and to the compensators."""

FEWEST_SCORED = 8

_HEARD = "level heard, against a normal ear (dB)"
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
    """Train, score, and write report, audio and pictures into a folder; returns the report as Markdown.

    Args:
        speech: folder to use instead of the embedded speech; every third file is scored and not trained on.
        minutes: of training.
        report: called with a line of progress.

    Raises:
        ValueError: unusable audio, one of under 0.7 s among the scored, or fewer than 22 files in ``speech``.
    """
    folder = Path(out)
    training, scored = _split(speech)
    clean = [_read(path) for path in scored]
    for path, utterance in zip(scored, clean, strict=True):  # not after minutes of training
        check_pair(utterance, utterance, NEURO_RATE, names=(str(path), str(path)))
    recipe = CompensatorRecipe(seed=seed)
    report(f"training on {len(training)} utterances for {minutes:g} minutes, ear {_name(audiogram)}")
    data, where = TrainingData(speech=training), folder / "training"
    with one_thread():  # the steps are small: on a busy machine two threads wait for each other
        checkpoint = train_compensator(
            data, recipe, out=where, audiogram=audiogram, max_minutes=minutes, report=report
        )
    torch.manual_seed(seed)
    conditions: dict[str, nn.Module] = {
        "unaided": Unaided(),
        "nalr": NALR(),
        "initial": MappingCompensator(MappingConfig.from_dict(recipe.model)).eval(),
        "compensated": load_compensator(checkpoint),
    }
    report(f"scoring {len(scored)} other utterances by HASPI, {len(conditions)} conditions")
    ear, normal = (MSBG(a, sample_rate=NEURO_RATE) for a in (audiogram, NORMAL))
    heard: dict[str, list[Tensor]] = {}
    haspi: dict[str, list[float]] = {}
    levels: dict[str, list[float]] = {}
    with torch.no_grad():
        normally = fmean(_levels([normal(utterance) for utterance in clean]))
        extra: dict[str, object] = {"normal_heard_level_mean": normally}
        rows = []
        for name, model in conditions.items():
            given = [model(utterance, audiogram) for utterance in clean]
            pairs = zip(clean, given, strict=True)
            items = [HaspiItem(utterance, aided, audiogram, NEURO_RATE) for utterance, aided in pairs]
            haspi[name], levels[name] = haspi_many(items, seed=seed % 2**32), _levels(given)
            heard[name] = [ear(signal) for signal in given]
            mean, level = fmean(haspi[name]), fmean(levels[name])
            off = fmean(_levels(heard[name])) - normally
            report(f"  {name}: mean HASPI {mean:.3f}")
            rows.append((name, f"{mean:.3f}", f"{level:.1f}", f"{off:+.1f}"))
            extra |= {f"{name}_mean": mean, f"{name}_level_mean": level}
            extra |= {f"{name}_heard_difference_db": off, f"{name}_haspi": haspi[name]}

    names = _names(scored, speech)
    ends = {"before": "unaided", "after": "compensated"}
    scores = [
        ItemScore(
            file=names[i],
            scores={"haspi": {end: haspi[name][i] for end, name in ends.items()}},
            clean_level=float(level_spl(clean[i])),
            levels={end: levels[name][i] for end, name in ends.items()},
            audiogram=audiogram,
            sample_rate=NEURO_RATE,
            seconds=len(clean[i]) / NEURO_RATE,
            seed=(seed + i) % 2**32,
        )
        for i in range(len(scored))
    ]
    result = HaspiReport(items=scores, seed=seed, extra=extra)
    write_report(result, folder)
    header = ("what the ear is given", "HASPI mean", "level given (dB SPL)", _HEARD)
    text = f"# {_name(audiogram)}\n\n{markdown(result)}\n{Table('', header, rows).markdown()}\n"
    (folder / "report.md").write_text(text, encoding="utf-8")
    _write_audio(folder / "audio", names, clean, heard)
    panel = {f"heard, {name}": heard[name][0] for name in ("unaided", "nalr", "compensated")}
    panel = {"original": clean[0], **panel}
    (folder / "spectrograms.png").write_bytes(draw_spectrograms(panel, NEURO_RATE))
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


def _write_audio(folder: Path, names: list[str], clean: list[Tensor], heard: dict[str, list[Tensor]]) -> None:
    """Three files an utterance, all by one gain, so that their loudness can be compared."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        ends = {f"heard-{name}": heard[name][i] for name in ("unaided", "compensated")}
        signals = {"original": clean[i], **ends}
        peak = max(float(signal.abs().max()) for signal in signals.values())
        for kind, signal in signals.items():
            write_audio(folder / f"{name}-{kind}.wav", 0.9 * signal / peak, NEURO_RATE)


def _name(audiogram: Audiogram) -> str:
    levels = ", ".join(f"{level:g}" for level in audiogram.levels)
    return f"{levels} dB HL ({audiogram.severity})"


def _levels(signals: list[Tensor]) -> list[float]:
    return [float(level_spl(signal)) for signal in signals]
