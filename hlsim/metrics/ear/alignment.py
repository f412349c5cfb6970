"""Alignment in time of an output with the clean signal: first as a whole, then by channel."""

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.fft import fft_length
from hlsim.metrics.ear.extent import Extent, integers
from hlsim.metrics.ear.recursions import RATE

MAX_LAG = 2400
"""Largest shift of a single channel of an output in samples, 100 ms."""

LAG_BLOCK = RATE // 2
"""Approximate number of samples per block of the correlation that aligns channels."""

HEADROOM = RATE // 500
"""Number of samples (2 ms) by which the whole output is late after its alignment.

An aid may delay some frequencies less than the whole signal. Without this delay, they would be
early.
"""


def spectrum_for_alignment(signals: Tensor, extent: Extent) -> Tensor:
    """Compute the spectra of signals without their means, for the correlation in ``bulk_delays``.

    They have no gradient.

    Args:
        signals: Signals at 24 kHz. Shape: (items, time).
        extent: Number of samples of each item before padding.

    Returns:
        Complex spectra, zero-padded for correlations at all delays. Shape: (items, frequencies).

    >>> spectrum_for_alignment(torch.randn(1, 100), Extent((100,))).shape
    torch.Size([1, 101])
    """
    points = fft_length(2 * extent.longest, 2)
    return torch.fft.rfft(extent.centred(signals.detach()), points)


def bulk_delays(reference_spectrum: Tensor, output: Tensor, extent: Extent) -> Tensor:
    """Compute the delay that each output of an aid needs to lie 2 ms behind its clean signal.

    The delay is found by the largest magnitude of the cross-covariance of the whole signals.

    Args:
        reference_spectrum: Spectra of the clean signals by ``spectrum_for_alignment``. Shape:
            (items, frequencies).
        output: Outputs at 24 kHz. Shape: (items, time).
        extent: Number of samples of each item, equal for clean signals and outputs.

    Returns:
        Delays in samples; negative ones advance the output. Shape: (items,), int64.

    >>> reference, extent = torch.randn(1, 100), Extent((100,))
    >>> bulk_delays(spectrum_for_alignment(reference, extent), reference, extent)
    tensor([48])
    """
    time, points = extent.longest, fft_length(2 * extent.longest, 2)
    with torch.no_grad():
        spectrum = reference_spectrum * spectrum_for_alignment(output, extent).conj()
        covariance = torch.fft.irfft(spectrum, points).abs()
        # in order of the lag, from 1 - time to time - 1
        by_lag = covariance.roll(time - 1, -1)[:, : 2 * time - 1]
        return by_lag.argmax(-1) - (time - 1) + HEADROOM


def lag_spectrum(reference: Tensor, extent: Extent) -> Tensor:
    """Transform a clean signal's channels for ``align_channels``, which correlates outputs with it.

    The result has the spectra of the differences between neighbouring samples. A correlation with
    these differences is the change of the correlation with the signal from one lag to the next.
    Near the maximum, single precision resolves these changes, but not the values themselves.

    Blocks of about half a second are transformed, which fit into caches. Neighbouring blocks
    overlap by twice the largest lag.

    Args:
        reference: Envelope or motion of the clean signal. Shape: (items, channels, padded).
        extent: Number of samples of each item before padding.

    Returns:
        Complex spectra, (items, channels, blocks, frequencies).

    >>> lag_spectrum(torch.zeros(1, 2, 128), Extent((128,))).shape
    torch.Size([1, 2, 1, 193])
    """
    max_lag, count, hop, points = _lag_blocks(extent)
    behind = count * hop - extent.longest + max_lag + 1
    steps = functional.pad(extent.cut(reference), (max_lag, behind)).diff()
    return torch.fft.rfft(steps.unfold(-1, hop + 2 * max_lag, hop), points)


def _lag_blocks(extent: Extent) -> tuple[int, int, int, int]:
    """Return the numbers that describe the blocks of ``lag_spectrum``.

    Returns:
        Largest delay of a channel in samples; number of blocks; samples per block; and length of
        the transform of a block with all lags.
    """
    max_lag = min(MAX_LAG, extent.longest)
    count = max(1, round(extent.longest / LAG_BLOCK))
    hop = -(-extent.longest // count)
    return max_lag, count, hop, fft_length(hop + 2 * max_lag, 16)


def align_channels(
    signal: Tensor, envelope: Tensor, reference_spectrum: Tensor, extent: Extent
) -> Tensor:
    """Shift each channel of an output to where it correlates best with the clean signal.

    Channels are delayed by -2399 to 2400 samples (100 ms) at 24 kHz, and at most by the length of
    the longest item. Samples from outside of an item are 0. The shifts are constants for the
    gradient.

    Args:
        signal: Channels to shift. Shape: (items, channels, padded).
        envelope: Envelope or motion of the same channels, from which the shifts are computed.
            Shape: (items, channels, padded).
        reference_spectrum: ``lag_spectrum`` of the clean signal's envelope or motion. Shape:
            (items, channels, blocks, frequencies).
        extent: Number of samples of each item before padding.

    Returns:
        Shifted channels. Shape: (items, channels, padded).

    >>> clean, extent = torch.zeros(1, 1, 128), Extent((128,))
    >>> clean[..., 50] = 1.0
    >>> early = clean.roll(-7, -1)
    >>> bool((align_channels(early, early, lag_spectrum(clean, extent), extent) == clean).all())
    True
    """
    with torch.no_grad():
        max_lag, count, hop, points = _lag_blocks(extent)
        padded = functional.pad(extent.cut(envelope), (0, count * hop - extent.longest))
        spectra = torch.fft.rfft(padded.unflatten(-1, (count, hop)), points)
        # in place, because these are large tensors
        products = spectra.conj_physical_().mul_(reference_spectrum)
        steps = torch.fft.irfft(products.sum(-2), points)[..., 1 : 2 * max_lag]
        correlation = functional.pad(steps.double().cumsum(-1), (1, 0))
        delays = correlation.argmax(-1) - (max_lag - 1)
    return shift(signal, delays, extent.ends, extent.ends, extent.padded)


def shift(
    signal: Tensor, delays: Tensor, ends: tuple[int, ...], stops: tuple[int, ...], size: int
) -> Tensor:
    """Delay each item, or each channel of it, by a whole number of samples.

    Sample t of the output is sample ``t - delay`` of the signal. Samples from outside of an item
    are 0.

    Args:
        signal: Signals. Shape: (items, time) or (items, channels, time).
        delays: Delays in samples; negative ones advance the signal. Shape: (items,) or (items,
            channels), int64.
        ends: Number of samples of each item of ``signal``; later samples count as 0.
        stops: Number of samples of each item of the output; later samples are 0.
        size: Number of samples of the output.

    Returns:
        Delayed signals. Shape: (items, size) or (items, channels, size).

    >>> signal = torch.tensor([[1.0, 2.0, 3.0]])
    >>> shift(signal, torch.tensor([1]), ends=(3,), stops=(3,), size=4)
    tensor([[0., 1., 2., 0.]])
    """
    return _Shift.apply(signal, delays, ends, stops, size)


class _Shift(torch.autograd.Function):
    """Function of ``shift``, whose gradient is the opposite shift.

    The gradient of an index would store the indices, which take twice the memory of the signals.
    """

    @staticmethod
    def forward(
        ctx: Any,
        signal: Tensor,
        delays: Tensor,
        ends: tuple[int, ...],
        stops: tuple[int, ...],
        size: int,
    ) -> Tensor:
        ctx.settings = -delays, stops, ends, signal.shape[-1]
        if signal.device.type == "cpu":  # slices are nine times as fast as an index
            delayed = signal.new_zeros((*signal.shape[:-1], size))
            for item, (end, stop) in enumerate(zip(ends, stops, strict=True)):
                rows, outputs = torch.atleast_2d(signal[item], delayed[item])
                item_delays = delays[item].flatten().tolist()
                for row, output, delay in zip(rows, outputs, item_delays, strict=True):
                    start = max(delay, 0)
                    last = max(start, min(end + delay, stop))
                    output[start:last] = row[start - delay : last - delay]
            return delayed
        target = torch.arange(size, device=signal.device)
        source = target - delays.unsqueeze(-1)
        source_end, target_end = (
            integers(limits, signal.device).view(-1, *[1] * (signal.ndim - 1))
            for limits in (ends, stops)
        )
        is_inside = (source >= 0) & (source < source_end) & (target < target_end)
        samples = signal.gather(-1, source.clamp(0, signal.shape[-1] - 1))
        return torch.where(is_inside, samples, 0.0)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None, None]:
        # The opposite delay, with the ends of input and output exchanged, returns each sample to
        # its place.
        return shift(gradient, *ctx.settings), None, None, None, None
