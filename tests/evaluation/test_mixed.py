"""The mixed model against the closed form of a balanced design, and its refusals."""

import math
import sys

import numpy as np
import pytest

from hlsim.evaluation.statistics import MixedModel, mixed_model


def balanced(listeners: int, each: int, between: float, seed: int = 0) -> tuple[np.ndarray, list[str]]:
    rng = np.random.default_rng(seed)
    table = 0.1 + between * rng.normal(size=(listeners, 1)) + 0.1 * rng.normal(size=(listeners, each))
    return table, [f"L{i}" for i in range(listeners) for _ in range(each)]


def test_balanced_design_has_a_closed_form() -> None:
    """REML of a balanced one-way design: the grand mean, with the between-listener mean square over n as its variance."""
    pytest.importorskip("statsmodels")
    table, names = balanced(12, 10, 0.15)
    found = mixed_model(table.ravel().tolist(), names)
    assert isinstance(found, MixedModel)
    means = table.mean(-1)
    between = table.shape[1] * means.var(ddof=1)
    within = ((table - means[:, None]) ** 2).sum() / (table.size - len(table))
    assert between > within  # or the variance would be at its boundary
    assert found.delta == pytest.approx(table.mean(), abs=1e-9)
    assert found.standard_error == pytest.approx(math.sqrt(between / table.size), rel=1e-3)
    assert found.residual_variance == pytest.approx(within, rel=1e-3)
    assert found.listener_variance == pytest.approx((between - within) / table.shape[1], rel=1e-3)
    assert found.z == pytest.approx(found.delta / found.standard_error)
    assert (found.ci_low + found.ci_high) / 2 == pytest.approx(found.delta)
    assert (found.n, found.listeners) == (120, 12)
    # what taking the items as independent would claim
    assert found.standard_error > 2 * table.std(ddof=1) / math.sqrt(table.size)


def test_no_listener_effect_is_a_note_and_no_warning(recwarn: pytest.WarningsRecorder) -> None:
    pytest.importorskip("statsmodels")
    table, names = balanced(6, 8, 0.0, seed=3)
    table = table - table.mean(-1, keepdims=True) + 0.1  # all listeners alike
    found = mixed_model(table.ravel().tolist(), names)
    assert isinstance(found, str) or found.delta == pytest.approx(0.1)
    assert not [w for w in recwarn.list if "statsmodels" in str(w.filename)]


@pytest.mark.parametrize("scale", [1.0, 0.1, 1e-4, 100.0])
def test_the_note_does_not_depend_on_the_unit(scale: float) -> None:
    """statsmodels takes any variance below 0.01 for one at its boundary: nearly all of scores from 0 to 1."""
    pytest.importorskip("statsmodels")
    table, names = balanced(12, 10, 0.15)
    unscaled, found = (mixed_model((k * table).ravel().tolist(), names) for k in (1.0, scale))
    assert isinstance(found, MixedModel) and isinstance(unscaled, MixedModel)
    assert (found.note, found.z, found.p) == ("", pytest.approx(unscaled.z), pytest.approx(unscaled.p))
    assert found.delta == pytest.approx(scale * table.mean())
    assert (found.ci_high - found.ci_low) / 2 == pytest.approx(1.959964 * found.standard_error)
    within = table.var(axis=-1, ddof=1).mean()
    assert found.residual_variance == pytest.approx(scale**2 * within, rel=1e-3)
    assert found.listener_variance == pytest.approx(scale**2 * unscaled.listener_variance, rel=1e-3)
    alike = table - table.mean(-1, keepdims=True) + 0.1  # of which it holds
    found = mixed_model((scale * alike).ravel().tolist(), names)
    assert isinstance(found, str) or "boundary" in found.note


def test_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "two listeners or more" in str(mixed_model([0.1, 0.2, 0.3], ["L1"] * 3))
    assert "more items than listeners" in str(mixed_model([0.1, 0.2], ["L1", "L2"]))
    assert mixed_model([0.1] * 4, ["L1", "L1", "L2", "L2"]) == "the differences do not vary"
    monkeypatch.setitem(sys.modules, "statsmodels.regression.mixed_linear_model", None)
    assert mixed_model([0.1, 0.2, 0.3], ["L1", "L1", "L2"]) == "statsmodels is not installed"
