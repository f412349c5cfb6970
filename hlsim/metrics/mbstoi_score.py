"""MBSTOI in PyTorch: the intelligibility of speech that a listener receives with two ears.

The score is that of pyclarity 0.9.0, with a gradient. In 15 one-third-octave bands and segments of
0.4 s, a model of the brain delays the signal of one ear, changes its level and subtracts it from
that of the other ear, with the errors that listeners make. The delay and the level are those that
maximise the ratio of clean to processed modulation. Where one ear has a larger ratio, that ear
counts. The score is the mean correlation of the clean and the processed envelopes. Please note:

- MBSTOI assumes normal hearing and ignores the level. For a listener with a hearing loss, apply a
  simulator to the processed signals first.
- Signals are not aligned. Align ``processed`` with ``clean`` first.
- The bands end at 4.3 kHz. A band in which ``processed`` is silent has an arbitrary correlation,
  that of rounding errors.

Source: Andersen, de Haan, Tan and Jensen 2018, "Refinement and validation of the binaural short
time objective intelligibility measure for spatially diverse conditions", Speech Communication 102,
1-13, doi 10.1016/j.specom.2018.06.001.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram.listener import EARS
from hlsim.audiogram.thresholds import check_two_channels
from hlsim.checks import Lengths, check_lengths
from hlsim.dsp.fft import power, rfft
from hlsim.metrics.ear.extent import Extent, integers
from hlsim.metrics.pair import cut_to_common_length
from hlsim.metrics.reference import map_on_cores
from hlsim.torchtools import constant_like

RATE = 10000
"""Sample rate in Hz at which the score is defined."""

FRAME, HOP, POINTS = 256, 128, 512
"""Samples of a frame, samples between frames, and points of a frame's Fourier transform."""

SEGMENT = 30
"""Frames that are correlated, 0.4 s."""

BANDS, LOWEST_CENTRE_HZ = 15, 150.0
"""Number of one-third-octave bands, and centre of the lowest one."""

RANGE_DB = 40.0
"""Level below that of the loudest frame at which clean speech counts as silent."""

DELAYS = np.linspace(-1e-3, 1e-3, 100)
"""Interaural delays in seconds that are compared."""

LEVELS = np.linspace(-20.0, 20.0, 40)
"""Interaural levels in dB that are compared."""

CPU_SEGMENTS, GPU_SEGMENTS = 2**17 // 4000, 2**25 // 4000
"""Segments that are computed at once. Each takes 4000 values per band."""

PAIRS = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))
"""Pairs of the four features of a band: the powers of the left and of the right ear, and the real
and the imaginary part of their cross-spectrum."""

LEFT_PAIR, RIGHT_PAIR = PAIRS.index((0, 0)), PAIRS.index((1, 1))
"""Positions in ``PAIRS`` of the power of the left and of the right ear alone."""


def mbstoi(
    processed: Tensor, clean: Tensor, *, sample_rate: int = 16000, lengths: Lengths | None = None
) -> Tensor:
    """Compute MBSTOI of each item: the intelligibility of speech at two ears, about 0 to 1.

    The score is deterministic and differentiable in both signals. Decisions are constants for the
    gradient: which frames are speech, the interaural delays and levels, and the better ear. Scores
    are computed in float64 where the device supports it.

    Args:
        processed: Processed speech at the left and the right ear. Shape: (..., 2, time).
        clean: Clean speech at the left and the right ear, time-aligned with ``processed``. Shape:
            (..., 2, time).
        sample_rate: Sample rate in Hz, 16000 to 48000.
        lengths: Number of samples of each item in a padded batch. Without it, zeros at the end of
            an item change its score by up to 0.007. Shape: (...).

    Returns:
        Scores. Shape: (...).

    Raises:
        ValueError: Signals of other shapes, on different devices or not finite; clean speech that
            is silent or lasts less than 0.41 s without its pauses; a rate or length out of range.

    >>> from hlsim import example_speech
    >>> clean = torch.stack([example_speech(), example_speech()])
    >>> round(float(mbstoi(clean, clean)), 2)
    1.0
    """
    equally_long = cut_to_common_length(processed, clean, sample_rate)
    longest = max(processed.shape[-1], clean.shape[-1])
    processed, clean = equally_long
    check_two_channels(clean)
    items, time = clean.shape[:-2], clean.shape[-1]
    ends = [time] * items.numel()
    if lengths is not None:
        all_ends = check_lengths(lengths, torch.Size((*items, longest)))
        ends = all_ends.clamp_max(time).flatten().tolist()
    dtype = torch.promote_types(processed.dtype, clean.dtype)
    precision = torch.float32 if processed.device.type == "mps" else torch.float64
    with torch.autocast(processed.device.type, enabled=False):
        signals = torch.stack([clean, processed], -3).to(precision).reshape(-1, 4, time)
        _check_values(signals)
        frames, counts = _remove_silence(*_resample_items(signals, ends, sample_rate))
        envelopes = _band_features(frames.unflatten(1, (2, 2)))
        return _mean_correlation(envelopes, counts).to(dtype).reshape(items)


def _mean_correlation(features: Tensor, counts: tuple[int, ...]) -> Tensor:
    """Compute the mean correlation over all segments of each item.

    Args:
        features: Output of ``_band_features``.
        counts: Number of frames of each item.

    Returns:
        Scores. Shape: (items,).
    """
    device = features.device
    windows = features.unfold(1, SEGMENT, 1)  # a segment begins at every frame
    segments = integers(counts, device) - SEGMENT
    total = sum(counts) - SEGMENT * len(counts)
    item = torch.arange(len(counts), device=device)
    item = item.repeat_interleave(segments, output_size=total)
    start = torch.arange(total, device=device) - (segments.cumsum(0) - segments)[item]
    # As in pyclarity, one ear alone is not used in the last segment of an item.
    may_use_one_ear = start < segments[item] - 1
    segments_at_once = CPU_SEGMENTS if device.type == "cpu" else GPU_SEGMENTS
    groups = torch.arange(total, device=device).split(segments_at_once)

    def correlate(group: Tensor) -> Tensor:
        return _correlate(windows[item[group], start[group]], may_use_one_ear[group])

    if len(counts) == 1:  # a single item is so short that starting threads costs more
        correlations = [correlate(group) for group in groups]
    else:
        correlations = map_on_cores(correlate, groups, features)
    sums = features.new_zeros(len(counts)).index_add(0, item, torch.cat(correlations))
    return sums / segments


def _check_values(signals: Tensor) -> None:
    """Raise ValueError unless all samples are finite and clean speech is not silent.

    The host waits for the device once.

    Args:
        signals: Clean speech at the left and the right ear, then processed speech. Shape: (items,
            4, time).
    """
    is_finite = signals.detach().isfinite().all(-1)
    is_sounding = signals.detach()[:, :2].flatten(1).any(-1, keepdim=True)
    names = [f"{signal} at the {ear} ear" for signal in ("clean", "processed") for ear in EARS]
    for index, (*finite, sounding) in enumerate(torch.cat((is_finite, is_sounding), 1).tolist()):
        item = f" of item {index}" if len(signals) > 1 else ""
        if not all(finite):
            raise ValueError(
                f"{names[finite.index(False)]}{item} holds samples that are NaN or infinite; "
                "remove them, or leave the item out"
            )
        if not sounding:
            raise ValueError(
                f"clean{item} is silent at the left and the right ear, so there is nothing to "
                "compare with; leave the item out"
            )


def _resample_items(signals: Tensor, ends: list[int], rate: int) -> tuple[Tensor, Extent]:
    """Resample items to 10 kHz, each by itself if their lengths differ, as pyclarity does.

    Args:
        signals: Signals. Shape: (items, 4, time).
        ends: Number of samples of each item before padding.
        rate: Sample rate in Hz.

    Returns:
        Resampled signals, zero after the end of each item, (items, 4, longest), and the number of
        samples of each item.
    """
    if min(ends) == max(ends):
        resampled = _resample(signals[..., : ends[0]], rate)
        return resampled, Extent((resampled.shape[-1],) * len(ends))
    items = [_resample(item[:, :end], rate) for item, end in zip(signals, ends, strict=True)]
    extent = Extent(tuple(item.shape[-1] for item in items))
    padded = [functional.pad(item, (0, extent.longest - item.shape[-1])) for item in items]
    return torch.stack(padded), extent


def _resample(signals: Tensor, rate: int) -> Tensor:
    """Resample signals to 10 kHz in the frequency domain, with one sample more, as pyclarity does.

    Shape: (..., time) -> (..., points).
    """
    time = signals.shape[-1]
    points = int(time * (RATE / rate) + 1)
    spectrum = rfft(signals)[..., : points // 2 + 1]
    if points % 2 == 0:  # the last coefficient stands for two
        spectrum = torch.cat([spectrum[..., :-1], 2.0 * spectrum[..., -1:]], -1)
    return torch.fft.irfft(spectrum, points) * (points / time)


def _remove_silence(signals: Tensor, extent: Extent) -> tuple[Tensor, tuple[int, ...]]:
    """Remove the frames where clean speech is silent at both ears, and overlap and add the others.

    The host waits for the device once.

    Args:
        signals: Clean signals of the left and the right ear, then the processed ones. Shape:
            (items, 4, time).
        extent: Number of samples of each item before padding.

    Returns:
        Windowed frames of the shortened signals, (items, 4, frames, 256), and the number of frames
        of each item.

    Raises:
        ValueError: Too few frames remain for a segment.
    """
    # As in pyclarity, a frame that ends with the signal is left out.
    frames_of = tuple(max(0, (end - 1 - FRAME) // HOP + 1) for end in extent.ends)
    padded = max(FRAME, extent.longest - 1)
    rows = functional.pad(signals, (0, max(0, padded - signals.shape[-1])))[..., :padded]
    window = constant_like(rows, _window)
    frames = rows.unfold(-1, FRAME, HOP) * window
    indices = torch.arange(frames.shape[2], device=rows.device)
    is_inside = indices < integers(frames_of, rows.device)[:, None]
    norms = frames.detach()[:, :2].norm(dim=-1) * is_inside[:, None]
    levels = 20.0 * torch.log10(norms + np.finfo(np.float64).eps)
    is_loud = levels > levels.amax(-1, keepdim=True) - RANGE_DB
    is_active = is_loud.any(1) & is_inside
    counts = tuple(is_active.sum(-1).tolist())
    if min(counts) <= SEGMENT:
        item = f" in item {counts.index(min(counts))}" if len(counts) > 1 else ""
        raise ValueError(
            f"expected at least {_seconds(SEGMENT + 1):.2g} s of clean speech within "
            f"{RANGE_DB:g} dB of its loudest frame{item}, got {_seconds(min(counts)):.2g} s; pass "
            "longer signals"
        )
    order = (~is_active).byte().argsort(dim=-1, stable=True)[:, : max(counts)]
    is_used = Extent(counts).inside(rows.device)
    active = frames.take_along_dim(order[:, None, :, None], 2) * is_used[:, None, :, None]
    first_halves = functional.pad(active[..., :HOP], (0, 0, 0, 1))
    second_halves = functional.pad(active[..., HOP:], (0, 0, 1, 0))
    hops = first_halves + second_halves
    return torch.cat([hops[..., :-1, :], hops[..., 1:, :]], -1) * window, counts


def _seconds(frames: int) -> float:
    return (frames + 1) * HOP / RATE if frames else 0.0


def _window() -> NDArray[np.float64]:
    """Return a Hann window without the zeros at its ends."""
    window: NDArray[np.float64] = np.hanning(FRAME + 2)[1:-1]
    return window


def _band_features(frames: Tensor) -> Tensor:
    """Compute the four features of each band, which ``PAIRS`` names, in each frame.

    Args:
        frames: Windowed frames of clean, then processed speech at the left, then the right ear.
            Shape: (items, 2, 2, frames, 256).

    Returns:
        Features of clean, then processed speech. Shape: (items, frames, bands, 8).
    """
    spectrum = rfft(functional.pad(frames, (0, POINTS - FRAME)))
    left, right = spectrum.unbind(2)
    cross = left * right.conj()
    features = torch.stack([power(left), power(right), cross.real, cross.imag], 2)
    bands = features @ constant_like(frames, _band_matrix)
    return bands.flatten(1, 2).permute(0, 2, 3, 1)


def _band_matrix() -> NDArray[np.float64]:
    """Return 1 where a frequency lies in a band, and 0 elsewhere: (frequencies, bands)."""
    bins = np.arange(POINTS // 2 + 1)[:, None]
    edges = LOWEST_CENTRE_HZ * 2.0 ** ((2.0 * np.arange(BANDS + 1) - 1.0) / 6.0)
    edge_bins = np.rint(edges * POINTS / RATE)
    return ((bins >= edge_bins[:-1]) & (bins < edge_bins[1:])).astype(np.float64)


def _correlate(windows: Tensor, may_use_one_ear: Tensor) -> Tensor:
    """Compute the mean correlation of clean and processed envelopes over bands, for each segment.

    The envelopes are those after equalisation and cancellation with the best delay and level, or
    those of one ear if it is better.

    Args:
        windows: Segments of the output of ``_band_features``. Shape: (segments, bands, 8, frames).
        may_use_one_ear: Whether one ear alone may be used. Shape: (segments,).

    Returns:
        Correlations. Shape: (segments,).
    """
    centred = windows - windows.mean(-1, keepdim=True)
    products = centred @ centred.transpose(-1, -2)
    first, second = (integers(features, windows.device) for features in zip(*PAIRS, strict=True))
    clean, both, processed = (
        (part + part.transpose(-1, -2))[..., first, second]
        for part in (products[..., :4, :4], products[..., :4, 4:], products[..., 4:, 4:])
    )
    grid = constant_like(windows, _cancellation_weights)
    with torch.no_grad():
        ratio, index = _find_largest_ratio(clean, processed, grid)
        is_silent = ~(clean.any(-1) & processed.any(-1))
        ratio = torch.where(is_silent, 0.0, ratio)
        ears = integers((LEFT_PAIR, RIGHT_PAIR), windows.device)
        of_ears = clean.index_select(-1, ears) / processed.index_select(-1, ears)
        left, right = of_ears.unbind(-1)
        # The ratio of an ear where both signals are silent is NaN, which is not larger.
        one_ear_is_better = (torch.maximum(left, right) > ratio) & may_use_one_ear[:, None]
        better_ear = torch.where(left > right, LEFT_PAIR, RIGHT_PAIR).unsqueeze(-1)
    weights = grid[torch.arange(BANDS, device=index.device), :, index]
    cancelled = _correlation(*((part * weights).sum(-1) for part in (both, clean, processed)))
    cancelled = torch.where(is_silent, -1.0, cancelled)
    one_ear = _correlation(
        *(part.take_along_dim(better_ear, -1)[..., 0] for part in (both, clean, processed))
    )
    return torch.where(one_ear_is_better, one_ear, cancelled).mean(-1)


def _correlation(both: Tensor, clean: Tensor, processed: Tensor) -> Tensor:
    """Divide covariances by standard deviations; 0 where a signal has no modulation.

    Args:
        both: Covariances of clean and processed envelopes.
        clean, processed: Variances of both.
    """
    is_varying = (clean > 0.0) & (processed > 0.0)
    clean, processed = (torch.where(is_varying, part, 1.0) for part in (clean, processed))
    return torch.where(is_varying, both * clean.rsqrt() * processed.rsqrt(), 0.0)


def _find_largest_ratio(clean: Tensor, processed: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
    """Find the delay and level with the largest ratio of clean to processed modulation.

    Args:
        clean, processed: Products of features. Shape: (segments, bands, pairs).
        grid: Output of ``_cancellation_weights``. Shape: (bands, pairs, delays * levels).

    Returns:
        Largest ratios, and the indices of their delays and levels. Shape: (segments, bands) each.
    """
    largest = [
        (clean[:, band] @ weights).div_(processed[:, band] @ weights).max(-1)
        for band, weights in enumerate(grid)
    ]
    ratios, indices = zip(*largest, strict=True)
    return torch.stack(ratios, -1), torch.stack(indices, -1)


def _cancellation_weights() -> NDArray[np.float64]:
    """Compute the weights of products of band features after equalisation and cancellation.

    Let L and R be the powers of a band at both ears, r + i m its cross-spectrum, and w its angular
    frequency. With the levels g and -g and the delay t, equalisation and cancellation give

        10^g L + 10^-g R - 2 cos(w t) r - 2 sin(w t) m.

    The product of two such terms is a weighted sum of products of the features (L, R, r, m). Its
    mean over normally distributed errors of level and delay (equations 5 and 6, times sqrt(2) for
    two ears) has a closed form (equations 7 and 8).

    Returns:
        Weights. Shape: (bands, pairs of features, delays * levels).
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
    entries = {
        (0, 0): 0.5 * mean_gain**4 * 10.0 ** (2.0 * g),
        (0, 1): 1.0,
        (0, 2): -2.0 * left * cosine,
        (0, 3): -2.0 * left * sine,
        (1, 1): 0.5 * mean_gain**4 * 10.0 ** (-2.0 * g),
        (1, 2): -2.0 * right * cosine,
        (1, 3): -2.0 * right * sine,
        (2, 2): 1.0 + cosine2,
        (2, 3): 2.0 * sine2,
        (3, 3): 1.0 - cosine2,
    }
    shape = BANDS, len(DELAYS), len(LEVELS)
    weights = [np.broadcast_to(entries[pair], shape) for pair in PAIRS]
    return np.stack(weights, 1).reshape(BANDS, len(PAIRS), -1)
