"""Words understood as HASPI tells them: fits ``hlsim/metrics/words.json`` anew, and leaves listeners and aids out.

    python examples/fit_words.py [FILE]      # writes the fit to FILE; needs pyclarity, about two minutes

Data of the Clarity prediction challenges that come with pyclarity: responses of hearing-impaired listeners to sentences
through ten aids (CPC1), and HASPI v2 of the better ear of the same signals, for standard ears of three severities (CPC3).

Hits among the words of a sentence are beta-binomial. The logit of their mean is

    intercept + within (h - m) + between (m - 0.5) + listener + listener's slope (h - 0.5) + aid

with h the sentence's HASPI, m the mean of its aid, and normal deviations of listeners, of their slopes and of aids: aids
whose mean differs by 0.1 differ by more words than two sentences of one aid do. Fitted by Laplace's approximation of the
marginal likelihood.
"""

import json
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.special import betaln, digamma, expit, polygamma

from hlsim.metrics.words import Curve, simulate_changes

START = (0.4, 3.2, 5.0, 0.5, -0.6, -1.0, -1.0)
"""Fixed coefficients, then logarithms of the dispersion and of the three deviations."""


class Fit(NamedTuple):
    curve: Curve
    start: np.ndarray


def data() -> pd.DataFrame:
    """A row a response: listener, system, hits, n_words, haspi, and the system's mean of it."""
    spec = find_spec("recipes")
    if spec is None or not spec.submodule_search_locations:
        raise SystemExit("pyclarity is not installed: pip install 'pyclarity==0.9.*'")
    recipes = Path(spec.submodule_search_locations[0])
    with (
        recipes / "cpc3/baseline/precomputed_haspi/clarity_data.train.haspi.jsonl"
    ).open() as file:
        scores = {row["signal"]: row["haspi"] for row in map(json.loads, file)}
    rows = pd.DataFrame(
        json.loads((recipes / "cpc1/test_listener_responses/CPC1.test.json").read_text())
    )
    rows["haspi"] = ("CEC1_" + rows.system + "_" + rows.scene + "_" + rows.listener).map(scores)
    rows = rows.dropna(subset="haspi").reset_index(drop=True)
    rows["mean"] = rows.groupby("system").haspi.transform("mean")
    return rows


def fit(rows: pd.DataFrame, start: np.ndarray | tuple[float, ...] = START) -> Fit:
    hits, words = rows.hits.to_numpy(float), rows.n_words.to_numpy(float)
    haspi, mean = rows.haspi.to_numpy(), rows["mean"].to_numpy()
    fixed = np.stack([np.ones(len(rows)), haspi - mean, mean - 0.5], 1)
    listeners, systems = (
        pd.get_dummies(rows[name]).to_numpy(float) for name in ("listener", "system")
    )
    groups = (listeners, listeners * (haspi - 0.5)[:, None], systems)
    mode = np.zeros(sum(group.shape[1] for group in groups))

    def derivatives(logit: np.ndarray, dispersion: float) -> tuple[np.ndarray, ...]:
        """Log likelihood of each row, and its first and second derivative."""
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
        """Log of the joint density at the deviations' mode (Newton), the curvatures and the deviations' design."""
        nonlocal mode
        base, dispersion = fixed @ x[:3], float(np.exp(x[3]))
        design = np.concatenate(
            [np.exp(s) * group for s, group in zip(x[4:], groups, strict=True)], 1
        )

        def joint(deviations: np.ndarray) -> float:
            values = derivatives(base + design @ deviations, dispersion)[0]
            return float(values.sum() - 0.5 * deviations @ deviations)

        for _ in range(50):
            _, first, second = derivatives(base + design @ mode, dispersion)
            hessian = design.T @ (np.maximum(-second, 1e-9)[:, None] * design) + np.eye(len(mode))
            step, here = np.linalg.solve(hessian, design.T @ first - mode), joint(mode)
            while not joint(mode + step) >= here - 1e-9 and np.abs(step).max() > 1e-9:
                step = step / 2.0
            mode = mode + step
            if np.abs(step).max() < 1e-7:
                break
        return joint(mode), -derivatives(base + design @ mode, dispersion)[2], design

    def marginal(x: np.ndarray) -> float:
        value, weights, design = at_mode(x)
        hessian = design.T @ (weights[:, None] * design) + np.eye(len(mode))
        return float(0.5 * np.linalg.slogdet(hessian)[1]) - value

    bounds = [(-15.0, 15.0)] * 3 + [(-3.0, 4.0)] + [(-5.0, 2.0)] * 3
    x = minimize(marginal, np.array(start), method="L-BFGS-B", bounds=bounds).x
    _, weights, design = at_mode(x)
    both = np.concatenate([fixed, design], 1)
    information = both.T @ (weights[:, None] * both) + np.diag([0.0] * 3 + [1.0] * len(mode))
    covariance = np.linalg.inv(information)[:3, :3]
    scales = np.exp(x[3:])
    return Fit(Curve(tuple(x[:3]), tuple(map(tuple, covariance)), *scales, float(words.mean())), x)


def expected(curve: Curve, rows: pd.DataFrame) -> np.ndarray:
    """Share of each sentence's words, averaged over listeners and aids."""
    haspi, mean = rows.haspi.to_numpy(), rows["mean"].to_numpy()
    logit = np.stack([np.ones(len(rows)), haspi - mean, mean - 0.5], 1) @ np.array(
        curve.coefficients
    )
    variance = curve.listener**2 + curve.aid**2 + (curve.listener_slope * (haspi - 0.5)) ** 2
    return expit(logit / np.sqrt(1.0 + 0.346 * variance))  # a logistic over a normal law, nearly


def left_out(rows: pd.DataFrame, by: str, start: np.ndarray) -> dict[str, float]:
    """Without each listener or aid in turn: the differences between two aids as each listener understood them."""
    inside, width, errors, coefficients, singles = [], [], [], [], []
    for name in rows[by].unique():
        curve = fit(rows[rows[by] != name].reset_index(drop=True), start).curve
        coefficients.append(curve.coefficients)
        held = rows[rows[by] == name]
        singles.append(100.0 * (expected(curve, held) - held.hits / held.n_words))
        for _, own in (held if by == "listener" else rows).groupby("listener"):
            aids = dict(tuple(own.groupby("system")))
            names = sorted(aids, key=lambda system: aids[system]["mean"].iloc[0])
            for i, before in enumerate(names):
                for after in names[i + 1 :]:
                    if by == "system" and name not in (before, after):
                        continue
                    pair = [
                        (aids[a].haspi.to_numpy(), aids[a]["mean"].iloc[0]) for a in (before, after)
                    ]
                    drawn = simulate_changes(curve, pair)
                    low, high = np.quantile(drawn, [0.05, 0.95])
                    heard = (
                        aids[after].correctness.mean() - aids[before].correctness.mean()
                    ) / 100.0
                    inside.append(low <= heard <= high)
                    width.append(high - low)
                    errors.append(heard - drawn.mean())
    spread = np.array(coefficients)
    count = len(spread)
    jackknife = np.sqrt((count - 1) / count * np.square(spread - spread.mean(0)).sum(0))
    return {
        "left_out": count,
        "differences": len(inside),
        "held_by_90_percent": float(np.mean(inside)),
        "width": float(np.mean(width)),
        "rms_error_of_a_sentence_in_points": float(
            np.sqrt(np.mean(np.square(np.concatenate(singles))))
        ),
        "rms_error": float(np.sqrt(np.mean(np.square(errors)))),
        "standard_errors": [round(float(s), 3) for s in jackknife],
    }


def main(path: str | None = None) -> None:
    rows = data()
    found = fit(rows)
    listeners, systems = rows.listener.nunique(), rows.system.nunique()
    print(f"{len(rows)} responses, {listeners} listeners, {systems} aids\n{found.curve}")
    if path is not None:
        rounded = json.loads(
            json.dumps(found.curve._asdict()), parse_float=lambda digits: round(float(digits), 6)
        )
        Path(path).write_text(json.dumps(rounded, indent=2) + "\n")
    for by in ("listener", "system"):
        print(f"without each {by} in turn: {left_out(rows, by, found.start)}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
