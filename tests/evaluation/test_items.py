"""Drawn items: the same for a seed, at their levels and ratios, and fairly shared out."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from compensators import NALR
from hlsim import Audiogram
from hlsim.calibration import level_spl
from hlsim.evaluation.items import (
    SIMULATOR_LEVELS,
    TREATMENTS,
    draw_items,
    draw_judged_items,
    read_ears,
    treat,
)


@pytest.fixture
def ears(tmp_path: Path) -> Path:
    rows = [Audiogram.standard(name).to_row() for name in ("N3", "N5", "S2")]
    path = tmp_path / "ears.csv"
    path.write_text("\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]))
    return path


def test_no_two_ears_have_one_name(tmp_path: Path) -> None:
    path = tmp_path / "ears.csv"
    names = ("A", "B", "A", "N3", "")
    rows = [
        {"listener": name, **Audiogram((10.0 * i,) * 8).to_row()} for i, name in enumerate(names)
    ]
    path.write_text("\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]))
    read = read_ears(path)
    assert read[0] == ("N2", Audiogram.standard("N2")) and len(read) == 8 + len(names)
    assert [name for name, _ in read[8:]] == ["A", "B", "A, row 3", "N3, row 4", "row 5"]
    assert [ear for _, ear in read[8:]] == [Audiogram((10.0 * i,) * 8) for i in range(5)]


@pytest.mark.parametrize(
    ("count", "levels"),
    [
        (8, (50.0, 65.0, 80.0)),
        (11, (50.0, 65.0, 80.0)),
        (8, (55.0, 75.0)),
        (8, (50.0, 60.0, 70.0, 80.0)),
    ],
)
def test_every_ear_meets_every_level_and_ratio(
    speech_dir: Path, count: int, levels: tuple[float, ...]
) -> None:
    ears = [(f"{i}", Audiogram((float(i),) * 8)) for i in range(count)]
    each = 4 * len(levels) * count
    settings: dict[str, Any] = {"items": 2 * each, "seconds": 0.05, "seed": 0, "levels": levels}
    drawn = draw_judged_items(speech_dir / "valid", speech_dir / "train", ears, **settings)
    noisy = [item.facts for item in drawn if item.facts["speech"] == "noisy"]
    met = {(facts["ear"], facts["input_level"], facts["snr"]) for facts in noisy}
    assert len(noisy) == len(met) == each


@pytest.mark.parametrize("count", [2, 4, 5])
def test_every_kind_of_ear_of_simulators_meets_every_level_and_ratio(
    speech_dir: Path, ears: Path, count: int
) -> None:
    levels, each = [50.0, 55.0, 60.0, 70.0, 80.0][:count], 16 * count
    settings: dict[str, Any] = {"items": 2 * each, "seconds": 0.1, "seed": 0, "levels": levels}
    drawn = draw_items(speech_dir / "valid", speech_dir / "train", ears, **settings)
    noisy = [item.facts for item in drawn if item.facts["speech"] == "noisy"]
    kinds = enumerate((facts["input_level"], facts["noise_snr"]) for facts in noisy)
    assert len({(number % 4, *met) for number, met in kinds}) == each == len(noisy)
    standard = {(tuple(facts["audiogram"]), facts["noise_snr"]) for facts in noisy[2::4]}
    assert len({ear for ear, _ in standard}) == 4 and len(standard) > 4


def test_items_follow_from_the_seed_and_have_the_level_and_ratio_that_they_state(
    speech_dir: Path, ears: Path
) -> None:
    def draw(seed: int, judged: bool) -> list[Any]:
        folders = speech_dir / "valid", speech_dir / "train"
        settings: dict[str, Any] = {"items": 16, "seconds": 1.0, "seed": seed}
        if judged:
            return draw_judged_items(*folders, [("N3", Audiogram.standard("N3"))], **settings)
        return draw_items(*folders, ears, **settings)

    for judged in (True, False):
        drawn, again, other = (draw(seed, judged) for seed in (0, 0, 1))
        assert all(torch.equal(a.signal, b.signal) for a, b in zip(drawn, again, strict=True))
        assert not torch.equal(drawn[0].signal, other[0].signal)
        for item in drawn:
            levelled = item.clean if judged else item.signal
            level = float(level_spl(levelled))
            assert level == pytest.approx(item.facts["input_level"], abs=0.01)
            ratio = item.facts["snr" if judged else "noise_snr"]
            if math.isnan(ratio):
                assert torch.equal(item.clean, item.signal)
            else:
                snr = float(level_spl(item.clean) - level_spl(item.signal - item.clean))
                assert snr == pytest.approx(ratio, abs=0.01)
    assert {item.facts["input_level"] for item in drawn} <= set(SIMULATOR_LEVELS)


def test_treatments_are_what_their_names_say(speech_dir: Path, ears: Path) -> None:
    drawn = draw_items(
        speech_dir / "valid", None, ears, items=1, seconds=1.5, seed=0, levels=(65.0,)
    )
    halved = torch.nn.Module()
    halved.forward = lambda waveform, ear: 0.5 * waveform  # type: ignore[method-assign]
    treated = treat(drawn, TREATMENTS, halved)
    assert [item.facts["treatment"] for item in treated] == list(TREATMENTS)
    as_is, louder, amplified, compressed, compensated = (item.signal for item in treated)
    assert torch.equal(as_is, drawn[0].signal)
    assert float(level_spl(louder)) == pytest.approx(85.0, abs=0.01)
    assert torch.equal(amplified, NALR(drawn[0].ear)(as_is))
    assert torch.equal(compensated, 0.5 * as_is)
    frames = [
        signal.unfold(0, 400, 400).square().mean(-1).log10() for signal in (as_is, compressed)
    ]
    loud = frames[0] > frames[0].max() - 2.0
    assert float(frames[1][loud].std()) < 0.7 * float(frames[0][loud].std())
    for wrong in ("compensated", "softer"):
        with pytest.raises(ValueError, match=wrong):
            treat(drawn, [wrong])  # type: ignore[list-item]
