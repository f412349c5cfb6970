"""Prediction of uncomfortable levels from thresholds, fitted to some people, tested on others.

    python docs/figures/uncomfortable_levels.py people/thresholds_in_noise.csv

The table has one row per person, see ``examples/people_recruitment.py``. Every second person
belongs to the fit. A level of 115 dB HL or more counts as not reached in the fit, and has no error
in the test.
"""

import sys

import numpy as np

from examples.people_recruitment import NOT_REACHED, fit_censored, read_uncomfortable_levels
from hlsim.audiogram.discomfort import predict_limits, predict_uncomfortable_levels


def main(path: str) -> None:
    """Print the fitted line, and the error of hlsim's prediction for the other people."""
    table = read_uncomfortable_levels(path)
    table["place"] = table["person"].rank(method="dense").astype(int)
    fitted, tested = (table[table["place"] % 2 == rest] for rest in (1, 0))
    design = np.stack([np.ones(len(fitted)), fitted["threshold"]], 1)
    fit = fit_censored(design, fitted["ucl"].to_numpy())
    (constant, slope), people = fit.coefficients, fitted["person"].nunique()
    print(
        f"{people} people: UCL = {constant:.1f} + {slope:.2f} threshold, SD {fit.deviation:.1f} dB"
    )
    for name, group in (("the fit", fitted), ("the others", tested)):
        is_above = group["ucl"] >= predict_limits(group["threshold"].to_numpy())
        print(f"{is_above.mean():.1%} of the levels of {name} are above the predicted limit")
    reached = tested[tested["ucl"] < NOT_REACHED]
    errors = predict_uncomfortable_levels(reached["threshold"].to_numpy()) - reached["ucl"]
    print(
        f"{tested['person'].nunique()} others: {len(reached)} of {len(tested)} levels reached, RMS "
        f"error {np.sqrt(np.square(errors).mean()):.1f} dB, mean {errors.mean():+.1f} dB"
    )


if __name__ == "__main__":
    main(sys.argv[1])
