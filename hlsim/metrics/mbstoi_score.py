"""MBSTOI in PyTorch: the intelligibility of speech that a listener receives with two ears.

The score is that of pyclarity 0.9.0, with a gradient. In 15 one-third-octave bands and segments of
0.4 s, a model of the brain delays the signal of one ear, changes its level and subtracts it from
that of the other ear, with the errors that listeners make (*equalisation and cancellation*). The
delay and the level are those that maximise the ratio of the modulation of clean speech to that of
the output. If one ear alone has a larger ratio, the signal of that ear is used. The score is the
mean correlation of the envelopes of clean speech and output. Please note:

- MBSTOI assumes normal hearing and ignores the level. For a listener with a hearing loss, apply a
  simulator to the outputs first.
- Signals are not aligned. Align ``output`` with ``clean`` first.
- The bands end at 4.3 kHz. A band in which ``output`` is silent has an arbitrary correlation,
  that of rounding errors.

Source: Andersen, de Haan, Tan and Jensen 2018, "Refinement and validation of the binaural short
time objective intelligibility measure for spatially diverse conditions", Speech Communication 102,
1-13, doi 10.1016/j.specom.2018.06.001.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram.thresholds import check_two_channels
from hlsim.checks import check_finite
from hlsim.dsp.fft import power, rfft
from hlsim.metrics.pair import match_pair
from hlsim.torchtools import Audio, Samples, as_type_of, constant, map_on_cores

RATE = 10000
"""Sample rate in Hz at which the score is defined."""

FRAME, HOP, POINTS = 256, 128, 512
"""Samples of a frame, samples between frames, and points of a frame's Fourier transform."""

SEGMENT = 30
"""Number of frames that are correlated at once, 0.4 s."""

BANDS, LOWEST_CENTRE_HZ = 15, 150.0
"""Number of one-third-octave bands, and centre of the lowest one."""

RANGE_DB = 40.0
"""Difference in dB from the loudest frame at which clean speech counts as silent."""

DELAYS = np.linspace(-1e-3, 1e-3, 100)
"""Interaural delays in seconds that are compared."""

LEVELS = np.linspace(-20.0, 20.0, 40)
"""Interaural levels in dB that are compared."""

CPU_SEGMENTS, GPU_SEGMENTS = 2**17 // 4000, 2**25 // 4000
"""Number of segments that are computed at once. Each needs 4000 values per band."""

LEFT_PAIR, RIGHT_PAIR = 0, 4
"""Positions of two products among the ten pairwise products of a band's four features.

The features are the powers of the left and of the right ear, and the real and the imaginary part of
their cross-spectrum. The two products are the squared powers of the left and of the right ear.
"""


def mbstoi(output: Audio, clean: Samples, *, sample_rate: int = 16000) -> Audio:
    """Compute MBSTOI of each item: the intelligibility of speech at two ears, about 0 to 1.

    The score is deterministic and differentiable in both signals. Decisions are constants for the
    gradient: which frames are speech, the interaural delays and levels, and the better ear. Scores
    are computed in float64 (float32 on Apple's GPUs), and returned in the wider dtype of both
    signals. Zeros at the end of an item change its score by up to 0.007, so score the items of a
    padded batch one by one.

    Args:
        output: Output of an aid at the left and the right ear. Shape: (..., 2, time).
        clean: Clean speech at the left and the right ear, time-aligned with ``output``. Shape:
            (..., 2, time). Lengths of both that differ by 0.1 s at most are cut to the shorter one,
            with a warning.
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Returns:
        Scores, of NumPy if ``output`` is an array. Shape: (...).

    Raises:
        ValueError: Signals of different shapes, without two channels, on different devices, not
            floating-point, not finite or above 1e9; clean speech that is silent or lasts less than
            0.41 s without its pauses; a rate out of range.

    >>> from hlsim import example_speech
    >>> clean = torch.stack([example_speech(), example_speech()])
    >>> round(float(mbstoi(clean, clean)), 2)
    1.0
    """
    matched, clean, _ = match_pair(output, clean, sample_rate)
    check_two_channels(clean)
    *items, _, time = clean.shape
    precision = torch.float32 if clean.device.type == "mps" else torch.float64
    signals = torch.stack([clean, matched], -3).to(precision).reshape(-1, 2, 2, time)
    check_finite(signals, "output or clean")
    is_sounding = signals[:, 0].flatten(1).any(-1).tolist()
    if not all(is_sounding):
        index = is_sounding.index(False)
        raise ValueError(f"clean is silent at both ears in item {index}; leave the item out")
    # One item at a time on a CPU, because caches hold no more.
    batches = signals.split(1 if signals.device.type == "cpu" else len(signals))
    with torch.autocast(signals.device.type, enabled=False):
        scores = map_on_cores(lambda batch: _score_batch(batch, sample_rate), batches, signals)
    return as_type_of(output, torch.cat(scores).to(clean.dtype).reshape(items))


def _score_batch(signals: Tensor, rate: int) -> Tensor:
    """Compute MBSTOI of several items at once.

    Args:
        signals: Clean speech, then the output, at the left, then the right ear. Shape: (items, 2,
            2, time).
        rate: Sample rate in Hz.

    Returns:
        Scores. Shape: (items,).

    Raises:
        ValueError: Without pauses, an item has 30 frames or fewer.
    """
    frames, counts = _remove_silence(_resample(signals.movedim(0, 2), rate))
    return _mean_correlation(_band_features(frames), counts)


def _resample(signals: Tensor, rate: int) -> Tensor:
    """Resample signals to 10 kHz in the frequency domain, with one sample more, as pyclarity does.

    Shape: (..., time) -> (..., time at 10 kHz + 1).
    """
    time = signals.shape[-1]
    points = int(time * (RATE / rate) + 1)
    spectrum = rfft(signals)[..., : points // 2 + 1]
    if points % 2 == 0:  # the last coefficient stands for two
        spectrum = torch.cat([spectrum[..., :-1], 2.0 * spectrum[..., -1:]], -1)
    return torch.fft.irfft(spectrum, points) * (points / time)


def _remove_silence(signals: Tensor) -> tuple[Tensor, list[int]]:
    """Remove the frames where clean speech is silent at both ears, and overlap-add the others.

    A frame is silent at an ear if it is 40 dB or more below the loudest frame of that ear. The
    shortened signals are divided into frames again.

    Args:
        signals: Clean signals of the left and the right ear, then the outputs, at 10 kHz. Shape:
            (2: clean and output, 2: left and right, items, time).

    Returns:
        Windowed frames of the shortened signals, those of all items one after another, (2, 2,
        frames, 256), and the number of frames of each item.

    Raises:
        ValueError: 30 frames or fewer remain of an item.
    """
    window = _window(like=signals)
    missing = FRAME + 1 - signals.shape[-1]
    padded = functional.pad(signals, (0, max(0, missing)))
    # As in pyclarity, a frame that ends with the signal is left out.
    frames = padded[..., :-1].unfold(-1, FRAME, HOP) * window
    norms = frames[0].detach().norm(dim=-1)  # ears, items, frames
    levels = 20.0 * torch.log10(norms + np.finfo(np.float64).eps)
    is_loud = levels > levels.amax(-1, keepdim=True) - RANGE_DB
    is_active = is_loud.any(0)
    counts = is_active.sum(-1).tolist()
    if min(counts) <= SEGMENT:
        raise ValueError(
            f"expected at least {(SEGMENT + 2) * HOP / RATE:.2g} s of clean speech within "
            f"{RANGE_DB:g} dB of its loudest frame, got {(min(counts) + 1) * HOP / RATE:.2g} s; "
            "pass longer signals"
        )
    active = frames.flatten(2, 3)[..., is_active.flatten(), :]
    first_halves, second_halves = active.split(HOP, -1)
    is_last = (_frames_to_end(counts, active.device) == 1)[:, None]
    is_first = is_last.roll(1, 0)
    before = torch.where(is_first, 0.0, second_halves.roll(1, -2))
    after = torch.where(is_last, 0.0, first_halves.roll(-1, -2))
    return torch.cat([first_halves + before, after + second_halves], -1) * window, counts


def _frames_to_end(counts: list[int], device: torch.device) -> Tensor:
    """Return, for each frame, the number of frames from it to the end of its item.

    Args:
        counts: Number of frames of each item.
        device: Device of the result.

    Returns:
        Numbers, such as 3, 2, 1 for an item of three frames. Shape: (frames of all items,).
    """
    return torch.cat([torch.arange(count, 0, -1, device=device) for count in counts])


@constant
def _window() -> NDArray[np.float64]:
    """Return a Hann window without the zeros at its ends. Shape: (256,)."""
    return np.hanning(FRAME + 2)[1:-1]


def _band_features(frames: Tensor) -> Tensor:
    """Compute four features of each one-third-octave band in each frame.

    The features are the power of the left ear, that of the right ear, and the real and the
    imaginary part of their cross-spectrum.

    Args:
        frames: Windowed frames of clean speech, then of the output, at the left, then the right
            ear. Shape: (2, 2, frames, 256).

    Returns:
        Four features of clean speech, then those of the output. Shape: (frames, bands, 8).
    """
    left, right = rfft(functional.pad(frames, (0, POINTS - FRAME))).unbind(1)
    cross = left * right.conj()
    features = torch.stack([power(left), power(right), cross.real, cross.imag], 1)
    bands = features @ _band_matrix(like=frames)
    return bands.flatten(0, 1).permute(1, 2, 0)


def _mean_correlation(features: Tensor, counts: list[int]) -> Tensor:
    """Compute the mean correlation over all segments of each item that end before its last frame.

    Args:
        features: Output of ``_band_features``. Shape: (frames of all items, bands, 8).
        counts: Number of frames of each item, more than ``SEGMENT``.

    Returns:
        Means. Shape: (items,).
    """
    windows = features.unfold(0, SEGMENT, 1)  # a segment begins at every frame
    to_end = _frames_to_end(counts, features.device)
    starts = (to_end > SEGMENT).nonzero().squeeze(-1)
    segments_at_once = CPU_SEGMENTS if features.device.type == "cpu" else GPU_SEGMENTS
    # As in pyclarity, one ear alone is not used in the last segment of an item.
    correlations = [
        _correlate(windows[group], to_end[group] > SEGMENT + 1)
        for group in starts.split(segments_at_once)
    ]
    items = torch.cat(correlations).split([count - SEGMENT for count in counts])
    return torch.stack([item.mean() for item in items])


@constant
def _band_matrix() -> NDArray[np.float64]:
    """Return 1 where a frequency lies in a band, and 0 elsewhere. Shape: (frequencies, bands)."""
    bins = np.arange(POINTS // 2 + 1)[:, None]
    edges = LOWEST_CENTRE_HZ * 2.0 ** ((2.0 * np.arange(BANDS + 1) - 1.0) / 6.0)
    edge_bins = np.rint(edges * POINTS / RATE)
    return ((bins >= edge_bins[:-1]) & (bins < edge_bins[1:])).astype(np.float64)


def _correlate(windows: Tensor, may_use_one_ear: Tensor) -> Tensor:
    """Compute the correlation of the envelopes of clean speech and output in each segment.

    The correlation is a mean over bands. The envelopes are those after equalisation and
    cancellation with the best delay and level, or those of one ear where its ratio of modulation is
    larger. A band in which clean speech has no modulation at either ear has the correlation -1. If
    only the output has none, it is 0, or -1 if one ear alone may not be used or clean speech has
    none at one ear.

    Args:
        windows: Segments of the output of ``_band_features``. Shape: (segments, bands, 8, frames).
        may_use_one_ear: Whether one ear alone may be used. Shape: (segments,).

    Returns:
        Correlations. Shape: (segments,).
    """
    centred = windows - windows.mean(-1, keepdim=True)
    products = centred @ centred.transpose(-1, -2)
    first, second = torch.triu_indices(4, 4, device=windows.device)
    # Both orders of a pair of features are added, so that squares count twice; the weights of
    # squares in ``_cancellation_weights`` have a factor of 0.5.
    clean, both, output = (
        (part + part.transpose(-1, -2))[..., first, second]
        for part in (products[..., :4, :4], products[..., :4, 4:], products[..., 4:, 4:])
    )
    grid = _cancellation_weights(like=windows)
    with torch.no_grad():
        ratio, index = _find_largest_ratio(clean, output, grid)
        is_silent = ~(clean.any(-1) & output.any(-1))
        ratio = torch.where(is_silent, 0.0, ratio)
        left, right = (clean[..., pair] / output[..., pair] for pair in (LEFT_PAIR, RIGHT_PAIR))
        # If both signals are silent at an ear, its ratio is NaN, and no ear alone is used.
        one_ear_is_better = (torch.maximum(left, right) > ratio) & may_use_one_ear[:, None]
        better_ear = torch.where(left > right, LEFT_PAIR, RIGHT_PAIR).unsqueeze(-1)
    weights = grid[torch.arange(BANDS, device=index.device), :, index]
    cancelled = _correlation(*((part * weights).sum(-1) for part in (both, clean, output)))
    cancelled = torch.where(is_silent, -1.0, cancelled)
    one_ear = _correlation(
        *(part.take_along_dim(better_ear, -1)[..., 0] for part in (both, clean, output))
    )
    return torch.where(one_ear_is_better, one_ear, cancelled).mean(-1)


def _correlation(both: Tensor, clean: Tensor, output: Tensor) -> Tensor:
    """Compute correlations from covariances and variances; 0 where a signal has no modulation.

    Args:
        both: Covariances of the envelopes of clean speech and output.
        clean, output: Variances of the envelopes, of the same shape.
    """
    is_varying = (clean > 0.0) & (output > 0.0)
    clean, output = (torch.where(is_varying, part, 1.0) for part in (clean, output))
    return torch.where(is_varying, both * clean.rsqrt() * output.rsqrt(), 0.0)


def _find_largest_ratio(clean: Tensor, output: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
    """Find the delay and level with the largest ratio of modulation, clean speech to output.

    Args:
        clean, output: Products of features, summed over the frames of a segment. Shape: (segments,
            bands, pairs).
        grid: Output of ``_cancellation_weights``. Shape: (bands, pairs, delays * levels).

    Returns:
        Largest ratios, and the indices of their delays and levels. Shape: (segments, bands) each.
    """
    largest = [
        (clean[:, band] @ weights).div_(output[:, band] @ weights).max(-1)
        for band, weights in enumerate(grid)
    ]
    ratios, indices = zip(*largest, strict=True)
    return torch.stack(ratios, -1), torch.stack(indices, -1)


@constant
def _cancellation_weights() -> NDArray[np.float64]:
    """Compute the weights of products of band features after equalisation and cancellation.

    Let L and R be the powers of a band at both ears, r + i m its cross-spectrum, and w its angular
    frequency. With g, the interaural level in dB over 20, and the delay t, equalisation and
    cancellation give

        10^g L + 10^-g R - 2 cos(w t) r - 2 sin(w t) m.

    The product of two such terms is a weighted sum of products of the features (L, R, r, m). Its
    mean over normally distributed errors of level and delay (equations 5 and 6, times sqrt(2) for
    two ears) has a closed form (equations 7 and 8).

    Returns:
        Weights. Those of squares are halved, because the caller adds both orders of a pair. Shape:
        (bands, pairs of features, delays * levels).
    """
    w = 2.0 * np.pi * LOWEST_CENTRE_HZ * 2.0 ** (np.arange(BANDS) / 3.0)[:, None, None]
    t, g = DELAYS[:, None], LEVELS / 20.0
    level_error = np.sqrt(2.0) * 1.5 / 20.0 * (1.0 + (np.abs(LEVELS) / 13.0) ** 1.6)
    delay_error = np.sqrt(2.0) * 65e-6 * (1.0 + np.abs(t) / 1.6e-3)
    # mean of 10^e, and mean of cos(w e), for a normal error e
    mean_gain = np.exp(0.5 * (np.log(10.0) * level_error) ** 2)
    mean_cosine = np.exp(-0.5 * (w * delay_error) ** 2)
    cosine, sine = mean_cosine * np.cos(w * t), mean_cosine * np.sin(w * t)
    cosine2, sine2 = mean_cosine**4 * np.cos(2.0 * w * t), mean_cosine**4 * np.sin(2.0 * w * t)
    left, right = mean_gain * 10.0**g, mean_gain * 10.0**-g
    products = [
        0.5 * mean_gain**4 * 10.0 ** (2.0 * g),  # L L
        1.0,  # L R
        -2.0 * left * cosine,  # L r
        -2.0 * left * sine,  # L m
        0.5 * mean_gain**4 * 10.0 ** (-2.0 * g),  # R R
        -2.0 * right * cosine,  # R r
        -2.0 * right * sine,  # R m
        1.0 + cosine2,  # r r
        2.0 * sine2,  # r m
        1.0 - cosine2,  # m m
    ]
    shape = BANDS, len(DELAYS), len(LEVELS)
    weights = [np.broadcast_to(product, shape) for product in products]
    return np.stack(weights, 1).reshape(BANDS, len(products), -1)
