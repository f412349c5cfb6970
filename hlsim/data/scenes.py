"""Scenes for several microphones: talkers and noise around a spherical head."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.calibration import NEURO_RATE, set_level
from hlsim.checks import check_number, check_rate, check_seed, check_waveform
from hlsim.data.mixing import mix
from hlsim.data.rooms import REVERBERATION_TIMES, Room, draw_room, find_arrivals
from hlsim.dsp.sphere import SPACINGS, evenly_spread_directions, head_responses, unit_vectors
from hlsim.torchtools import compute_once

DIFFUSE_DIRECTIONS = 64
"""Number of directions from which diffuse noise comes."""

ECHO_HEIGHTS = 12
"""Number of heights from which echoes come."""

ECHO_AZIMUTHS = 24
"""Number of azimuths from which echoes come, at each height."""

_LEAD_SECONDS = 0.002
"""Length of the impulse responses before the time at which sound passes the centre of the head."""

_RESPONSE_SECONDS = 0.032
"""Length of the impulse responses."""


class Scene(NamedTuple):
    """Signals of the microphones of a scene.

    Attributes:
        input: Target and maskers at the microphones, (..., microphones, ears, time), the front
            microphones and the left ear first.
        target: Direct sound of the target alone, of the same shape.

    >>> Scene(torch.zeros(2, 2, 10), torch.zeros(2, 2, 10)).input.shape
    torch.Size([2, 2, 10])
    """

    input: Tensor
    target: Tensor

    @property
    def reference(self) -> Tensor:
        """The target at the front microphones, (..., ears, time), the clean speech of losses."""
        return self.target[..., 0, :, :]


def make_scene(
    target: Tensor,
    maskers: Sequence[Tensor] = (),
    azimuths: Sequence[float] = (),
    *,
    diffuse: Tensor | None = None,
    snr: float,
    target_azimuth: float = 0.0,
    spacing: float = 0.01,
    sample_rate: int = NEURO_RATE,
    seed: int = 0,
    room: Room | None = None,
) -> Scene:
    """Place a talker, maskers and diffuse noise around a listener with two microphones a side.

    Talker and maskers are plane waves from the horizontal plane to a rigid sphere, see
    ``hlsim.dsp.sphere``; in a ``room``, their echoes are plane waves from the whole sphere. Diffuse
    noise comes from 64 directions that are evenly spread over the sphere, with a random part of the
    recording from each.

    Args:
        target: Speech at its level at the centre of the head without the head, (time,).
        maskers: Other talkers or noises at their relative levels, (time,) or longer.
        azimuths: Azimuth of each masker in degrees, -360 to 360, 0 in front, 90 on the left.
        diffuse: Recording of noise with the level of a masker that becomes diffuse, (time,) or
            longer.
        snr: Signal-to-noise ratio at the microphones in dB, -100 to 100: the active level of the
            target, with its echoes, minus the level of all other sounds, with the powers of all
            microphones averaged.
        target_azimuth: Azimuth of the target in degrees, -360 to 360.
        spacing: Distance between the two microphones of a side in m, 0.002 to 0.1.
        sample_rate: Sample rate of all signals in Hz, 16000 to 48000.
        seed: Seed of the parts of the recording for diffuse noise, 0 to 2**32 - 1.
        room: Room with echoes of the talker and the maskers, but not of diffuse noise; none by
            default, as in the open. Echoes make sounds louder, by about 3 dB at 0.3 s.

    Returns:
        The scene. Direct sound passes the centre of the head at the time it has in ``target``.

    Raises:
        MissingExtraError: There is a room, and pyroomacoustics is not installed.
        ValueError: A signal is not valid, a masker or the diffuse noise is shorter than the target,
            all of them are silent, there is no masker and no diffuse noise, there is not one
            azimuth for each masker, a number is out of range, ``room`` is no room or cannot have
            its reverberation time, or a source is outside the room.

    >>> import hlsim
    >>> speech = hlsim.example_speech()
    >>> scene = make_scene(speech, [speech.flip(-1)], [120.0], snr=0.0)
    >>> scene.input.shape
    torch.Size([2, 2, 64320])
    """
    rate = check_rate(sample_rate)
    check_number("snr", snr, -100.0, 100.0)
    check_seed(seed)
    check_number("spacing", spacing, *SPACINGS)
    if isinstance(maskers, Tensor) or not isinstance(azimuths, Sequence):
        raise ValueError(
            "expected lists of maskers and azimuths, got another type; write [masker], [120.0]"
        )
    for azimuth in (*azimuths, target_azimuth):
        check_number("an azimuth", azimuth, -360.0, 360.0)
    if len(maskers) != len(azimuths):
        raise ValueError(
            f"expected one azimuth for each of {len(maskers)} maskers, got {len(azimuths)}"
        )
    if not isinstance(room, Room | None):
        raise ValueError(f"expected a room, got {room!r}; write Room()")
    if not maskers and diffuse is None:
        raise ValueError("expected a masker or diffuse noise; pass one of them")
    check_waveform(target, "target")
    if target.ndim != 1:
        raise ValueError(f"expected a target of shape (time,), got {tuple(target.shape)}")
    time = len(target)

    def place(sound: Tensor, azimuth: float, room: Room | None) -> Tensor:
        directions = unit_vectors([azimuth])
        if room is None:
            return sound_at_microphones(sound[None], directions, spacing, rate)
        responses = room_impulse_responses(room, azimuth, spacing, rate)
        return _filter_sounds(sound[None], responses[None], rate)

    direct_sound = place(target, target_azimuth, None)
    target_at_ears = direct_sound if room is None else place(target, target_azimuth, room)
    noise_at_ears = torch.zeros_like(target_at_ears)
    for masker, azimuth in zip(maskers, azimuths, strict=True):
        _check_masker(masker, "a masker", time)
        noise_at_ears += place(masker[:time], azimuth, room)
    if diffuse is not None:
        _check_masker(diffuse, "diffuse", time)
        shifts = np.random.default_rng(seed).integers(len(diffuse), size=DIFFUSE_DIRECTIONS)
        parts = torch.stack([diffuse.roll(int(shift))[:time] for shift in shifts])
        noise_at_ears += _filter_sounds(parts, diffuse_impulse_responses(spacing, rate), rate)
    channels = target_at_ears.flatten(0, 1)
    mixture = mix(channels, noise_at_ears.flatten(0, 1), snr, rate, channels=True)
    return Scene(mixture.reshape(target_at_ears.shape), direct_sound)


def draw_scenes(
    targets: Tensor,
    voices: Tensor,
    noise: Tensor | None,
    snr: Tensor,
    generator: torch.Generator,
    *,
    mismatch: float = 0.0,
    spacing: float = 0.01,
    reverberation_time: float = 0.0,
) -> Scene:
    """Draw random scenes at 16 kHz for training, see ``make_scene``.

    The target comes from up to 10 degrees beside the front. If there is ``noise``, up to three
    maskers come from random directions, each with the same probability the voice or the noise of
    another item, and half of the scenes have diffuse noise, too; the others have at least one
    masker. Otherwise, one to three voices of other items come from random directions.

    Args:
        targets: Speech at its level, (items, time).
        voices: Speech of the same items at any level, (items, time), for maskers.
        noise: Recordings of noise, (items, time), or None.
        snr: Signal-to-noise ratio of each scene in dB, (items,).
        generator: Source of the random numbers.
        mismatch: Standard deviation in dB of the gains of the microphones.
        spacing: Distance between the two microphones of a side in m.
        reverberation_time: Longest reverberation time in s of random rooms, 0.2 to 1.5, in which
            half of the scenes are; 0 for no rooms.

    Returns:
        Scenes with leading dimension (items,). The gains of the microphones are those of ``input``
        alone.

    Raises:
        MissingExtraError: There are rooms, and pyroomacoustics is not installed.
        ValueError: There is only one item, which would be its own masker, the shapes do not fit
            together, a number is out of range, or ``make_scene`` rejects a signal.

    >>> voices = torch.randn(2, 8000)
    >>> scenes = draw_scenes(voices, voices, None, torch.zeros(2), torch.Generator())
    >>> scenes.input.shape
    torch.Size([2, 2, 2, 8000])
    """

    def draw(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    if reverberation_time != 0.0:
        check_number("reverberation_time", reverberation_time, *REVERBERATION_TIMES)
    check_number("mismatch", mismatch, 0.0)
    count = len(targets)
    shapes = [tuple(signals.shape) for signals in (targets, voices, noise) if signals is not None]
    if len({*shapes}) > 1 or snr.shape != (count,):
        raise ValueError(
            "expected targets, voices and noise of one shape (items, time), and one SNR per item, "
            f"got the shapes {', '.join(map(str, shapes))} and {tuple(snr.shape)}"
        )
    if count < 2:
        raise ValueError(
            f"expected two or more items, because each voice masks that of another, got {count}"
        )
    scenes = []
    for item, target in enumerate(targets):
        is_diffuse = noise is not None and draw(0.0, 1.0) < 0.5
        maskers = []
        for _ in range(int(draw(0.0 if is_diffuse else 1.0, 4.0))):
            source = voices if noise is None or draw(0.0, 1.0) < 0.5 else noise
            other = source[(item + int(draw(1.0, max(2.0, count)))) % count]
            maskers.append(set_level(other, draw(59.0, 71.0)))
        azimuths = [draw(-180.0, 180.0) for _ in maskers]
        diffuse = None
        if noise is not None and is_diffuse:
            diffuse = set_level(noise[item], draw(59.0, 71.0))
        has_room = reverberation_time != 0.0 and draw(0.0, 1.0) < 0.5
        scene = make_scene(
            target,
            maskers,
            azimuths,
            diffuse=diffuse,
            snr=float(snr[item]),
            target_azimuth=draw(-10.0, 10.0),
            spacing=spacing,
            seed=int(draw(0.0, 2.0**31)),
            room=draw_room(reverberation_time, generator) if has_room else None,
        )
        normal = np.random.default_rng(int(draw(0.0, 2.0**31))).normal(
            size=(*scene.input.shape[:2], 1)
        )
        gains = 10.0 ** (torch.from_numpy(mismatch * normal).to(target) / 20.0)
        scenes.append(Scene(scene.input * gains, scene.target))
    return Scene(*(torch.stack(signals) for signals in zip(*scenes, strict=True)))


def _check_masker(signal: Tensor, name: str, time: int) -> None:
    """Raise ValueError unless a masker is a single signal of at least ``time`` samples."""
    check_waveform(signal, name)
    if signal.ndim != 1 or len(signal) < time:
        raise ValueError(
            f"expected {name} of shape (time,) with at least {time} samples as the target has, "
            f"got {tuple(signal.shape)}; repeat a short masker"
        )


def sound_at_microphones(
    signals: Tensor,
    directions: NDArray[np.float64],
    spacing: float = 0.01,
    sample_rate: int = NEURO_RATE,
) -> Tensor:
    """Compute the sound of plane waves at the microphones on a spherical head.

    Args:
        signals: Sound from each direction at the centre of the head without the head, (...,
            directions, time).
        directions: Unit vectors of the directions, (directions, 3), see ``hlsim.dsp.sphere``.
        spacing: Distance between the two microphones of a side in m.
        sample_rate: Sample rate in Hz.

    Returns:
        The sum over the directions, (..., microphones, ears, time).

    >>> sound_at_microphones(torch.zeros(3, 1, 100), unit_vectors([90.0])).shape
    torch.Size([3, 2, 2, 100])
    """
    responses = head_impulse_responses(directions, spacing, sample_rate)
    return _filter_sounds(signals, responses, sample_rate)


def _filter_sounds(signals: Tensor, responses: NDArray[np.float64], sample_rate: int) -> Tensor:
    """Filter sounds by impulse responses of their directions, and add them up.

    The responses begin 2 ms before time 0. The result has no such lead and no gradients, and is as
    long as the signals.

    Shape: (..., directions, time), (directions, microphones, ears, length) -> (..., microphones,
        ears, time).
    """
    time = signals.shape[-1]
    lead = int(_LEAD_SECONDS * sample_rate)
    points = scipy.fft.next_fast_len(time + responses.shape[-1], real=True)
    spectra = np.fft.rfft(signals.detach().double().cpu().numpy(), points)
    filters = np.fft.rfft(responses, points)
    sums = np.einsum("...df,dmef->...mef", spectra, filters)
    filtered = np.fft.irfft(sums, points)[..., lead : lead + time]
    return torch.from_numpy(filtered).to(signals)


def room_impulse_responses(
    room: Room, azimuth: float, spacing: float = 0.01, sample_rate: int = NEURO_RATE
) -> NDArray[np.float64]:
    """Compute impulse responses from a source in a room to the microphones on a spherical head.

    Each echo is a plane wave at a whole number of samples, from the centre of one of 288 equal
    areas of the sphere.

    Args:
        room: Room with the listener.
        azimuth: Azimuth of the source in degrees.
        spacing: Distance between the two microphones of a side in m.
        sample_rate: Sample rate in Hz.

    Returns:
        Impulse responses, (microphones, ears, length). Direct sound passes the centre of the head 2
        ms after their beginning, with the same level as without the room.

    >>> room_impulse_responses(Room(reverberation_time=0.2), 90.0).shape
    (2, 2, 3744)
    """
    delays, amplitudes, directions = find_arrivals(room, azimuth)
    height, turn = directions[:, 2], np.arctan2(directions[:, 1], directions[:, 0])
    row = np.minimum(ECHO_HEIGHTS * (0.5 + 0.5 * height), ECHO_HEIGHTS - 1).astype(int)
    column = np.rint(ECHO_AZIMUTHS * turn / (2.0 * np.pi)).astype(int) % ECHO_AZIMUTHS
    area = ECHO_AZIMUTHS * row + column
    area[delays.argmin()] = ECHO_HEIGHTS * ECHO_AZIMUTHS  # the direct sound, after all areas
    lead = int(_LEAD_SECONDS * sample_rate)
    samples = lead + np.rint(sample_rate * delays).astype(int)
    length = lead + int((room.reverberation_time + _RESPONSE_SECONDS) * sample_rate)
    impulses = np.zeros((ECHO_HEIGHTS * ECHO_AZIMUTHS + 1, length))
    np.add.at(impulses, (area, samples), amplitudes)
    direct = head_impulse_responses(unit_vectors([azimuth]), spacing, sample_rate)
    responses = np.concatenate((_echo_impulse_responses(spacing, sample_rate), direct))
    return _filter_sounds(torch.from_numpy(impulses), responses, sample_rate).numpy()


@compute_once
def _echo_impulse_responses(spacing: float, sample_rate: int) -> NDArray[np.float64]:
    """Compute impulse responses from the centres of the areas from which echoes come.

    The areas are numbered by height, from below, and then by azimuth, from the front to the left.
    The constant parts are removed: those of thousands of echoes would add up to 100 times that of
    the direct sound.

    Args:
        spacing: Distance between the two microphones of a side in m.
        sample_rate: Sample rate in Hz.

    Returns: Responses, (areas, microphones, ears, length), see ``head_impulse_responses``.
    """
    height = (2.0 * np.arange(ECHO_HEIGHTS) + 1.0) / ECHO_HEIGHTS - 1.0
    flat = unit_vectors(360.0 * np.arange(ECHO_AZIMUTHS) / ECHO_AZIMUTHS)
    directions = np.sqrt(1.0 - height[:, None, None] ** 2) * flat
    directions[..., 2] = height[:, None]
    responses = head_impulse_responses(directions.reshape(-1, 3), spacing, sample_rate)
    return responses - responses.mean(-1, keepdims=True)


@compute_once
def diffuse_impulse_responses(spacing: float, sample_rate: int) -> NDArray[np.float64]:
    """Compute impulse responses from the directions of diffuse noise.

    They are scaled so that the sounds from all directions have the power of one recording.

    Args:
        spacing: Distance between the two microphones of a side in m.
        sample_rate: Sample rate in Hz.

    Returns:
        Impulse responses, see ``head_impulse_responses``.

    >>> diffuse_impulse_responses(0.01, 16000).shape
    (64, 2, 2, 512)
    """
    directions = evenly_spread_directions(DIFFUSE_DIRECTIONS)
    responses = head_impulse_responses(directions, spacing, sample_rate)
    return DIFFUSE_DIRECTIONS**-0.5 * responses


def head_impulse_responses(
    directions: NDArray[np.float64], spacing: float = 0.01, sample_rate: int = NEURO_RATE
) -> NDArray[np.float64]:
    """Compute impulse responses from directions to the microphones on a spherical head.

    Args:
        directions: Unit vectors of the directions, (directions, 3).
        spacing: Distance between the two microphones of a side in m.
        sample_rate: Sample rate in Hz.

    Returns:
        Impulse responses, (directions, microphones, ears, length). Sound passes the centre of the
        head 2 ms after their beginning.

    >>> head_impulse_responses(unit_vectors([0.0])).shape
    (1, 2, 2, 512)
    """
    points = int(_RESPONSE_SECONDS * sample_rate)
    frequencies = np.fft.rfftfreq(points, 1.0 / sample_rate)
    lead = int(_LEAD_SECONDS * sample_rate)
    delay = np.exp(-2j * np.pi * frequencies * lead / sample_rate)
    return np.fft.irfft(head_responses(directions, frequencies, spacing) * delay, points)
