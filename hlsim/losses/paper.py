"""The training criteria of the Neuro-MSBG paper: Equations 2 to 9.

They are what a simulator learns by. As the criterion of a compensator through ``HearingLossLoss`` they have faults:

- They are not balanced. The gradient on eight band gains from none is 6.9e-3 for N1, 2.0e-3 for N3 and 3.5e-6 for N5, and
  2.9e-5 at 50 dB SPL to 0.139 at 80: a mixed batch trains for mild ears and loud speech. The weights come from a paper
  that scales its speech to unit power, which would mend the levels of the speech, and not the ears.
- Of their value, 0.70 of 0.87 is phase, whose gradient is faded where it is faint: value and gradient disagree, and Adam
  on a free waveform raises the value. Polarity-inverted speech (1.36) costs more than noise at -5 dB SNR (1.34).
- Rank correlation with HASPI and HASQI over 17 degradations is .50 and .70. A filter bank trained by them from zero is
  behind the prescription NAL-R (HASPI .877, .950), and learns no compression.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from hlsim.dsp.fft import power
from hlsim.dsp.stft import STFT

PAPER_STFT = STFT(400, 400, 100)
"""The paper's transform at 16 kHz: 201 frequencies."""

DEFAULT_WEIGHTS = {"magnitude": 0.9, "phase": 0.3, "complex": 0.1, "time": 0.2}
"""The paper leaves its weights open; these are those of MP-SENet (Lu, Ai and Ling 2023), on which it builds."""

_TINY = 1e-12

_FAINT = 8e-4  # squared magnitude of a tone of 20 dB SPL in the paper's transform


def magnitude_loss(estimate: Tensor, truth: Tensor) -> Tensor:
    """Mean square of the difference of magnitudes (Equation 2). Shape: complex (items, frames, bins) -> (items,)."""
    return (_magnitude(estimate) - _magnitude(truth)).square().mean((-2, -1))


def phase_loss(estimate: Tensor, truth: Tensor) -> Tensor:
    """Anti-wrapped phase error: instantaneous phase + group delay + instantaneous frequency (Equations 3 to 6).

    The value is the paper's. Its gradient is 1 / magnitude, so that all of it would come from the bins that nobody hears;
    it is faded out where estimate or truth is fainter than a tone of 20 dB SPL.

    Shape: complex (items, frames, bins) -> (items,).
    """
    difference: Tensor = _FadedDifference.apply(estimate, truth)
    instantaneous = anti_wrap(difference).mean((-2, -1))
    group_delay = anti_wrap(difference.diff(dim=-1)).mean((-2, -1))
    if difference.shape[-2] < 2:
        return instantaneous + group_delay
    return instantaneous + group_delay + anti_wrap(difference.diff(dim=-2)).mean((-2, -1))


def complex_loss(estimate: Tensor, truth: Tensor) -> Tensor:
    """Twice the mean square of real and imaginary differences (Equation 7). Shape: (items, frames, bins) -> (items,)."""
    difference = torch.view_as_real(estimate - truth)
    return 2.0 * difference.square().mean((-3, -2, -1))


def time_loss(estimate: Tensor, truth: Tensor) -> Tensor:
    """Mean absolute difference of waveforms (Equation 8). Shape: (items, time) -> (items,)."""
    return (estimate - truth).abs().mean(-1)


def anti_wrap(angle: Tensor) -> Tensor:
    """Distance of an angle to the nearest multiple of 2 pi (Ai and Ling 2023). Any shape, radians."""
    turns = (angle.detach() / (2.0 * math.pi)).round_()
    return torch.sub(angle, turns, alpha=2.0 * math.pi).abs()


def paper_stft(sample_rate: int) -> STFT:
    """The paper's transform at another rate: windows of 25 ms every 6.25 ms, to the nearest sample."""
    hop = round(sample_rate * PAPER_STFT.hop / 16000)
    return STFT(4 * hop, 4 * hop, hop)


def paper_parts(
    estimate: Tensor, truth: Tensor, stft: STFT = PAPER_STFT, frequencies: int | None = None
) -> dict[str, Tensor]:
    """The paper's four losses by name, of each item. Shape: (items, time) twice -> (items,) each.

    Args:
        stft: spectra are scaled to the magnitudes of the paper's transform, so that a rate changes no level; magnitude
            and complex loss to its number of frequencies, so that an empty band does not change them either.
        frequencies: how many of the transform's to compare, from 0 Hz up; all if None.
    """
    first, second = (stft.analyse(waveform)[..., :frequencies] for waveform in (estimate, truth))
    if (scale := PAPER_STFT.window / stft.window) != 1.0:
        first, second = first * scale, second * scale
    share = first.shape[-1] / PAPER_STFT.frequencies
    return {
        "magnitude": magnitude_loss(first, second) * share,
        "phase": phase_loss(first, second),
        "complex": complex_loss(first, second) * share,
        "time": time_loss(estimate, truth),
    }


def weighted_sum(parts: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """Sum of parts times weights (Equation 9); parts without a weight do not count."""
    total = torch.zeros_like(next(iter(parts.values())))
    for name, weight in weights.items():
        if weight:
            total = total + weight * parts[name]
    return total


def _magnitude(spectrum: Tensor) -> Tensor:
    return (power(spectrum) + _TINY).sqrt()


class _FadedDifference(torch.autograd.Function):
    """Angle of the truth's product with the estimate's conjugate: that from the one's phase to the other's.

    The gradient of an angle is i z / |z|^2; here it is times |z|^2 / (|z|^2 + faint), and the same of the other's.
    """

    @staticmethod
    def forward(estimate: Tensor, truth: Tensor) -> Tensor:
        (x, y), (u, v) = _apart(estimate), _apart(truth)
        # one angle, where that of each takes as long again as all the rest
        return torch.atan2(x * v - y * u, x * u + y * v)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        estimate, truth = ctx.saved_tensors
        first, second = ctx.needs_input_grad
        return (
            _turned(estimate, -gradient * _fading(estimate, truth)) if first else None,
            _turned(truth, gradient * _fading(truth, estimate)) if second else None,
        )


def _apart(spectrum: Tensor) -> tuple[Tensor, Tensor]:
    """Real and imaginary parts; next to silence, where the angle is rounding, the real one is small and positive."""
    # contiguous, for torch takes twenty times as long where every second number is another's
    real, imaginary = spectrum.real.contiguous(), spectrum.imag.contiguous()
    return torch.where(real.abs().add_(imaginary.abs()) < 1e-7, 1e-7, real), imaginary


def _turned(spectrum: Tensor, share: Tensor) -> Tensor:
    """i times the spectrum times real numbers."""
    return torch.complex(-spectrum.imag * share, spectrum.real * share)


def _fading(spectrum: Tensor, other: Tensor) -> Tensor:
    level = power(other)
    return level / ((level + _FAINT) * (power(spectrum) + _FAINT))
