"""Drawn items: the same for a seed, with the stated levels and ratios, in all combinations."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from compensators import NALR
from hlsim import Audiogram
from hlsim.audio import write_audio
from hlsim.calibration import level_spl
from hlsim.data.recorded_scenes import SceneClips, SceneFiles
from hlsim.evaluation.items import (
    SIMULATOR_LEVELS,
    apply_treatments,
    draw_aid_items,
    draw_scene_items,
    draw_simulator_items,
    ear_name,
    read_ears,
)
from tests.helpers import write_table


def test_all_ears_have_different_names(tmp_path: Path) -> None:
    path, names = tmp_path / "ears.csv", ("A", "B", "A", "N3", "")
    ears = [Audiogram((10.0 * i,) * 8) for i in range(5)]
    rows = [{"listener": name, **ear.to_row()} for name, ear in zip(names, ears, strict=True)]
    read = read_ears(write_table(path, rows))
    assert read[0] == ("N2", Audiogram.standard("N2"))
    assert read[8:] == list(zip(["A", "B", "A, row 3", "N3, row 4", "row 5"], ears, strict=True))


@pytest.mark.parametrize(
    ("count", "levels"),
    [
        (11, (50.0, 65.0, 80.0)),
        (8, (5.0, 6.0, 7.0, 8.0)),
    ],
)
def test_every_ear_has_every_level_and_ratio(
    speech_dir: Path, count: int, levels: tuple[float, ...]
) -> None:
    ears = [(f"{i}", Audiogram((float(i),) * 8)) for i in range(count)]
    expected = 4 * len(levels) * count
    settings: dict[str, Any] = {"items": 2 * expected, "seconds": 0.05, "seed": 0, "levels": levels}
    drawn = draw_aid_items(speech_dir / "valid", speech_dir / "train", ears, **settings)
    noisy = [item.facts for item in drawn if item.facts["speech"] == "noisy"]
    combinations = {(facts["ear"], facts["input_level"], facts["snr"]) for facts in noisy}
    assert len(noisy) == len(combinations) == expected


@pytest.mark.parametrize(("count", "levels"), [(3, (50.0, 65.0, 80.0)), (1, (50.0, 60.0))])
def test_items_of_scenes_are_for_both_sides_at_every_level(
    tmp_path: Path, count: int, levels: tuple[float, ...]
) -> None:
    """The channels of a scene have different powers, by which they are known."""
    wave = 0.1 * torch.sin(0.5 * torch.arange(1600))
    write_audio(tmp_path / "clean.wav", torch.stack((wave, 0.5 * wave)), 16000)
    gains = torch.tensor([[1.0], [0.8], [0.6], [0.4]])
    write_audio(tmp_path / "mixture.wav", gains * wave, 16000)
    files = SceneFiles(tmp_path / "clean.wav", (tmp_path / "mixture.wav",), (1, 2))
    scenes = SceneClips([files], sample_rate=16000, seconds=0.1)
    ears = [(f"{i}", Audiogram((float(i),) * 8)) for i in range(count)]
    number = 2 * len(levels) * count
    drawn = draw_scene_items(scenes, ears, items=number, seconds=0.1, seed=0, levels=levels)
    combinations = set()
    for item in drawn:
        assert float(level_spl(item.clean)) == pytest.approx(item.facts["input_level"], abs=1e-3)
        ratios = level_spl(item.signal) - level_spl(item.clean)
        is_right = bool(ratios[0, 0] > 0.1)  # whose clean speech is softer by 6 dB
        expected = torch.tensor([[1.6, 2.0], [0.8, 1.2]] if is_right else [[1.0, 0.8], [0.6, 0.4]])
        torch.testing.assert_close(10.0 ** (ratios / 20.0), expected, atol=1e-3, rtol=0.0)
        assert torch.equal(item.reference_signal, item.signal[0, 0])
        combinations.add((item.facts["ear"], item.facts["input_level"], is_right))
    assert len(combinations) == number


@pytest.mark.parametrize("count", [4, 5])
def test_every_kind_of_ear_of_simulators_has_every_level_and_ratio(
    speech_dir: Path, ears_file: Path, count: int
) -> None:
    levels, expected = [50.0, 55.0, 60.0, 70.0, 80.0][:count], 16 * count
    settings: dict[str, Any] = {"items": 2 * expected, "seconds": 0.1, "seed": 0, "levels": levels}
    drawn = draw_simulator_items(speech_dir / "valid", speech_dir / "train", ears_file, **settings)
    noisy = [item.facts for item in drawn if item.facts["speech"] == "noisy"]
    pairs = enumerate((facts["input_level"], facts["noise_snr"]) for facts in noisy)
    assert len({(number % 4, *pair) for number, pair in pairs}) == expected == len(noisy)
    standard = {(tuple(facts["audiogram"]), facts["noise_snr"]) for facts in noisy[2::4]}
    assert len({ear for ear, _ in standard}) == 4 and len(standard) > 4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"levels": []}, "one or more levels"),
        ({"levels": [65.0, 500.0]}, "a level"),
        ({"items": 1.5}, "items"),
    ],
)
def test_numbers_of_simulator_items_are_checked(
    speech_dir: Path, ears_file: Path, changes: dict[str, Any], words: str
) -> None:
    settings = {"items": 2, "seconds": 0.1, "seed": 0, **changes}
    with pytest.raises(ValueError, match=words):
        draw_simulator_items(speech_dir / "valid", None, ears_file, **settings)


@pytest.mark.parametrize("judged", [True, False])
def test_items_depend_on_the_seed_and_have_their_level_and_ratio(
    speech_dir: Path, ears_file: Path, judged: bool
) -> None:
    def draw(seed: int) -> list[Any]:
        folders = speech_dir / "valid", speech_dir / "train"
        settings: dict[str, Any] = {"items": 16, "seconds": 1.0, "seed": seed}
        if judged:
            return draw_aid_items(*folders, [("N3", Audiogram.standard("N3"))], **settings)
        return draw_simulator_items(*folders, ears_file, **settings)

    drawn, again, different = draw(0), draw(0), draw(1)
    assert all(torch.equal(a.signal, b.signal) for a, b in zip(drawn, again, strict=True))
    assert not torch.equal(drawn[0].signal, different[0].signal)
    for item in drawn:
        level = float(level_spl(item.clean if judged else item.signal))
        assert level == pytest.approx(item.facts["input_level"], abs=0.01)
        ratio = item.facts["snr" if judged else "noise_snr"]
        if math.isnan(ratio):
            assert torch.equal(item.clean, item.signal)
        else:
            snr = float(level_spl(item.clean) - level_spl(item.signal - item.clean))
            assert snr == pytest.approx(ratio, abs=0.01)
    assert {item.facts["input_level"] for item in drawn} <= set(SIMULATOR_LEVELS)


def test_treatments(speech_dir: Path, ears_file: Path) -> None:
    settings: dict[str, Any] = {"items": 1, "seconds": 1.5, "seed": 0, "levels": (65.0,)}
    drawn = draw_simulator_items(speech_dir / "valid", None, ears_file, **settings)
    halving = torch.nn.Module()
    halving.forward = lambda waveform, ear: 0.5 * waveform  # type: ignore[method-assign]
    treatments = ["as-is", "louder", "nalr", "compressed", "compensated"]
    treated = apply_treatments(drawn, treatments, halving)
    assert [item.facts["treatment"] for item in treated] == treatments and not halving.training
    as_is, louder, amplified, compressed, compensated = (item.signal for item in treated)
    assert torch.equal(as_is, drawn[0].signal) and torch.equal(compensated, 0.5 * as_is)
    assert float(level_spl(louder)) == pytest.approx(85.0, abs=0.01)
    in_place = torch.nn.Module()
    in_place.forward = lambda waveform, ear: waveform.mul_(0.5)  # type: ignore[method-assign]
    apply_treatments(drawn, ["compensated"], in_place)
    assert torch.equal(as_is, drawn[0].signal) and torch.equal(compensated, 0.5 * as_is)
    assert torch.equal(amplified, NALR(drawn[0].ear)(as_is))
    before, after = (
        signal.unfold(0, 400, 400).square().mean(-1).log10() for signal in (as_is, compressed)
    )
    loud = before > before.max() - 2.0
    assert float(after[loud].std()) < 0.7 * float(before[loud].std())
    with pytest.raises(ValueError, match="sample_rate=16000, got 44100"):
        apply_treatments(drawn, ["compensated"], NALR(sample_rate=44100))
    for unknown in ("compensated", "softer"):
        with pytest.raises(ValueError, match=unknown):
            apply_treatments(drawn, [unknown])


def test_silence_after_short_recordings_causes_a_warning(tmp_path: Path) -> None:
    write_audio(tmp_path / "short.wav", 0.1 * torch.ones(8000), 16000)
    settings: dict[str, Any] = {"items": 1, "seed": 0}
    ears = [("N3", Audiogram.standard("N3"))]
    draw_aid_items(tmp_path, None, ears, seconds=0.5, **settings)
    with pytest.warns(UserWarning, match=r"1 of 1 items end in silence .* or longer recordings\.$"):
        draw_aid_items(tmp_path, None, ears, seconds=1.0, **settings)


def test_recordings_that_are_left_out_are_counted(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_audio(tmp_path / f"{name}.wav", 0.1 * torch.randn(8000), 16000)
    (tmp_path / "broken.wav").write_text("no audio")
    settings: dict[str, Any] = {"items": 20, "seconds": 0.2, "seed": 0}
    with pytest.warns(UserWarning) as warned:
        draw_aid_items(tmp_path, None, read_ears(None), **settings)
    texts = [str(warning.message) for warning in warned]
    assert sum("left out: " in text and "broken.wav" in text for text in texts) == 1
    assert any("1 of 4 recordings of speech were drawn and left out" in text for text in texts)


def test_a_standard_ear_keeps_its_name_with_measured_uncomfortable_levels() -> None:
    assert ear_name(Audiogram.standard("N4", ucl={1000: 110})) == "N4"
