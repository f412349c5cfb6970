"""The comparison with people finds what simulated people were made of."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from torch import nn

from hlsim import MSBG, Audiogram
from hlsim.simulators import Attenuation
from tests.helpers import load_example, load_figure

FLAT_EARS = [Audiogram((level,) * 8) for level in (0.0, 20.0, 40.0)]


def test_a_population_of_known_slope_gives_the_slope_back() -> None:
    recruitment = load_example("people_recruitment.py")
    random = np.random.default_rng(0)
    threshold = random.uniform(0.0, 80.0, 6000)
    level = 90.0 + 0.25 * threshold + 12.0 * random.standard_normal(6000)
    ucl = np.where(level >= 115.0, random.choice([115.0, 120.0], 6000), level)
    fit = recruitment.fit_censored(recruitment.line(threshold), ucl)
    np.testing.assert_allclose(fit.coefficients, [90.0, 0.25], atol=0.8, rtol=0.05)
    assert abs(fit.deviation - 12.0) < 0.5
    # Without the levels that were not reached, the slope is too small.
    reached = ucl < 115.0
    assert np.polyfit(threshold[reached], ucl[reached], 1)[0] < 0.2
    assert abs(recruitment.full_recruitment(105.0 * 0.75, 0.25) - 105.0) < 1e-9


@pytest.mark.parametrize("hz", [500, 4000])
def test_the_uncomfortable_level_follows_the_loss_in_a_linear_ear_and_hardly_in_msbg(
    hz: int,
) -> None:
    recruitment = load_example("people_recruitment.py")

    def levels(simulator: nn.Module) -> np.ndarray:
        return recruitment.simulated_uncomfortable_levels(simulator, FLAT_EARS, hz, 90.0)

    np.testing.assert_allclose(levels(Attenuation()), [90.0, 110.0, 130.0], atol=0.1)
    slopes = np.diff(levels(MSBG(smearing=False))) / 20.0
    assert (slopes > 0.1).all() and (slopes < 0.25).all()


def test_loudness_grows_by_one_in_a_linear_ear_and_with_the_loss_in_msbg() -> None:
    recruitment = load_example("people_recruitment.py")
    linear = recruitment.growth_of_perceived_level(Attenuation(), FLAT_EARS)
    np.testing.assert_allclose(linear, 1.0, atol=1e-3)
    # Full recruitment at 105 dB SPL.
    growth = recruitment.growth_of_perceived_level(MSBG(smearing=False), FLAT_EARS)
    np.testing.assert_allclose(growth, [1.0, 105.0 / 85.0, 105.0 / 65.0], rtol=0.03)


def test_slopes_of_a_known_full_recruitment_give_it_back() -> None:
    people = load_example("people.py")
    loss = np.linspace(40.0, 80.0, 99)
    rows = pd.DataFrame({"slope": 0.3 * 120.0 / (120.0 - loss), "normal": 0.3})
    rows["MSBG without smearing"] = 0.3 * 105.0 / (105.0 - loss)
    assert abs(people.full_recruitment_of_slopes(rows) - 120.0) < 0.01


def test_a_curve_with_a_step_on_a_slope_gives_the_step_back() -> None:
    people = load_example("people.py")
    loss = np.array([10, 14, 15, 16, 20])
    curve = pd.Series(9.0 - 0.25 * loss - 1.5 * (loss > 15), index=loss)
    assert people.flat_step(curve, limit=15.0) == pytest.approx(1.5)


def test_simulated_values_are_used_again_only_for_the_same_ears(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    people = load_example("people.py")
    monkeypatch.setattr(people, "SIMULATORS", {"msbg": MSBG})
    path, keys = tmp_path / "values.csv", pd.DataFrame({"person": ["P001", "P002"], "hz": 500})
    for ears, value in ((FLAT_EARS[:2], 1.0), (FLAT_EARS[:2], 2.0), (FLAT_EARS[1:3], 3.0)):
        people.simulate(path, keys, ears, ["msbg"], lambda _, value=value: np.full(2, value))
        used = 1.0 if value == 2.0 else value  # the second call finds those of the first
        assert pd.read_csv(path).msbg.tolist() == [used, used]


def test_slopes_are_read_with_the_mean_threshold_of_their_frequencies(tmp_path: Path) -> None:
    recruitment = load_example("people_recruitment.py")
    columns = ["left_500", "left_1500", "left_4000", "right_1500", "right_4000"]
    table = pd.DataFrame(
        [("P001", 10.0, 20.0, 60.0, 30.0, None), ("P002", 10.0, 20.0, 110.0, 30.0, 40.0)],
        columns=["person", *columns],
    ).assign(mlow_left=0.5, mlow_right=[0.4, 0.3])
    table.to_csv(tmp_path / "loudness.csv", index=False)
    rows = recruitment.read_loudness(tmp_path / "loudness.csv")
    # An ear without a threshold at 4 kHz and one with a threshold above the range are left out.
    assert rows[["person", "ear", "threshold", "slope"]].values.tolist() == [
        ["P001", "left", 40.0, 0.5],
        ["P002", "right", 35.0, 0.3],
    ]
    assert rows.audiogram[0] == Audiogram((10.0, 20.0, 60.0), (500.0, 1500.0, 4000.0))


def test_a_loss_costs_tuning_in_msbg_and_none_in_a_linear_ear() -> None:
    tuning = load_example("people_tuning.py")
    ears = [FLAT_EARS[0], FLAT_EARS[2]]
    normal, impaired = tuning.tuning_depths(MSBG(), ears, [1000, 1000])
    linear_normal, linear_impaired = tuning.tuning_depths(Attenuation(), ears, [1000, 1000])
    assert 15.0 < impaired < normal - 5.0 and normal < 40.0
    assert abs(linear_normal - linear_impaired) < 0.3
    # The depth of an ear without a loss is that of the detector.
    assert abs(linear_normal - normal) < 1.0


def test_smearing_widens_no_filter_for_a_tone_and_fills_a_part_of_a_gap_in_noise() -> None:
    tuning = load_example("people_tuning.py")
    before, after, wide = tuning.passed_by_filters("tone", 1000, "severe")
    assert abs(after - before) < 0.5 and wide > before + 15.0
    before, after, wide = tuning.passed_by_filters("noise", 2000, "severe")
    assert before + 3.0 < after < wide - 3.0


def _simulated_responses(effect: float) -> pd.DataFrame:
    random = np.random.default_rng(0)
    rows = []
    for challenge, sign in (("CEC1", 1.0), ("CEC2", -1.0)):
        for system in range(6):
            mean = 0.15 + 0.14 * system
            for listener in range(10):
                for scene in range(4):
                    haspi = np.clip(mean + 0.1 * random.standard_normal(), 0.0, 1.0)
                    logit = 4.0 * (haspi - 0.5) + sign * effect
                    hits = random.binomial(8, 1.0 / (1.0 + np.exp(-logit)))
                    scene_name = f"S{challenge}{system}{listener}{scene}"
                    row = (challenge, f"L{listener}", f"E{system}", scene_name, 12.5 * hits, haspi)
                    rows.append(row)
    columns = "challenge listener system scene words_correct_percent haspi_better_ear".split()
    return pd.DataFrame(rows, columns=columns)


@pytest.mark.slow
def test_the_effect_of_a_challenge_is_found_again(tmp_path: Path) -> None:
    words = load_figure("fit_words.py")
    path = tmp_path / "responses.csv"
    _simulated_responses(effect=0.5).to_csv(path, index=False)
    curve = words.fit(words.read_responses(path)).curve
    assert abs(curve.challenge - 0.5) < 0.15
    assert abs(curve.coefficients[0]) < 0.2 and abs(curve.coefficients[1] - 4.0) < 1.0
    easy, hard = curve.of_challenge(1), curve.of_challenge(2)
    np.testing.assert_allclose(easy.coefficients[0] - hard.coefficients[0], 2.0 * curve.challenge)


def test_number_of_words_follows_from_the_shares() -> None:
    words = load_figure("fit_words.py")
    assert words.count_words(pd.Series([85.71, 100.0])) == 7
    assert words.count_words(pd.Series([50.0, 80.0])) == 10
    assert words.count_words(pd.Series([0.0, 100.0])) == 8


def _depths_with_a_step(
    simulator: nn.Module, ears: Sequence[Audiogram], hz: Sequence[int]
) -> np.ndarray:
    losses = np.array([np.mean(ear.levels) for ear in ears])
    return 20.0 - 0.2 * losses + 5.0 * (losses > 35.0)


def _growth_of_msbg(simulator: nn.Module, ears: Sequence[Audiogram]) -> np.ndarray:
    return np.array([105.0 / (105.0 - np.mean(ear.levels)) for ear in ears])


def _write_people(folder: Path) -> None:
    random = np.random.default_rng(0)
    people, loudness, tuned = [], [], []
    for number in range(1, 13):
        loss = 5.0 * number
        row = {"person": f"P{number:03d}"}
        for ear in ("left", "right"):
            row |= {f"{ear}_{hz}": loss for hz in (125, 250, 500, 750, 1000, 1500, 2000, 4000)}
            for hz in (500, 1000, 2000, 4000):
                row[f"ucl_{ear}_{hz}"] = 90.0 + 0.2 * loss + 5.0 * random.standard_normal()
        people.append(row)
        slope = 0.3 * 105.0 / (105.0 - loss)
        loudness.append(row | {"mlow_left": slope, "mlow_right": slope})
        for hz in (500, 1000, 2000, 4000):
            group = "normal" if number < 4 else "impaired"
            depth = 20.0 - 0.2 * loss + random.standard_normal()
            tuned.append((f"T{number:03d}", group, hz, loss, depth))
    pd.DataFrame(people).to_csv(folder / "thresholds_in_noise.csv", index=False)
    pd.DataFrame(loudness).to_csv(folder / "loudness.csv", index=False)
    columns = "ear group frequency_hz threshold_500ms_db_spl tuning_depth_db".split()
    pd.DataFrame(tuned, columns=columns).to_csv(folder / "tuning.csv", index=False)


@pytest.mark.slow
def test_one_command_prints_and_draws(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("matplotlib")
    people = load_example("people.py")
    # MSBG takes minutes, and every simulator is called in the same way.
    simulators: dict[str, Callable[[], nn.Module]] = dict.fromkeys(people.SIMULATORS, Attenuation)
    monkeypatch.setattr(people, "SIMULATORS", simulators)
    monkeypatch.setattr(people.tuning, "tuning_depths", _depths_with_a_step)
    monkeypatch.setattr(people.recruitment, "growth_of_perceived_level", _growth_of_msbg)
    bootstrap = people.recruitment.bootstrap
    monkeypatch.setattr(
        people.recruitment, "bootstrap", lambda rows, statistic: bootstrap(rows, statistic, 3)
    )
    _write_people(tmp_path)
    out = tmp_path / "out"
    people.main(str(tmp_path), str(out))
    first = capsys.readouterr().out
    assert "Slope of UCL over threshold" in first and "Step of the tuning depth" in first
    assert "left out: there is no" in first and "clarity_responses.csv" in first
    lines = first.splitlines()
    slopes = next(line for line in lines if line.startswith("| 500 |"))
    assert "| 1.00 |" in slopes  # that of the linear ear
    steps = next(line for line in lines if line.startswith("| MSBG | 0.0 ["))
    assert steps.split("| ")[3].startswith("5.0 [")  # at 35 dB HL
    assert "from 40 dB HL on: 105 [105, 105]" in first
    for name in ("recruitment", "loudness", "tuning"):
        assert (out / f"people-{name}.png").stat().st_size > 0
    monkeypatch.setattr(people, "SIMULATORS", dict.fromkeys(simulators, None))
    people.main(str(tmp_path), str(out))  # The simulated values are used again.
    assert capsys.readouterr().out == first
