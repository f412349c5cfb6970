"""Measure what softer output of `hearing-aid` costs: words and HASPI for several loudnesses.

    python docs/figures/aid_loudness.py speech/valid noise/valid --out FOLDER [--passes 1] \\
        [--sentences 12 --no-words]

The sentences are those of ``examples/machine_listener.py``, in quiet and at two SNRs, at 65 dB SPL
without noise. In a pass, each sentence is heard by one of the ears N2 to N5, in turn. Moonshine
tiny writes down the words behind two simulated ears, the exact MSBG and one that only attenuates.
The conditions are the loudness in dB, the slider ``amplification`` for comparison, and NAL-R. A
stopped run continues where it was. It needs `pip install moonshine_voice==0.0.48`.
"""

import argparse
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame
from torch import Tensor, nn

from compensators import load_compensator
from examples.machine_listener import (
    SENTENCES,
    Comparison,
    WordsCorrect,
    describe,
    load_recogniser,
    make_items,
    print_table,
    read_sentences,
)
from hlsim import Audiogram
from hlsim.evaluation.measures import LEVELS, PERCEPTION, find_measures
from hlsim.evaluation.running.store import ScoreStore
from hlsim.evaluation.study import Condition, Item, Measure, run_study
from hlsim.progress import ProgressLine

BASE = "loudness 0"
SIMULATORS = {"msbg": "MSBG", "attenuation": "linear ear"}
SNRS = (math.inf, 5.0, 0.0)
PLACES = ("quiet", "5 dB", "0 dB")
EARS = {name: Audiogram.standard(name) for name in ("N2", "N3", "N4", "N5")}


class LessAmplification(nn.Module):
    """A hearing aid with the slider ``amplification`` at 0.8."""

    def __init__(self, aid: nn.Module) -> None:
        super().__init__()
        self.aid = aid

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Process a waveform for an ear."""
        output: Tensor = self.aid(waveform, audiogram, amplification=0.8)
        return output


def load_conditions() -> list[Condition]:
    """Return the aids, of which the first is the default."""
    aids: dict[str, Any] = {
        f"loudness {loudness}": load_compensator("hearing-aid", loudness=float(loudness))
        for loudness in (0, -5, -10)
    }
    aids["amplification 0.8"] = LessAmplification(load_compensator("hearing-aid"))
    aids["NAL-R"] = load_compensator("nalr")
    return [Condition(name, aid) for name, aid in aids.items()]


def measure_words(
    simulator: str, listener: WordsCorrect, item: Item, output: Tensor
) -> dict[str, float]:
    """Return the share of words correct under the name of the listener's simulator."""
    return {simulator: listener(item, output)["words_correct"]}


def load_words(simulator: str) -> Measure:
    """Return the measure of words behind a simulated ear."""
    listener = WordsCorrect(load_recogniser("moonshine-tiny"), simulator=simulator)
    compute = partial(measure_words, simulator, listener)
    return Measure(simulator, compute, ["hlsim"], listener.fingerprint)


def draw_items(speech: str, noise: str, passes: int, count: int | None) -> list[Item]:
    """Return the items of the first sentences. The ears move on by one in each pass."""
    names = [*EARS]
    sentences = read_sentences(SENTENCES)[:count]
    items = []
    for number in range(passes):
        ears = {name: EARS[name] for name in names[number:] + names[:number]}
        items += make_items(speech, noise, sentences, ears, SNRS, 0, step=len(EARS))
    return items


def print_words(table: DataFrame, simulator: str) -> None:
    """Print words correct and their differences from the default in each condition."""
    comparison = Comparison(table.assign(words_correct=table[simulator]))
    rows = []
    for name in table["condition"].unique():
        shares = [comparison.shares(name, snr) for snr in SNRS]
        base = [comparison.shares(BASE, snr) for snr in SNRS]
        changes = [share - default for share, default in zip(shares, base, strict=True)]
        changes.append(sum(changes) / len(SNRS))
        cells = [f"{share[0]:.3f}" for share in shares]
        rows.append([name, *cells, *(describe(change, "+.3f") for change in changes)])
    changes_of = [f"minus default, {place}" for place in (*PLACES, "mean")]
    header = [SIMULATORS[simulator], *PLACES, *changes_of]
    print_table(header, rows)


def draw_words(table: DataFrame, path: Path) -> None:
    """Draw words correct over the level of the output relative to NAL-R, in quiet and in noise."""
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    panels = figure.subplots(1, len(SIMULATORS), sharey=True)
    levels = table.groupby("condition", sort=False)["level"].mean()
    levels -= levels["NAL-R"]
    softer = [name for name in levels.index if name.startswith("loudness")]
    for panel, (simulator, title) in zip(panels, SIMULATORS.items(), strict=True):
        comparison = Comparison(table.assign(words_correct=table[simulator]))
        for number, (snr, label) in enumerate(zip(SNRS, PLACES, strict=True)):
            shares = np.stack([comparison.shares(name, snr) for name in softer])
            low, high = np.nanpercentile(shares[:, 1:], (2.5, 97.5), axis=1)
            panel.fill_between(levels[softer], low, high, alpha=0.15)
            panel.plot(levels[softer], shares[:, 0], "o-", color=f"C{number}", label=label)
        panel.set(title=title, xlabel="output level minus NAL-R's (dB)", ylim=(0.0, 1.0))
    panels[0].set_ylabel("words correct")
    panels[0].legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("speech", help="folder of speech")
    parser.add_argument("noise", help="folder of noise, with a subfolder for each kind")
    parser.add_argument("--passes", type=int, default=1)
    parser.add_argument("--sentences", type=int, help="number of sentences; by default all")
    parser.add_argument("--no-words", action="store_true", help="without a recogniser")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--picture", type=Path, help="PNG file of the curves")
    options = parser.parse_args()
    items = draw_items(options.speech, options.noise, options.passes, options.sentences)
    simulators = [] if options.no_words else [*SIMULATORS]
    measures = [*map(load_words, simulators), *find_measures(["haspi"]), PERCEPTION, LEVELS]
    with ProgressLine("outputs") as progress:
        table = run_study(
            items,
            load_conditions(),
            measures,
            store=ScoreStore(options.out / "scores.jsonl"),
            jobs=1,
            progress=progress,
        )
    table.to_csv(options.out / "table.csv", index=False)
    for simulator in simulators:
        print_words(table, simulator)
    if options.picture and simulators:
        draw_words(table, options.picture)
    quiet = table["snr"] == math.inf
    for label, rows in (("quiet", table[quiet]), ("noise", table[~quiet])):
        means = rows.groupby("condition", sort=False)[["haspi", "level", "loudness_error"]].mean()
        means["level"] -= means["level"]["NAL-R"]
        print(f"{label}; level is relative to NAL-R\n{means.round(3)}\n", flush=True)


if __name__ == "__main__":
    main()
