"""Spectral smearing (Baer and Moore 1993): each 5.8 ms frame's power spectrum is spread over wider auditory filters."""

import math
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.erb import ERB_AT_0_HZ, erb
from hlsim.dsp.fft import power, rfft
from hlsim.msbg.ear import MSBG_RATE
from hlsim.torchtools import constant_like

FRAME, HOP, FFT = 256, 64, 512

SMEARING_DELAY = 3 * HOP
"""Samples by which smearing delays: its frames are read three hops late."""

BROADENING = {"mild": (1.6, 1.1), "moderate": (2.4, 1.6), "severe": (4.0, 2.0)}
"""Widening of the lower and the upper side of the auditory filters; with no loss nothing is smeared (pyclarity 0.9.0)."""

SKIRT_HZ = 800.0
"""How far above what it is given smearing reaches, by the skirts of its frames' spectra."""

_TINY = 1e-24  # Pa^2
_MOST = 1e30
_NEVER = 1e-36  # Pa^2, keeps a division from one by 0
_CACHED = 1200  # frames


def roex_filters(lower: float, upper: float, count: int, spacing: float) -> NDArray[np.float64]:
    """Auditory filters (1 + g) exp(-g), divided by their bandwidth, at equally spaced frequencies.

    Args:
        lower, upper: widening of the lower and the upper side.
        count: filters, and frequencies of each.
        spacing: Hz between frequencies, which begin at 0.

    Returns: (count, count), a row a filter.
    """
    bins = np.arange(count, dtype=float)
    hz = bins * spacing
    bandwidth = erb(hz)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (
            np.abs(bins[:, None] - bins) / bins[:, None] * 4.0 * hz[:, None] / bandwidth[:, None]
        )
    g = distance / np.where(bins < bins[:, None], lower, upper)
    filters = (1.0 + g) * np.exp(-g) / (bandwidth * (lower + upper) / (2.0 * ERB_AT_0_HZ))[:, None]
    filters[0] = 0.0
    filters[0, 0] = 2.0 / (lower + upper)
    return filters


def smearing_from_filters(
    normal: NDArray[np.float64], wide: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The wide filters with the normal ones divided out: what, seen through normal filters, looks like the wide ones.

    Shape: (count, count) twice -> (count, count), to be multiplied with a power spectrum.
    """
    count = len(normal)
    half = count // 2
    # the filters go on above the highest frequency as mirror images of their lower sides, or the division rings
    extended = np.concatenate((normal, np.zeros((count, half))), axis=1)
    for i in range(half, count):
        stop = min(2 * i - 1, 3 * half)
        mirrored = normal[i, 2 * i - count : max(1, 2 * i - 3 * half) : -1]
        extended[i, count:stop] = mirrored[: stop - count]
    matrix = np.asarray(np.linalg.lstsq(extended, wide, rcond=-1)[0][:count], dtype=np.float64)
    return matrix


@lru_cache(maxsize=4)
def smearing_matrix(lower: float, upper: float) -> NDArray[np.float64]:
    """The matrix for MSBG's 512-point spectra. Returns (256, 256)."""
    normal, wide = (
        roex_filters(*sides, FFT // 2, MSBG_RATE / FFT) for sides in ((1.0, 1.0), (lower, upper))
    )
    return smearing_from_filters(normal, wide)


def smearing_matrix_below(severity: str, step: int, highest: float) -> NDArray[np.float64]:
    """The part of the matrix on which what is below ``highest`` Hz depends, by the window's skirts.

    Args:
        step: the signal runs at 44.1 kHz / step.
    """
    bins = min(FFT // 2 // step, math.ceil((highest + SKIRT_HZ) * FFT / MSBG_RATE))
    return smearing_matrix(*BROADENING[severity])[:bins, :bins]


def smear(waveform: Tensor, matrix: Tensor, step: int = 1) -> Tensor:
    """Smear a waveform as pyclarity's ``smear3`` does at 44.1 kHz, its delay and its first, irregular frames included.

    Shape: (..., time), (bins, bins) -> (..., hop * (ceil(time / hop) + 3)) with hop = 64 // step.

    Args:
        matrix: ``smearing_matrix``, or the part of it for the lowest frequencies; the others, and the Nyquist frequency,
            are left out. At most (256 // step, 256 // step).
        step: 1 at 44.1 kHz; 2 at 22.05 kHz, where the same frames are taken at every other sample and nothing above
            11 kHz is known.
    """
    hop = HOP // step
    count = math.ceil(waveform.shape[-1] / hop)
    window = constant_like(waveform, _window, step)
    frames = _frames(waveform, count, hop, window)
    # on a CPU a few frames at a time, for the steps from one to the next to find them in its cache
    size = (
        max(1, _CACHED * step // waveform[..., 0].numel())
        if waveform.device.type == "cpu"
        else count
    )
    if size >= count:
        return _overlap_add(_widen(frames, window, matrix), hop)
    return _overlap_add(
        torch.cat([_widen(part, window, matrix) for part in frames.split(size, -2)], -2), hop
    )


def _widen(frames: Tensor, window: Tensor, matrix: Tensor) -> Tensor:
    """Smear each frame's power. Shape: (..., frames, 2 n), (2 n,), (bins, bins) -> (..., frames, n)."""
    spectrum, _ = spread(rfft(frames)[..., : len(matrix)], matrix)
    half = len(window) // 2
    return torch.fft.irfft(spectrum, len(window))[..., :half] * window[:half]


def spread(spectrum: Tensor, matrix: Tensor, least: float = 0.0) -> tuple[Tensor, Tensor]:
    """The spectrum with its power smeared and its phase kept, and that power.

    Silence counts as a power of 1e-24 Pa^2, and stays as it is.

    Shape: complex (..., bins), (bins, bins) or one an item (items, bins, bins) -> complex (..., bins), (..., bins).

    Args:
        least: gradients are held to those of powers that smearing divides or multiplies by 1 / ``least`` at most; with 0
            they have no bound where it turns a power's sign, or fills what was empty.
    """
    if torch.is_grad_enabled() and (spectrum.requires_grad or matrix.requires_grad):
        widened, smeared, *_ = _Spread.apply(spectrum, matrix, least)
    else:
        widened, smeared, *_ = _spread(spectrum, matrix)
    return widened, smeared


def _spread(spectrum: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """``spread``'s two; the factor on the spectrum, real and imaginary part, and the power that it had."""
    given = power(spectrum)
    smeared = (given @ matrix.mT).add_(_TINY)
    # a matrix that is learned keeps what it was multiplied with
    given = given + _TINY if matrix.requires_grad else given.add_(_TINY)
    quotient = smeared / given
    # the square root of a negative power is imaginary; of 0 it takes long, and beside 1e9 Pa silence counts as nothing
    real, imaginary = (
        quotient.clamp(_TINY, _MOST).sqrt_(),
        quotient.neg().clamp_(_TINY, _MOST).sqrt_(),
    )
    return spectrum * torch.complex(real, imaginary), smeared, real, imaginary, given


class _Spread(torch.autograd.Function):
    """``_spread`` with a gradient of a third of the steps.

    Of z = f x with |f|^2 = s / p, s = A p and p = |x|^2, and g the conjugate of f times the gradient at z, it is
    g + x (A^T t - e / p) with e = Re(conj(x) g) and t = e / s + 2 h, h the gradient at s: with the power of one
    frequency the factor of others changes. That of A is t p^T / 2.
    """

    @staticmethod
    def forward(spectrum: Tensor, matrix: Tensor, least: float) -> tuple[Tensor, ...]:
        return _spread(spectrum, matrix)

    @staticmethod
    def setup_context(
        ctx: Any, inputs: tuple[Tensor, Tensor, float], output: tuple[Tensor, ...]
    ) -> None:
        ctx.least = inputs[2]
        ctx.mark_non_differentiable(*output[2:])
        ctx.set_materialize_grads(
            False
        )  # nobody asks for the power's where signals are smeared alone
        ctx.save_for_backward(*inputs[:2], *output[1:])

    @staticmethod
    def backward(
        ctx: Any, gradient: Tensor | None, of_power: Tensor | None, *others: None
    ) -> tuple[Tensor | None, Tensor | None, None]:
        spectrum, matrix, *made = ctx.saved_tensors
        # where the gradient is differentiated, what is constant here comes from the spectrum anew
        smeared, real, imaginary, given = (
            _spread(spectrum, matrix)[1:] if torch.is_grad_enabled() else made
        )
        if ctx.least:
            size = smeared.abs()
            divisor = torch.copysign(torch.maximum(size, ctx.least * given), smeared)
            held = (given / (ctx.least * size + _NEVER)).clamp_max(1.0).sqrt()
            divisor, real, imaginary = divisor * held, real * held, imaginary * held
        else:
            divisor = smeared + torch.copysign(smeared.new_full((), _NEVER), smeared)
        # real and imaginary part apart: a product of complex and real numbers first makes the real ones complex
        right, up = spectrum.real, spectrum.imag
        if gradient is None:
            along_right = along_up = torch.zeros_like(given)
        else:
            along_right = torch.addcmul(gradient.real * real, gradient.imag, imaginary)
            along_up = torch.addcmul(gradient.imag * real, gradient.real, imaginary, value=-1.0)
        changed = torch.addcmul(right * along_right, up, along_up)
        toward = changed / divisor
        if of_power is not None:
            toward = toward + 2.0 * of_power
        share = toward @ matrix - changed / given
        of_matrix = None
        if ctx.needs_input_grad[1]:
            every = 0.5 * toward.mT @ given
            of_matrix = every.sum_to_size(matrix.shape)
        of_spectrum = torch.complex(
            torch.addcmul(along_right, right, share), torch.addcmul(along_up, up, share)
        )
        return of_spectrum, of_matrix, None


def _window(step: int) -> Tensor:
    """Of analysis and synthesis: their product adds up to 1 over four frames; then zeros. Returns (512 // step,)."""
    place = 2.0 * math.pi * (torch.arange(0, FRAME, step, dtype=torch.float64) + 0.5) / FRAME
    window = (0.5 - 0.5 * place.cos()) / math.sqrt(1.5)
    return functional.pad(window, (0, (FFT - FRAME) // step))


def _frames(waveform: Tensor, count: int, hop: int, window: Tensor) -> Tensor:
    """Frame k covers hops k - 3 to k from the fifth on, and what follows, which the window takes away.

    The first four are as ``smear3`` fills them, as if hops 1 to 3 came again after the first four.

    Shape: (..., time), (8 * hop,) -> (..., count, 8 * hop).
    """
    padded = functional.pad(waveform, (0, hop * (max(count, 4) + 4) - waveform.shape[-1]))
    again = torch.cat((padded[..., : 4 * hop], padded[..., hop:]), -1)
    return again.unfold(-1, 8 * hop, hop)[..., :count, :] * window


def _overlap_add(frames: Tensor, hop: int) -> Tensor:
    parts, count = frames.unflatten(-1, (4, hop)), frames.shape[-2]
    hops = parts.unbind(-2)
    total = frames.new_zeros(*frames.shape[:-2], count + 3, hop)
    for j in range(3):
        total[..., j : j + count, :].add_(hops[j])
    if count == 1:
        total[..., 1, :].add_(hops[2][..., 0, :])
    if count >= 4:
        total[..., 3:count, :].add_(hops[3][..., : count - 3, :])
        # in smear3's last three hops the fourth last frame's first parts stand for the last parts of the last three
        total[..., count:, :].add_(parts[..., count - 4, :3, :])
    return total.flatten(-2)
