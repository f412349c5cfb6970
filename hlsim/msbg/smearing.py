"""Spectral smearing: what the wider auditory filters of an impaired ear do to a spectrum.

The signal is cut into frames of 5.8 ms, one every 1.5 ms (a *hop*). The power spectrum of each
frame is multiplied by a matrix that spreads it over neighbouring frequencies, and the phase is kept
(or turned by 90 degrees where the product is negative).

Source: Baer and Moore (1993), Journal of the Acoustical Society of America 94, 1229-1241.
"""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.erb import ERB_AT_0_HZ, erb
from hlsim.dsp.fft import power, rfft
from hlsim.msbg.ear import MSBG_RATE
from hlsim.torchtools import DifferentiableFunction, constant

FRAME = 256
"""Length of a frame in samples at 44.1 kHz."""

HOP = 64
"""Samples at 44.1 kHz from one frame to the next."""

FFT = 512
"""Length of the Fourier transform of a frame, which is zero-padded to twice its length."""

SMEARING_DELAY = 3 * HOP
"""Delay of smearing in samples at 44.1 kHz, because its frames are read three hops late."""

BROADENING = {"mild": (1.6, 1.1), "moderate": (2.4, 1.6), "severe": (4.0, 2.0)}
"""Factors by which the lower and the upper sides of the auditory filters are wider than normal.

With the severity ``"none"``, nothing is smeared. The values are those of pyclarity 0.9.0.
"""

SKIRT_HZ = 800.0
"""Distance in Hz by which smearing spreads a spectrum beyond its highest frequency."""

_POWER_FLOOR = 1e-24
"""Power in Pa^2 that is added to powers before and after smearing, so that silence stays silent."""

_MIN_POWER_RATIO = 1e-24
"""Smallest ratio of powers whose square root is computed, because square roots of 0 are slow."""

_MAX_POWER_RATIO = 1e30
"""Largest ratio of powers, in place of infinity where silence lies next to very loud sounds."""

_DIVISION_EPS = 1e-36
"""Power in Pa^2 that keeps divisors away from 0."""

_PHASE_FLOOR = 1.2e-6
"""Amplitude over the RMS of its frame below which a frequency has no usable phase.

It is ten times the rounding error of float32.
"""


def roex_filters(lower: float, upper: float, count: int, spacing: float) -> NDArray[np.float64]:
    """Compute the auditory filters of an ear: how much of each frequency each filter passes.

    The filters are rounded exponentials, (1 + g) exp(-g), divided by their bandwidths relative to
    that of a normal filter at 0 Hz. g is the distance from the centre frequency in quarters of the
    filter's equivalent rectangular bandwidth, which ``lower`` or ``upper`` widens. The filter at
    0 Hz passes this frequency only.

    Args:
        lower: Factor by which the lower sides of the filters are wider than normal.
        upper: Factor by which the upper sides of the filters are wider than normal.
        count: Number of filters, and of frequencies.
        spacing: Distance in Hz between frequencies, the first of which is 0 Hz.

    Returns:
        Weights of powers, (count, count). Each row is a filter, centred on the frequency of the
        same index.

    >>> roex_filters(1.0, 1.0, count=256, spacing=44100 / 512).shape
    (256, 256)
    """
    bins = np.arange(count, dtype=float)
    centre_bins = bins[:, None]
    hz = bins * spacing
    bandwidth = erb(hz)[:, None]
    # The filter at 0 Hz divides by 0. It is set below.
    with np.errstate(divide="ignore", invalid="ignore"):
        relative_distance = np.abs(centre_bins - bins) / centre_bins
        distance = relative_distance * 4.0 * hz[:, None] / bandwidth
    g = distance / np.where(bins < centre_bins, lower, upper)
    relative_bandwidth = bandwidth * (lower + upper) / (2.0 * ERB_AT_0_HZ)
    filters = (1.0 + g) * np.exp(-g) / relative_bandwidth
    filters[0] = 0.0
    filters[0, 0] = 2.0 / (lower + upper)
    return filters


@constant
def smearing_matrix(
    severity: str, rate_divisor: int = 1, highest: float = MSBG_RATE / 2.0
) -> NDArray[np.float64]:
    """Compute the matrix that blurs power spectra as an impaired ear does, for ``smear``.

    Args:
        severity: Severity of the hearing loss, ``"mild"``, ``"moderate"`` or ``"severe"``.
        rate_divisor: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.
        highest: Highest frequency of the signals in Hz. The matrix ends 800 Hz above it, because
            smearing spreads signals that far.

    Returns:
        Matrix, (bins, bins), with 86 Hz from bin to bin.

    >>> smearing_matrix("mild").shape
    (256, 256)
    >>> smearing_matrix("mild", rate_divisor=2, highest=8000.0).shape
    (103, 103)
    """
    bins = min(FFT // 2 // rate_divisor, math.ceil((highest + SKIRT_HZ) * FFT / MSBG_RATE))
    return design_smearing(severity, FFT // 2, MSBG_RATE / FFT)[:bins, :bins]


def design_smearing(severity: str, count: int, spacing: float) -> NDArray[np.float64]:
    """Compute a matrix that makes a normal ear perceive a power spectrum as an impaired ear does.

    The matrix is multiplied by the power spectrum. The filters of the normal ear have nearly the
    same outputs for the product as the filters of the impaired ear for the spectrum itself:
    ``normal @ matrix`` approximates ``wide``.

    Args:
        severity: Severity of the hearing loss, ``"mild"``, ``"moderate"`` or ``"severe"``.
        count: Number of frequencies, and of filters of each ear.
        spacing: Distance in Hz between frequencies, the first of which is 0 Hz.

    Returns:
        Matrix, (count, count).

    >>> design_smearing("mild", count=8, spacing=1000.0).shape
    (8, 8)
    """
    normal = roex_filters(1.0, 1.0, count, spacing)
    wide = roex_filters(*BROADENING[severity], count, spacing)
    half = count // 2
    # Above the highest frequency, each filter continues with the mirror image of its lower side.
    # Without this continuation, the division would ring.
    extended = np.concatenate((normal, np.zeros((count, half))), axis=1)
    for i in range(half, count):
        stop = min(2 * i - 1, 3 * half)
        mirrored = normal[i, 2 * i - count : max(1, 2 * i - 3 * half) : -1]
        extended[i, count:stop] = mirrored[: stop - count]
    solution = np.linalg.lstsq(extended, wide, rcond=-1)[0]
    return np.asarray(solution[:count], dtype=np.float64)


def smear(waveform: Tensor, matrix: Tensor, rate_divisor: int = 1) -> Tensor:
    """Blur the spectra of waveforms, as the wide auditory filters of an impaired ear do.

    The waveforms are cut into frames of 5.8 ms, one every 1.5 ms (a hop), and the power spectrum of
    each frame is multiplied by a matrix. At 44.1 kHz, the result equals that of pyclarity's
    ``smear3``, with its delay of three hops and its irregular first frames.

    Shape: (..., time), (bins, bins) -> (..., hop * (ceil(time / hop) + 3)), where hop is
        64 / rate_divisor.

    Args:
        waveform: Signals in Pa.
        matrix: Matrix from ``smearing_matrix``. Frequencies beyond it, and always the Nyquist
            frequency, are removed.
        rate_divisor: 1 for waveforms at 44.1 kHz, 2 for waveforms at 22.05 kHz.

    >>> matrix = torch.from_numpy(smearing_matrix("severe")).float()
    >>> smear(torch.randn(2, 640), matrix).shape
    torch.Size([2, 832])
    """
    hop = HOP // rate_divisor
    count = math.ceil(waveform.shape[-1] / hop)
    window = _window(rate_divisor, like=waveform)
    frames = _cut_frames(waveform, count, hop, window)
    spectrum, *_ = _SmearSpectrum.call(rfft(frames)[..., : len(matrix)], matrix)
    half = len(window) // 2
    smeared_frames = torch.fft.irfft(spectrum, len(window))[..., :half] * window[:half]
    return _overlap_add(smeared_frames, hop)


def _smear_spectrum(
    spectrum: Tensor, matrix: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Spread the power of spectra over neighbouring frequencies.

    The phase is kept, unless smearing gives a negative power. Its square root is imaginary, so that
    the phase turns by 90 degrees. Silence counts as a power of 1e-24 Pa^2 and stays as it is.

    Shape: complex (..., bins), (bins, bins) -> complex (..., bins), then (..., bins) each.

    Args:
        spectrum: Spectra of pressures in Pa.
        matrix: Matrix by which power spectra are multiplied.

    Returns:
        The smeared spectrum; its power in Pa^2; the real and the imaginary part of the complex
        factor on the spectrum, of which one is nearly 0; and the power of the spectrum in Pa^2.
    """
    spectrum_power = power(spectrum)
    smeared_power = (spectrum_power @ matrix.mT).add_(_POWER_FLOOR)
    spectrum_power.add_(_POWER_FLOOR)
    ratio = smeared_power / spectrum_power
    # The square root of a negative ratio is imaginary.
    real = ratio.clamp(_MIN_POWER_RATIO, _MAX_POWER_RATIO).sqrt_()
    imaginary = ratio.neg().clamp_(_MIN_POWER_RATIO, _MAX_POWER_RATIO).sqrt_()
    smeared_spectrum = torch.complex(real, imaginary).mul_(spectrum)
    return smeared_spectrum, smeared_power, real, imaginary, spectrum_power


class _SmearSpectrum(DifferentiableFunction):
    """``_smear_spectrum`` with a hand-written backward pass, in two thirds of autograd's time.

    Let x be the spectrum, p = |x|^2 its power, A the matrix, s = A p the smeared power, f the
    complex factor with f^2 = s / p, which is imaginary where s < 0, and z = f x the smeared
    spectrum. Let g be the gradient with respect to z times the conjugate of f. Then, with
    e = Re(conj(x) g), the gradient with respect to x is g + x (A^T (e / s) - e / p), because the
    power of one frequency changes the factors of others. The first part, g - x e / p, is the
    gradient with respect to the phase of x. It grows as f, without limit where power spreads to a
    frequency that has hardly any of its own. Where |x| is below ``_PHASE_FLOOR``, this part is
    reduced in proportion to p, because the phase of x is then that of rounding errors. A single x
    that a Fourier transform rounds to 0 would otherwise decide the gradient of the whole signal.
    The second part grows without limit where s is near 0. The matrix is a constant and has no
    gradient.
    """

    @staticmethod
    def forward(spectrum: Tensor, matrix: Tensor) -> tuple[Tensor, ...]:
        return _smear_spectrum(spectrum, matrix)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*inputs, *output[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> tuple[Tensor, None]:
        spectrum, matrix, *outputs = ctx.saved_tensors
        dtype = spectrum.dtype
        if torch.is_grad_enabled():
            # This gradient is itself differentiated, so it must depend on the spectrum. Single
            # precision cannot represent the squares of powers in the second derivative.
            if spectrum.device.type != "mps":  # Apple's GPUs have no double precision.
                spectrum, gradient = spectrum.to(torch.complex128), gradient.to(torch.complex128)
                matrix = matrix.double()
            outputs = list(_smear_spectrum(spectrum, matrix)[1:])
        smeared_power, real, imaginary, spectrum_power = outputs
        eps = smeared_power.new_full((), _DIVISION_EPS)
        divisor = smeared_power + torch.copysign(eps, smeared_power)
        floor_power = spectrum_power.mean(-1, keepdim=True) * _PHASE_FLOOR**2
        reduction = (spectrum_power / floor_power).clamp(max=1.0)

        # g = gradient * conj(f), e = Re(conj(x) g), then the gradient. Real and imaginary parts are
        # computed separately, because torch would first convert the real factors of a complex
        # product to complex numbers.
        g_real = torch.addcmul(gradient.real * real, gradient.imag, imaginary)
        g_imag = torch.addcmul(gradient.imag * real, gradient.real, imaginary, value=-1.0)
        e = torch.addcmul(spectrum.real * g_real, spectrum.imag, g_imag)
        weight = (e / divisor) @ matrix - reduction * (e / spectrum_power)
        spectrum_gradient = torch.complex(
            torch.addcmul(reduction * g_real, spectrum.real, weight),
            torch.addcmul(reduction * g_imag, spectrum.imag, weight),
        )
        return spectrum_gradient.to(dtype), None


@constant
def _window(rate_divisor: int) -> Tensor:
    """Compute the window of analysis and synthesis, zero-padded to twice its length.

    The squares of four windows that are one hop apart add up to 1.

    Returns:
        Window, (512 // rate_divisor,).
    """
    samples = torch.arange(0, FRAME, rate_divisor, dtype=torch.float64)
    phase = 2.0 * math.pi * (samples + 0.5) / FRAME
    window = (0.5 - 0.5 * phase.cos()) / math.sqrt(1.5)
    return functional.pad(window, (0, (FFT - FRAME) // rate_divisor))


def _cut_frames(waveform: Tensor, count: int, hop: int, window: Tensor) -> Tensor:
    """Cut waveforms into windowed frames as pyclarity's ``smear3`` does, three hops late.

    Counted from 0, frame k covers hops k - 3 to k from frame 4 on. The first four frames are
    irregular, as if hops 1 to 3 were repeated after the first four hops. Each frame has four hops,
    and the window zero-pads it to eight.

    Shape: (..., time), (8 * hop,) -> (..., count, 8 * hop).
    """
    padded = functional.pad(waveform, (0, hop * (max(count, 4) + 4) - waveform.shape[-1]))
    with_repetition = torch.cat((padded[..., : 4 * hop], padded[..., hop:]), -1)
    return with_repetition.unfold(-1, 8 * hop, hop)[..., :count, :] * window


def _overlap_add(frames: Tensor, hop: int) -> Tensor:
    """Overlap-add frames as pyclarity's ``smear3`` does, including its irregular last three hops.

    Shape: (..., count, 4 * hop) -> (..., hop * (count + 3)).
    """
    count = frames.shape[-2]
    parts = frames.unflatten(-1, (4, hop))
    total = frames.new_zeros(*frames.shape[:-2], count + 3, hop)
    for part in range(3):
        total[..., part : part + count, :].add_(parts[..., part, :])
    if count >= 4:
        total[..., 3:count, :].add_(parts[..., : count - 3, 3, :])
        # In the last three hops, smear3 repeats the first three parts of the fourth last frame, and
        # leaves out the fourth parts of the last three frames.
        total[..., count:, :].add_(parts[..., count - 4, :3, :])
    return total.flatten(-2)
