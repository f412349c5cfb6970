"""Conversion of signals to the sample rate at which MSBG's smearing frames are whole samples.

MSBG smears frames of 256 samples at 44.1 kHz, one every 64. What smearing does to a sound depends
on where its frames begin: the outputs of MSBG for a sound and for the same sound, shifted by half a
hop, differ by as much as a trained network on other frames differs from MSBG. At 16537.5 Hz, which
is three eighths of 44.1 kHz, the same frames have 96 samples, one every 24, and a Fourier transform
of 192 points has the frequencies of MSBG's.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.calibration import NEURO_RATE
from hlsim.dsp.fft import fade_out_weights, fft_length, rfft
from hlsim.dsp.fir import lowpass_fir
from hlsim.msbg.ear import EAR_DELAY, MSBG_RATE, ear_filter, lowpass_filter
from hlsim.msbg.filter_bank import BANKS, gammatone_response
from hlsim.msbg.model import STRUCTURAL_DELAY
from hlsim.msbg.response import half_length, impulse_responses
from hlsim.torchtools import DifferentiableFunction, constant

FRAME_RATE = MSBG_RATE * 3 / 8
"""Sample rate in Hz of signals that are cut into MSBG's frames, 16537.5 Hz."""

HOP = 24
"""Samples at the frame rate from one frame to the next. A frame has four times as many."""

FFT_POINTS = 192
"""Number of points of the Fourier transform of a frame, which is padded with zeros."""

FRAME_PERIOD = 20480
"""Samples at 16 kHz after which frames, and pairs of frames, begin on a whole sample again."""

FRAMES_PER_PERIOD = 882
"""Number of frames that begin in a ``FRAME_PERIOD``."""

_LOWPASS_HALF_LENGTH = 1383
"""Samples at 44.1 kHz on each side of the middle of the low-pass of both conversions."""

_BANK_HALF_LENGTH = half_length(MSBG_RATE)
"""Samples at 44.1 kHz that the response of the filter bank has before time 0, and from it on."""

_EAR_HALF_LENGTH = _BANK_HALF_LENGTH // 2
"""Samples at 44.1 kHz that the response of the ear has before time 0, and from it on."""

_INWARD_FIELD = math.ceil((_EAR_HALF_LENGTH + _LOWPASS_HALF_LENGTH) * NEURO_RATE / MSBG_RATE)
"""Number of samples at 16 kHz on each side that influence a sample of ``to_frame_rate``."""

_OUTWARD_FIELD = math.ceil((_BANK_HALF_LENGTH + _LOWPASS_HALF_LENGTH) * NEURO_RATE / MSBG_RATE)
"""Number of samples at 16 kHz on each side that influence a sample of ``from_frame_rate``."""

FILTERS_FIELD = _INWARD_FIELD + _OUTWARD_FIELD
"""Number of samples at 16 kHz before and after an output sample that influence it by filters."""

_FRAME_OFFSET = 4.5 + 4.0 / 3.0
"""Time in samples at 44.1 kHz from the beginning of a signal to its first sample at the frame rate.

The frames of the model begin at multiples of 64 samples after its delay of 507 samples, half a
sample before the first sample that its window does not make zero. Here, too, samples lie half a
sample, or 4/3 samples at 44.1 kHz, beside the beginning of a frame, so that they lie symmetrically
about its middle.
"""

_UNIT = 2560
"""Number of samples at 16 kHz, an even one, of which lengths of Fourier transforms are multiples.

They take as long as a whole number of samples at the frame rate, 2646.
"""

_UNIT_AT_FRAME_RATE = 2646

_UNIT_AT_MSBG_RATE = 7056

_IMAGE_BINS = (_UNIT_AT_FRAME_RATE - _UNIT) // 2
"""Number of frequencies of a transform of one unit between half of one and half of the other rate.
"""


def to_frame_rate(waveform: Tensor) -> Tensor:
    """Filter signals with outer and middle ear, without delay, and convert them to the frame rate.

    The first sample of the result lies 0.13 ms after the first one of the signal, so that frames
    lie where those of MSBG do. ``from_frame_rate`` undoes this shift.

    Shape: (items, time) -> (items, time * 1323 / 1280), rounded up.

    Args:
        waveform: Signals at 16 kHz. A part of a longer signal must begin at a multiple of
            ``FRAME_PERIOD``, so that its frames are those of the whole.

    >>> to_frame_rate(torch.randn(2, 1280)).shape
    torch.Size([2, 1323])
    """
    time = waveform.shape[-1]
    units = _transform_units(time + _INWARD_FIELD)
    spectrum = rfft(_precise(waveform), units * _UNIT)
    # The spectrum of samples is periodic: above half their rate, it is its own mirror image.
    image = spectrum[..., -_IMAGE_BINS * units - 1 : -1].flip(-1).conj()
    spectrum = torch.cat((spectrum, image), -1) * _inward_response(units, like=spectrum)
    converted = torch.fft.irfft(spectrum, units * _UNIT_AT_FRAME_RATE)
    length = math.ceil(time * _UNIT_AT_FRAME_RATE / _UNIT)
    return converted[..., :length].to(waveform.dtype)


def from_frame_rate(waveform: Tensor, severity: Tensor, length: int) -> Tensor:
    """Convert signals to 16 kHz, and apply the other fixed filters of MSBG.

    They are the sum of the filter bank's channels without gains, the inverse of the outer and
    middle ear, and a low-pass.

    Shape: (items, time), (items,) -> (items, length).

    Args:
        waveform: Signals at the frame rate, as long as those that ``to_frame_rate`` returns.
        severity: Degree of loss of each ear, 0 (none) to 3 (severe), which selects the bank.
        length: Number of samples of the input of ``to_frame_rate``.

    >>> from_frame_rate(torch.randn(2, 1323), torch.tensor([0, 3]), 1280).shape
    torch.Size([2, 1280])
    """
    units = _transform_units(length + _OUTWARD_FIELD)
    spectrum = rfft(_precise(waveform), units * _UNIT_AT_FRAME_RATE)
    # ONNX cannot index complex numbers.
    responses = torch.view_as_real(_outward_responses(units, like=spectrum))[severity]
    spectrum = spectrum * torch.view_as_complex(responses)
    # What lies above half of the new rate is mirrored.
    split = units * _UNIT // 2
    start = split - _IMAGE_BINS * units
    image = spectrum[..., split:].flip(-1).conj()
    spectrum = torch.cat((spectrum[..., :start], spectrum[..., start : split + 1] + image), -1)
    converted = torch.fft.irfft(spectrum, units * _UNIT)
    return converted[..., :length].to(waveform.dtype)


def analyse_frames(waveform: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the spectra of MSBG's windowed frames, with the time origin in their middle.

    The first frame begins 72 samples (three hops) before the signal.

    Shape: (items, time) -> (items, ceil(time / 24) + 3, 97) twice, the real and the imaginary
        parts.

    Args:
        waveform: Signals at the frame rate, from ``to_frame_rate``.

    >>> real, imaginary = analyse_frames(torch.randn(1, 240))
    >>> real.shape
    torch.Size([1, 13, 97])
    """
    return _Analysis.call(waveform, _analysis_matrices(like=waveform))


def synthesise_frames(real: Tensor, imaginary: Tensor, length: int) -> Tensor:
    """Compute signals at the frame rate from their spectra, the inverse of ``analyse_frames``.

    Shape: (items, frames, 97) twice -> (items, length).

    Args:
        real: Real parts of the spectra.
        imaginary: Imaginary parts of the spectra.
        length: Number of samples of the result, at most 24 * (frames - 3).

    >>> waveform = torch.randn(1, 240)
    >>> bool(torch.allclose(synthesise_frames(*analyse_frames(waveform), 240), waveform, atol=1e-5))
    True
    """
    return _Synthesis.call(real, imaginary, _synthesis_matrices(like=real), length)


class _Analysis(DifferentiableFunction):
    """Spectra of frames by products with matrices, and their gradient by ``_Synthesis``.

    The samples of a frame lie symmetrically about its middle, so that its even part has a real
    spectrum, and its odd part an imaginary one. With their gradients, two products with matrices of
    half the size take half the time of a Fourier transform, and real and imaginary parts are
    contiguous.

    Shape: (items, time), matrices (2, 48, 97) -> (items, frames, 97) twice.
    """

    @staticmethod
    def forward(waveform: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
        missing = -waveform.shape[-1] % HOP
        hops = functional.pad(waveform, (3 * HOP, missing + 3 * HOP)).unflatten(-1, (-1, HOP))
        frames = hops.shape[1] - 3
        # A frame has two hops before its middle, here in reversed order of samples, and two after.
        reversed_hops = hops.flip(-1)
        after = torch.cat((hops[:, 2 : frames + 2], hops[:, 3:]), -1)
        before = torch.cat((reversed_hops[:, 1 : frames + 1], reversed_hops[:, :frames]), -1)
        return (after + before) @ matrices[0], (after - before) @ matrices[1]

    @staticmethod
    def setup_context(
        ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor]
    ) -> None:
        waveform, matrices = inputs
        ctx.time = waveform.shape[-1]
        ctx.save_for_backward(matrices)

    @staticmethod
    def backward(ctx: Any, real: Tensor, imaginary: Tensor) -> tuple[Tensor, None]:
        (matrices,) = ctx.saved_tensors
        return _Synthesis.call(real, imaginary, matrices.mT, ctx.time), None


class _Synthesis(DifferentiableFunction):
    """Signals from the spectra of their frames, by products with matrices, and their gradient.

    The matrices give the even and the odd part of each frame, and overlapping frames are added up.
    The gradient is that of a linear function: ``_Analysis`` with the transposed matrices.

    Shape: (items, frames, 97) twice, matrices (2, 97, 48) -> (items, length).
    """

    @staticmethod
    def forward(real: Tensor, imaginary: Tensor, matrices: Tensor, length: int) -> Tensor:
        even, odd = real @ matrices[0], imaginary @ matrices[1]
        after, before = even + odd, even - odd
        # The first and the last three hops lie outside the signal, and are left out.
        stop = even.shape[1] - 3
        hops = after[:, 1 : stop + 1, :HOP] + after[:, :stop, HOP:]
        reversed_hops = before[:, 2 : stop + 2, :HOP] + before[:, 3:, HOP:]
        return (hops + reversed_hops.flip(-1)).flatten(1)[:, :length]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor, int], output: Tensor) -> None:
        ctx.save_for_backward(inputs[2])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None, None]:
        (matrices,) = ctx.saved_tensors
        return *_Analysis.call(gradient, matrices.mT), None, None


def _transform_units(time: int) -> int:
    """Choose the length of transforms for ``time`` samples at 16 kHz, in units of 160 ms."""
    return fft_length(math.ceil(time / _UNIT))


def _precise(waveform: Tensor) -> Tensor:
    """Return signals as they are or, in an export to ONNX, in double precision.

    The float32 transforms of onnxruntime are off by 1e-3.
    """
    return waveform.double() if torch.compiler.is_exporting() else waveform


@constant
def _analysis_matrices() -> NDArray[np.float64]:
    """Compute the matrices from the even and odd parts of frames to real and imaginary parts.

    Returns:
        Matrices for the samples after the middle of a frame, (2, 48, 97), which apply MSBG's
        window.
    """
    times = np.arange(2 * HOP, dtype=np.float64)[:, None] + 0.5
    angles = 2.0 * np.pi / FFT_POINTS * times * np.arange(FFT_POINTS // 2 + 1)
    window = np.cos(np.pi / (4 * HOP) * times) ** 2
    return np.stack((np.cos(angles), -np.sin(angles))) * window


@constant
def _synthesis_matrices() -> NDArray[np.float64]:
    """Compute the matrices from real and imaginary parts to the even and odd parts of frames.

    Returns:
        Matrices, (2, 97, 48), which apply MSBG's window and divide by the sum of the squares of
        four overlapping windows, 1.5.
    """
    weights = np.full(FFT_POINTS // 2 + 1, 2.0)  # Each frequency but the first and last is a pair.
    weights[[0, -1]] = 1.0
    return (_analysis_matrices() * weights / (1.5 * FFT_POINTS)).swapaxes(1, 2)


@constant
def _inward_response(units: int) -> NDArray[np.complex128]:
    """Compute the response of ``to_frame_rate``: outer and middle ear, and a low-pass.

    Args:
        units: Length of the Fourier transform in units of 160 ms.

    Returns:
        Response at the frequencies up to half of the frame rate, (units * 1323 + 1,).
    """
    response = _fourier_transform(_ear_taps(), units) * _conversion(units, _EAR_HALF_LENGTH)
    return response * (_UNIT_AT_FRAME_RATE / _UNIT)


@constant
def _outward_responses(units: int) -> NDArray[np.complex128]:
    """Compute the frequency responses of ``from_frame_rate``, one per degree of loss.

    Args:
        units: Length of the Fourier transform in units of 160 ms.

    Returns:
        Responses up to half of the frame rate, (severities, units * 1323 + 1).
    """
    responses = _fourier_transform(_bank_taps(), units)
    conversion = _conversion(units, _BANK_HALF_LENGTH)
    return responses * conversion * (_UNIT / _UNIT_AT_FRAME_RATE)


def _fourier_transform(taps: NDArray[np.float64], units: int) -> NDArray[np.complex128]:
    """Compute the spectra of taps at 44.1 kHz up to half of the frame rate.

    Shape: (..., taps) -> complex (..., units * 1323 + 1), where a unit is 160 ms.
    """
    bins = units * _UNIT_AT_FRAME_RATE // 2 + 1
    return np.asarray(np.fft.rfft(taps, units * _UNIT_AT_MSBG_RATE)[..., :bins])


def _conversion(units: int, advance: int) -> NDArray[np.complex128]:
    """Compute the response, without delay, of the low-pass between 16 kHz and the frame rate.

    It ends between 8 kHz and half of the frame rate, where it is so near 0 that the Fourier
    transforms do not make it ring: an output depends on no samples beyond ``FILTERS_FIELD``.

    Args:
        units: Length of the Fourier transform in units of 160 ms.
        advance: Number of samples at 44.1 kHz by which the response is advanced in addition.

    Returns:
        Response at the frequencies up to half of the frame rate, (units * 1323 + 1,).
    """
    nyquist = FRAME_RATE / 2.0
    length = 2 * _LOWPASS_HALF_LENGTH + 1
    cutoff = (NEURO_RATE / 2.0 + nyquist) / 2.0
    # The beta is that of an attenuation by 250 dB.
    taps = lowpass_fir(length, cutoff / (MSBG_RATE / 2.0), kaiser_beta=26.6)
    response = _fourier_transform(taps, units)
    points = units * _UNIT_AT_MSBG_RATE
    bins = np.arange(len(response))
    # Whole cycles are left out, because the sine of thousands of radians is rounded to 1e-13.
    cycles = bins * (advance + _LOWPASS_HALF_LENGTH) % points / points
    return response * np.exp(2j * np.pi * cycles)


@lru_cache(maxsize=1)
def _ear_taps() -> NDArray[np.float64]:
    """Compute the impulse response of outer and middle ear, advanced by ``_FRAME_OFFSET``.

    Returns:
        Coefficients at 44.1 kHz, time 0 in the middle, (2 * ``_EAR_HALF_LENGTH``,).
    """
    omega, points = _grid()
    response = np.fft.rfft(ear_filter(), points)[: len(omega)]
    (taps,) = _centred_taps(response[None], EAR_DELAY + _FRAME_OFFSET)
    margin = _BANK_HALF_LENGTH - _EAR_HALF_LENGTH
    return taps[margin : margin + 2 * _EAR_HALF_LENGTH]


@lru_cache(maxsize=1)
def _bank_taps() -> NDArray[np.float64]:
    """Compute the impulse responses of ``from_frame_rate``, delayed by ``_FRAME_OFFSET``.

    Returns:
        Coefficients at 44.1 kHz, time 0 in the middle, (severities, 2 * ``_BANK_HALF_LENGTH``).
    """
    omega, points = _grid()
    responses = []
    for bank in BANKS.values():
        response = gammatone_response(bank, points, bins=len(omega)).sum(0)
        for taps in (ear_filter(backward=True), lowpass_filter()):
            response = response * np.fft.rfft(taps, points)[: len(omega)]
        responses.append(response * 10.0 ** (-bank.recombination_db / 20.0))
    return _centred_taps(np.stack(responses), STRUCTURAL_DELAY - EAR_DELAY - _FRAME_OFFSET)


def _centred_taps(responses: NDArray[np.complex128], advance: float) -> NDArray[np.float64]:
    """Compute impulse responses at 44.1 kHz that fade out at 8 kHz, as MSBG does when it resamples.

    Args:
        responses: Frequency responses at the frequencies of ``_grid``, (responses, frequencies).
        advance: Number of samples at 44.1 kHz by which the responses are advanced.

    Returns:
        Impulse responses with time 0 in the middle, (responses, 2 * ``_BANK_HALF_LENGTH``).
    """
    omega, points = _grid()
    fade = fade_out_weights(len(omega), MSBG_RATE / points, NEURO_RATE / 2)
    return impulse_responses(responses * np.exp(1j * omega * advance) * fade, points, MSBG_RATE)


def _grid() -> tuple[NDArray[np.float64], int]:
    """Return frequencies up to 8 kHz in radians per sample, and the FFT length, at 44.1 kHz."""
    points = 10 * _UNIT_AT_MSBG_RATE
    frequencies = np.arange(10 * _UNIT // 2 + 1, dtype=np.float64)
    return np.asarray(2.0 * np.pi / points * frequencies), points
