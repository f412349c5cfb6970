"""Compare simulated ears with people: loudness, tuning, and words at a HASPI.

    python examples/people.py PEOPLE [OUT]

It prints the tables of docs/people.md and draws its figures to the folder OUT, by default
``people``. PEOPLE is a folder with up to four tables; a comparison without its table is left out.

- ``thresholds_in_noise.csv``: ``person``, thresholds (``left_500``) and uncomfortable levels
  (``ucl_left_500``) in dB HL, such as those of the Oldenburg Hearing Health Record (Jafri et al.
  2025, doi 10.5281/zenodo.16919812, CC BY 4.0).
- ``loudness.csv``, of the same record: ``person``, thresholds in dB HL (``left_1500`` and others),
  and ``mlow_left`` and ``mlow_right``, slopes of the lower part of the loudness function of Brand
  and Hohmann (2002) in categorical units per dB, means of noises around 1.5 and 4 kHz.
- ``tuning.csv``: ``ear``, ``group`` (normal or impaired), ``frequency_hz``,
  ``threshold_500ms_db_spl`` and ``tuning_depth_db``, as measured by Lecluyse et al. (2013).
- ``clarity_responses.csv``: see ``docs/figures/fit_words.py``.

It takes about ten minutes on one core. Simulated values are kept in OUT and used again for the same
ears; delete them after a change of a simulator. Numbers are fitted to persons with odd numbers, and
the tables that use them show the others, unless they say otherwise.
"""

import sys
import warnings
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
import people_recruitment as recruitment
import people_tuning as tuning
from matplotlib.figure import Figure
from PIL import Image
from scipy.optimize import brentq
from torch import nn

from hlsim import MSBG, Audiogram, load_pretrained
from hlsim.audiogram.scale import SEVERITY_LIMITS
from hlsim.simulators import Attenuation

sys.path.append(str(Path(__file__).parents[1] / "docs" / "figures"))
import fit_words

SIMULATORS: dict[str, Callable[[], nn.Module]] = {
    "MSBG": MSBG,
    "MSBG without smearing": lambda: MSBG(smearing=False),
    "linear ear": Attenuation,
    "neuro-msbg": lambda: load_pretrained("neuro-msbg"),
}

THREE_EARS = ("MSBG", "MSBG without smearing", "linear ear")
"""Simulators without the network, which has not learned from sounds that short."""

COLOURS = dict(zip(SIMULATORS, ("tab:blue", "tab:cyan", "tab:gray", "tab:purple"), strict=True))

LOSS_GROUPS = ((-10, 20), (20, 40), (40, 60), (60, 101))
"""Thresholds in dB HL from and below which loudness is compared."""

TUNING_GROUPS = ((-20, 20), (20, 30), (30, 40), (40, 50), (50, 75))
"""Thresholds in dB SPL from and below which tuning is compared."""

INTENDED = {"intended smearing": False, "intended, continuous": True}
"""Calculated tuning by name, and whether it follows the loss continuously."""

NORMAL_THRESHOLD = 15.0
"""Largest threshold in dB HL of an ear whose loudness counts as normal."""

RECRUITING_THRESHOLD = 40.0
"""Threshold in dB HL from which full recruitment is estimated from slopes."""

FULL_RECRUITMENT_SPL = 105.0
"""Level in dB SPL at which MSBG's loudness is normal."""


def is_fitted(names: pd.Series) -> pd.Series:
    """Return which of the persons or ears, such as P013, have odd numbers: they are fitted to."""
    return names.str[1:].astype(int) % 2 == 1


def simulate(
    path: Path,
    keys: pd.DataFrame,
    inputs: Sequence[object],
    simulators: Sequence[str],
    compute: Callable[[nn.Module], np.ndarray],
) -> None:
    """Add one column per simulator to a table, unless a file of an earlier run has them.

    Args:
        path: File of the simulated values.
        keys: Columns that identify the rows, to which the simulated values are added.
        inputs: Values from which the result of each row is computed. The file has their text, too.
        simulators: Names of the simulators.
        compute: Function that returns the values of all rows for a simulator.
    """
    table = keys.assign(inputs=[str(row) for row in inputs])
    names = [*table.columns]
    if path.is_file():
        stored = pd.read_csv(path)
        is_comparable = len(stored) == len(table) and {*names} <= {*stored.columns}
        if is_comparable and (stored[names].to_numpy() == table.to_numpy()).all():
            return
    for name in simulators:
        print(f"simulating {path.stem}: {name}", file=sys.stderr, flush=True)
        table[name] = compute(SIMULATORS[name]())
    table.to_csv(path, index=False)


def print_table(title: str, table: pd.DataFrame) -> None:
    """Print a table in Markdown."""
    print(f"\n{title}\n")
    print("| " + " | ".join(table.columns) + " |")
    print("|" + "---|" * len(table.columns))
    for row in table.itertuples(index=False):
        print("| " + " | ".join(map(str, row)) + " |")


def in_groups(
    values: pd.Series, groups: tuple[tuple[int, int], ...]
) -> list[tuple[str, pd.Series]]:
    """Return a title and a mask of the values per group."""
    return [(f"{low} to {high}", (values >= low) & (values < high)) for low, high in groups]


def save(figure: Figure, path: Path) -> None:
    """Save a figure with 48 colours, which need a third of the space."""
    data = BytesIO()
    figure.savefig(data, dpi=110, format="png")
    picture = Image.open(data).convert("RGB").quantize(48, Image.Quantize.MAXCOVERAGE)
    picture.save(path, optimize=True)


# Loudness


def simulated_levels(rows: pd.DataFrame, out: Path) -> tuple[pd.DataFrame, dict[int, float]]:
    """Add the UCL of each simulated ear, and return the UCL of the normal ear per frequency, too.

    The latter is that of a censored line at 0 dB HL through the persons with odd numbers.
    """
    odd = rows[is_fitted(rows.person)]
    normal = {int(hz): float(censored_line(part).coefficients[0]) for hz, part in odd.groupby("hz")}

    def compute(simulator: nn.Module) -> np.ndarray:
        levels = np.empty(len(rows))
        for hz, ucl in normal.items():
            is_hz = (rows.hz == hz).to_numpy()
            ears = list(rows.audiogram[is_hz])
            levels[is_hz] = recruitment.simulated_uncomfortable_levels(simulator, ears, hz, ucl)
        return levels

    path = out / "simulated-ucl.csv"
    keys = rows[["person", "ear", "hz", "threshold"]]
    inputs = [*zip(rows.audiogram, rows.hz.map(normal), strict=True)]
    simulate(path, keys, inputs, [*SIMULATORS], compute)
    stored = pd.read_csv(path)
    return rows.assign(**{name: stored[name].to_numpy() for name in SIMULATORS}), normal


def censored_line(rows: pd.DataFrame) -> recruitment.CensoredFit:
    """Fit the line of UCL over the threshold."""
    design = recruitment.line(rows.threshold.to_numpy())
    return recruitment.fit_censored(design, rows.ucl.to_numpy())


def slope_without_censored(rows: pd.DataFrame) -> float:
    """Return the slope of the levels that were reached, as if there were no others."""
    reached = rows[rows.ucl < recruitment.NOT_REACHED]
    return float(np.polyfit(reached.threshold, reached.ucl, 1)[0])


def simulated_slope(rows: pd.DataFrame, name: str) -> float:
    return float(np.polyfit(rows.threshold, rows[name], 1)[0])


def bias(rows: pd.DataFrame, name: str) -> float:
    """Return the simulated level minus the measured one in dB, where some are not reached."""
    simulated = rows[name].to_numpy()
    limit = recruitment.NOT_REACHED - simulated
    difference = rows.ucl.to_numpy() - simulated
    constant = np.ones((len(rows), 1))
    return -float(recruitment.fit_censored(constant, difference, limit).coefficients[0])


def full_recruitment(rows: pd.DataFrame) -> float:
    """Return the level in dB SPL of full recruitment with which MSBG would have people's slope.

    In MSBG the slope is (R - level in the channels) / R, where R is the level of full recruitment.
    The level in the channels follows from the slope of MSBG without smearing at 105 dB SPL.
    """
    channel_level = FULL_RECRUITMENT_SPL * (1.0 - simulated_slope(rows, "MSBG without smearing"))
    slope = float(censored_line(rows).coefficients[1])
    return recruitment.full_recruitment(channel_level, slope)


def with_interval(
    rows: pd.DataFrame, statistic: Callable[[pd.DataFrame], float], digits: int = 2
) -> str:
    """Return a statistic with its interval of 95 %, by bootstrap over persons."""
    low, high = recruitment.bootstrap(rows, lambda part: [statistic(part)])[:, 0]
    return f"{statistic(rows):.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def compare_recruitment(path: Path, out: Path) -> None:
    """Compare uncomfortable levels of simulated ears with those of people."""
    rows, normal = simulated_levels(recruitment.read_uncomfortable_levels(path), out)
    print("\nFitted to persons with odd numbers: UCL of a normal ear in dB HL,", normal)
    is_odd = is_fitted(rows.person)
    lines = {}
    for hz, part in rows[is_odd].groupby("hz"):
        intercept, slope = lines[hz] = censored_line(part).coefficients
        print(f"and the line of UCL over threshold: {hz} Hz {intercept:.1f} + {slope:.3f} T")
    rows["line"] = [lines[row.hz] @ [1.0, row.threshold] for row in rows.itertuples()]

    table = []
    for hz, part in rows.groupby("hz"):
        row = {
            "Hz": hz,
            "ears": len(part),
            "not reached": f"{(part.ucl >= recruitment.NOT_REACHED).mean():.0%}",
            "people": with_interval(part, lambda p: censored_line(p).coefficients[1]),
            "people, left out": with_interval(part, slope_without_censored),
        }
        for name in SIMULATORS:
            row[name] = f"{simulated_slope(part, name):.2f}"
        row["full recruitment (dB SPL)"] = with_interval(part, full_recruitment, 0)
        table.append(row)
    print_table("Slope of UCL over threshold, dB per dB, all persons", pd.DataFrame(table))
    line = censored_line(rows)
    intercept, slope = line.coefficients
    print(f"All frequencies: {intercept:.1f} + {slope:.2f} T, deviation {line.deviation:.1f} dB")

    even = rows[~is_odd]
    names = [*SIMULATORS, "line"]
    for title, column, groups in (
        ("dB HL", "threshold", in_groups(even.threshold, LOSS_GROUPS)),
        ("Hz", "hz", [(str(hz), even.hz == hz) for hz in normal]),
    ):
        table = []
        for label, mask in [*groups, ("all", even[column].notna())]:
            part = even[mask]
            row = {title: label, "values": len(part)}
            row["not reached"] = f"{(part.ucl >= recruitment.NOT_REACHED).mean():.0%}"
            for name in names:
                row[name] = with_interval(part, lambda p, name=name: bias(p, name), 1)
            row["MSBG minus line"] = with_interval(
                part, lambda p: bias(p, "MSBG") - bias(p, "line"), 1
            )
            table.append(row)
        print_table("UCL minus that of people in dB, even numbers", pd.DataFrame(table))

    difference = (rows["neuro-msbg"] - rows["MSBG"]).abs().median()
    print(f"Median difference between neuro-msbg and MSBG: {difference:.2f} dB")

    draw_recruitment(rows, out / "people-recruitment.png")


def draw_recruitment(rows: pd.DataFrame, path: Path) -> None:
    """Draw UCL over the threshold: people as dots and a line, simulated ears as means."""
    figure = Figure(figsize=(9.2, 6.4), layout="constrained")
    places = figure.subplots(2, 2).ravel()
    random = np.random.default_rng(0)
    for axes, (hz, part) in zip(places, rows.groupby("hz"), strict=False):
        jitter = random.uniform(-1.5, 1.5, (2, len(part)))
        axes.scatter(
            part.threshold + jitter[0], part.ucl + jitter[1], s=4, color="tab:orange", alpha=0.3
        )
        points = np.array([-10.0, 100.0])
        people = recruitment.line(points) @ censored_line(part).coefficients
        axes.plot(points, people, color="tab:orange", linewidth=3, label="people, censored line")
        centres = part.threshold.round(-1)
        for name, colour in COLOURS.items():
            means = part.groupby(centres)[name].mean()
            axes.plot(means.index, means, color=colour, label=name)
        axes.axhline(recruitment.NOT_REACHED, color="black", linewidth=0.5, linestyle=":")
        axes.set(ylim=(60, 130), xlim=(-12, 102), title=f"{hz} Hz")
        axes.set(xlabel="threshold (dB HL)", ylabel="uncomfortable level (dB HL)")
    axes.legend(fontsize="small", loc="lower right")
    save(figure, path)


def compare_loudness(path: Path, out: Path) -> None:
    """Compare the growth of loudness below the kink of simulated ears with that of people."""
    rows = recruitment.read_loudness(path)
    ears = list(rows.audiogram)
    growths = out / "simulated-growth.csv"
    simulate(
        growths,
        rows[["person", "ear", "threshold"]],
        ears,
        THREE_EARS,
        lambda simulator: recruitment.growth_of_perceived_level(simulator, ears),
    )
    growth = pd.read_csv(growths)[[*THREE_EARS]].to_numpy()
    is_odd = is_fitted(rows.person).to_numpy()
    is_normal = is_odd & (rows.threshold <= NORMAL_THRESHOLD).to_numpy()
    # A normal ear of this table has a loss of some dB, so its simulated growth is not quite one.
    slope = rows.slope[is_normal].mean() / growth[is_normal].mean(0)
    rows[[*THREE_EARS]] = growth * slope
    print(f"\nFitted to {is_normal.sum()} ears of persons with odd numbers, slope at 0 dB HL:")
    print({name: round(float(x), 3) for name, x in zip(THREE_EARS, slope, strict=True)})
    line = np.polyfit(rows.threshold[is_odd], rows.slope[is_odd], 1)
    rows["line"] = np.polyval(line, rows.threshold)
    print(f"and the line of the slope over the threshold: {line[1]:.3f} + {line[0]:.5f} T")

    even = rows[~is_odd]
    names = [*THREE_EARS, "line"]
    medians, biases, ranks = [], [], []
    for label, mask in [*in_groups(even.threshold, LOSS_GROUPS), ("all", even.slope.notna())]:
        part = even[mask]
        first = {"threshold (dB HL)": label, "ears": len(part)}
        low, middle, high = part.slope.quantile([0.25, 0.5, 0.75])
        people = f"{middle:.2f} ({low:.2f} to {high:.2f})"
        predicted = {name: f"{part[name].median():.2f}" for name in names}
        medians.append(first | {"people": people} | predicted)
        biases.append(first | _per_name(part, names, slope_bias, 0))
        ranks.append(first | _per_name(part, ["threshold", *THREE_EARS[:2]], rank_correlation, 2))
    print_table("Slope of loudness, median (middle half), even numbers", pd.DataFrame(medians))
    print_table("Median slope compared with that of people in %", pd.DataFrame(biases))
    print_table("Rank correlation with people's slopes", pd.DataFrame(ranks))
    both = even.pivot(index="person", columns="ear", values=["slope", "threshold"]).dropna()
    residual = np.log(both["slope"]) - np.log(np.polyval(line, both["threshold"]))
    deviation = np.log(even.slope / even.line).quantile([0.16, 0.84]).round(2)
    between_ears = residual.left.corr(residual.right, method="spearman")
    print(f"Logarithm of slope over line, 16 and 84 %: {list(deviation)};", end=" ")
    print(f"rank correlation of both ears of {len(both)} persons: {between_ears:.2f}")

    normal = dict(zip(THREE_EARS, slope, strict=True))["MSBG without smearing"]
    impaired = even[even.threshold >= RECRUITING_THRESHOLD].assign(normal=normal)
    level = with_interval(impaired, full_recruitment_of_slopes, 0)
    limit = f"{RECRUITING_THRESHOLD:.0f} dB HL"
    print(f"Full recruitment that would give people's slopes from {limit} on: {level} dB SPL")
    draw_loudness(rows, out / "people-loudness.png")


def _per_name(
    rows: pd.DataFrame,
    names: Sequence[str],
    statistic: Callable[[pd.DataFrame, str], float],
    digits: int,
) -> dict[str, str]:
    """Return a statistic with its interval for each column."""
    return {name: with_interval(rows, lambda p, n=name: statistic(p, n), digits) for name in names}


def slope_bias(rows: pd.DataFrame, name: str) -> float:
    """Return by how many percent the median predicted slope exceeds that of people."""
    return 100.0 * (rows[name].median() / rows.slope.median() - 1.0)


def rank_correlation(rows: pd.DataFrame, name: str) -> float:
    """Return the rank correlation of a column with people's slopes."""
    return float(rows.slope.corr(rows[name], method="spearman"))


def full_recruitment_of_slopes(rows: pd.DataFrame) -> float:
    """Return the level in dB SPL of full recruitment with which MSBG would have people's slopes.

    An ear that grows by R / (R - loss) dB per dB for full recruitment at R has an effective loss,
    which follows from its growth in MSBG without smearing, where R is 105 dB SPL. The median ratio
    of measured and predicted slopes is 1 at the returned level.
    """
    growth = rows["MSBG without smearing"] / rows.normal
    loss = FULL_RECRUITMENT_SPL * (1.0 - 1.0 / growth)

    def median_difference(level: float) -> float:
        return float(np.median(np.log(rows.slope / rows.normal * (level - loss) / level)))

    return float(brentq(median_difference, loss.max() + 0.1, 1000.0))


def draw_loudness(rows: pd.DataFrame, path: Path) -> None:
    """Draw the slope of loudness over the threshold: people as dots, simulated ears as lines."""
    figure = Figure(figsize=(9.2, 4.0), layout="constrained")
    axes = figure.subplots()
    jitter = np.random.default_rng(0).uniform(-1.0, 1.0, len(rows))
    axes.scatter(rows.threshold + jitter, rows.slope, s=4, color="tab:orange", alpha=0.3)
    centres = rows.threshold.round(-1)
    is_group = centres.map(centres.value_counts()) >= 5
    groups = rows[is_group].groupby(centres[is_group])
    people = groups.slope.median()
    axes.plot(people.index, people, color="tab:orange", linewidth=3, label="people, median")
    for name in THREE_EARS:
        medians = groups[name].median()
        axes.plot(medians.index, medians, color=COLOURS[name], label=f"{name}, median")
    axes.set(xlabel="threshold, mean of 1.5 and 4 kHz (dB HL)", ylim=(0.0, 1.9))
    axes.set(ylabel="slope of loudness (units per dB)")
    axes.legend(fontsize="small", loc="upper left")
    save(figure, path)


# Tuning


def compare_tuning(path: Path, out: Path) -> None:
    """Compare the tuning depth of simulated ears with that of people."""
    rows = tuning.read_tuning(path)
    rows["person"] = rows.ear
    stored = out / "simulated-tuning.csv"
    ears, hz = list(rows.audiogram), list(rows.hz)
    simulate(
        stored,
        rows[["ear", "hz"]],
        ears,
        THREE_EARS,
        lambda simulator: tuning.tuning_depths(simulator, ears, hz),
    )
    for name, values in pd.read_csv(stored)[[*THREE_EARS]].items():
        rows[name] = values.to_numpy()

    for name, is_continuous in INTENDED.items():
        rows[name] = tuning.intended_depths(
            ears, hz, rows.hearing_level, rows["MSBG without smearing"].to_numpy(), is_continuous
        )
    names = [*THREE_EARS, *INTENDED]

    table = []
    for frequency, part in rows.groupby("hz"):
        row = {"Hz": frequency, "ears": len(part)}
        row["line on the threshold"] = f"{-part.depth.corr(part.threshold):.2f}"
        for name in names:
            row[name] = correlation(part, name)
        row["MSBG minus line"] = with_interval(
            part, lambda p: p.depth.corr(p["MSBG"]) + p.depth.corr(p.threshold)
        )
        table.append(row)
    print_table("r with the measured tuning depth", pd.DataFrame(table))

    table = []
    for label, mask in in_groups(rows.threshold, TUNING_GROUPS):
        part = rows[mask]
        row = {
            "threshold (dB SPL)": label,
            "values": len(part),
            "people": with_interval(part, lambda p: p.depth.mean(), 1),
        }
        for name in names:
            row[name] = f"{part[name].mean():.1f}"
        table.append(row)
    print_table("Mean tuning depth in dB, 0.5 to 4 kHz", pd.DataFrame(table))

    is_odd = is_fitted(rows.ear)
    table = []
    for name in ["threshold", *names]:
        row = {"predicted from": name}
        for label, is_line in (("offset per frequency", False), ("line per frequency", True)):
            if name == "threshold" and not is_line:
                row[label] = "-"
                continue
            errors = [
                held_out_errors(part, name, is_line, is_odd[part.index])
                for _, part in rows.groupby("hz")
            ]
            row[label] = f"{np.sqrt(np.square(np.concatenate(errors)).mean()):.1f}"
        table.append(row)
    print_table("RMS error of the depth in dB, fitted to odd ears, even ears", pd.DataFrame(table))
    compare_steps(rows, out)

    table = []
    for sound in ("tone", "noise"):
        for frequency in (1000, 2000, 4000):
            levels = tuning.passed_by_filters(sound, frequency, "severe")
            row = {"sound": sound, "Hz": frequency}
            titles = ("before smearing", "after smearing", "wide filter")
            row |= {title: f"{level:.1f}" for title, level in zip(titles, levels, strict=True)}
            table.append(row)
    print_table("Part of a sound that passes a filter beside it, in dB", pd.DataFrame(table))


def correlation(rows: pd.DataFrame, name: str) -> str:
    """Return r of the measured with the simulated depth, or a dash if that does not vary."""
    if rows[name].std() < 0.5:
        return "-"
    is_missing = rows[name].isna().sum()
    return f"{rows.depth.corr(rows[name]):.2f}" + (f" ({is_missing} lost)" if is_missing else "")


def held_out_errors(rows: pd.DataFrame, name: str, is_line: bool, is_odd: pd.Series) -> np.ndarray:
    """Fit an offset or a line to the odd ears, and return the errors of the even ones in dB."""
    rows = rows[rows[name].notna()]
    odd, even = rows[is_odd[rows.index]], rows[~is_odd[rows.index]]
    slope, offset = np.polyfit(odd[name], odd.depth, 1) if is_line else (1.0, np.nan)
    if not is_line:
        offset = (odd.depth - odd[name]).mean()
    return (even.depth - offset - slope * even[name]).to_numpy()


def compare_steps(rows: pd.DataFrame, out: Path) -> None:
    """Estimate the change of the tuning depth at MSBG's limits of severity, and draw it."""
    levels = {
        *range(0, 81, 5),
        *(round(limit) + side for limit in SEVERITY_LIMITS for side in (-1, 1)),
    }
    ears = [Audiogram((float(level),) * 8) for level in sorted(levels)]
    keys = pd.DataFrame(
        [(hz, ear.levels[0]) for hz in tuning.NOISE_SPECTRUM_LEVEL for ear in ears],
        columns=["hz", "threshold"],
    )
    flat = ears * len(tuning.NOISE_SPECTRUM_LEVEL)
    path = out / "simulated-tuning-flat.csv"
    simulate(
        path,
        keys,
        flat,
        THREE_EARS,
        lambda simulator: tuning.tuning_depths(simulator, flat, list(keys.hz)),
    )
    simulated = pd.read_csv(path)

    rows["mean loss"] = [mean_loss(ear) for ear in rows.audiogram]
    table = []
    for name in ("depth", "MSBG", "MSBG without smearing", "intended smearing"):
        row = {"tuning depth of": "people" if name == "depth" else name}
        steps = estimate_steps(rows, name)
        low, high = recruitment.bootstrap(rows, lambda part, name=name: estimate_steps(part, name))
        for limit, *values in zip(SEVERITY_LIMITS, steps, low, high, strict=True):
            row[f"at {limit:g} dB HL"] = "{:z.1f} [{:z.1f}, {:z.1f}]".format(*values)
        table.append(row)
    print_table("Step of the tuning depth at a mean loss, in dB", pd.DataFrame(table))

    table = []
    for name in ("MSBG", "MSBG without smearing"):
        curves = [part.set_index("threshold")[name] for _, part in simulated.groupby("hz")]
        row = {"tuning depth of": name}
        for limit in SEVERITY_LIMITS:
            steps = [flat_step(curve, limit) for curve in curves]
            row[f"at {limit:g} dB HL"] = f"{min(steps):.1f} to {max(steps):.1f}"
        table.append(row)
    print_table("Fall at a flat loss beyond the slope, 0.5 to 4 kHz, in dB", pd.DataFrame(table))

    figure = Figure(figsize=(9.2, 6.4), layout="constrained")
    places = figure.subplots(2, 2).ravel()
    for axes, (hz, part) in zip(places, rows.groupby("hz"), strict=False):
        groups = part.groupby(part.hearing_level.round(-1))
        is_group = groups.size() >= 3
        means, deviations = groups.depth.mean()[is_group], groups.depth.std()[is_group]
        style = {"fmt": "o", "color": "tab:orange", "capsize": 2}
        axes.errorbar(
            means.index, means, deviations, label="people, mean and SD of 3 or more", **style
        )
        for name in THREE_EARS:
            curve = simulated[simulated.hz == hz]
            axes.plot(curve.threshold, curve[name], color=COLOURS[name], label=f"{name}, flat loss")
        for limit in SEVERITY_LIMITS:
            axes.axvline(limit, color="black", linewidth=0.5, linestyle=":")
        axes.set(xlabel="threshold (dB HL)", ylabel="tuning depth (dB)", title=f"{hz} Hz")
        axes.set(ylim=(-12, 42))
    places[0].legend(fontsize="small", loc="upper right")
    save(figure, out / "people-tuning.png")


def flat_step(curve: pd.Series, limit: float) -> float:
    """Return by how much a curve falls at a limit beyond its mean slope just below and above.

    >>> flat_step(pd.Series({10: 9.0, 14: 8.0, 16: 6.5, 20: 5.5}), limit=15)
    1.0
    """
    below = curve.loc[: limit - 0.5].tail(2)
    above = curve.loc[limit + 0.5 :].head(2)
    falls = [side.iloc[0] - side.iloc[1] for side in (below, above)]
    spans = [side.index[1] - side.index[0] for side in (below, above)]
    slope = sum(falls) / sum(spans)
    fall = below.iloc[1] - above.iloc[0]
    return float(fall - slope * (above.index[0] - below.index[1]))


def mean_loss(ear: Audiogram) -> float:
    """Return the mean threshold from 2 to 8 kHz in dB HL, which decides MSBG's severity, or NaN."""
    is_high = [2000.0 <= hz <= 8000.0 for hz in ear.frequencies]
    return float(np.mean(np.array(ear.levels)[is_high])) if any(is_high) else float("nan")


def estimate_steps(rows: pd.DataFrame, name: str) -> np.ndarray:
    """Regress the depth on frequency, threshold, mean loss and steps; return the steps in dB."""
    rows = rows[rows[name].notna() & rows["mean loss"].notna()]
    loss = rows["mean loss"].to_numpy()
    columns = [(rows.hz == hz).to_numpy(float) for hz in tuning.NOISE_SPECTRUM_LEVEL]
    columns += [rows.hearing_level.to_numpy(), loss]
    columns += [(loss > limit).astype(float) for limit in SEVERITY_LIMITS]
    coefficients, *_ = np.linalg.lstsq(np.stack(columns, 1), rows[name].to_numpy(), rcond=None)
    return coefficients[-len(SEVERITY_LIMITS) :]


# Words


def compare_words(path: Path, out: Path) -> None:
    """Compare the words that are predicted from HASPI with those that people understood."""
    responses = fit_words.read_responses(path)
    result = fit_words.fit(responses)
    print("\nFitted to all responses:", result.curve)
    systems = fit_words.leave_out_systems(responses, result.start)
    print_table("Each aid left out: share of words", systems.round(2))
    table = []
    for name in ("in its challenge", "in any"):
        errors = systems[f"predicted {name}"] - systems.measured
        row = {"predicted": name}
        for challenge, values in errors.groupby(systems.challenge):
            row[f"bias, challenge {challenge}"] = f"{values.mean():+.3f}"
        row["RMS error"] = f"{np.sqrt(np.square(errors).mean()):.3f}"
        inside = np.average(systems[f"inside {name}"], weights=systems.listeners)
        row["inside 90 %"] = f"{inside:.1%} of {systems.listeners.sum()}"
        table.append(row)
    print_table("Summary", pd.DataFrame(table))

    figure = Figure(figsize=(9.2, 3.8), layout="constrained")
    for axes, challenge in zip(figure.subplots(1, 2), (1, 2), strict=True):
        part = systems[systems.challenge == challenge].sort_values("haspi")
        axes.plot(part.haspi, part.measured, "o", color="tab:orange", label="people")
        for name, style in (("in its challenge", "-"), ("in any", ":")):
            values = part[f"predicted {name}"]
            label = f"predicted {name}, aid left out"
            axes.plot(part.haspi, values, style, color="tab:blue", label=label)
        axes.set(xlabel="mean HASPI of an aid", ylabel="share of words", ylim=(0, 1))
        axes.set_title(f"challenge {challenge}", fontsize="medium")
    axes.legend(fontsize="small")
    save(figure, out / "people-words.png")


COMPARISONS = {
    "thresholds_in_noise.csv": compare_recruitment,
    "loudness.csv": compare_loudness,
    "tuning.csv": compare_tuning,
    "clarity_responses.csv": compare_words,
}


def main(people: str, out: str = "people") -> None:
    warnings.filterwarnings("ignore", message="waveform has a level")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    for file, compare in COMPARISONS.items():
        path = Path(people) / file
        if path.is_file():
            compare(path, folder)
        else:
            print(f"left out: there is no {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
