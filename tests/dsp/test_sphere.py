"""Tests of the sound at a rigid sphere: limits that are known in closed form."""

import numpy as np
import pytest

from hlsim.dsp.sphere import (
    HEAD_RADIUS,
    SPEED_OF_SOUND,
    evenly_spread_directions,
    microphone_positions,
    sphere_response,
    unit_vectors,
)


def test_long_waves_pass_the_sphere_unchanged() -> None:
    response = sphere_response(np.linspace(-1.0, 1.0, 9), [0.0, 0.1])
    np.testing.assert_allclose(response, 1.0, atol=1e-3)


def test_the_facing_point_doubles_the_pressure_of_short_waves() -> None:
    assert abs(sphere_response(1.0, [20000.0]))[0] == pytest.approx(2.0, rel=0.01)


def test_sound_behind_the_sphere_is_focussed() -> None:
    angles = np.radians([140.0, 160.0, 180.0])
    shadow, edge, bright_spot = abs(sphere_response(np.cos(angles), [2000.0]))[:, 0]
    assert bright_spot > edge
    assert bright_spot > shadow


def interaural_delay(azimuth: float, frequency: float) -> float:
    """Return the phase delay between opposite points of the sphere in s."""
    sine = np.sin(np.radians(azimuth))
    left, right = sphere_response([sine, -sine], [frequency])[:, 0]
    return float(np.angle(left / right)) / (2.0 * np.pi * frequency)


@pytest.mark.parametrize("azimuth", [15.0, 45.0, 90.0])
def test_delay_of_long_waves_is_that_of_kuhn(azimuth: float) -> None:
    # Kuhn 1977, Journal of the Acoustical Society of America 62(1), Equation 5
    expected = 3.0 * HEAD_RADIUS / SPEED_OF_SOUND * np.sin(np.radians(azimuth))
    assert interaural_delay(azimuth, 50.0) == pytest.approx(expected, rel=0.01)


def test_delay_of_short_waves_is_that_of_woodworth() -> None:
    # The path around the sphere and the direct one: a / c * (angle + sin(angle)), at 60 degrees
    frequencies = np.arange(40000.0, 40500.0, 10.0)
    sine = np.sin(np.pi / 3.0)
    left, right = sphere_response([sine, -sine], frequencies)
    phase = np.unwrap(np.angle(left / right))
    group_delay = np.polyfit(2.0 * np.pi * frequencies, phase, 1)[0]
    expected = HEAD_RADIUS / SPEED_OF_SOUND * (np.pi / 3.0 + sine)
    assert group_delay == pytest.approx(expected, rel=0.05)


def test_microphones_have_their_spacing_and_mirror_each_other() -> None:
    positions = microphone_positions(0.01)
    distance = HEAD_RADIUS * np.linalg.norm(positions[0] - positions[1], axis=-1)
    np.testing.assert_allclose(distance, 0.01, rtol=1e-3)
    np.testing.assert_allclose(positions[:, 0], positions[:, 1] * [1.0, -1.0, 1.0])


def test_spread_directions_have_equal_shares_of_the_sphere() -> None:
    directions = evenly_spread_directions(400)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    moments = directions.T @ directions / 400
    np.testing.assert_allclose(moments, np.eye(3) / 3.0, atol=2e-3)


def test_unit_vectors_turn_to_the_left() -> None:
    np.testing.assert_allclose(unit_vectors(90.0), [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(unit_vectors(180.0), [-1.0, 0.0, 0.0], atol=1e-12)
