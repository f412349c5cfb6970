"""Directional microphones: front ends that turn several microphones into one signal per ear.

Inputs have the shape (..., microphones, ears, time): at each side of the head, a front and a rear
microphone, left side first. Outputs have the shape (..., ears, time), which any aid of two ears
takes. Sounds from the front come out nearly as the front microphone receives them; most sounds from
other directions are attenuated. The filters look ahead by up to 1 ms.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from compensators.smoothing import exponential_average
from compensators.wearable import State, Stream
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import NEURO_RATE
from hlsim.checks import (
    check_attributes,
    check_finite,
    check_names,
    check_number,
    check_rate,
    check_waveform,
)
from hlsim.dsp.fft import fft_length
from hlsim.dsp.sphere import (
    SPACINGS,
    SPEED_OF_SOUND,
    evenly_spread_directions,
    head_responses,
    unit_vectors,
)
from hlsim.torchtools import Audio, as_samples, as_type_of, compute_once

LOOK_AHEAD = 0.001
"""Look-ahead of the filters in seconds."""

FILTER_SECONDS = 0.008
"""Duration of the filters in seconds, after their look-ahead."""

PATTERNS = {"dipole": 0.0, "hypercardioid": 1.0 / 3.0, "supercardioid": 0.577, "cardioid": 1.0}
"""Delay of the rear microphone for each directional pattern, by name.

It is relative to the time in which sound passes from one microphone to the other. The pattern has
its null where the cosine of the angle to the front is minus this number.
"""

_NOISE_DIRECTIONS = 200
"""Number of directions of the sounds in the model of diffuse noise."""

_DISTORTION_WEIGHT = 1e3
"""Weight of the power of the error of sound from the front, relative to that of diffuse noise."""

_LOWEST_BLOCKED = 100.0
"""Frequency in Hz at which the cardioids of ``beam_and_blocking_taps`` are 3 dB softer."""

POWER_FLOOR = 1e-12
"""Power in Pa^2, about -26 dB SPL, that is added to powers by which others are divided."""


class FilterAndSum(nn.Module):
    """Fixed filters, one per microphone and ear, whose outputs are added up.

    Args:
        taps: Impulse responses from each microphone to each ear of the output, (ears of the
            output, microphones, ears of the microphones, length).
        look_ahead: Number of samples of the impulse responses before time 0.
        sample_rate: Sample rate in Hz.

    Attributes:
        latency: Delay of streams in samples, the look-ahead.
        takes_microphones: True, as for each aid that gets the signals of all microphones.
        ears: Number of ears with microphones, 2.

    Raises:
        ValueError: The rate is out of range.

    >>> mean = FilterAndSum(torch.eye(2).reshape(2, 1, 2, 1).repeat(1, 2, 1, 1) / 2)
    >>> mean(torch.ones(2, 2, 100)).shape
    torch.Size([2, 100])
    """

    takes_microphones = True
    ears = 2

    taps: Tensor

    def __init__(
        self,
        taps: Tensor | NDArray[np.float64],
        look_ahead: int = 0,
        sample_rate: int = NEURO_RATE,
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.latency = look_ahead
        self.register_buffer("taps", torch.as_tensor(taps).float())

    def forward(self, waveform: Audio, audiogram: AudiogramLike | None = None) -> Audio:
        """Return the output for whole signals, time-aligned with the front microphones.

        Args:
            waveform: Signals of the microphones, a tensor or an array, as is the output.
            audiogram: Ignored, so that the module can be called as an aid.

        Shape: (..., microphones, ears, time) -> (..., ears, time).

        Raises:
            ValueError: The samples are not floating-point numbers with time last, there are none or
                one above 1e9 in magnitude, or there is another number of microphones or ears.
        """
        signals = as_samples(waveform)
        return as_type_of(waveform, self.delayed_output(signals)[..., -signals.shape[-1] :])

    def delayed_output(self, waveform: Tensor) -> Tensor:
        """Return the output for whole signals as a stream returns it: late by the look-ahead.

        The frames of an aid begin at the first sample of its input. So an aid that gets this output
        changes its gains at the same times as behind the stream.

        Args:
            waveform: Signals of the microphones.

        Shape: (..., microphones, ears, time) -> (..., ears, look-ahead + time).

        Raises:
            ValueError: See ``forward``.
        """
        self.check_microphones(waveform)
        # Powers of soft sounds are 0 in half precision.
        signals = waveform.to(torch.promote_types(waveform.dtype, torch.float32))
        padded = functional.pad(signals, (0, self.latency))
        with torch.autocast(waveform.device.type, enabled=False):
            output = self.process(padded, self.initial_state(signals))[0]
        return output.to(waveform.dtype)

    def check_microphones(self, waveform: Tensor) -> None:
        """Raise ValueError unless a waveform has as many microphones and ears as the filters."""
        check_waveform(waveform)
        expected = tuple(self.taps.shape[1:3])
        if waveform.shape[-3:-1] != expected:
            raise ValueError(
                f"expected signals of {expected[0]} microphones at {expected[1]} ears, (..., "
                f"{expected[0]}, {expected[1]}, time), got shape {tuple(waveform.shape)}; stack "
                "the microphones of each side from front to rear, the left side first; or place "
                "mono speech by hlsim.data.scenes.make_scene"
            )

    def initial_state(self, waveform: Tensor) -> State:
        """Return the state at the beginning of a signal, before which there is silence.

        Args:
            waveform: Signals with the shape, type and device of those to process.

        Returns: Zeros in place of the earlier samples that the filters need, under "past", (...,
            microphones, ears, length of the filters - 1).
        """
        return {"past": waveform.new_zeros(*waveform.shape[:-1], self.taps.shape[-1] - 1)}

    def process(self, waveform: Tensor, state: State) -> tuple[Tensor, State]:
        """Return the output, delayed by ``latency`` samples, and the state after the last sample.

        Args:
            waveform: Signals of the microphones.
            state: State from ``initial_state``, or from the call for the preceding samples.

        Shape: (..., microphones, ears, time) -> (..., ears, time).
        """
        samples = torch.cat((state["past"], waveform), -1)
        past = samples[..., waveform.shape[-1] :]
        return self.filter(samples, self.taps), {"past": past}

    @staticmethod
    def filter(samples: Tensor, taps: Tensor) -> Tensor:
        """Filter the signals of the microphones, and add them up for each ear.

        Args:
            samples: Signals of the microphones, after the earlier samples that the filters need.
            taps: Impulse responses.

        Shape: (..., microphones, ears, length - 1 + time), (ears, microphones, ears, length)
            -> (..., ears, time).
        """
        points = fft_length(samples.shape[-1])
        spectra = torch.fft.rfft(samples, points).unsqueeze(-4)
        products = spectra * torch.fft.rfft(taps.to(samples), points)
        output = torch.fft.irfft(products.sum((-3, -2)), points)
        return output[..., taps.shape[-1] - 1 : samples.shape[-1]]

    def stream(self, audiogram: AudiogramLike | None = None) -> MicrophoneStream:
        """Return a stream, which processes signals that arrive in chunks.

        Args:
            audiogram: Ignored, as in ``forward``.

        Raises:
            ValueError: The front end is a beamformer for another rate than 16000 Hz.
        """
        return MicrophoneStream(self)


class MicrophoneStream:
    """A front end for signals that arrive in chunks: a function from a chunk to the next output.

    The output is that for the whole signal, without gradients, and is delayed by the ``latency`` of
    the front end and of the aid.

    Args:
        front_end: Front end with ``process`` and ``initial_state``.
        aid: Stream of the aid behind the front end; None for the front end alone.

    Attributes:
        aid: Stream of the aid, whose sliders ``aid.set`` moves, or None.

    >>> stream = DifferentialMicrophone().stream()
    >>> stream(torch.zeros(2, 2, 100)).shape
    torch.Size([2, 100])
    """

    def __init__(self, front_end: FilterAndSum, aid: Stream | None = None) -> None:
        self.aid = aid
        self._front_end = front_end
        self._state: State | None = None
        self._zero: Tensor = torch.empty(0)

    @torch.no_grad()
    def __call__(self, chunk: Audio) -> Audio:
        """Return the next output. Shape: (..., microphones, ears, time) -> (..., ears, time).

        Raises:
            ValueError: The chunk is not a floating-point waveform, or has no samples, another
                number of microphones or ears, other leading dimensions than the first one, or a
                sample that is NaN, infinite or above 1e9 in magnitude; or the aid rejects an ear or
                a slider. A rejected chunk leaves the stream as it was.
        """
        samples = as_samples(chunk)
        self._front_end.check_microphones(samples)
        check_finite(samples, "the chunk")  # It would stay in the averages of powers.
        signals = samples.to(torch.promote_types(samples.dtype, torch.float32))
        shape: torch.Size = self._zero.shape[:-1]
        state = self._state
        if state is None:
            state = self._front_end.initial_state(signals)
        elif signals.shape[:-1] != shape:
            raise ValueError(
                f"expected a chunk of shape {(*shape, 'time')} as before, got "
                f"{tuple(signals.shape)}; call flush before a signal of another shape"
            )
        with torch.autocast(signals.device.type, enabled=False):
            output, state = self._front_end.process(signals, state)
        output = output.to(samples.dtype)
        if self.aid is not None:
            output = self.aid(output)
        # The aid may reject the chunk, which then has not changed this stream.
        self._state, self._zero = state, torch.zeros_like(samples[..., :1])
        return as_type_of(chunk, output)

    def flush(self) -> Tensor:
        """Return the end of the output, which is still missing because of the delay.

        The next chunk is then the beginning of another signal.

        Shape: -> (..., ears, latency), where the latency includes that of the aid.

        Raises:
            ValueError: There was no chunk since the beginning of the signal, or the aid rejects a
                slider.
        """
        if self._state is None:
            raise ValueError("expected a chunk before flush, got none; there is nothing to return")
        latency = self._front_end.latency
        rest = self._zero[..., 0, :, :0]  # (..., ears, 0)
        if latency:
            rest = self(self._zero.expand(*self._zero.shape[:-1], latency))
        self._state = None
        if self.aid is None:
            return rest
        end = self.aid.flush()
        return torch.cat((rest, end), -1) if latency else end


class DifferentialMicrophone(FilterAndSum):
    """A fixed directional microphone at each side: front minus delayed rear microphone.

    The difference falls by 6 dB per octave towards low frequencies, which a filter compensates down
    to ``lowest``. Below this frequency, the output falls, so that the noise of the microphones is
    not amplified further. Source: Elko 2004, in Huang and Benesty (editors), Audio Signal
    Processing for Next-Generation Multimedia Communication Systems, chapter 2.

    Shape: (..., 2 microphones, 2 ears, time) -> (..., 2 ears, time).

    Args:
        pattern: "cardioid", "supercardioid", "hypercardioid" or "dipole".
        spacing: Distance between the two microphones of a side in m, 0.002 to 0.1.
        lowest: Frequency in Hz, 20 to 2000, at which sound from the front is 3 dB softer, if the
            spacing is far below its wavelength.
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Raises:
        ValueError: The pattern is unknown, or a value is out of range.

    >>> front_end = DifferentialMicrophone("cardioid")
    >>> front_end(torch.zeros(2, 2, 16000)).shape
    torch.Size([2, 16000])
    """

    def __init__(
        self,
        pattern: str = "hypercardioid",
        *,
        spacing: float = 0.01,
        lowest: float = 200.0,
        sample_rate: int = NEURO_RATE,
    ) -> None:
        check_names([pattern], PATTERNS, "patterns")
        check_number("spacing", spacing, *SPACINGS)
        check_number("lowest", lowest, 20.0, 2000.0)
        rate = check_rate(sample_rate)
        responses = differential_responses(PATTERNS[pattern], spacing, lowest, rate)
        look_ahead = look_ahead_samples(rate)
        one_side = _impulse_responses(responses, look_ahead, filter_length(rate))
        taps = np.einsum("ef,ml->emfl", np.eye(2), one_side)
        super().__init__(taps, look_ahead, rate)


class AdaptiveDifferentialMicrophone(DifferentialMicrophone):
    """An adaptive directional microphone at each side, whose null follows the loudest noise behind.

    A share, 0 to 1, of a cardioid to the rear is subtracted from a cardioid to the front. A larger
    share moves the null from 180 towards 90 degrees. Each side has one share for all frequencies,
    which minimises the power of its output: it is computed from average powers of the recent past.
    Source: Elko and Nguyen Pong 1995, IEEE ASSP Workshop on Applications of Signal Processing to
    Audio and Acoustics, who use an LMS algorithm instead of averages.

    Shape: (..., 2 microphones, 2 ears, time) -> (..., 2 ears, time).

    Args:
        seconds: Time constant of the averages in seconds, 0.001 to 10.
        spacing: Distance between the two microphones of a side in m, 0.002 to 0.1.
        lowest: Frequency in Hz, 20 to 2000, see ``DifferentialMicrophone``.
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Raises:
        ValueError: A value is out of range.

    >>> AdaptiveDifferentialMicrophone()(torch.zeros(2, 2, 16000)).shape
    torch.Size([2, 16000])
    """

    def __init__(
        self,
        *,
        seconds: float = 0.02,
        spacing: float = 0.01,
        lowest: float = 200.0,
        sample_rate: int = NEURO_RATE,
    ) -> None:
        super().__init__("cardioid", spacing=spacing, lowest=lowest, sample_rate=sample_rate)
        check_number("seconds", seconds, 0.001, 10.0)
        self.past_weight = math.exp(-1.0 / (self.sample_rate * seconds))

    def initial_state(self, waveform: Tensor) -> State:
        powers = waveform.new_zeros(*waveform.shape[:-3], 2 * waveform.shape[-2])
        return {**super().initial_state(waveform), "powers": powers}

    def process(self, waveform: Tensor, state: State) -> tuple[Tensor, State]:
        samples = torch.cat((state["past"], waveform), -1)
        to_front = self.filter(samples, self.taps)
        to_rear = self.filter(samples, self.taps.flip(1))
        products = torch.cat((to_front * to_rear, to_rear.square()), -2).mT
        averages = exponential_average(products, state["powers"], self.past_weight)
        common, rear = averages.mT.chunk(2, -2)
        share = (common / (rear + POWER_FLOOR)).clamp(0.0, 1.0)
        past = samples[..., waveform.shape[-1] :]
        return to_front - share * to_rear, {"past": past, "powers": averages[..., -1, :]}


class BinauralMVDR(FilterAndSum):
    """A fixed beamformer that combines the microphones of both sides to the front.

    Of all filters that pass sound from the front as the front microphone of each ear receives it,
    these pass the least diffuse noise (minimum variance distortionless response). The head is
    modelled as a rigid sphere, and the noise as sounds of equal power from all directions. Only
    sounds from the front keep their differences of level and time between the ears: remaining noise
    gets those of the front.

    Shape: (..., 2 microphones, 2 ears, time) -> (..., 2 ears, time).

    Args:
        loading: Power of each microphone's own noise, relative to the diffuse noise, for which the
            filters are designed, 1e-6 to 1. The larger it is, the less they amplify this noise.
        spacing: Distance between the two microphones of a side in m, 0.002 to 0.1.
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Raises:
        ValueError: A value is out of range.

    >>> BinauralMVDR()(torch.zeros(2, 2, 16000)).shape
    torch.Size([2, 16000])
    """

    def __init__(
        self, *, loading: float = 1e-4, spacing: float = 0.01, sample_rate: int = NEURO_RATE
    ) -> None:
        check_number("loading", loading, 1e-6, 1.0)
        check_number("spacing", spacing, *SPACINGS)
        rate = check_rate(sample_rate)
        look_ahead = look_ahead_samples(rate)
        super().__init__(mvdr_taps(loading, spacing, rate, look_ahead), look_ahead, rate)


class DirectionalAid(nn.Module):
    """A directional front end, followed by an aid of two ears.

    Args:
        front_end: Combination of microphones, (..., microphones, ears, time) to (..., ears, time),
            such as ``BinauralMVDR()``.
        aid: Aid of two ears, such as those of ``load_compensator``, at the same sample rate.

    Raises:
        ValueError: The front end is not a ``FilterAndSum``, the aid is not a module, or was built
            for another sample rate or, behind an ``AdaptiveBeamformer``, another
            ``full_scale_spl``.

    >>> from compensators import NALR
    >>> aid = DirectionalAid(DifferentialMicrophone(), NALR())
    >>> aid(torch.zeros(2, 2, 16000), ["N2", "N4"]).shape
    torch.Size([2, 16000])
    """

    takes_microphones = True
    ears = 2

    front_end: FilterAndSum
    aid: Any

    def __init__(self, front_end: FilterAndSum, aid: nn.Module) -> None:
        super().__init__()
        if not isinstance(front_end, FilterAndSum):
            raise ValueError(f"expected a front end, got {front_end!r}; write BinauralMVDR()")
        if not isinstance(aid, nn.Module):
            raise ValueError(f"expected an aid, got {aid!r}; load it by hlsim.load_compensator")
        check_attributes(aid, "an aid", sample_rate=front_end.sample_rate)
        if hasattr(front_end, "full_scale_spl"):
            check_attributes(aid, "an aid", full_scale_spl=front_end.full_scale_spl)
        self.front_end = front_end
        self.aid = aid

    def forward(
        self, waveform: Tensor, audiogram: AudiogramLike | None = None, **sliders: Any
    ) -> Tensor:
        """Return the output for whole signals.

        Args:
            waveform: Signals of the microphones.
            audiogram: Ears of the listener, by default those of the aid.
            sliders: Further arguments of the aid, such as ``noise_reduction=0.0``.

        Shape: (..., microphones, ears, time) -> (..., ears, time).

        Raises:
            ValueError: The waveform is not valid, see ``FilterAndSum.forward``, or the aid rejects
                an ear or the value of a slider.
        """
        delayed = self.front_end.delayed_output(waveform)
        output: Tensor = self.aid(delayed, audiogram, **sliders)
        return output[..., -waveform.shape[-1] :]

    def gains(self, audiogram: AudiogramLike | None = None, level: float = 65.0) -> Tensor:
        """Measure the insertion gains in dB of the aid behind the front end, see ``Aid.gains``.

        They do not include the front end, which passes sound from the front nearly unchanged; a
        differential microphone attenuates it below its ``lowest`` frequency.
        """
        gains: Tensor = self.aid.gains(audiogram, level)
        return gains

    @property
    def latency(self) -> int:
        """Delay of streams in samples at 16 kHz, that of the front end and that of the aid.

        An aid without streams, such as ``NALR``, has none: reading it raises AttributeError.
        """
        return self.front_end.latency + int(self.aid.latency)

    def stream(self, audiogram: AudiogramLike | None = None, **sliders: Any) -> MicrophoneStream:
        """Return a stream, which processes signals that arrive in chunks.

        Args:
            audiogram: Ears of the listener, by default those of the aid.
            sliders: Values of the aid's sliders, see the ``stream`` of the aid.

        Raises:
            ValueError: The aid or the front end has no streams, or the aid rejects an ear or a
                slider.
        """
        stream = self.front_end.stream()
        stream.aid = self.aid.stream(audiogram, **sliders)
        return stream


def behind_front_end(aid: Any) -> Any:
    """Return the hearing aid behind a front end, or the aid itself if it has no front end.

    >>> from compensators import NALR
    >>> type(behind_front_end(DirectionalAid(BinauralMVDR(), NALR()))).__name__
    'NALR'
    """
    return aid.aid if isinstance(aid, DirectionalAid) else aid


def look_ahead_samples(sample_rate: int) -> int:
    """Return the look-ahead of front ends' filters in whole samples, at most 1 ms.

    >>> look_ahead_samples(16000)
    16
    """
    return int(LOOK_AHEAD * sample_rate)


def filter_length(sample_rate: int) -> int:
    """Return the length of front ends' filters in samples, up to 9 ms with the look-ahead.

    >>> filter_length(16000)
    144
    """
    return look_ahead_samples(sample_rate) + int(FILTER_SECONDS * sample_rate)


def design_frequencies(sample_rate: int) -> NDArray[np.float64]:
    """Return the frequencies in Hz at which filters are designed, from 0 to half the rate.

    >>> len(design_frequencies(16000))
    289
    """
    points = 4 * filter_length(sample_rate)
    return np.linspace(0.0, sample_rate / 2.0, points // 2 + 1)


def differential_responses(
    delay: float, spacing: float, lowest: float, sample_rate: int
) -> NDArray[np.complex128]:
    """Compute the frequency responses of a differential microphone's filters.

    Args:
        delay: Delay of the rear microphone, relative to the time in which sound passes the spacing.
        spacing: Distance between the microphones in m.
        lowest: Frequency in Hz, see ``DifferentialMicrophone``.
        sample_rate: Sample rate in Hz.

    Returns:
        Responses of the front and of the rear microphone at ``design_frequencies``, (2,
        frequencies).

    >>> differential_responses(delay=1.0, spacing=0.01, lowest=200.0, sample_rate=16000).shape
    (2, 289)
    """
    omega = 2.0 * np.pi * design_frequencies(sample_rate)
    travel = spacing / SPEED_OF_SOUND
    # Sound from the front passes the pair in the travel time, and is then delayed once more.
    total = travel * (1.0 + delay)
    decay = np.exp(-2.0 * np.pi * lowest * total)
    front = 0.5 * (1.0 + decay) / (1.0 - decay * np.exp(-1j * omega * total))
    rear = -front * np.exp(-1j * omega * travel * delay)
    return np.stack((front, rear))


@compute_once
def mvdr_taps(loading: float, spacing: float, sample_rate: int, before: int) -> NDArray[np.float64]:
    """Design the filters of ``BinauralMVDR`` by least squares over their coefficients (Frost 1972).

    Args:
        loading: Power of each microphone's own noise, relative to the diffuse noise.
        spacing: Distance between the microphones of a side in m.
        sample_rate: Sample rate in Hz.
        before: Number of samples before time 0.

    Returns:
        Impulse responses from each microphone to each ear of the output, (ears of the output,
        microphones, ears of the microphones, length): front microphone first, left ear first.

    >>> mvdr_taps(loading=1e-4, spacing=0.01, sample_rate=16000, before=16).shape
    (2, 2, 2, 144)
    """
    frequencies = design_frequencies(sample_rate)
    noise = head_responses(evenly_spread_directions(_NOISE_DIRECTIONS), frequencies, spacing)
    noise = noise.reshape(_NOISE_DIRECTIONS, 4, -1)
    front = head_responses(unit_vectors([0.0]), frequencies, spacing).reshape(4, -1)
    covariance = np.einsum("dif,djf->ijf", noise, noise.conj()) / _NOISE_DIRECTIONS
    covariance += loading * np.eye(4)[..., None]
    covariance += _DISTORTION_WEIGHT * front[:, None] * front.conj()
    length = filter_length(sample_rate)
    lags = np.arange(length) - np.arange(length)[:, None]
    matrix = np.fft.irfft(covariance)[..., lags]
    matrix = matrix.transpose(0, 2, 1, 3).reshape(4 * length, 4 * length)
    delay = np.exp(-2j * np.pi * frequencies * before / sample_rate)
    wanted = front[:2, None] * delay * front.conj()
    goal = _DISTORTION_WEIGHT * np.fft.irfft(wanted)[..., :length]
    taps = scipy.linalg.solve(matrix, goal.reshape(2, -1).T, assume_a="pos").T
    return np.asarray(taps, dtype=np.float64).reshape(2, 2, 2, length)


def beam_and_blocking_taps(loading: float, spacing: float, before: int) -> NDArray[np.float64]:
    """Design filters at 16 kHz of beams to the front, and of signals without sound from the front.

    The beams are those of ``mvdr_taps``. The two other signals are, at each side, a cardioid to the
    rear, and the difference between the beam and a cardioid to the front, where the beam is
    filtered as the cardioid filters sound from the front. Of sound in front of a sphere, they have
    -40 dB or less up to 4 kHz, relative to the front microphone, and up to -24 dB at 8 kHz, if the
    spacing is 1 cm.

    Args:
        loading: Power of each microphone's own noise, see ``mvdr_taps``.
        spacing: Distance between the microphones of a side in m.
        before: Number of samples before time 0 in each impulse response.

    Returns:
        Impulse responses, (3, ears of the output, microphones, ears of the microphones, length):
        the beams, the cardioids, and the differences. They are twice as long as those of
        ``mvdr_taps``.

    >>> beam_and_blocking_taps(loading=1e-4, spacing=0.01, before=8).shape
    (3, 2, 2, 2, 288)
    """
    beams = mvdr_taps(loading, spacing, NEURO_RATE, before)
    length = 2 * beams.shape[-1]
    frequencies = design_frequencies(NEURO_RATE)
    points = 2 * (len(frequencies) - 1)
    front = head_responses(unit_vectors([0.0]), frequencies, spacing)[0, :, 0]
    path = front[1] / front[0]
    cardioid = differential_responses(1.0, spacing, _LOWEST_BLOCKED, NEURO_RATE)
    to_rear = np.stack((-cardioid[0] * path, cardioid[0]))
    passed = cardioid[0] + cardioid[1] * path
    taps = np.zeros((3, 2, 2, 2, length))
    taps[0, ..., : beams.shape[-1]] = beams
    taps[2] = _impulse_responses(np.fft.rfft(beams, points) * passed, 0, length)
    for ear in range(2):
        taps[1, ear, :, ear] = _impulse_responses(to_rear, before, length)
        taps[2, ear, :, ear] -= _impulse_responses(cardioid, before, length)
    return taps


def _impulse_responses(
    responses: NDArray[np.complex128], before: int, length: int
) -> NDArray[np.float64]:
    """Convert frequency responses to impulse responses that begin before time 0.

    The highest eighth of the frequencies fades out, so that little of the responses is cut off.

    Args:
        responses: Responses at ``design_frequencies``.
        before: Number of samples before time 0.
        length: Number of samples of the result.

    Shape: (..., frequencies) -> (..., length).
    """
    bins = responses.shape[-1]
    fade_bins = bins // 8
    fade = np.ones(bins)
    fade[-fade_bins:] = np.cos(np.linspace(0.0, 0.5 * np.pi, fade_bins)) ** 2
    impulses = np.fft.irfft(responses * fade)
    return np.roll(impulses, before, -1)[..., :length]
