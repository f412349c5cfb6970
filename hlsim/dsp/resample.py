"""Resampling by a windowed sinc.

The kernel is that of torchaudio's ``sinc_interp_kaiser`` (J. O. Smith, *Digital Audio Resampling*).
It is a sinc whose cut-off frequency is 94.8 % of the lower Nyquist frequency, cut to 64 zero
crossings on either side of its centre and multiplied by a Kaiser window with beta = 14.77. resampy
calls these parameters ``kaiser_best``.

The table shows the gain of the kernels between all pairs of 16, 22.05, 24, 32, 44.1 and 48 kHz,
where f is the frequency divided by the lower Nyquist frequency. ``tests/dsp/test_resample.py``
measures these values.

=====================  ============  ============
gain                   float32       float64
=====================  ============  ============
f up to 0.9            +-0.023 dB    +-0.023 dB
f = 0.948 (cut-off)    -6 dB         -6 dB
f = 1                  -61.6 dB      -61.6 dB
f from 1.01            -90 dB        -90 dB
f from 1.05            -103 dB       -145 dB
=====================  ============  ============
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.checks import check_rate, check_time_last
from hlsim.torchtools import compute_once

ROLLOFF = 0.9475937167399596
"""Cut-off frequency divided by the lower of the two Nyquist frequencies."""

ZERO_CROSSINGS = 64
"""Number of zero crossings of the sinc on either side of its centre."""

KAISER_BETA = 14.769656459379492
"""Shape parameter of the Kaiser window."""

HIGHEST_RESAMPLING_RATE = 1_000_000
"""Highest sample rate in Hz from which or to which signals are resampled."""

MAX_KERNEL_VALUES = 100_000_000
"""Largest number of values of a kernel without its margins, 0.4 GB in float32.

To 16000 Hz, there are 0.07 million from 44100 Hz and 11 million from 44056 Hz. From 44101 Hz there
would be 706 million.
"""


def resample(waveform: Tensor, source_rate: int, target_rate: int) -> Tensor:
    """Convert waveforms to another sample rate, without delay.

    The gain is flat within 0.023 dB up to 90 % of the lower Nyquist frequency. It is at most -61 dB
    at this frequency and -90 dB from 101 % of it on. On a GPU whose convolutions use TF32, which is
    torch's default, the last value is -69 dB; ``torch.backends.cudnn.allow_tf32 = False`` restores
    -90 dB.

    Shape: (..., time) -> (..., ceil(time * target_rate / source_rate)).

    Args:
        waveform: Floating-point samples.
        source_rate: Sample rate of ``waveform`` in Hz.
        target_rate: Sample rate of the result in Hz.

    Raises:
        ValueError: The samples are integers or complex, time is not last, a rate is not a whole
            number from 1 to 1000000 Hz, or the greatest common divisor of the rates is so small
            that the kernel would take gigabytes, as for 44101 and 16000 Hz.

    >>> resample(torch.randn(2, 44100), 44100, 16000).shape
    torch.Size([2, 16000])
    """
    source_rate = check_rate(source_rate, 1, HIGHEST_RESAMPLING_RATE)
    target_rate = check_rate(target_rate, 1, HIGHEST_RESAMPLING_RATE)
    check_time_last(waveform)
    if source_rate == target_rate:
        return waveform
    common = math.gcd(source_rate, target_rate)
    source, target = source_rate // common, target_rate // common
    if source * target > MAX_KERNEL_VALUES:
        raise ValueError(
            f"cannot resample from {source_rate} to {target_rate} Hz: their greatest common "
            f"divisor, {common}, is too small; choose rates such as 16000, 22050, 24000, "
            "32000, 44100 and 48000"
        )
    kernel = sinc_kernel(source, target, waveform.dtype, waveform.device)

    *leading, time = waveform.shape
    signals = waveform.reshape(math.prod(leading), 1, time)
    reach = (kernel.shape[-1] - source) // 2
    padded = functional.pad(signals, (reach, reach + source))
    # Each block of ``source`` samples gives ``target`` samples, one per row of the kernel.
    blocks = functional.conv1d(padded, kernel, stride=source)
    resampled = blocks.mT.reshape(*leading, -1)
    return resampled[..., : -(-time * target // source)]


@compute_once
def sinc_kernel(source: int, target: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Compute the filters with which a convolution resamples signals.

    A block of ``source`` input samples gives ``target`` output samples. There is one filter for
    each of these output samples.

    Args:
        source: Source rate divided by the greatest common divisor of both rates.
        target: Target rate divided by the greatest common divisor of both rates.
        dtype: Type of the result. The filters are computed in float32 at least.
        device: Device of the result.

    Returns:
        Filters, (target, 1, 2 * reach + source), for a convolution with a stride of ``source``.
        They cover ``reach`` samples before and after a block.

    >>> sinc_kernel(3, 1, torch.float32, torch.device("cpu")).shape
    torch.Size([1, 1, 409])
    """
    computed = torch.promote_types(dtype, torch.float32)
    cutoff = min(source, target) * ROLLOFF
    reach = math.ceil(ZERO_CROSSINGS * source / cutoff)
    taps = torch.arange(-reach, reach + source, dtype=computed, device=device) / source
    phases = torch.arange(0, -target, -1, dtype=computed, device=device) / target
    # distance of each tap from the output sample, in zero crossings of the sinc
    distance = (phases[:, None, None] + taps) * cutoff
    distance = distance.clamp(-ZERO_CROSSINGS, ZERO_CROSSINGS)

    beta = torch.tensor(KAISER_BETA, dtype=computed, device=device)
    window = torch.i0(beta * (1 - (distance / ZERO_CROSSINGS).square()).sqrt()) / torch.i0(beta)
    angle = distance * math.pi
    sinc = torch.where(angle == 0, 1.0, angle.sin() / angle)
    return (sinc * (window * (cutoff / source))).to(dtype)
