"""Tables of a comparison of compensators."""

import pytest

from hlsim.evaluation.previous.measurements import TONES
from hlsim.report.page import Section, render_page
from hlsim.report.previous.compensators import tone_table
from hlsim.report.previous.gain_pictures import gain_picture
from hlsim.report.previous.pictures import condition_colours
from hlsim.report.previous.tables import Table


def test_table_of_tones() -> None:
    about = {"compensator": "own", "ear": "N3", "levels": [50.0, 65.0], "frequencies": [*TONES]}
    offs = [[0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [-1.0] * 6]
    sidebands = [[-50.0, -40.0, -3.2, -10.0, -60.0, -60.0], [-120.0] * 5 + [6.0]]
    first, second = tone_table([{**about, "heard_off_db": offs, "sidebands_db": sidebands}]).rows
    assert first == [
        "N3, own, 50 dB SPL",
        "+0.0",
        "+1.0",
        "+2.0",
        "+3.0",
        "+4.0",
        "+5.0",
        "-3 (1000 Hz)",
    ]
    assert second[0] == "N3, own, 65 dB SPL" and second[-1] == "6 (4000 Hz)"


@pytest.mark.parametrize("count", [1, 3, 6])
def test_every_level_has_its_curve(count: int) -> None:
    levels, hz = [40.0 + 10.0 * i for i in range(count)], [250.0, 1000.0, 2000.0, 4000.0]
    about = {"ear": "N3", "levels": levels, "frequencies": hz}
    curves = [
        {**about, "compensator": name, "gain_db": [[9.0 * i] * 4 for i in range(count)]}
        for name in "ab"
    ]
    picture = gain_picture("N3", curves, {"a": "C0", "b": "C1"})
    text = picture.data.decode()
    assert text.count(">input of ") + text.count("<!-- input of ") == count
    assert f"a {', '.join(f'{9 * i}' for i in range(count))}" in picture.alt


def test_a_compensator_has_one_colour_and_what_is_as_loud_has_it_paler() -> None:
    at = ["NAL-R at own's level", "equaliser at own's level"]
    colours = condition_colours(["unaided", "NAL-R", *at, "own", "other"])
    assert [*colours] == ["unaided", "NAL-R", *at, "own", "other"]
    assert [colours[name] for name in ("unaided", "NAL-R", "own", "other")] == [
        "C0",
        "C1",
        "C2",
        "C3",
    ]
    assert [colours[name] for name in at] == [("C2", 0.6), ("C2", 0.3)]
    assert condition_colours(["a", "b at c's level"]) == {"a": "C0", "b at c's level": "C1"}


def test_a_folded_table_says_what_it_is_and_opens() -> None:
    section = Section("Gain", tables=[Table("Gain in dB", ("a", "b"), [("x", "1")], folded=True)])
    text = render_page("Title", [section])
    assert "<details><summary>Gain in dB</summary>" in text and "<caption>" not in text
