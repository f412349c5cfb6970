"""The mean difference where utterances nest within listeners: a mixed model, by statsmodels where that is installed."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hlsim.evaluation.significance import ROUNDING


@dataclass(frozen=True)
class MixedModel:
    """Differences = mean + listener's own deviation + residual, fitted by REML.

    Attributes:
        n, listeners: differences, and listeners they come from.
        delta: estimated mean difference.
        standard_error, z, p: of it; Wald test, two-sided.
        ci_low, ci_high: its 95 % Wald interval.
        listener_variance, residual_variance: between and within listeners.
        note: what the fit complained of, such as no convergence; empty where it did not.
    """

    n: int
    listeners: int
    delta: float
    standard_error: float
    z: float
    p: float
    ci_low: float
    ci_high: float
    listener_variance: float
    residual_variance: float
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        """A plain dictionary that JSON can hold."""
        return asdict(self)


def mixed_model(differences: Sequence[float], listeners: Sequence[str]) -> MixedModel | str:
    """The mean difference with listeners as a random intercept, or the reason in words why there is none.

    With few listeners the Wald test is too sure of itself (Luke 2017, Behav. Res. Methods 49): read it beside the tests
    of the listeners' means.
    """
    groups = len(set(listeners))
    if groups < 2 or len(differences) <= groups:
        return "needs two listeners or more, and more items than listeners"
    values = np.asarray(differences, dtype=np.float64)
    if np.ptp(values) <= ROUNDING * np.abs(values).max():
        return "the differences do not vary"
    try:
        # no extra brings statsmodels: the report is whole without it
        models = importlib.import_module("statsmodels.regression.mixed_linear_model")
    except ImportError:
        return "statsmodels is not installed"
    ones = np.ones((len(values), 1))
    # statsmodels takes any variance below 0.01 for one at its boundary, whatever the unit
    scale = float(values.std())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            fit = models.MixedLM(values / scale, ones, groups=np.asarray(listeners)).fit(reml=True)
            z, p = (float(x[0]) for x in (fit.tvalues, fit.pvalues))
            delta, error, low, high = (
                scale * float(x) for x in (fit.fe_params[0], fit.bse_fe[0], *fit.conf_int()[0])
            )
        except (np.linalg.LinAlgError, ValueError) as failure:
            return f"the fit failed ({failure})"
    figures = (delta, error, z, p, low, high)
    if not np.isfinite(figures).all():
        return "the fit has no standard error"
    complaints = [] if fit.converged else ["no convergence"]
    complaints += sorted({str(w.message) for w in caught if "boundary" in str(w.message)})
    return MixedModel(
        len(values),
        groups,
        *figures,
        listener_variance=scale**2 * float(np.asarray(fit.cov_re)[0, 0]),
        residual_variance=scale**2 * float(fit.scale),
        note="; ".join(complaints),
    )
