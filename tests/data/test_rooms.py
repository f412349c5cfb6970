"""Tests of rooms with echoes, from image sources."""

import sys
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import hlsim
from hlsim.data.rooms import Arrivals, Room, draw_room, find_arrivals
from hlsim.data.scenes import (
    draw_scenes,
    head_impulse_responses,
    make_scene,
    room_impulse_responses,
)
from hlsim.dsp.sphere import unit_vectors
from hlsim.extras import MissingExtraError
from hlsim.training.recipes import CompensatorRecipe

RATE = 16000


def _decay_db(response: NDArray[np.float64]) -> NDArray[np.float64]:
    """Energy after each sample in dB re all of it (Schroeder 1965). Shape: (time,) -> (time,)."""
    energy = np.cumsum(response[::-1] ** 2)[::-1]
    return np.asarray(10.0 * np.log10(energy / energy[0]))


@pytest.mark.parametrize("seconds", [0.3, 0.5])
def test_sound_decays_as_fast_as_the_room_says(seconds: float) -> None:
    for azimuth in (0.0, 120.0):
        response = room_impulse_responses(Room(reverberation_time=seconds), azimuth)[0, 0]
        decay = _decay_db(response)
        start, end = np.argmax(decay < -5.0), np.argmax(decay < -25.0)
        assert 3.0 * (end - start) / RATE == pytest.approx(seconds, rel=0.25)


def test_echoes_are_as_strong_as_sabine_predicts() -> None:
    room = Room(reverberation_time=0.5)
    response = room_impulse_responses(room, 30.0)
    direct = head_impulse_responses(unit_vectors([30.0]))[0]
    echoes = response.copy()
    echoes[..., : direct.shape[-1]] -= direct
    ratio = 10.0 * np.log10((direct**2).sum() / (echoes**2).sum())
    critical_distance = 0.057 * np.sqrt(np.prod(room.size) / room.reverberation_time)
    assert ratio == pytest.approx(20.0 * np.log10(critical_distance / room.distance), abs=1.5)


def test_direct_sound_is_the_first_and_the_loudest_arrival() -> None:
    delays, amplitudes, directions = find_arrivals(Room(), 200.0)
    first = delays.argmin()
    assert delays[first] == pytest.approx(0.0, abs=1e-9)
    assert amplitudes[first] == pytest.approx(1.0) == amplitudes.max()
    np.testing.assert_allclose(directions[first], unit_vectors(200.0), atol=1e-6)
    assert delays.max() <= 0.3
    assert np.sum(amplitudes > 0.99) == 1


def test_first_echo_of_the_floor_comes_from_below_at_the_time_of_its_path() -> None:
    # Source and head are 1.2 m above the floor and 1 m apart; all other walls are farther away.
    delays, _, directions = find_arrivals(Room((20.0, 20.0, 8.0), 1.5, (10.0, 10.0, 1.2)), 0.0)
    echo = np.argsort(delays)[1]
    path = np.hypot(1.0, 2.4)
    assert delays[echo] == pytest.approx((path - 1.0) / 343.0)
    np.testing.assert_allclose(directions[echo], [1.0 / path, 0.0, -2.4 / path], atol=1e-6)


def test_echoes_come_from_their_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    room = Room(reverberation_time=0.2)
    for azimuth in (45.0, 120.0, 270.0):  # the centres of areas
        echo = np.sqrt(1.0 - (1.0 / 12.0) ** 2) * unit_vectors(azimuth) + [0.0, 0.0, 1.0 / 12.0]
        arrivals = Arrivals(
            np.array([0.0, 0.05]), np.array([0.0, 1.0]), np.stack((unit_vectors(0.0), echo))
        )
        monkeypatch.setattr(
            "hlsim.data.scenes.find_arrivals", lambda *_, arrivals=arrivals: arrivals
        )
        response = room_impulse_responses(room, 0.0)[..., 800 : 800 + 512]
        expected = head_impulse_responses(echo[None])[0]
        np.testing.assert_allclose(response, expected - expected.mean(-1, keepdims=True), atol=1e-6)


def test_room_that_is_the_same_on_both_sides_sounds_the_same_at_both_ears() -> None:
    response = room_impulse_responses(Room(head=(2.5, 2.5, 1.2)), 0.0)
    np.testing.assert_allclose(response[:, 0], response[:, 1], atol=1e-3 * np.abs(response).max())


def test_scene_in_a_room_has_the_direct_sound_as_target() -> None:
    speech = hlsim.example_speech()[:RATE]
    masker = speech.flip(-1)
    scenes = [make_scene(speech, [masker], [120.0], snr=0.0, room=room) for room in (None, Room())]
    torch.testing.assert_close(scenes[0].target, scenes[1].target)
    echoes = [(scene.input - scene.target).square().mean() for scene in scenes]
    assert echoes[1] > 1.2 * echoes[0]


def test_random_scenes_have_rooms_only_where_they_are_wanted() -> None:
    speech = hlsim.example_speech()
    voices = torch.stack([speech[start : start + RATE] for start in (0, 8000, 16000, 24000)])

    def echoes_db(seconds: float) -> torch.Tensor:
        snr = torch.full((4,), 60.0)  # hardly any maskers
        generator = torch.Generator().manual_seed(0)
        scenes = draw_scenes(voices, voices, None, snr, generator, reverberation_time=seconds)
        parts = [
            signal.square().mean((1, 2, 3))
            for signal in (scenes.input - scenes.target, scenes.target)
        ]
        return 10.0 * (parts[0] / parts[1]).log10()

    assert echoes_db(0.0).max() < -50.0
    in_rooms = echoes_db(0.4)
    assert in_rooms.max() > -20.0
    assert in_rooms.min() < -50.0


def test_random_rooms_contain_all_their_sources() -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        room = draw_room(0.3, generator)
        assert 0.2 <= room.reverberation_time <= 0.3
        for azimuth in (0.0, 90.0, 180.0, 270.0):
            source = np.array(room.head) + room.distance * unit_vectors(azimuth)
            assert np.all((source > 0.1) & (source < np.array(room.size) - 0.1))


def test_impossible_rooms_raise_errors() -> None:
    with pytest.raises(ValueError, match="a side of the room"):
        Room((1.0, 5.0, 2.7))
    for size in ((6.0, 5.0), 6.0, None):
        with pytest.raises(ValueError, match="three numbers for size"):
            Room(size)  # type: ignore[arg-type]
    assert hash(Room([6.0, 5.0, 2.7])) == hash(Room())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="azimuth"):
        find_arrivals(Room(), "90")  # type: ignore[arg-type]
    speech = hlsim.example_speech()[:RATE]
    for room in (0.3, Room):
        with pytest.raises(ValueError, match=r"write Room\(\)"):
            make_scene(speech, [speech], [90.0], snr=0.0, room=room)  # type: ignore[arg-type]
    voices, snr = torch.stack((speech, speech)), torch.zeros(2)
    for seconds in (-0.4, 0.1, 2.0, float("nan")):
        with pytest.raises(ValueError, match="reverberation_time"):
            draw_scenes(voices, voices, None, snr, torch.Generator(), reverberation_time=seconds)
    with pytest.raises(ValueError, match="the position of the head"):
        Room(head=(2.0, 5.0, 1.2))
    with pytest.raises(ValueError, match="reverberation_time"):
        Room(reverberation_time=float("nan"))
    with pytest.raises(ValueError, match="distance"):
        Room(distance=0.0)
    with pytest.raises(ValueError, match="a source inside the room"):
        find_arrivals(Room(distance=4.0), 0.0)
    with pytest.raises(ValueError, match="choose a longer time or a smaller room"):
        find_arrivals(Room((30.0, 30.0, 30.0), 0.2), 0.0)


def test_without_pyroomacoustics_the_error_names_the_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pyroomacoustics", None)
    with pytest.raises(MissingExtraError, match=r"hlsim\[scenes\]"):
        find_arrivals(Room(), 0.0)


def test_recipes_take_rooms_for_random_scenes_alone() -> None:
    assert CompensatorRecipe(kind="beamforming-aid", reverberation_time=0.5)
    with pytest.raises(ValueError, match="only random scenes have rooms"):
        CompensatorRecipe(reverberation_time=0.5)
    times: tuple[Any, ...] = (0.1, "0.4", None, True)
    for seconds in times:
        with pytest.raises(ValueError, match="reverberation_time"):
            CompensatorRecipe(kind="beamforming-aid", reverberation_time=seconds)
