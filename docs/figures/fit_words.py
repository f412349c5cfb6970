"""Fit and cross-validate the curve from HASPI to words in ``hlsim/metrics/words.json``.

    python docs/figures/fit_words.py TABLE [FILE]

It takes some minutes, and writes the fit to FILE. TABLE is a CSV file with one row per response
of a listener to a sentence: ``challenge`` (CEC1 or CEC2), ``listener``, ``system`` (hearing aid),
``scene`` (sentence), ``words_correct_percent`` and ``haspi_better_ear``, its HASPI v2. The shipped
fit is that of responses from Clarity's first two enhancement challenges, which their
prediction challenges publish. They are not part of hlsim.

The number of understood words of a sentence is beta-binomial. The logit of its mean is

    intercept + within (h - m) + between (m - 0.5) + challenge c + listener + slope (h - 0.5) + aid

where h is the HASPI of the sentence, m the mean HASPI of its aid, and c = 1 for the first and -1
for the second challenge, whose scenes were harder to understand at the same HASPI. The intercept is
therefore that of the mean of the two. Listeners, their slopes and aids have normal deviations.
``between`` differs from ``within``, because two aids whose mean HASPI differs by 0.1 differ by more
words than two sentences of one aid do. The fit maximises Laplace's approximation of the marginal
likelihood.
"""

import json
import sys
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.special import betaln, digamma, expit, polygamma

from hlsim.metrics.words import Curve, simulate_proportions

FIXED = 4
"""Number of fixed coefficients, of which the last is the effect of the challenge."""

START = (0.4, 3.2, 5.0, 0.0, 0.5, -0.6, -1.0, -1.0)
"""Initial values: fixed coefficients, and logarithms of the dispersion and of three deviations."""

WORDS = range(7, 11)
"""Possible numbers of words in a sentence."""


class Fit(NamedTuple):
    """Fitted curve, and all coefficients as initial values of another fit."""

    curve: Curve
    start: np.ndarray


def read_responses(path: str | Path) -> pd.DataFrame:
    """Read one row per response: listener, system, sign, hits, n_words, haspi, mean per system.

    ``challenge`` is 1 or 2, and ``sign`` is 1 for the first challenge and -1 for the second one.
    """
    rows = pd.read_csv(path)
    rows["system"] = rows.challenge + " " + rows.system
    rows["challenge"] = rows.challenge.map({"CEC1": 1, "CEC2": 2})
    rows["sign"] = 3.0 - 2.0 * rows.challenge
    rows["haspi"] = rows.haspi_better_ear
    rows["mean"] = rows.groupby("system").haspi.transform("mean")
    scenes = rows.groupby(["challenge", "scene"]).words_correct_percent
    rows["n_words"] = scenes.transform(count_words)
    rows["hits"] = np.rint(rows.n_words * rows.words_correct_percent / 100.0)
    return rows


def count_words(percentages: pd.Series) -> int:
    """Return the smallest number of words of a sentence that the shares of its words allow.

    Where each response has all words or none, it is 8, near the mean.
    """
    shares = percentages.to_numpy() / 100.0
    if set(shares) <= {0.0, 1.0}:
        return 8
    errors = [np.abs(shares * words - np.rint(shares * words)).max() for words in WORDS]
    matching = [words for words, error in zip(WORDS, errors, strict=True) if error < 2e-3]
    return matching[0] if matching else WORDS[int(np.argmin(errors))]


def fit(rows: pd.DataFrame, start: np.ndarray | tuple[float, ...] = START) -> Fit:
    """Fit the curve to responses, from initial values."""
    hits, words = rows.hits.to_numpy(float), rows.n_words.to_numpy(float)
    haspi, mean = rows.haspi.to_numpy(), rows["mean"].to_numpy()
    fixed = np.stack([np.ones(len(rows)), haspi - mean, mean - 0.5, rows.sign], 1)
    listeners, systems = (
        pd.get_dummies(rows[name]).to_numpy(float) for name in ("listener", "system")
    )
    groups = (listeners, listeners * (haspi - 0.5)[:, None], systems)
    mode = np.zeros(sum(group.shape[1] for group in groups))

    def derivatives(logit: np.ndarray, dispersion: float) -> tuple[np.ndarray, ...]:
        """Compute the log likelihood of each row, and its derivatives with respect to the logit."""
        p = np.clip(expit(logit), 1e-7, 1.0 - 1e-7)
        slope, a, b = p * (1.0 - p), p * dispersion, (1.0 - p) * dispersion
        misses = words - hits
        value = betaln(hits + a, misses + b) - betaln(a, b)
        first = dispersion * (digamma(hits + a) - digamma(a) - digamma(misses + b) + digamma(b))
        second = (
            polygamma(1, hits + a) - polygamma(1, a) + polygamma(1, misses + b) - polygamma(1, b)
        )
        curvature = dispersion**2 * second * slope**2 + first * slope * (1.0 - 2.0 * p)
        return value, first * slope, curvature

    def at_mode(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Find the mode of the deviations by Newton's method.

        Returns:
            The log of the joint density at the mode, the curvature of each row, and the design
            matrix of the deviations.
        """
        nonlocal mode
        base, dispersion = fixed @ x[:FIXED], float(np.exp(x[FIXED]))
        design = np.concatenate(
            [np.exp(s) * group for s, group in zip(x[FIXED + 1 :], groups, strict=True)], 1
        )

        def joint(deviations: np.ndarray) -> float:
            values = derivatives(base + design @ deviations, dispersion)[0]
            return float(values.sum() - 0.5 * deviations @ deviations)

        for _ in range(50):
            _, first, second = derivatives(base + design @ mode, dispersion)
            hessian = design.T @ (np.maximum(-second, 1e-9)[:, None] * design) + np.eye(len(mode))
            step = np.linalg.solve(hessian, design.T @ first - mode)
            density = joint(mode)
            while not joint(mode + step) >= density - 1e-9 and np.abs(step).max() > 1e-9:
                step = step / 2.0
            mode = mode + step
            if np.abs(step).max() < 1e-7:
                break
        return joint(mode), -derivatives(base + design @ mode, dispersion)[2], design

    def negative_marginal(x: np.ndarray) -> float:
        value, weights, design = at_mode(x)
        hessian = design.T @ (weights[:, None] * design) + np.eye(len(mode))
        return float(0.5 * np.linalg.slogdet(hessian)[1]) - value

    bounds = [(-15.0, 15.0)] * FIXED + [(-3.0, 4.0)] + [(-5.0, 2.0)] * 3
    x = minimize(negative_marginal, np.array(start), method="L-BFGS-B", bounds=bounds).x
    _, weights, design = at_mode(x)
    full_design = np.concatenate([fixed, design], 1)
    prior_precision = np.diag([0.0] * FIXED + [1.0] * len(mode))
    information = full_design.T @ (weights[:, None] * full_design) + prior_precision
    covariance = np.linalg.inv(information)[:3, :3]
    *coefficients, challenge = x[:FIXED]
    dispersion, *deviations = np.exp(x[FIXED:])
    table = tuple(map(tuple, covariance))
    curve = Curve(
        tuple(coefficients), table, dispersion, *deviations, float(words.mean()), challenge
    )
    return Fit(curve, x)


def predict(curve: Curve, rows: pd.DataFrame) -> np.ndarray:
    """Predict the share of words understood of each sentence, averaged over listeners and aids."""
    haspi, mean = rows.haspi.to_numpy(), rows["mean"].to_numpy()
    predictors = np.stack([np.ones(len(rows)), haspi - mean, mean - 0.5, rows.sign], 1)
    logit = predictors @ np.array([*curve.coefficients, curve.challenge])
    variance = curve.listener**2 + curve.aid**2 + (curve.listener_slope * (haspi - 0.5)) ** 2
    return expit(logit / np.sqrt(1.0 + 0.346 * variance))  # nearly the mean over a normal law


def differences_between_aids(
    curve: Curve, rows: pd.DataFrame, system: str | None
) -> Iterator[tuple[float, np.ndarray]]:
    """Compare each listener's responses to two aids with the curve.

    Args:
        curve: Fitted curve.
        rows: Responses.
        system: Aid that one of the two must be; None for all pairs.

    Yields:
        The measured difference in the share of words, and simulated differences.
    """
    for (_, challenge), responses in rows.groupby(["listener", "challenge"]):
        aids = dict(tuple(responses.groupby("system")))
        names = sorted(aids, key=lambda name: aids[name]["mean"].iloc[0])
        for before, after in combinations(names, 2):
            if system is not None and system not in (before, after):
                continue
            pair = [(aids[a].haspi.to_numpy(), aids[a]["mean"].iloc[0]) for a in (before, after)]
            shares = [aids[name].words_correct_percent.mean() for name in (before, after)]
            of_challenge = curve.of_challenge(challenge)
            first, second = simulate_proportions(of_challenge, pair)
            yield (shares[1] - shares[0]) / 100.0, second - first


def leave_out_systems(rows: pd.DataFrame, start: np.ndarray) -> pd.DataFrame:
    """Predict each aid with the curve of the others, in its challenge and in any.

    Args:
        rows: Responses.
        start: Initial values of the fits.

    Returns:
        One row per aid: challenge, system, mean HASPI, measured share of words, predicted shares,
        and the share of its listeners whose own share lies in the interval of 90 %.
    """
    table = []
    for system, responses in rows.groupby("system"):
        curve = fit(rows[rows.system != system].reset_index(drop=True), start).curve
        challenge, mean = responses.challenge.iloc[0], responses["mean"].iloc[0]
        row = {"challenge": challenge, "system": system, "haspi": mean}
        row["measured"] = (responses.hits / responses.n_words).mean()
        for name, variant in (
            ("in its challenge", curve.of_challenge(challenge)),
            ("in any", curve),
        ):
            [shares] = simulate_proportions(variant, [(responses.haspi.to_numpy(), mean)])
            row[f"predicted {name}"] = shares.mean()
            is_inside = []
            for _, part in responses.groupby("listener"):
                [shares] = simulate_proportions(variant, [(part.haspi.to_numpy(), mean)])
                low, high = np.quantile(shares, [0.05, 0.95])
                is_inside.append(low <= (part.hits / part.n_words).mean() <= high)
            row[f"inside {name}"] = np.mean(is_inside)
        row["listeners"] = len(is_inside)
        table.append(row)
    return pd.DataFrame(table)


def cross_validate(rows: pd.DataFrame, by: str, start: np.ndarray) -> dict[str, float]:
    """Leave out each listener or each aid in turn, and predict it with the curve of the others.

    Args:
        rows: Responses.
        by: ``listener`` or ``system``.
        start: Initial values of the fits.
    """
    is_inside, widths, errors, coefficients, sentence_errors = [], [], [], [], []
    for name in rows[by].unique():
        is_left_out = rows[by] == name
        curve = fit(rows[~is_left_out].reset_index(drop=True), start).curve
        coefficients.append(curve.coefficients)
        left_out = rows[is_left_out]
        sentence_errors.append(
            100.0 * (predict(curve, left_out) - left_out.hits / left_out.n_words)
        )
        if by == "listener":
            differences = differences_between_aids(curve, left_out, None)
        else:
            differences = differences_between_aids(curve, rows, name)
        for measured, simulated in differences:
            low, high = np.quantile(simulated, [0.05, 0.95])
            is_inside.append(low <= measured <= high)
            widths.append(high - low)
            errors.append(measured - simulated.mean())
    spread = np.array(coefficients)
    count = len(spread)
    jackknife = np.sqrt((count - 1) / count * np.square(spread - spread.mean(0)).sum(0))
    return {
        "left_out": count,
        "differences": len(is_inside),
        "inside_90_percent_interval": float(np.mean(is_inside)),
        "width": float(np.mean(widths)),
        "rms_error_of_a_sentence_in_points": float(
            np.sqrt(np.mean(np.square(np.concatenate(sentence_errors))))
        ),
        "rms_error": float(np.sqrt(np.mean(np.square(errors)))),
        "standard_errors": [round(float(error), 3) for error in jackknife],
    }


def main(table: str, path: str | None = None) -> None:
    rows = read_responses(table)
    result = fit(rows)
    listeners, systems = rows.listener.nunique(), rows.system.nunique()
    print(f"{len(rows)} responses, {listeners} listeners, {systems} aids\n{result.curve}")
    if path is not None:
        rounded = json.loads(
            json.dumps(result.curve._asdict()), parse_float=lambda digits: round(float(digits), 6)
        )
        Path(path).write_text(json.dumps(rounded, indent=2) + "\n")
    print(leave_out_systems(rows, result.start).round(3).to_string())
    for by in ("listener", "system"):
        print(f"without each {by} in turn: {cross_validate(rows, by, result.start)}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
