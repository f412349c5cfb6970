"""The criterion ``"paper"``: the training losses of the Neuro-MSBG paper, Equations 2 to 9.

They compare an estimate with its target. In the paper, they train simulators. As the criterion of
an aid in ``HearingLossLoss``, they have faults:

- They are not balanced. The gradient on eight band gains that start at 0 dB is 6.9e-3 for N1,
  2.0e-3 for N3 and 3.5e-6 for N5, and for N3 2.9e-5 at 50 dB SPL to 0.139 at 80: a mixed batch
  trains for mild ears and loud speech. The weights come from a paper that scales its speech to unit
  power, which would balance the levels of the speech, but not the ears.
- Of their value for ``example_speech`` and N3, 0.63 of 0.80 is phase, whose gradient is faded out
  in faint frequencies: value and gradient disagree, and when Adam optimises the samples of a
  waveform, the value rises. For N3, inverted polarity costs as much as white noise at -5 dB SNR
  (1.3 both).
- Their rank correlations with HASPI and HASQI over 17 degradations are .33 and .59 (``python
  docs/figures/validity.py hlsim/data/speech/valid``). A filter bank trained by them from zero has a
  HASPI of .877, where the prescription NAL-R has .950, and learns no compression.
"""

import math
from typing import Any

import torch
from torch import Tensor

from hlsim.dsp.fft import power
from hlsim.dsp.stft import STFT
from hlsim.torchtools import DifferentiableFunction

PAPER_STFT = STFT(400, 400, 100)
"""The paper's short-time Fourier transform at 16 kHz: 201 frequencies, every 100 samples."""

DEFAULT_WEIGHTS = {"magnitude": 0.9, "phase": 0.3, "complex": 0.1, "time": 0.2}
"""Weights of MP-SENet (Lu, Ai and Ling 2023), on which the paper builds.

The paper does not state its own.
"""

POWER_FLOOR = 1e-12
"""Squared magnitude that is added before the root, so that its gradient is finite."""

FAINT_POWER = 8e-4
"""Squared magnitude of a tone of 20 dB SPL in the paper's transform."""

SILENT_MAGNITUDE = 1e-7
"""Sum of the magnitudes of real and imaginary part below which it replaces the real part."""


def phase_loss(estimate: Tensor, target: Tensor) -> Tensor:
    """Compute the mean error of the phase of spectra in radians (Equations 3 to 6).

    This is the sum of three means: of the distance between the phases, and of the distances between
    their differences from frequency to frequency (group delay) and from frame to frame
    (instantaneous frequency, left out for a single frame). All frequencies count alike in the
    value. The gradient of a phase is 1 / magnitude, so that inaudible frequencies would dominate
    the gradient. Therefore the gradient is faded out where the estimate or the target is fainter
    than a tone of 20 dB SPL.

    The spectra are those of signals in pascals by ``PAPER_STFT``.

    Shape: complex (items, frames, bins) twice -> (items,).

    >>> spectrum = torch.full((1, 3, 201), 1.0 + 0.0j)
    >>> phase_loss(1j * spectrum, spectrum)  # a quarter of a turn
    tensor([1.5708])
    """
    difference: Tensor = _FadedPhaseDifference.call(estimate, target)
    instantaneous = anti_wrap(difference).mean((-2, -1))
    group_delay = anti_wrap(difference.diff(dim=-1)).mean((-2, -1))
    total = instantaneous + group_delay
    if difference.shape[-2] < 2:
        return total
    return total + anti_wrap(difference.diff(dim=-2)).mean((-2, -1))


def anti_wrap(angle: Tensor) -> Tensor:
    """Compute the distance of angles from the nearest multiple of 2 pi, a whole turn, in radians.

    Shape: (...) -> (...).

    Source: Ai and Ling (2023).

    >>> anti_wrap(torch.tensor([0.5, 2.0 * math.pi - 0.5])).round(decimals=3)
    tensor([0.5000, 0.5000])
    """
    turns = (angle.detach() / (2.0 * math.pi)).round_()
    return torch.sub(angle, turns, alpha=2.0 * math.pi).abs()


def paper_parts(estimate: Tensor, target: Tensor) -> dict[str, Tensor]:
    """Compute the paper's four losses of waveforms at 16 kHz, in pascals.

    They are the mean squared difference of the magnitudes of spectra (Equation 2), the error of
    their phase (``phase_loss``), twice the mean squared difference of their real and imaginary
    parts (Equation 7), and the mean absolute difference of the waveforms (Equation 8).

    Args:
        estimate: Waveforms to judge, (items, time).
        target: Waveforms that the estimate should equal, (items, time).

    Returns:
        ``magnitude``, ``phase``, ``complex`` and ``time`` of each item, (items,) each.

    >>> speech = torch.randn(1, 16000)
    >>> parts = paper_parts(speech, speech)
    >>> {name: part.item() for name, part in parts.items()}
    {'magnitude': 0.0, 'phase': 0.0, 'complex': 0.0, 'time': 0.0}
    """
    spectrum, target_spectrum = PAPER_STFT.analyse(estimate), PAPER_STFT.analyse(target)
    magnitude_error = _magnitude(spectrum) - _magnitude(target_spectrum)
    complex_error = torch.view_as_real(spectrum - target_spectrum)
    return {
        "magnitude": magnitude_error.square().mean((-2, -1)),
        "phase": phase_loss(spectrum, target_spectrum),
        "complex": 2.0 * complex_error.square().mean((-3, -2, -1)),
        "time": (estimate - target).abs().mean(-1),
    }


def _magnitude(spectrum: Tensor) -> Tensor:
    return (power(spectrum) + POWER_FLOOR).sqrt()


class _FadedPhaseDifference(DifferentiableFunction):
    """Phase of the target minus that of the estimate, as the angle of one complex product.

    The gradient of the angle of z is i z / |z|^2. Here it is faded out near silence: multiplied by
    |z|^2 / (|z|^2 + ``FAINT_POWER``), and by the same factor of the other spectrum.

    Shape: complex (...) twice -> (...) in radians.
    """

    @staticmethod
    def forward(estimate: Tensor, target: Tensor) -> Tensor:
        x, y = _real_imag(estimate)
        u, v = _real_imag(target)
        # One angle, because that of each spectrum takes as long as everything else.
        return torch.atan2(x * v - y * u, x * u + y * v)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        estimate, target = ctx.saved_tensors
        # The difference is that of the target minus that of the estimate, hence the sign.
        return (
            _times_i(estimate, -gradient * _fade_weight(estimate, target)),
            _times_i(target, gradient * _fade_weight(target, estimate)),
        )


def _real_imag(spectrum: Tensor) -> tuple[Tensor, Tensor]:
    """Return the real and the imaginary part of spectra.

    Near silence, where rounding decides the angle, a small positive number replaces the real part.
    Shape: complex (...) -> (...), (...).
    """
    # Contiguous, because torch takes twenty times as long with interleaved numbers.
    real, imaginary = spectrum.real.contiguous(), spectrum.imag.contiguous()
    silent = real.abs().add_(imaginary.abs()) < SILENT_MAGNITUDE
    return torch.where(silent, SILENT_MAGNITUDE, real), imaginary


def _times_i(spectrum: Tensor, factor: Tensor) -> Tensor:
    """Multiply a complex spectrum by i and by real factors, element by element."""
    return torch.complex(-spectrum.imag * factor, spectrum.real * factor)


def _fade_weight(spectrum: Tensor, other: Tensor) -> Tensor:
    """Compute 1 / |z|^2 of a spectrum z, faded out where it or the other spectrum is faint."""
    # 1 / |z|^2, times |z|^2 / (|z|^2 + faint), times the same factor of the other spectrum
    level = power(other)
    return level / ((level + FAINT_POWER) * (power(spectrum) + FAINT_POWER))
