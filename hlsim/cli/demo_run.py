"""The command ``demo``: an aid for one ear is trained through Neuro-MSBG, scored and shown."""

import time
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import Callback

from compensators import load_compensator
from hlsim.audio import find_audio
from hlsim.audiogram import Audiogram
from hlsim.data import bundled
from hlsim.evaluation.demo import evaluate_trained_aid
from hlsim.evaluation.items import ear_name
from hlsim.progress import ProgressLine
from hlsim.report.demo_page import demo_page, result_table
from hlsim.report.writing import write_results
from hlsim.training.batches import TrainingData
from hlsim.training.compensator import train_compensator
from hlsim.training.recipes import CompensatorRecipe


class DurationEstimate(Callback):
    """Callback that prints, at step 60, how much longer the demo takes.

    The pace is that of steps 10 to 60. A training of fewer steps prints nothing.

    >>> DurationEstimate().last_step
    60
    """

    first_step = 10  # the steps before are slower, because they reserve memory
    last_step = 60
    scoring_steps = 400  # take as long as validations, scores and page on two cores

    def on_train_batch_end(self, trainer: Any, module: Any, *arguments: Any) -> None:
        step = trainer.global_step
        if step == self.first_step:
            self.start = time.monotonic()
        elif step == self.last_step:
            pace = (time.monotonic() - self.start) / (self.last_step - self.first_step)
            minutes = pace * (trainer.max_steps - step + self.scoring_steps) / 60.0
            module.print(f"The demo will take about {minutes:.1f} minutes more")


def run_demo(out: str | Path, audiogram: Audiogram, *, steps: int = 1000, **running: Any) -> str:
    """Train an aid for one ear on bundled speech, score it beside NAL-R, and write its page.

    Progress is printed.

    Args:
        out: Folder of the page, the scores and the training, which resumes if it was interrupted.
        audiogram: Audiogram of the ear.
        steps: Number of training steps.
        running: Arguments ``jobs`` and ``dask`` of ``run_study``.

    Returns:
        Text for a terminal: the verdict, the table of results, and the address of the page.

    Raises:
        ValueError: The steps are not 1 or more, a threshold is above 100 dB HL, the folder has
            another training, or nothing could be scored.
    """
    ear = f"{ear_name(audiogram)} (pure-tone average {audiogram.pta:.0f} dB HL)"
    print(f"Training an aid for the ear {ear}, {steps} steps")
    checkpoint = train_compensator(
        TrainingData(speech=find_audio(bundled.SPEECH / "train")),
        # Single clips at a high rate train one ear in fewer and shorter steps than the defaults do.
        CompensatorRecipe(steps=steps, batch=1, learning_rate=6e-3, validate_every=200),
        out=Path(out) / "training",
        audiogram=audiogram,
        callbacks=[DurationEstimate()],
    )
    print("Scoring other utterances without an aid, with NAL-R and with the aid")
    aid = load_compensator(checkpoint)
    with ProgressLine("scores", "reading the utterances", "drawing the page") as progress:
        evaluation = evaluate_trained_aid(
            aid, audiogram, ear_name=ear, training_steps=steps, progress=progress, **running
        )
        page = demo_page(evaluation)
        path = write_results(page, evaluation, out)
    return f"\n{page.verdict}\n\n{result_table(evaluation).text()}\n\n{path.as_uri()}"
