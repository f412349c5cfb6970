"""The study of the command ``demo``: an aid for one ear, trained through Neuro-MSBG and scored."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import Callback

from compensators import NALR, load_compensator
from hlsim.audio import find_audio, read_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import NEURO_RATE, set_level
from hlsim.data.bundled import SPEECH
from hlsim.dsp.resample import resample
from hlsim.evaluation.aid_properties import measure_aids, measure_gain_curve
from hlsim.evaluation.aids import AtLevelOf, Unaided
from hlsim.evaluation.comparison import compare
from hlsim.evaluation.items import INPUT_LEVELS, ear_name
from hlsim.evaluation.measures import LEVELS, MEASURES, NORMAL, PERCEPTION, perceive
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.running.parallel import Progress, one_thread
from hlsim.evaluation.study import Condition, Item
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

_MAX_SECONDS = 5.0  # of an utterance that is scored, so that HASPI takes half as long


class DurationEstimate(Callback):
    """Callback that prints the expected duration of the demo, from the pace of the first steps.

    >>> DurationEstimate().last_step
    60
    """

    first_step = 10  # the steps before are slower, because they reserve memory
    last_step = 60
    scoring_steps = 900  # as long as scores and page take, with as many processes as cores

    def on_train_batch_end(self, trainer: Any, module: Any, *arguments: Any) -> None:
        step = trainer.global_step
        if step == self.first_step:
            self.start = time.monotonic()
        elif step == self.last_step:
            pace = (time.monotonic() - self.start) / (self.last_step - self.first_step)
            minutes = pace * (trainer.max_steps - step + self.scoring_steps) / 60.0
            module.print(f"The demo will take about {minutes:.1f} minutes more")


def run_demo(
    out: str | Path,
    audiogram: Audiogram,
    *,
    steps: int = 3000,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> str:
    """Train a hearing aid for one ear, and compare it with no aid and with NAL-R by HASPI.

    The folder ``out`` receives a page with sounds, ``report.html``, and the trained checkpoint.

    Args:
        out: Folder of the results.
        audiogram: The ear.
        steps: Number of training steps.
        jobs: Number of processes that compute scores; all cores by default.
        progress: Function that is called with the number of values so far and of all values.

    Returns:
        Verdict, table and address of the page, for a terminal.
    """
    folder = Path(out)
    ear = f"{ear_name(audiogram)} (pure-tone average {audiogram.pta:.0f} dB HL)"
    print(f"Training an aid for the ear {ear}, {steps} steps")
    with one_thread():  # the steps are small: on a busy machine two threads wait for each other
        checkpoint = train_compensator(
            TrainingData(speech=find_audio(SPEECH / "train")),
            CompensatorRecipe(steps=steps),
            out=folder / "training",
            audiogram=audiogram,
            callbacks=[DurationEstimate()],
        )
    trained, nal_r = load_compensator(checkpoint), NALR()
    conditions = [
        Condition(UNAIDED, Unaided(), "unaided"),
        Condition(NAL_R, nal_r, "prescription"),
        Condition(NAL_R_AT_LEVEL, AtLevelOf(nal_r, trained), "same level", TRAINED),
        Condition(TRAINED, trained),
    ]
    items = _read_items(audiogram)
    print(f"Scoring {len(items)} other utterances under {len(conditions)} conditions")
    evaluation = Evaluation.run(
        items,
        conditions,
        [MEASURES["haspi"], LEVELS, PERCEPTION],
        store=None,
        settings={"seed": 0, "training_steps": steps},
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
    perceived = {NORMAL_EAR: [perceive(item.clean, NORMAL, NEURO_RATE) for item in items]}
    outputs = {}
    with torch.no_grad():
        for condition in conditions:
            signals = [condition.output(item) for item in items]
            outputs[condition.name] = signals
            perceived[condition.name] = [
                perceive(signal, audiogram, NEURO_RATE) for signal in signals
            ]
    page = demo_page(evaluation, ear, outputs, perceived)
    path = write_page(page, evaluation.to_dict(), folder)
    return f"\n{page.verdict}\n\n{result_table(evaluation).text()}\n\n{path.as_uri()}"


def _read_items(audiogram: Audiogram) -> list[Item]:
    """Read the utterances to score, each with a seed of its own."""
    facts = {"severity": audiogram.severity}
    items = []
    for number, path in enumerate(find_audio(SPEECH / "valid")):
        waveform, rate = read_audio(path)
        clip = resample(waveform[0], rate, NEURO_RATE)[: round(_MAX_SECONDS * NEURO_RATE)]
        clean = set_level(clip, _SPEECH_LEVEL)
        items.append(Item(path.stem, clean, clean, audiogram, seed=number, facts=facts))
    return items
