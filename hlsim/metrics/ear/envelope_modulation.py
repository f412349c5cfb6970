"""Features of HASPI: how well the fluctuations of an output follow those of clean speech.

1. The levels of the ear's 32 channels are smoothed and sampled 2667 times per second. A sample of
   all channels is a *frame*. Frames in which clean speech is inaudible are left out.
2. Five numbers describe the shape of the spectrum in a frame: projections of the levels on cosines
   over frequency, the *cepstrum*.
3. Ten filters divide the fluctuations of each cepstral coefficient over time into bands, the *rates
   of modulation*, from 2 to 256 Hz.
4. At each rate, the output is correlated with clean speech. The ten correlations are the features.

Source: Kates and Arehart 2021, "The hearing-aid speech perception index (HASPI) version 2", Speech
Communication 131, 35-46.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.fft import fft_length
from hlsim.metrics.ear.alignment import shift
from hlsim.metrics.ear.clean_speech import UnscorableError
from hlsim.metrics.ear.extent import Extent
from hlsim.metrics.ear.model import CHANNELS
from hlsim.torchtools import constant

STRIDE = 9
"""Number of samples at 24 kHz between the starts of two frames."""

WINDOW_SAMPLES = 52
"""Length of the smoothing window, which ends 26 samples after its frame."""

WINDOW_STRIDES = -(-(WINDOW_SAMPLES + 2) // STRIDE)
"""Number of strides that the zero-padded window spans."""

WINDOW_LEAD = WINDOW_STRIDES * STRIDE - WINDOW_SAMPLES // 2 - 1
"""Number of zeros before a signal, so that the window of its first frame is complete."""

SILENCE_DB = 2.5
"""Level in dB over threshold that a frame of clean speech must exceed to count.

For fine structure, it holds for segments, and for each channel in them.
"""

COSINES = 5
"""Number of cepstral coefficients."""

RATES = (2.0, 6.0, 10.0, 16.0, 25.0, 40.0, 64.0, 100.0, 160.0, 256.0)
"""Rates of modulation: centre frequencies of the modulation filters in Hz.

The filter of the lowest rate is a low-pass.
"""

FRAME_RATE = 2560.0
"""Frame rate for which pyclarity designs the modulation filters. The true one is 24000 / 9."""

MAX_FILTER_SECONDS = 0.24
"""Duration of the filters up to 10 Hz. The others have as many periods as that at 10 Hz."""

NOISE_DB = 0.1
"""Standard deviation of the ear's internal noise on the levels at the auditory nerve, in dB."""

ENERGY_FLOOR = 1e-30
"""Sum of squares, without the mean, below which a signal counts as constant."""


def smooth_frames(levels: Tensor, delays: Tensor, extent: Extent) -> Tensor:
    """Delay the levels of channels, smooth them, and take every ninth sample as a frame.

    Args:
        levels: Levels in dB over threshold at 24 kHz. Shape: (items, channels, padded).
        delays: Delays in samples that compensate for the different group delays of the channels.
            Shape: (items, channels), int64.
        extent: Number of samples of each item before padding.

    Returns:
        Frames in dB over threshold. Shape: (items, channels, ceil(longest / 9)).

    >>> delays = torch.zeros(1, 2, dtype=torch.int64)
    >>> smooth_frames(torch.ones(1, 2, 128), delays, Extent((128,))).shape
    torch.Size([1, 2, 15])
    """
    count = -(-extent.longest // STRIDE)
    stops = tuple(end + WINDOW_LEAD for end in extent.ends)
    delayed = shift(
        levels, delays + WINDOW_LEAD, extent.ends, stops, STRIDE * (count + WINDOW_STRIDES - 1)
    )
    window = _smoothing(like=levels)
    parts = delayed.unflatten(-1, (-1, STRIDE)) @ window
    return sum(
        (parts[..., i : i + count, i] for i in range(1, WINDOW_STRIDES)),
        start=parts[..., :count, 0],
    )


@constant
def _smoothing() -> NDArray[np.float64]:
    """Return the window that smooths levels: a Hann window of 52 taps with the sum 1.

    It is zero-padded and has nine successive taps per column. Shape: (STRIDE, WINDOW_STRIDES).
    """
    window = np.hanning(WINDOW_SAMPLES + 2)[1:-1]
    padded = np.pad(window / window.sum(), (WINDOW_STRIDES * STRIDE - WINDOW_SAMPLES, 0))
    return padded.reshape(WINDOW_STRIDES, STRIDE).T


def mean_amplitude(levels: Tensor) -> Tensor:
    """Compute the contribution of some channels to the mean amplitude over all 32 channels.

    Add the contributions of all channels. Their sum, the mean amplitude, shows whether a frame is
    audible.

    Args:
        levels: Frames of these channels in dB over threshold. Shape: (items, channels, frames).

    Returns:
        Contributions, where an amplitude of 1 is the threshold. They have no gradient. Shape:
            (items, frames).

    >>> mean_amplitude(torch.zeros(1, 16, 2))
    tensor([[0.5000, 0.5000]])
    """
    return (levels.detach() * (math.log(10.0) / 20.0)).exp().sum(-2) / CHANNELS


def cepstrum(levels: Tensor, channels: slice = slice(None)) -> Tensor:
    """Compute the contribution of some channels to the five cepstral coefficients of each frame.

    Add the contributions of all channels to get the coefficients, which describe the shape of the
    spectrum. They are the projections of its levels on five cosines over the channel number (which
    is an ERB scale), with 0.5, 1, ... 2.5 periods and a norm of 1.

    Args:
        levels: Frames of these channels in dB over threshold. Shape: (..., channels, frames).
        channels: Range of these channels among the 32 of the ear.

    Returns:
        Contributions in dB. Shape: (..., 5, frames).

    >>> cepstrum(torch.ones(32, 4)).shape
    torch.Size([5, 4])
    """
    return _unit_cosines(like=levels)[:, channels] @ levels


def find_audible_frames(amplitude: Tensor, extent: Extent) -> tuple[Tensor, Extent]:
    """Find the frames in which clean speech exceeds the threshold of hearing.

    A frame is audible if its mean amplitude is more than 2.5 dB above the threshold. The function
    synchronises with a GPU once.

    Args:
        amplitude: Mean amplitude of clean speech over all channels, where 1 is the threshold.
            Shape: (items, frames).
        extent: Number of samples at 24 kHz of each item before padding.

    Returns:
        Indices of the audible frames of each item in ascending order, (items, longest), and the
        number of audible frames of each item, of which ``longest`` is the largest. Shorter rows are
        filled up with indices of other frames.

    Raises:
        UnscorableError: An item has fewer than two audible frames.

    >>> indices, audible = find_audible_frames(torch.tensor([[0.0, 9.0, 9.0]]), Extent((27,)))
    >>> indices, audible.ends
    (tensor([[1, 2]]), (2,))
    """
    frames_of = Extent(tuple(-(-end // STRIDE) for end in extent.ends))
    is_audible = frames_of.cut(amplitude) > 10.0 ** (SILENCE_DB / 20.0)
    order, counts = move_to_front(is_audible)
    audible = Extent(counts)
    if min(audible.ends) < 2:
        raise UnscorableError(
            "clean is below the threshold of hearing in all frames or all but one; raise its "
            "level, or leave the item out"
        )
    return order[:, : audible.longest], audible


def move_to_front(is_audible: Tensor) -> tuple[Tensor, tuple[int, ...]]:
    """Find the order in which the audible frames of each item come first, in their order.

    The function synchronises with a GPU once.

    Args:
        is_audible: True for audible frames. Shape: (items, frames).

    Returns:
        Indices of the frames in the new order, (items, frames), and the number of audible frames of
        each item.

    >>> move_to_front(torch.tensor([[False, True, True]]))
    (tensor([[1, 2, 0]]), (2,))
    """
    order = (~is_audible).byte().argsort(dim=-1, stable=True)
    return order, tuple(is_audible.sum(-1).tolist())


@constant
def cosines() -> NDArray[np.float64]:
    """Return the cosines over the channels that define the five cepstral coefficients.

    They have 0.5, 1, ... 2.5 periods and the amplitude 1. Shape: (5, 32).

    >>> cosines().shape
    (5, 32)
    """
    angle = np.pi * np.arange(CHANNELS) / (CHANNELS - 1)
    return np.cos(np.arange(1, COSINES + 1)[:, None] * angle)


@constant
def _unit_cosines() -> NDArray[np.float64]:
    """Return ``cosines`` with the norm 1. Shape: (5, 32)."""
    waves = cosines()
    return waves / np.linalg.norm(waves, axis=1, keepdims=True)


# -- modulation filters ----------------------------------------------------------------------------


class _Covariance(NamedTuple):
    """Covariances of the cepstral coefficients of two signals at each rate of modulation.

    Attributes:
        xx, yy, xy: Sums over time of the squares and of the products of the filtered coefficients,
            clean x and output y, without their means. Shape: (items, 10, 5).
        waves: Coefficients x and y before the filters, without their means. Shape: (items, 2, 5,
            audible frames).
        spectra: Fourier transforms of ``waves``. Shape: (items, 2, 5, frequencies).
    """

    xx: Tensor
    yy: Tensor
    xy: Tensor
    waves: Tensor
    spectra: Tensor


def _modulation_covariance(clean: Tensor, output: Tensor, extent: Extent) -> _Covariance:
    """Filter the coefficients over time by ten zero-phase filters, and compute covariances.

    Args:
        clean, output: Cepstral coefficients of the audible frames. Shape: (items, 5, frames).
        extent: Number of audible frames of each item.
    """
    points = _points(extent.longest)
    waves = extent.centred(torch.stack((clean, output), 1))
    spectra = torch.fft.rfft(waves, points)
    responses = _responses(points, like=clean)
    # On a CPU, one filter at a time fits into the caches; a GPU needs large tensors.
    filters_at_once = 1 if clean.device.type == "cpu" else len(responses)
    sums = []
    for part in responses.split(filters_at_once):
        filtered = torch.fft.irfft(spectra[:, None] * part[:, None, None], points)
        x, y = extent.centred(filtered).unbind(2)
        sums.append(torch.stack((x.square().sum(-1), y.square().sum(-1), (x * y).sum(-1))))
    xx, yy, xy = torch.cat(sums, 2)
    return _Covariance(xx, yy, xy, waves, spectra)


def _points(frames: int) -> int:
    """Return a length of the Fourier transform with which no filter wraps around the frames."""
    return fft_length(frames + len(_filters()[0]) // 2, 256)


@lru_cache(maxsize=1)
def _filters() -> tuple[NDArray[np.float64], ...]:
    """Return the taps of the ten modulation filters: a Hann window, then Hann-windowed cosines.

    Each filter has an odd number of taps, (taps,), and is centred on the middle one.
    """
    filters = []
    for k, rate in enumerate(RATES):
        seconds = MAX_FILTER_SECONDS if k < 2 else MAX_FILTER_SECONDS * RATES[2] / rate
        half = math.floor(seconds * FRAME_RATE / 2)
        window = np.hanning(2 * half + 1)
        window /= window.sum()
        if k:
            window *= 2.0 * np.cos(2.0 * np.pi * rate / FRAME_RATE * np.arange(-half, half + 1))
        filters.append(window)
    return tuple(filters)


@constant
def _responses(points: int) -> NDArray[np.float64]:
    """Return the frequency responses of the modulation filters. Shape: (10, points // 2 + 1)."""
    return zero_phase_responses(_filters(), points)


def zero_phase_responses(
    filters: Sequence[NDArray[np.float64]], points: int
) -> NDArray[np.float64]:
    """Compute the frequency responses of symmetric filters without their delay, which are real.

    Args:
        filters: Taps of each filter, an odd number of them, symmetric about the middle one.
        points: Length of the Fourier transform.

    Returns:
        Responses of the filters. Shape: (filters, points // 2 + 1).

    >>> zero_phase_responses([np.array([0.25, 0.5, 0.25])], 4)
    array([[1. , 0.5, 0. ]])
    """
    padded = [np.pad(taps, (0, points - len(taps))) for taps in filters]
    centred = [np.roll(row, -(len(taps) // 2)) for row, taps in zip(padded, filters, strict=True)]
    return np.fft.rfft(centred).real


# -- correlation -----------------------------------------------------------------------------------


def normalised_covariance(xx: Tensor, yy: Tensor, xy: Tensor) -> Tensor:
    """Compute the magnitude of the correlation of two signals; 0 where one of them is constant.

    Args:
        xx, yy: Sum of squares of each signal, from which its mean was subtracted. Any shape.
        xy: Sum of the products of both signals, of the same shape.

    >>> normalised_covariance(torch.tensor(4.0), torch.tensor(9.0), torch.tensor(-3.0))
    tensor(0.5000)
    """
    is_varying = (xx >= ENERGY_FLOOR) & (yy >= ENERGY_FLOOR)
    norm = torch.where(is_varying, xx, 1.0).sqrt() * torch.where(is_varying, yy, 1.0).sqrt()
    return torch.where(is_varying, xy.abs() / norm, 0.0)


def correlation(clean: Tensor, output: Tensor, extent: Extent) -> Tensor:
    """Compute the features of HASPI: how much an output is correlated with clean speech.

    The magnitude of the correlation is averaged over the five cepstral coefficients. A coefficient
    that is constant over time counts as 0. The ear's internal noise is not added here.

    Args:
        clean, output: Cepstral coefficients of the audible frames of clean speech and of the
            output. Shape: (items, 5, audible frames).
        extent: Number of audible frames of each item.

    Returns:
        Correlation at each rate of modulation, 0 to 1. Shape: (items, 10).

    >>> waves = torch.randn(1, 5, 900)
    >>> correlation(waves, waves, Extent((900,))).round(decimals=4)[0, :3]
    tensor([1., 1., 1.])
    """
    covariance = _modulation_covariance(clean, output, extent)
    return normalised_covariance(covariance.xx, covariance.yy, covariance.xy).mean(-1)


def expected_correlation(clean: Tensor, output: Tensor, extent: Extent) -> Tensor:
    """Compute the mean of the features of HASPI over all draws of the ear's internal noise.

    HASPI adds noise to the levels of both signals. Here no noise is drawn: its mean effect follows
    from its variance. The noise increases the energies by which the covariance is divided, and
    contributes zero on average to the covariance itself. The mean and the variance of the quotient
    are computed to second order. The mean of the quotient's magnitude is that of a folded normal
    distribution.

    Args:
        clean, output: Cepstral coefficients of the audible frames of clean speech and of the
            output, without noise. Shape: (items, 5, audible frames).
        extent: Number of audible frames of each item.

    Returns:
        Mean correlation at each rate of modulation. Shape: (items, 10).

    >>> waves = torch.randn(1, 5, 900)
    >>> expected_correlation(waves, waves, Extent((900,))).shape
    torch.Size([1, 10])
    """
    covariance = _modulation_covariance(clean, output, extent)
    variance = NOISE_DB**2
    energies = torch.from_numpy(np.stack([_noise_energy(frames) for frames in extent.ends]))
    noise = variance * energies.to(clean).unsqueeze(-1)
    xx, yy, xy = covariance.xx + noise, covariance.yy + noise, covariance.xy
    xx2, yy2, xy2, noise2 = _energies_filtered_twice(covariance, extent)
    noise2 = variance**2 * noise2
    # relative variances of both energies, and covariance of the product with either energy
    spread_x = (4.0 * variance * xx2 + 2.0 * noise2) / xx.square()
    spread_y = (4.0 * variance * yy2 + 2.0 * noise2) / yy.square()
    norm = xx.sqrt() * yy.sqrt()
    both = 2.0 * variance * xy2 / norm
    quotient = xy / norm
    mean = quotient * (1.0 + 0.375 * (spread_x + spread_y)) - 0.5 * both * (1.0 / xx + 1.0 / yy)
    # variance of the product over its norm, then of the quotient
    product = (variance * (xx2 + yy2) + noise2) / norm.square()
    spread = (
        product
        + 0.25 * quotient.square() * (spread_x + spread_y)
        - quotient * both * (1.0 / xx + 1.0 / yy)
    )
    spread = spread.clamp_min(1e-12)
    folded = (2.0 / math.pi * spread).sqrt() * torch.exp(-0.5 * mean.square() / spread)
    return (folded + mean * torch.erf(mean / (2.0 * spread).sqrt())).mean(-1)


def _energies_filtered_twice(covariance: _Covariance, extent: Extent) -> list[Tensor]:
    """Compute the energies of coefficients and of white noise after filtering them twice.

    They determine the variance of sums of products: of coefficients with noise, and of noise with
    noise, where both passed the same filter. Circular filters have results that depend on the
    length of the transform, therefore each item is transformed with the length that it has alone.

    Args:
        covariance: Coefficients before the filters and their spectra.
        extent: Number of audible frames of each item.

    Returns:
        Energies xx (of clean speech), yy (of the output) and xy of the coefficients, (items, 10
        modulation rates, 5 coefficients) each, and energy of noise of variance 1, (items, 10, 1).
    """
    items = []
    for item, frames in enumerate(extent.ends):
        points = _points(frames)
        spectra = covariance.spectra[item]
        if points != _points(extent.longest):
            spectra = torch.fft.rfft(covariance.waves[item, ..., :frames], points)
        x, y = torch.view_as_real(spectra)
        weights = _twice_filtered(points, like=x)
        products = x.square(), y.square(), x * y
        energies = [weights @ product.sum(-1).mT for product in products]
        items.append((*energies, frames * weights.sum(-1, keepdim=True)))
    return [torch.stack(energies) for energies in zip(*items, strict=True)]


@lru_cache(maxsize=1024)
def _noise_energy(frames: int) -> NDArray[np.float64]:
    """Return the expected energy of white noise of variance 1 behind each modulation filter.

    The energy is a sum of squares over the frames. The means before and after the filters are
    subtracted, as in ``_modulation_covariance``.

    Args:
        frames: Number of frames.

    Returns:
        Energies. Shape: (10,).
    """
    energies = []
    for taps in _filters():
        half = min(len(taps) // 2, frames - 1)
        lags = np.arange(-half, half + 1)
        taps = taps[len(taps) // 2 + lags]
        sums = np.concatenate(([0.0], np.cumsum(taps)))
        ends = np.arange(half, half + frames) + 1
        # the response to a constant
        steady = sums[np.minimum(ends, len(taps))] - sums[np.maximum(ends - frames, 0)]
        energy = (taps**2 * (frames - np.abs(lags))).sum()
        energies.append(energy - (steady**2).mean() - steady.var())
    return np.array(energies)


@constant
def _twice_filtered(points: int) -> NDArray[np.float64]:
    """Return weights for squared magnitudes of a spectrum, whose weighted sum is an energy.

    It is the energy of the signal after it passed each modulation filter twice. Shape: (10,
    points // 2 + 1).
    """
    sides = np.full(points // 2 + 1, 2.0)
    sides[[0, -1]] = 1.0
    return _responses(points) ** 4 * sides / points
