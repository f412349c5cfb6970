"""Modified binaural STOI in torch: pyclarity 0.9.0's score, batched, differentiable, many times as fast.

Andersen, de Haan, Tan and Jensen 2018, "Refinement and validation of the binaural short time objective intelligibility
measure for spatially diverse conditions", Speech Communication 102, 1-13, doi 10.1016/j.specom.2018.06.001.

In each of 15 one-third-octave bands and each 0.4 s, an equalisation-cancellation stage delays one ear's signal, changes
its level and subtracts it from the other's, with the errors that listeners make. Of a grid of delays and levels it takes
those that leave most of the clean signal's modulation for that of the processed one. Where one ear alone does better,
that ear counts. The score is the mean correlation of the clean and the processed envelopes. What to know of it:

- It is of normal hearing and knows no level: a gain alone changes nothing. Of a listener with a loss give it what a
  simulator makes of the processed signals.
- It allows for no delay between ``processed`` and ``clean``: align them.
- Bands end at 4.3 kHz. A band where ``processed`` has nothing at all is scored by the rounding of the transforms.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.checks import Lengths, check_lengths, check_rate, check_waveform
from hlsim.dsp.fft import power, rfft
from hlsim.metrics.ear.model import Extent, integers
from hlsim.metrics.pair import cut_to_common_length
from hlsim.torchtools import constant_like

_RATE = 10000  # Hz that the measure works at
_FRAME, _HOP, _POINTS = (
    256,
    128,
    512,
)  # samples of a frame, from frame to frame, and of its transform
_SEGMENT = 30  # frames that are correlated, 0.4 s
_BANDS, _LOWEST_CENTRE = 15, 150.0  # one-third octaves, and the lowest one's centre in Hz
_RANGE_DB = 40.0  # below the loudest frame, under which clean speech counts as silent

_DELAYS = np.linspace(-1e-3, 1e-3, 100)  # seconds
_LEVELS = np.linspace(-20.0, 20.0, 40)  # dB

# values of the grid that are compared at once: what fits the cache of a CPU, and what occupies a GPU
_TOGETHER_CPU, _TOGETHER_GPU = 2**17, 2**25

# of the left and the right ear's power and the real and the imaginary part of their cross-spectrum
_PAIRS = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3))
_EARS = (_PAIRS.index((0, 0)), _PAIRS.index((1, 1)))


def mbstoi(
    processed: Tensor, clean: Tensor, *, sample_rate: int = 16000, lengths: Lengths | None = None
) -> Tensor:
    """Compute MBSTOI, the predicted intelligibility of speech that is heard with two ears.

    The score lies between 0 and 1, approximately. It is deterministic and has a gradient with
    respect to both signals. The gradient treats the discrete decisions of the algorithm as
    constants: which frames are speech, the interaural delays and levels, and the better ear.

    Args:
        processed: Processed speech at the two ears, left first, ``(..., 2, time)``.
        clean: Clean speech at the two ears, time-aligned with it, ``(..., 2, time)``.
        sample_rate: Sample rate in Hz, 16000 to 48000.
        lengths: Number of samples of each item of a padded batch, ``(...,)``. Without it, zeros at
            the end of an item change its score by up to 0.007.

    Returns:
        Scores, ``(...,)``, computed in float64 where the device supports it.

    Raises:
        ValueError: The shapes differ, the clean speech is silent or lasts less than 0.41 s without
            its pauses, a sample is NaN or infinite, or a rate or length is out of range.

    Source:
        Andersen, de Haan, Tan and Jensen 2018, "Refinement and validation of the binaural short
        time objective intelligibility measure for spatially diverse conditions", Speech
        Communication 102; as in pyclarity 0.9.0.

    Example:
        >>> import torch
        >>> from hlsim import example_speech
        >>> from hlsim.metrics import mbstoi
        >>> clean = torch.stack([example_speech(), example_speech()])
        >>> round(float(mbstoi(clean, clean)), 2)
        1.0
    """
    rate = check_rate(sample_rate)
    processed, clean, lengths = cut_to_common_length(processed, clean, rate, lengths)
    _check_shapes(processed, clean)
    items = clean.shape[:-2]
    ends = [clean.shape[-1]] * items.numel()
    if lengths is not None:
        ends = check_lengths(lengths, torch.Size((*items, clean.shape[-1]))).flatten().tolist()
    dtype = torch.promote_types(processed.dtype, clean.dtype)
    precision = torch.float32 if processed.device.type == "mps" else torch.float64
    with torch.autocast(processed.device.type, enabled=False):
        signals = torch.stack([clean, processed], -3).to(precision).reshape(-1, 4, clean.shape[-1])
        _check_values(signals)
        resampled, extent = _resample_items(signals, tuple(ends), rate)
        frames, counts = _without_silence(resampled, extent)
        envelopes = _band_envelopes(frames.unflatten(1, (2, 2)))
        # for each item and each start the frames from there on that make a segment
        windows = envelopes.unfold(1, _SEGMENT, 1)
        segments = np.array(counts) - _SEGMENT
        # the last segment of an item is left to the equalisation-cancellation stage, as in the reference
        item = np.repeat(np.arange(len(segments)), segments)
        start = np.concatenate([np.arange(count) for count in segments])
        chosen = np.stack((item, start, start < segments[item] - 1))
        together = _TOGETHER_CPU if signals.device.type == "cpu" else _TOGETHER_GPU
        step = together // (len(_DELAYS) * len(_LEVELS))
        places = _moved(chosen, signals.device)
        scores = [
            _correlations(windows[part[0], part[1]], part[2].bool())
            for part in places.split(step, -1)
        ]
        total = signals.new_zeros(len(segments)).index_add(0, places[0], torch.cat(scores))
        return (total / _moved(segments, signals.device)).to(dtype).reshape(items)


def _moved(values: NDArray[np.int64], device: torch.device) -> Tensor:
    """Return whole numbers on a device, without making the host wait for it."""
    return torch.from_numpy(values).to(device, non_blocking=device.type != "cpu")


def _check_shapes(processed: Tensor, clean: Tensor) -> None:
    for signal, name in ((processed, "processed"), (clean, "clean")):
        check_waveform(signal, name)
        if signal.ndim < 2 or signal.shape[-2] != 2:
            raise ValueError(
                f"expected {name} of shape (..., 2, time), left ear first, "
                f"got {tuple(signal.shape)}"
            )
    if processed.shape != clean.shape:
        raise ValueError(
            f"expected signals of the same shape, got processed {tuple(processed.shape)} "
            f"and clean {tuple(clean.shape)}"
        )
    if processed.device != clean.device:
        raise ValueError(
            f"expected signals on the same device, got processed on {processed.device} "
            f"and clean on {clean.device}; move one of them with .to(device)"
        )


def _check_values(signals: Tensor) -> None:
    """Validate clean and processed signals. The host waits for the device once. Shape: (items, 4, time)."""
    finite = signals.detach().isfinite().all(-1).all(0)
    sounding = signals.detach()[:, :2].flatten(1).any(-1).all()
    values = torch.cat((finite, sounding[None])).tolist()
    for name, ears in (("processed", values[2:4]), ("clean", values[:2])):
        if not all(ears):
            raise ValueError(f"{name} holds samples that are NaN or infinite")
    if not values[4]:
        raise ValueError("clean is silent, every sample of an item is zero")


def _resample_items(signals: Tensor, ends: tuple[int, ...], rate: int) -> tuple[Tensor, Extent]:
    """Resample items, those of one length together, for the method depends on the length.

    Shape: (items, 4, time) -> (items, 4, longest), zero after the ends.
    """
    if min(ends) == max(ends):
        resampled = _resample(signals[..., : ends[0]], rate)
        return resampled, Extent((resampled.shape[-1],) * len(ends))
    by_end: dict[int, list[int]] = {}
    for item, end in enumerate(ends):
        by_end.setdefault(end, []).append(item)
    rows: dict[int, Tensor] = {}
    for end, members in by_end.items():
        chosen = signals.index_select(0, integers(tuple(members), signals.device))
        rows |= zip(members, _resample(chosen[..., :end], rate), strict=True)
    extent = Extent(tuple(rows[item].shape[-1] for item in range(len(ends))))
    padded = [
        functional.pad(rows[item], (0, extent.longest - rows[item].shape[-1]))
        for item in range(len(ends))
    ]
    return torch.stack(padded), extent


def _resample(signals: Tensor, rate: int) -> Tensor:
    """To 10 kHz by Fourier coefficients, and a sample more, as the reference. Shape: (..., time) -> (..., points)."""
    time = signals.shape[-1]
    points = int(time * (_RATE / rate) + 1)
    spectrum = rfft(signals)[..., : points // 2 + 1]
    if points % 2 == 0:  # the last coefficient stands for two
        spectrum = torch.cat([spectrum[..., :-1], 2.0 * spectrum[..., -1:]], -1)
    return torch.fft.irfft(spectrum, points) * (points / time)


def _without_silence(signals: Tensor, extent: Extent) -> tuple[Tensor, list[int]]:
    """Leave out the frames where the clean speech is silent at both ears, and overlap and add the others.

    The host waits for the device once.

    Args:
        signals: the left and the right ear's clean signal, then the processed ones. Shape: (items, 4, time).

    Returns: (items, 4, frames, samples), and the number of frames of each item.
    """
    # the reference leaves out a frame that ends with the signal
    frames_of = tuple(max(0, (end - 1 - _FRAME) // _HOP + 1) for end in extent.ends)
    padded = max(_FRAME, extent.longest - 1)
    rows = functional.pad(signals, (0, max(0, padded - signals.shape[-1])))[..., :padded]
    window = constant_like(rows, _window)
    frames = rows.unfold(-1, _FRAME, _HOP) * window
    places = torch.arange(frames.shape[2], device=rows.device)
    there = places < integers(frames_of, rows.device)[:, None]
    norms = frames.detach()[:, :2].norm(dim=-1) * there[:, None]
    levels = 20.0 * torch.log10(norms + np.finfo(np.float64).eps)
    active = (levels.amax(-1, keepdim=True) - _RANGE_DB < levels).any(1) & there
    counts = active.sum(-1).tolist()
    fewest = min(counts)
    if fewest <= _SEGMENT:
        item = f" in item {counts.index(fewest)}" if len(counts) > 1 else ""
        raise ValueError(
            f"expected at least {_seconds(_SEGMENT + 1):.2g} s of clean speech within {_RANGE_DB:g} dB "
            f"of its loudest frame{item}, got {_seconds(fewest):.2g} s"
        )
    order = (~active).byte().argsort(dim=-1, stable=True)[:, : max(counts)]
    used = Extent(tuple(counts)).inside(rows.device)
    kept = frames.take_along_dim(order[:, None, :, None], 2) * used[:, None, :, None]
    hops = functional.pad(kept[..., :_HOP], (0, 0, 0, 1)) + functional.pad(
        kept[..., _HOP:], (0, 0, 1, 0)
    )
    return torch.cat([hops[..., :-1, :], hops[..., 1:, :]], -1) * window, counts


def _seconds(frames: int) -> float:
    return (frames + 1) * _HOP / _RATE if frames else 0.0


def _band_envelopes(frames: Tensor) -> Tensor:
    """Compute the power of each band at both ears, and the real and imaginary parts of its
    cross-spectrum.

    Shape: (items, clean and processed, left and right, frames, samples) -> (items, frames, bands, 8).
    """
    spectrum = rfft(functional.pad(frames, (0, _POINTS - _FRAME)))
    left, right = spectrum.unbind(2)
    cross = left * right.conj()
    features = torch.stack([power(left), power(right), cross.real, cross.imag], 2)
    bands = features @ constant_like(frames, _band_matrix)
    return bands.flatten(1, 2).permute(0, 2, 3, 1)


def _correlations(windows: Tensor, single: Tensor) -> Tensor:
    """Compute the mean over bands of the correlation between clean and processed envelopes.

    The envelopes are those after equalisation and cancellation with the best delay and level, or of
    one ear if that is better.

    Args:
        windows: segments of the output of ``_band_envelopes``.
        single: whether one ear alone may be used.

    Shape: (segments, bands, 8, frames), (segments,) -> (segments,).
    """
    centred = windows - windows.mean(-1, keepdim=True)
    products = centred @ centred.transpose(-1, -2)
    first, second = (integers(places, windows.device) for places in zip(*_PAIRS, strict=True))
    ears = integers(_EARS, windows.device)
    clean, both, given = (
        (part + part.transpose(-1, -2))[..., first, second]
        for part in (products[..., :4, :4], products[..., :4, 4:], products[..., 4:, 4:])
    )
    grid = constant_like(windows, _jittered)
    with torch.no_grad():
        place, gain = _best(clean, given, grid)
        nothing = ~(clean.any(-1) & given.any(-1))
        gain = torch.where(nothing, 0.0, gain)
        left, right = (clean.index_select(-1, ears) / given.index_select(-1, ears)).unbind(-1)
        # NaN, where both signals of an ear are silent, is no better
        alone = (torch.maximum(left, right) > gain) & single[:, None]
        ear = torch.where(left > right, _EARS[0], _EARS[1]).unsqueeze(-1)
    weights = grid[torch.arange(_BANDS, device=place.device), :, place]
    cancelled = _correlation(*((part * weights).sum(-1) for part in (both, clean, given)))
    cancelled = torch.where(nothing, -1.0, cancelled)
    one_ear = _correlation(*(part.take_along_dim(ear, -1)[..., 0] for part in (both, clean, given)))
    return torch.where(alone, one_ear, cancelled).mean(-1)


def _correlation(both: Tensor, clean: Tensor, given: Tensor) -> Tensor:
    """0 where a signal has no modulation."""
    sound = (clean > 0.0) & (given > 0.0)
    clean, given = torch.where(sound, clean, 1.0), torch.where(sound, given, 1.0)
    return torch.where(sound, both * clean.rsqrt() * given.rsqrt(), 0.0)


def _best(clean: Tensor, given: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
    """Where on the grid most is left of the clean signal's modulation for that of the given, and how much.

    Shape: (segments, bands, pairs) twice, (bands, pairs, grid) -> (segments, bands) twice.
    """
    found = [
        (clean[:, band] @ pairs).div_(given[:, band] @ pairs).max(-1)
        for band, pairs in enumerate(grid)
    ]
    gain, place = (torch.stack(part, -1) for part in zip(*found, strict=True))
    return place, gain


def _window() -> NDArray[np.float64]:
    """Hann, without the zeros at its ends."""
    window: NDArray[np.float64] = np.hanning(_FRAME + 2)[1:-1]
    return window


def _band_matrix() -> NDArray[np.float64]:
    """Which frequencies are in which band; edges at the nearest frequency. Returns (frequencies, bands)."""
    bins = np.arange(_POINTS // 2 + 1)
    edges = _LOWEST_CENTRE * 2.0 ** ((2.0 * np.arange(_BANDS + 1) - 1.0) / 6.0)
    places = np.rint(edges * _POINTS / _RATE)
    return ((bins[:, None] >= places[:-1]) & (bins[:, None] < places[1:])).astype(np.float64)


def _jittered() -> NDArray[np.float64]:
    """Compute the weights of products of band features after equalisation and cancellation.

    Let L and R be the powers of a band at both ears, r + i m its cross-spectrum, and w its angular
    frequency. With the levels g and -g and the delay t, equalisation and cancellation give

        10^g L + 10^-g R - 2 cos(w t) r - 2 sin(w t) m.

    The product of two such terms is a weighted sum of products of the features (L, R, r, m). Its
    mean over normally distributed errors of level and delay (equations 5 and 6, times sqrt(2) for
    two ears) has a closed form (equations 7 and 8).

    Returns: weights, (bands, pairs of features, delays * levels).
    """
    w = 2.0 * np.pi * _LOWEST_CENTRE * 2.0 ** (np.arange(_BANDS) / 3.0)[:, None, None]
    t, g = _DELAYS[:, None], _LEVELS / 20.0
    level_error = np.sqrt(2.0) * 1.5 / 20.0 * (1.0 + (np.abs(_LEVELS) / 13.0) ** 1.6)
    delay_error = np.sqrt(2.0) * 65e-6 * (1.0 + np.abs(t) / 1.6e-3)
    # means of 10^e, of cos(w e) and of their squares, of a normal error e
    raised = np.exp(0.5 * (np.log(10.0) * level_error) ** 2)
    turned = np.exp(-0.5 * (w * delay_error) ** 2)
    cosine, sine = turned * np.cos(w * t), turned * np.sin(w * t)
    cosine2, sine2 = turned**4 * np.cos(2.0 * w * t), turned**4 * np.sin(2.0 * w * t)
    left, right = raised * 10.0**g, raised * 10.0**-g
    entries = {
        (0, 0): 0.5 * raised**4 * 10.0 ** (2.0 * g),
        (0, 1): 1.0,
        (0, 2): -2.0 * left * cosine,
        (0, 3): -2.0 * left * sine,
        (1, 1): 0.5 * raised**4 * 10.0 ** (-2.0 * g),
        (1, 2): -2.0 * right * cosine,
        (1, 3): -2.0 * right * sine,
        (2, 2): 1.0 + cosine2,
        (2, 3): 2.0 * sine2,
        (3, 3): 1.0 - cosine2,
    }
    made = [np.broadcast_to(entries[pair], (_BANDS, len(_DELAYS), len(_LEVELS))) for pair in _PAIRS]
    return np.stack(made, 1).reshape(_BANDS, len(_PAIRS), -1)
