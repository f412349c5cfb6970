"""Compare thresholds of simulated ears in the digit test with those of people, and draw them.

    python docs/figures/digits_people.py thresholds_in_noise.csv --out digits-people [--every 3]

The table has a row per person with audiograms (``left_500``, ..., dB HL) and the threshold of a
test with digit triplets in noise of 65 dB SPL, free field (``srt_db_snr``). It was made from the
Oldenburg Hearing Health Record (Jafri et al. 2025, doi 10.5281/zenodo.16919812, CC BY 4.0). Each
person is tested with the ear of the lower pure-tone average (PTA), behind four simulators.
``--every 3`` takes every third person in the order of PTA. Tests that OUT.jsonl has are not
repeated. docs/digits-people.png is the figure.

Only one number is fitted, the difference between the skill of the listener and that of people. For
the error of each person, it is the mean difference of all others.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib import pyplot
from numpy.typing import NDArray
from scipy.stats import spearmanr

from hlsim import Audiogram, reception_threshold
from hlsim.audiogram import HIGHEST_SIMULATED
from hlsim.files import read_table
from hlsim.progress import ProgressLine

Array = NDArray[np.float64]

SIMULATORS = {
    "attenuation": "linear ear",
    "msbg-unsmeared": "MSBG without smearing",
    "msbg": "MSBG",
    "neuro-msbg": "default network",
}
"""Names for the tables by simulator."""

HERTZ = (125, 250, 500, 750, 1000, 1500, 2000, 4000)

GROUPS = {"below 20": (-99, 20), "20 to 35": (20, 35), "35 to 50": (35, 50), "from 50": (50, 999)}
"""Limits of the PTA in dB HL of groups of people."""

LOW_LOSS = 30.0
"""PTA in dB HL below which people's thresholds rise slowly: the bend of all 279."""

AT_ONCE = 8
"""Number of people per call of ``reception_threshold``."""

BENDS = np.arange(15.0, 56.0)
"""Bends in dB HL among which the best one is found."""

DRAWS = 300
"""Bootstrap samples of people."""


Person = tuple[str, float, Audiogram]
"""Name, threshold in noise in dB, and better ear."""


def read_people(path: Path) -> list[Person]:
    """Read name, threshold in noise and better ear of each person, in the order of PTA."""
    people = []
    for _, row in read_table(path, "the people"):
        ears = []
        for side in ("left", "right"):
            measured = {hz: row[f"{side}_{hz}"] for hz in HERTZ if row[f"{side}_{hz}"]}
            levels = {hz: min(float(x), HIGHEST_SIMULATED) for hz, x in measured.items()}
            if {500, 1000, 2000, 4000} <= levels.keys():
                ears.append(Audiogram(tuple(levels.values()), tuple(levels)))
        better = min(ears, key=lambda ear: ear.pta)
        people.append((row["person"], float(row["srt_db_snr"]), better))
    return sorted(people, key=lambda person: person[2].pta)


def run_tests(
    people: list[Person], simulators: list[str], triplets: int, seed: int, path: Path
) -> None:
    """Test each person behind each simulator, and append a line per test to a file.

    Each call tests people of all losses, so that a run which is stopped leaves an even share.
    """
    tests = {(name, simulator, seed) for name, _, _ in people for simulator in simulators}
    finished = tests & {(row["person"], row["simulator"], row["seed"]) for row in read_tests(path)}
    total, done = len(tests), len(finished)
    calls = -(-len(people) // AT_ONCE)
    with ProgressLine("tests") as progress, path.open("a", encoding="utf-8") as file:
        for start in range(calls):
            for name in simulators:
                part = people[start::calls]
                part = [person for person in part if (person[0], name, seed) not in finished]
                if not part:
                    continue
                ears = [ear for _, _, ear in part]
                result = reception_threshold(ears, simulator=name, triplets=triplets, seed=seed)
                for (person, srt, ear), value in zip(part, result.unaided.value, strict=True):
                    row = {"person": person, "simulator": name, "seed": seed, "people": srt}
                    row |= {"pta": ear.pta, "hlsim": float(value)}
                    file.write(json.dumps(row) + "\n")
                file.flush()
                done += len(part)
                progress(done, total)


def read_tests(path: Path) -> list[dict]:
    """Read the lines of ``run_tests``, none if there is no file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def fit_two_lines(pta: Array, srt: Array) -> tuple[float, float, float]:
    """Fit two lines that meet, and return the slope below, the slope above and the bend."""
    fits = []
    for bend in BENDS:
        design = np.stack([np.ones_like(pta), pta, np.maximum(pta - bend, 0.0)], 1)
        weights = np.linalg.lstsq(design, srt, rcond=None)[0]
        error = np.square(design @ weights - srt).sum()
        fits.append((error, weights[1], weights[1] + weights[2], bend))
    return min(fits)[1:]


def intervals(statistics: Callable[[Array], Sequence[float]], count: int) -> list[str]:
    """Format statistics of people with their bootstrap intervals of 95 %.

    Args:
        statistics: Function of the indices of people.
        count: Number of people.
    """
    rng = np.random.default_rng(0)
    values = [statistics(rng.integers(count, size=count)) for _ in range(DRAWS)]
    limits = np.quantile(values, [0.025, 0.975], axis=0)
    estimates = zip(statistics(np.arange(count)), *limits, strict=True)
    return [f"{value:.2f} [{low:.2f}, {high:.2f}]" for value, low, high in estimates]


def compare(people: Array, hlsim: Array, error: Array) -> tuple[float, ...]:
    """Compute rank correlation, correlation, median absolute error and root mean square error."""
    rank, r = spearmanr(hlsim, people)[0], np.corrcoef(hlsim, people)[0, 1]
    return rank, r, np.median(np.abs(error)), np.sqrt(np.square(error).mean())


def print_table(head: str, rows: list[list[str]]) -> None:
    """Print a table in Markdown."""
    columns = head.count("|") + 1
    print(f"\n| {head} |\n|{'---|' * columns}")
    for row in rows:
        print(f"| {' | '.join(row)} |")


def report(tests: dict[str, list[dict]]) -> None:
    """Print all tables."""
    agreement, slopes, groups = [], [], []
    labels = {name: label for name, label in SIMULATORS.items() if tests[name]}
    for name, label in labels.items():
        pta, people, hlsim = (
            np.array([row[key] for row in tests[name]]) for key in ("pta", "people", "hlsim")
        )
        count = len(pta)
        difference = people - hlsim
        offset = difference.mean()
        error = (offset - difference) * count / (count - 1)  # with the offset of all others
        columns = intervals(lambda i, x=(people, hlsim, error): compare(*(v[i] for v in x)), count)
        agreement.append([label, *columns, f"{offset:+.1f}"])
        sources = {label: hlsim, "people": people} if name == "msbg" else {label: hlsim}
        for source, srt in sources.items():
            columns = intervals(lambda i, x=(pta, srt): fit_two_lines(*(v[i] for v in x)), count)
            slopes.append([source, *columns])
        for group, (low, high) in GROUPS.items():
            members = (pta >= low) & (pta < high)
            inside = error[members]
            groups.append(
                [
                    label,
                    group,
                    str(len(inside)),
                    f"{inside.mean():+.1f}",
                    f"{np.median(np.abs(inside)):.1f}",
                    f"{np.sqrt(np.square(inside).mean()):.1f}",
                    f"{spearmanr(hlsim[members], people[members])[0]:.2f}",
                    f"{spearmanr(pta[members], people[members])[0]:.2f}",
                    f"{hlsim[members].std(ddof=1):.2f}",
                    f"{people[members].std(ddof=1):.2f}",
                ]
            )
    print(f"{', '.join(f'{label}: {len(tests[name])} people' for name, label in labels.items())}")
    print_table("ear | rank r | r | median absolute error | RMSE | offset", agreement)
    print_table("source | slope below the bend | above | bend (dB HL)", slopes)
    head = "ear | PTA (dB HL) | people | bias | median absolute error | RMSE"
    print_table(f"{head} | rank r | rank r of PTA | SD of the ear | SD of people", groups)
    if len({len(rows) for rows in tests.values() if rows}) == 1:
        print_differences(labels, tests)
    print_limits(labels, tests)


def print_differences(labels: dict[str, str], tests: dict[str, list[dict]]) -> None:
    """Print how far other predictors of people's thresholds lie from MSBG."""
    if "msbg" not in labels:
        return
    pta, people, msbg = (
        np.array([row[key] for row in tests["msbg"]]) for key in ("pta", "people", "hlsim")
    )
    rows = []
    for name, label in {**labels, "pta": "PTA"}.items():
        if name == "msbg":
            continue
        values = pta if name == "pta" else np.array([row["hlsim"] for row in tests[name]])

        def difference(i: Array, values: Array = values) -> list[float]:
            return [
                spearmanr(values[i], people[i])[0] - spearmanr(msbg[i], people[i])[0],
                np.corrcoef(values[i], people[i])[0, 1] - np.corrcoef(msbg[i], people[i])[0, 1],
                np.median(np.abs(values[i] - msbg[i])),
            ]

        columns = intervals(difference, len(pta))
        rows.append([label, *columns[:2], "" if name == "pta" else columns[2]])
    print_table("minus MSBG | rank r | r | median absolute difference (dB)", rows)


def print_limits(labels: dict[str, str], tests: dict[str, list[dict]]) -> None:
    """Print what the rank correlation would be if something else were as it is not.

    Below ``LOW_LOSS``, the order of the ears is replaced by that of the PTA, once among the values
    that these ears have, and once below all others. *PTA* is the rank correlation without an ear.
    """
    rows = []
    for name, label in labels.items():
        pta, people, hlsim = (
            np.array([row[key] for row in tests[name]]) for key in ("pta", "people", "hlsim")
        )
        low = pta < LOW_LOSS
        ordered, below = hlsim.copy(), hlsim.copy()
        ordered[low] = np.sort(hlsim[low])[pta[low].argsort().argsort()]
        below[low] = pta[low] - 1000.0
        predictors = (hlsim, ordered, below, pta)
        rows.append([label, *(f"{spearmanr(x, people)[0]:.2f}" for x in predictors)])
    low_loss = f"{LOW_LOSS:.0f} dB HL"
    print_table(
        f"ear | rank r | below {low_loss} in the order of PTA | and below all others | PTA", rows
    )


def report_retest(first: list[dict], second: list[dict]) -> None:
    """Print how well two tests with other triplets agree, for the people who have both."""
    rows = []
    for name, label in SIMULATORS.items():
        values = [
            {row["person"]: row["hlsim"] for row in tests if row["simulator"] == name}
            for tests in (first, second)
        ]
        both = [
            (values[0][person], values[1][person]) for person in values[1] if person in values[0]
        ]
        if both:
            once, again = np.array(both).T
            deviation = np.std(once - again, ddof=1) / np.sqrt(2.0)
            rank, r = spearmanr(once, again)[0], np.corrcoef(once, again)[0, 1]
            rows.append([label, str(len(both)), f"{rank:.2f}", f"{r:.2f}", f"{deviation:.2f}"])
    print_table("ear | people | rank r of two tests | r | SD of one test (dB)", rows)


def draw(tests: dict[str, list[dict]], everybody: list[Person]) -> None:
    """Draw people as dots and each ear as a line, the mean over five neighbours."""
    figure, axes = pyplot.subplots(figsize=(8.0, 4.0), layout="constrained")
    pta = [ear.pta for _, _, ear in everybody]
    srt = [threshold for _, threshold, _ in everybody]
    axes.plot(pta, srt, ".", color="0.65", label=f"people ({len(pta)})")
    for name, label in SIMULATORS.items():
        rows = tests[name]
        if not rows:
            continue
        offset = np.mean([row["people"] - row["hlsim"] for row in rows])
        window = np.ones(5) / 5.0
        smooth = [
            np.convolve([row[key] for row in rows], window, "valid") for key in ("pta", "hlsim")
        ]
        # The network lies upon MSBG, so its line is dashed.
        style = {"linestyle": "--", "color": "black"} if name == "neuro-msbg" else {}
        axes.plot(smooth[0], smooth[1] + offset, label=label, **style)
    axes.set(xlabel="pure-tone average of the better ear (dB HL)", ylabel="threshold (dB SNR)")
    axes.set(title="Digits in noise, unaided", ylim=(-13.0, 16.0))
    axes.legend(fontsize="small")
    figure.savefig(Path(__file__).parents[1] / "digits-people.png", dpi=110)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="path without the ending .jsonl")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--triplets", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--simulators", nargs="+", default=list(SIMULATORS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    everybody = read_people(options.table)
    people = everybody[:: options.every]
    path = options.out.with_suffix(".jsonl")
    run_tests(people, options.simulators, options.triplets, options.seed, path)
    names = {person for person, _, _ in people}
    everything = sorted(read_tests(path), key=lambda row: (row["pta"], row["person"]))
    rows = [row for row in everything if row["seed"] == options.seed and row["person"] in names]
    tests = {name: [row for row in rows if row["simulator"] == name] for name in SIMULATORS}
    report(tests)
    tested = [{row["person"] for row in rows} for rows in tests.values() if rows]
    common = set.intersection(*tested)
    if any(common < names for names in tested):
        print("\nOnly people whom all ears have")
        report({name: [row for row in tests[name] if row["person"] in common] for name in tests})
    for seed in sorted({row["seed"] for row in everything} - {options.seed}):
        report_retest(rows, [row for row in everything if row["seed"] == seed])
    draw(tests, everybody)


if __name__ == "__main__":
    main()
