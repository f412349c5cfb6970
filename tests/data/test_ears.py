"""Random ears: as measured ones. Ears of a plan: proportions, different ears an utterance, and none in two splits."""

from collections import Counter
from pathlib import Path

import pytest
import torch

from hlsim.audiogram import Audiogram, severity_index
from hlsim.audiogram.thresholds import as_thresholds
from hlsim.data import ears as module
from hlsim.data.ears import Ears, check_shares, draw_thresholds
from hlsim.data.plan_settings import PlanSettings

SPLITS = ("train", "valid", "test")


def plan_ears(
    shares: dict[str, float] | None,
    first: Path | None,
    second: Path | None,
    splits: tuple[str, ...],
    seed: int,
    ears: int = 2,
) -> Ears:
    settings = PlanSettings(
        Path(), severities=shares, seed=seed, audiograms=first, test_audiograms=second, ears=ears
    )
    return module.plan_ears(settings, splits)


def table(path: Path, ears: list[tuple[str, tuple[float, ...]]], **columns: list[str]) -> Path:
    names = [f"hl_{f}" for f in (250, 500, 1000, 2000, 3000, 4000, 6000, 8000)]
    lines = [",".join(["listener", *columns, *names])]
    for i, (who, levels) in enumerate(ears):
        lines.append(
            ",".join([who, *(values[i] for values in columns.values()), *map(str, levels)])
        )
    path.write_text("\n".join(lines) + "\n")
    return path


def listeners(count: int) -> list[tuple[str, tuple[float, ...]]]:
    """Two ears each, from mild to severe."""
    return [
        (f"L{i:03d}", tuple(float(20 + 2 * i + side + k) for k in range(8)))
        for i in range(count)
        for side in (0, 1)
    ]


def test_drawn_ears_look_like_measured_ones() -> None:
    ears = draw_thresholds(20000, torch.Generator().manual_seed(3))
    assert ears.shape == (20000, 8)
    assert float(ears.min()) >= -10.0 and float(ears.max()) <= 100.0
    shares = torch.bincount(severity_index(ears), minlength=4) / len(ears)
    # the docstring's: 27, 18, 19 and 36 %
    torch.testing.assert_close(shares, torch.tensor([0.27, 0.18, 0.19, 0.36]), atol=0.015, rtol=0)
    rounded = (ears % 5.0 == 0.0).all(-1).float().mean()
    assert 0.73 < float(rounded) < 0.77
    # high-frequency losses are the rule
    assert float((ears[:, -2] > ears[:, 0]).float().mean()) > 0.7


def test_drawn_ears_are_alike_at_neighbouring_frequencies() -> None:
    ears = draw_thresholds(5000, torch.Generator().manual_seed(4))
    correlation = torch.corrcoef(ears.T)
    neighbours = correlation.diagonal(1)
    assert float(neighbours.min()) > 0.85
    assert float(correlation[0, -1]) < float(neighbours.min()) - 0.1
    # even about a series' own shape: the jump from 3 to 4 kHz is small and its sign varies
    jump = ears[:, 5] - ears[:, 4]
    assert float(jump.abs().median()) < 10.0


def test_drawing_depends_on_the_generator_alone() -> None:
    first = draw_thresholds(64, torch.Generator().manual_seed(5))
    torch.rand(7)
    assert torch.equal(first, draw_thresholds(64, torch.Generator().manual_seed(5)))
    assert not torch.equal(first, draw_thresholds(64, torch.Generator().manual_seed(6)))
    as_thresholds(first)  # every one is fit for a simulator


def test_drawn_ears_meet_the_proportions_and_are_disjoint() -> None:
    ears = plan_ears(None, None, None, SPLITS, seed=0)
    drawn = {split: list(ears.assign(split, 150, 2)) for split in SPLITS}
    for own in drawn.values():
        counts = Counter(ear.severity for pair in own for ear in pair)
        assert counts == {"mild": 100, "moderate": 100, "severe": 100}
        assert all(first.severity != second.severity for first, second in own)
    sets = {split: {ear.levels for pair in own for ear in pair} for split, own in drawn.items()}
    assert (
        not sets["train"] & sets["test"]
        and not sets["train"] & sets["valid"]
        and not sets["valid"] & sets["test"]
    )
    assert drawn["train"] == list(
        plan_ears(None, None, None, SPLITS, seed=0).assign("train", 150, 2)
    )
    assert drawn["train"] != list(
        plan_ears(None, None, None, SPLITS, seed=1).assign("train", 150, 2)
    )


def test_other_proportions_and_counts() -> None:
    ears = plan_ears({"none": 1.0, "severe": 3.0}, None, None, SPLITS, seed=0)
    drawn = list(ears.assign("train", 7, 3))
    assert Counter(ear.severity for own in drawn for ear in own) == {"none": 5, "severe": 16}
    assert all(len(set(own)) == 3 for own in drawn)
    with pytest.raises(ValueError, match="unknown severities deaf; allowed: none, mild"):
        check_shares({"deaf": 1.0})
    for bad in ({"mild": -1.0, "severe": 2.0}, {"mild": 0.0}, {}):
        with pytest.raises(ValueError, match="0 or more, not all 0"):
            check_shares(bad)


def test_a_file_without_splits_is_divided_by_listeners(tmp_path: Path) -> None:
    path = table(tmp_path / "ears.csv", listeners(20))
    ears = plan_ears(None, path, None, SPLITS, seed=0)
    assert {split: len(own) for split, own in ears.measured.items()}["test"] >= 6
    owners = {ear.levels: split for split, own in ears.measured.items() for ear in own}
    assert sum(map(len, ears.measured.values())) == len(owners)
    drawn = list(ears.assign("train", 40, 2))
    assert {ear.levels for own in drawn for ear in own} <= {
        k for k, split in owners.items() if split == "train"
    }
    assert all(first != second for first, second in drawn)
    alone = plan_ears(None, path, None, ("train",), seed=0)
    assert not alone.measured["test"] and not alone.measured["valid"]


def test_a_file_of_fewer_listeners_than_splits_is_too_few(tmp_path: Path) -> None:
    path = table(tmp_path / "ears.csv", listeners(1))
    with pytest.raises(ValueError, match="0 measured ears for train; allowed: 2 or more"):
        plan_ears(None, path, None, SPLITS, seed=0)


def test_files_and_columns_that_say_the_split(tmp_path: Path) -> None:
    levels = listeners(6)
    path = table(tmp_path / "ears.csv", levels[:4], split=["train", "train", "test", "test"])
    ears = plan_ears(None, path, None, ("train", "test"), seed=0)
    assert [ear.levels for ear in ears.measured["test"]] == [levels[2][1], levels[3][1]]
    first, second = table(tmp_path / "1.csv", levels[:8]), table(tmp_path / "2.csv", levels[6:])
    ears = plan_ears(None, first, second, ("train", "test"), seed=0)
    assert {ear.levels for ear in ears.measured["test"]} == {own for _, own in levels[6:]}
    # what both files hold stays with test
    assert {ear.levels for ear in ears.measured["train"]} == {own for _, own in levels[:6]}


def test_few_measured_ears_are_still_different_and_of_the_severity(tmp_path: Path) -> None:
    for levels, shares, count, expected in (
        ([30.0, 31.0, 32.0, 70.0], {"mild": 1.0, "severe": 1.0}, 3, {"mild": 40, "severe": 20}),
        ([30.0, 70.0, 71.0], {"mild": 2.0, "severe": 1.0}, 2, {"mild": 20, "severe": 20}),
    ):
        path = table(tmp_path / "ears.csv", [(f"L{level}", (level,) * 8) for level in levels])
        drawn = list(plan_ears(shares, path, None, ("train",), seed=0).assign("train", 20, count))
        assert all(len(set(own)) == count for own in drawn)
        assert Counter(ear.severity for own in drawn for ear in own) == expected


def test_what_is_refused(tmp_path: Path) -> None:
    path = table(
        tmp_path / "ears.csv", [("a", (60.0,) * 8), ("b", (61.0,) * 8), ("c", (110.0,) * 8)]
    )
    with pytest.raises(ValueError, match="no mild ears for train"):
        plan_ears({"mild": 1.0, "severe": 1.0}, path, None, ("train",), seed=0)
    ears = plan_ears(None, path, None, ("train",), seed=0)
    assert len(ears.measured["train"]) == 2  # 110 dB HL is more than a simulator takes
    with pytest.raises(ValueError, match="2 measured ears for train; allowed: 3 or more"):
        plan_ears(None, path, None, ("train",), seed=0, ears=3)
    with pytest.raises(ValueError, match="ears for test alone"):
        plan_ears(None, None, path, ("train",), seed=0)
    bad = table(tmp_path / "bad.csv", [("a", (60.0,) * 8)], split=["dev"])
    with pytest.raises(ValueError, match="unknown splits dev"):
        plan_ears(None, bad, None, ("train",), seed=0)


def test_an_ear_is_the_same_after_the_file(tmp_path: Path) -> None:
    ears = plan_ears(None, None, None, ("train",), seed=3)
    for own in ears.assign("train", 20, 2):
        for ear in own:
            assert Audiogram.from_row(ear.to_row()) == ear
