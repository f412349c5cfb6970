"""Smearing as in MSBG, but with bounded derivatives, for networks of the structure ``bands``.

Where smearing changes the sign of a power or fills an empty frequency, the derivatives of MSBG have
no bound. Here the output itself is a smooth function of the input, so that first and second
derivatives are both bounded and exact.
"""

from typing import Any

import torch
from torch import Tensor

from hlsim.dsp.fft import power

MIN_FACTOR = 1e-3
"""Ratio of smeared to original power, -30 dB, below which the smoothed factor levels off."""

MAX_FACTOR = 1e4
"""Largest ratio of smeared to original power, 40 dB."""

_SILENCE = 1e-24
"""Power in Pa^2 that is added to powers before and after smearing, so that silence stays silent."""


def _smooth_factor(spectrum_power: Tensor, smeared_power: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the complex square root of the ratio of two powers, with a bounded derivative.

    The magnitude of the ratio r is limited to ``MAX_FACTOR``. The factor is the square root of
    r + i e, where e is ``MIN_FACTOR``. The exact root of r would change at r = 0 from real to
    imaginary with a slope without bound; this factor changes smoothly.

    Args:
        spectrum_power: Power of the spectrum in Pa^2, above 0. Any shape.
        smeared_power: Power of the smeared spectrum in Pa^2, which may be negative. The same shape.

    Returns:
        Real and imaginary part of the factor, of the same shape.
    """
    ratio = smeared_power / _ratio_divisor(spectrum_power, smeared_power)
    size = (ratio.square() + MIN_FACTOR**2).sqrt()
    # The difference of size and ratio would lose its digits, so the smaller part is a quotient.
    larger = (size + ratio.abs()).mul(0.5).sqrt()
    smaller = 0.5 * MIN_FACTOR / larger
    # The larger part is the real one for positive ratios.
    half_sum = 0.5 * (larger + smaller)
    # ONNX has no copysign.
    half_difference = 0.5 * (larger - smaller)
    half_difference = torch.where(ratio < 0.0, -half_difference, half_difference)
    return half_sum + half_difference, half_sum - half_difference


def _ratio_divisor(spectrum_power: Tensor, smeared_power: Tensor) -> Tensor:
    """Return the original power plus |smeared power| / ``MAX_FACTOR``.

    Smeared power divided by it never exceeds ``MAX_FACTOR`` in magnitude.
    """
    return torch.add(spectrum_power, smeared_power.abs(), alpha=1.0 / MAX_FACTOR)


class SmoothSmearing(torch.autograd.Function):
    """Smearing of spectra as in MSBG, with bounded derivatives and a hand-written backward pass.

    Autograd would be as fast, but the loss would store 40 % more for its gradient.

    Let x be the spectrum, p = |x|^2 its power, A the matrix, s = A p the smeared power, d the
    divisor of the ratio, f the factor and z = f x the smeared spectrum. Let h be the gradient with
    respect to s, G the one with respect to z, and q = G conj(x). The gradient with respect to the
    ratio s / d is u = Re(q f) / (2 |f|^2). Then, with t = u p / d^2 + h,

    - the gradient with respect to x is G conj(f) + 2 x (A^T t - u s / d^2);
    - the gradient with respect to A is t p^T.

    Args:
        spectrum: Spectrum of each frame in Pa, complex (..., frames, frequencies).
        matrix: Matrix by which power spectra are multiplied, (..., frequencies, frequencies).

    Returns:
        The smeared spectrum; the smeared power in Pa^2, which may be negative; and the real and the
        imaginary part of the factor, which have no gradient. Shape of each: (..., frames,
        frequencies).

    >>> spectrum = torch.ones(1, 2, dtype=torch.complex64)
    >>> smeared, *_ = SmoothSmearing.apply(spectrum, torch.tensor([[4.0, 0.0], [0.0, 1.0]]))
    >>> smeared.abs().round(decimals=2)
    tensor([[2., 1.]])
    """

    @staticmethod
    def forward(spectrum: Tensor, matrix: Tensor) -> tuple[Tensor, ...]:
        powers = power(spectrum)
        smeared_power = (powers @ matrix.mT).add_(_SILENCE)
        real, imaginary = _smooth_factor(powers.add_(_SILENCE), smeared_power)
        return spectrum * torch.complex(real, imaginary), smeared_power, real, imaginary

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[2:])
        ctx.save_for_backward(*inputs, *output[1:])

    @staticmethod
    def backward(
        ctx: Any, gradient: Tensor, power_gradient: Tensor, *_: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        spectrum, matrix, smeared_power, real, imaginary = ctx.saved_tensors
        # Real and imaginary parts are separate and contiguous, because torch would convert the real
        # factors of a complex product to complex numbers, and is slow on every other number.
        x_real, x_imag = spectrum.real.contiguous(), spectrum.imag.contiguous()
        g_real, g_imag = gradient.real.contiguous(), gradient.imag.contiguous()
        powers = torch.addcmul(x_real.square() + _SILENCE, x_imag, x_imag)
        if torch.is_grad_enabled():
            # This gradient is itself differentiated, so it must depend on the spectrum.
            smeared_power = power(spectrum) @ matrix.mT + _SILENCE
            real, imaginary = _smooth_factor(powers, smeared_power)
        divisor = _ratio_divisor(powers, smeared_power)
        q_real = torch.addcmul(g_real * x_real, g_imag, x_imag)
        q_imag = torch.addcmul(g_imag * x_real, g_real, x_imag, value=-1.0)
        squared_factor = torch.addcmul(real.square(), imaginary, imaginary)
        u = torch.addcmul(q_real * real, q_imag, imaginary, value=-1.0)
        u = 0.5 * u / (squared_factor * divisor)
        t = torch.addcmul(power_gradient, u, powers / divisor)
        weight = 2.0 * torch.addcmul(t @ matrix, u, smeared_power / divisor, value=-1.0)
        matrix_gradient = t.mT @ powers if ctx.needs_input_grad[1] else None
        direct_real = torch.addcmul(g_real * real, g_imag, imaginary)
        direct_imag = torch.addcmul(g_imag * real, g_real, imaginary, value=-1.0)
        spectrum_gradient = torch.complex(
            torch.addcmul(direct_real, x_real, weight), torch.addcmul(direct_imag, x_imag, weight)
        )
        return spectrum_gradient, matrix_gradient
