"""Tables of a comparison of compensators."""

from hlsim.evaluation.measurements import TONES
from hlsim.report.compensators import shift_table, tone_table


def test_tables_of_tones_and_shifted_speech() -> None:
    about = {"compensator": "own", "ear": "N3", "levels": [50.0, 65.0], "frequencies": [*TONES]}
    offs = [[0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [-1.0] * 6]
    sidebands = [[-50.0, -40.0, -3.2, -10.0, -60.0, -60.0], [-120.0] * 5 + [6.0]]
    first, second = tone_table([{**about, "heard_off_db": offs, "sidebands_db": sidebands}]).rows
    assert first == ["N3, own, 50 dB SPL", "+0.0", "+1.0", "+2.0", "+3.0", "+4.0", "+5.0", "-3 (1000 Hz)"]
    assert second[0] == "N3, own, 65 dB SPL" and second[-1] == "6 (4000 Hz)"
    found = {"compensator": "own", "items": [0, 2], "difference_db": [[-30.0, -20.0], [-12.4, -20.0]]}
    assert [*shift_table([found]).rows] == [["own", "4", "-20", "-12"]]
