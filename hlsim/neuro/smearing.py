"""Smearing as in MSBG, but with bounded derivatives, for networks of the structure ``bands``.

Where smearing changes the sign of a power or fills an empty frequency, the derivatives of MSBG have
no bound. Here the output itself is a smooth function of the input, so that first and second
derivatives are both bounded and exact.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hlsim.torchtools import DifferentiableFunction

MIN_FACTOR = 1e-3
"""Ratio of smeared to original power, -30 dB, below which the smoothed factor levels off."""

BLOCK_POINTS = 140_000
"""Number of points of spectra that are smeared at once on a CPU, those of 2 s of one item."""

MAX_FACTOR = 1e4
"""Largest ratio of smeared to original power, 40 dB."""

_SILENCE = 1e-15
"""Power in Pa^2 that is added to powers before and after smearing, so that silence stays silent.

Second derivatives contain its square in a denominator, which single precision must not exceed.
"""


Planes = tuple[Tensor, Tensor]
"""Real and imaginary parts of complex numbers.

Torch is slow on every other number of a complex tensor, and converts the real factors of complex
products to complex numbers.
"""


def power(real: Tensor, imaginary: Tensor) -> Tensor:
    """Compute squared magnitudes of complex numbers from their real and imaginary parts.

    Shape: (...) twice -> (...).

    >>> power(torch.tensor([3.0]), torch.tensor([4.0]))
    tensor([25.])
    """
    return _Power.call(real, imaginary)


class _Power(DifferentiableFunction):
    """The function ``power``, whose hand-written backward pass takes half of autograd's time."""

    @staticmethod
    def forward(real: Tensor, imaginary: Tensor) -> Tensor:
        return torch.addcmul(real.square(), imaginary, imaginary)

    @staticmethod
    def setup_context(ctx: Any, inputs: Planes, output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Planes:
        real, imaginary = ctx.saved_tensors
        doubled = 2.0 * gradient
        return real * doubled, imaginary * doubled


def smear_and_amplify(
    spectrum: Planes, smeared_power: Tensor, gains: Tensor, matrices: Planes, step: int
) -> Planes:
    """Smear spectra so that they have given powers, and multiply them by the factors of gains.

    The powers are met up to 40 dB above that of the spectrum (``MAX_FACTOR``), and level off 30 dB
    below it (``MIN_FACTOR``). Well above this floor, the phase of the spectrum remains, apart from
    that of the factors. Near it, the phase turns smoothly: by 45 degrees where the smeared power is
    0, and towards 90 degrees where it is negative.

    Args:
        spectrum: Spectrum of each frame in Pa, (items, frames, frequencies).
        smeared_power: Power of the smeared spectrum in Pa^2, which may be negative, (items, frames,
            frequencies).
        gains: Gain of each channel at the first frame of each step, and at the end of the last
            step, (items, steps + 1, channels). Between them, gains are linear.
        matrices: Matrices by which ``gains`` are multiplied for the real and for the imaginary
            parts of the factors, (items, channels, frequencies).
        step: Number of frames per step.

    Returns:
        The smeared and amplified spectrum, (items, frames, frequencies).

    >>> ones = torch.ones(1, 2, 2)
    >>> powers = torch.tensor([[[4.0, 1.0], [4.0, 1.0]]])
    >>> real, _ = smear_and_amplify((ones, 0 * ones), powers, ones, (ones, 0 * ones), step=2)
    >>> real.round(decimals=2)
    tensor([[[4., 2.],
             [4., 2.]]])
    """
    inputs = (*spectrum, smeared_power, gains, *matrices)
    if torch.compiler.is_exporting():
        return _smear_differentiably(*inputs, step=step)
    return _SmearAndAmplify.call(*inputs, step)


class _SmearAndAmplify(DifferentiableFunction):
    """The function ``smear_and_amplify``, with a hand-written backward pass.

    Autograd would store four times as much for the gradient of the loss, and take longer. The
    second derivative is autograd's, of ``_smear_differentiably``.

    Let x be the spectrum, p = |x|^2 its power, s the smeared power, d the divisor of the ratio
    r = s / d, f the factor of the smearing, with |f|^4 = r^2 + ``MIN_FACTOR``^2, and g that of the
    gains, so that the output is x f g. Let h be the gradient with respect to the output, and
    q = h conj(x). The gradient with respect to the ratio is u = Re(q conj(g) f) / (2 |f|^2). Then
    the gradients are

    - h conj(f g) - 2 x u s / d^2 with respect to x;
    - u p / d^2 with respect to s;
    - q conj(f) with respect to g.
    """

    @staticmethod
    def forward(
        real: Tensor,
        imaginary: Tensor,
        smeared_power: Tensor,
        gains: Tensor,
        real_matrix: Tensor,
        imaginary_matrix: Tensor,
        step: int,
    ) -> Planes:
        matrices = _scale(real_matrix), _scale(imaginary_matrix)
        output = torch.empty_like(real), torch.empty_like(real)
        for block in _cut_blocks(real, step, buffers=8):
            spectrum = block.cut(real, imaginary)
            (powers,) = block.cut(smeared_power)
            factor, *_ = _smearing_factor(spectrum, powers, block.buffers[:6])
            gain_factors = block.factors(gains, matrices, block.buffers[6:])
            product = _multiply(factor, gain_factors, block.buffers[2:4])
            _multiply(spectrum, product, block.cut(*output))
        return output

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Planes) -> None:
        *tensors, ctx.step = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, *gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        if torch.is_grad_enabled():
            # The gradient is itself differentiated.
            function = partial(_smear_differentiably, step=ctx.step)
            pull_back = torch.func.vjp(function, *inputs)[1]
            return (*pull_back(gradient), None)
        real, imaginary, smeared_power, gains, *matrices = inputs
        needs_matrices = any(ctx.needs_input_grad[4:])
        scaled = [_scale(matrix) for matrix in matrices]
        slopes = [torch.empty_like(real) for _ in range(3)]
        gains_slope = torch.zeros_like(gains)
        matrix_slopes = [torch.zeros_like(matrix) for matrix in matrices if needs_matrices]
        for block in _cut_blocks(real, ctx.step, buffers=12):
            spectrum, outer = block.cut(real, imaginary), block.cut(*gradient)
            (powers,) = block.cut(smeared_power)
            factor, size, divisor, ratio = _smearing_factor(spectrum, powers, block.buffers[:6])
            gain_factors = block.factors(gains, scaled, block.buffers[6:8])
            real_slope, imaginary_slope, power_slope = block.cut(*slopes)
            product = _multiply(factor, gain_factors, block.buffers[8:10])
            _multiply(product, outer, (real_slope, imaginary_slope), -1.0)
            product = _multiply(spectrum, outer, block.buffers[8:10], -1.0)
            smeared = _multiply(gain_factors, product, block.buffers[10:12], -1.0)
            ratio_slope = smeared[0].mul_(factor[0]).addcmul_(smeared[1], factor[1], value=-1.0)
            ratio_slope.div_(size).div_(divisor)
            # p / d is 1 - |r| / MAX_FACTOR.
            torch.abs(ratio, out=power_slope).mul_(ratio_slope)
            torch.sub(ratio_slope, power_slope, alpha=1.0 / MAX_FACTOR, out=power_slope).mul_(0.5)
            weight = ratio.mul_(ratio_slope)
            real_slope.addcmul_(spectrum[0], weight, value=-1.0)
            imaginary_slope.addcmul_(spectrum[1], weight, value=-1.0)
            factor_slopes = _multiply(factor, product, block.buffers[6:8], -1.0)
            block.add_slopes(factor_slopes, gains, scaled, gains_slope, matrix_slopes)
        if not needs_matrices:
            return (*slopes, gains_slope, None, None, None)
        return (*slopes, gains_slope, *map(_scale, matrix_slopes), None)


@dataclass
class _Block:
    """Part of the items and frames of spectra, with tensors for intermediate results.

    Attributes:
        items: Items of the block.
        frames: Frames of the block.
        steps: Steps of the block, and the one after them.
        step: Number of frames per step.
        buffers: Tensors of the shape of the block, (items, frames, frequencies).
    """

    items: slice
    frames: slice
    steps: slice
    step: int
    buffers: Sequence[Tensor]

    def cut(self, *maps: Tensor) -> list[Tensor]:
        """Cut the items and frames of the block out of tensors, (items, frames, n) each."""
        return [values[self.items, self.frames] for values in maps]

    def factors(self, gains: Tensor, matrices: Sequence[Tensor], out: Sequence[Tensor]) -> Planes:
        """Compute the factors by which gains multiply the block's spectra, divided by root 8.

        The gains of a frame, interpolated linearly between steps, are multiplied by each matrix.

        Args:
            gains: Gains of all items and steps, (items, steps + 1, channels).
            matrices: Matrices for real and imaginary parts, divided by the square root of 8,
                (items, channels, frequencies) each.
            out: Two tensors of the shape of the block, which are filled with the real and the
                imaginary parts of the factors, and returned.
        """
        for matrix, result in zip(matrices, out, strict=True):
            rows = gains[self.items, self.steps] @ matrix[self.items]
            for frame in range(self.step):
                part = result[:, frame :: self.step]
                count = part.shape[1]
                torch.lerp(rows[:, :count], rows[:, 1 : count + 1], frame / self.step, out=part)
        return out[0], out[1]

    def add_slopes(
        self,
        factor_slopes: Planes,
        gains: Tensor,
        matrices: Sequence[Tensor],
        gains_slope: Tensor,
        matrix_slopes: Sequence[Tensor],
    ) -> None:
        """Add the gradients with respect to gains and matrices, the backward pass of ``factors``.

        Args:
            factor_slopes: Gradients with respect to the results of ``factors``, two tensors of the
                shape of the block.
            gains: Gains of all items and steps, (items, steps + 1, channels).
            matrices: Matrices of ``factors``, divided by the square root of 8, (items, channels,
                frequencies) each.
            gains_slope: Tensor of the shape of ``gains`` to which their gradient is added.
            matrix_slopes: Two tensors of the shape of ``matrices`` for their gradients, or none.
        """
        rows = gains[self.items, self.steps]
        for index, (slope, matrix) in enumerate(zip(factor_slopes, matrices, strict=True)):
            sums = slope.new_zeros(*rows.shape[:2], slope.shape[-1])
            for frame in range(self.step):
                part = slope[:, frame :: self.step]
                count = part.shape[1]
                sums[:, :count].add_(part, alpha=1.0 - frame / self.step)
                if frame:
                    sums[:, 1 : count + 1].add_(part, alpha=frame / self.step)
            gains_slope[self.items, self.steps] += sums @ matrix[self.items].mT
            if matrix_slopes:
                matrix_slopes[index][self.items] += rows.mT @ sums


def _cut_blocks(spectrum: Tensor, step: int, buffers: int) -> Iterator[_Block]:
    """Cut the items and frames of spectra, (items, frames, frequencies), into blocks.

    On a CPU, a block is a part of one item that fits the cache. Smaller blocks take longer, because
    it takes several microseconds to begin an operation. The operations of a block write their
    results to the same buffers again and again, because it takes time to return the memory to the
    system after each operation.

    Args:
        spectrum: Real parts of the spectra.
        step: Number of frames per step. Blocks begin with a step.
        buffers: Number of buffers.
    """
    items, frames, frequencies = spectrum.shape
    items_at_once, steps_at_once = items, math.ceil(frames / step)
    if spectrum.device.type == "cpu":
        items_at_once = 1
        steps_at_once = min(steps_at_once, max(1, BLOCK_POINTS // (step * frequencies)))
    hop = steps_at_once * step
    workspace = spectrum.new_empty(buffers, items_at_once, hop, frequencies)
    for item in range(0, items, items_at_once):
        for start in range(0, frames, hop):
            stop = min(start + hop, frames)
            yield _Block(
                slice(item, item + items_at_once),
                slice(start, stop),
                slice(start // step, math.ceil(stop / step) + 1),
                step,
                workspace[:, :, : stop - start].unbind(),
            )


def _smearing_factor(
    spectrum: Sequence[Tensor], smeared_power: Tensor, out: Sequence[Tensor]
) -> tuple[Planes, Tensor, Tensor, Tensor]:
    """Compute the complex square root of the ratio of two powers, with a bounded derivative.

    The magnitude of the ratio r is limited to ``MAX_FACTOR``. The factor is the square root of
    r + i e, where e is ``MIN_FACTOR``. The exact root of r would change at r = 0 from real to
    imaginary with a slope without bound; this factor changes smoothly.

    Args:
        spectrum: Real and imaginary part of the spectrum in Pa.
        smeared_power: Power of the smeared spectrum in Pa^2, which may be negative.
        out: Six tensors for the results and an intermediate one.

    Shape: (items, frames, frequencies) for all tensors.

    Returns:
        Factor times the square root of 8, magnitude of r + i e, divisor of the ratio, and ratio.
    """
    first, second, size, divisor, ratio, total = out
    real, imaginary = spectrum
    # Tensors, because torch takes three times as long to begin an operation with a Python number.
    silence, floor = real.new_tensor(_SILENCE), real.new_tensor(MIN_FACTOR)
    torch.addcmul(silence, real, real, out=size).addcmul_(imaginary, imaginary)
    torch.abs(smeared_power, out=divisor)
    torch.add(size, divisor, alpha=1.0 / MAX_FACTOR, out=divisor)
    torch.div(smeared_power, divisor, out=ratio)
    torch.addcmul(floor * floor, ratio, ratio, out=size).sqrt_()
    # The larger part of the root is L, and the smaller one S. As a root of a difference, S would be
    # noise, and torch selects by a condition ten times as slowly as it adds L + S and L - S.
    torch.abs(ratio, out=first).add_(size).sqrt_()
    torch.div(floor, first, out=second)
    torch.add(first, second, out=total)
    first.sub_(second).copysign_(ratio)
    torch.sub(total, first, out=second)
    first.add_(total)
    return (first, second), size, divisor, ratio


def _smear_differentiably(
    real: Tensor,
    imaginary: Tensor,
    smeared_power: Tensor,
    gains: Tensor,
    real_matrix: Tensor,
    imaginary_matrix: Tensor,
    *,
    step: int,
) -> Planes:
    """Compute ``smear_and_amplify`` by operations that autograd differentiates."""
    divisor = real.square() + _SILENCE + imaginary.square() + smeared_power.abs() / MAX_FACTOR
    ratio = smeared_power / divisor
    size = (ratio.square() + MIN_FACTOR**2).sqrt()
    # The smaller part of the root follows from the larger one. As a difference, it would be noise.
    is_negative = ratio < 0.0
    larger = (0.5 * (size + torch.where(is_negative, -ratio, ratio))).sqrt()
    smaller = 0.5 * MIN_FACTOR / larger
    first = torch.where(is_negative, smaller, larger)
    second = torch.where(is_negative, larger, smaller)
    shares = [gains[:, :-1].lerp(gains[:, 1:], frame / step) for frame in range(step)]
    rows = torch.stack(shares, 2).flatten(1, 2)[:, : real.shape[1]]
    gain_real, gain_imaginary = rows @ real_matrix, rows @ imaginary_matrix
    factor_real = first * gain_real - second * gain_imaginary
    factor_imaginary = first * gain_imaginary + second * gain_real
    output_real = real * factor_real - imaginary * factor_imaginary
    return output_real, real * factor_imaginary + imaginary * factor_real


def _scale(values: Tensor) -> Tensor:
    """Divide by the square root of 8."""
    return values * math.sqrt(0.125)


def _multiply(
    first: Sequence[Tensor], second: Sequence[Tensor], out: Sequence[Tensor], sign: float = 1.0
) -> Planes:
    """Multiply ``first``, or with the sign -1 its conjugate, by ``second``, and fill ``out``.

    Each is a pair of real and imaginary parts, any shape.
    """
    (a, b), (c, d) = first, second
    real = torch.mul(a, c, out=out[0]).addcmul_(b, d, value=-sign)
    return real, torch.mul(a, d, out=out[1]).addcmul_(b, c, value=sign)
