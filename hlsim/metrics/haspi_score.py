"""HASPI version 2 in PyTorch: the intelligibility of speech in an impaired ear.

The score is that of pyclarity 0.9.0, with a gradient. Please note:

- HASPI rewards gain: 20 dB took one utterance from 0.53 to 0.99. Report the level beside the score.
- White noise in place of the processed speech should score 0. It does to within 0.05 on utterances
  of 3 s and more, but scores up to 0.3 on 1.2 s, 0.45 on 0.7 s and 0.99 on 0.2 s. Signals shorter
  than 0.7 s are rejected.
- If the reference is below the threshold of hearing, every signal has the same score. References
  below 20 dB SPL are rejected. A constant offset does not count as level.
- The ear spans 80 to 8000 Hz. Between 16 and 48 kHz, scores differ by up to 0.008. Compare scores
  of one rate.
- Signals and channels are aligned by whole samples. One sample in one channel changes a score by up
  to 0.006. Where two delays match equally well, single precision may choose another one than double
  precision.

Source: Kates and Arehart 2021, "The hearing-aid speech perception index (HASPI) version 2", Speech
Communication 131, 35-46, doi 10.1016/j.specom.2020.05.001.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import Lengths
from hlsim.metrics.ear import envelope_modulation as envelopes
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.clean_speech import CleanBatch, CleanSpeech
from hlsim.metrics.ear.model import CHANNELS, Extent
from hlsim.metrics.pair import Noise, match_pair
from hlsim.metrics.reference import PreparedBatch, Reference, Settings, map_on_cores
from hlsim.torchtools import constant, not_compiled


@not_compiled  # tracing takes minutes
def haspi(
    processed: Tensor,
    clean: Tensor,
    audiogram: AudiogramLike,
    *,
    sample_rate: int = 16000,
    full_scale_spl: float = PASCAL_SPL,
    lengths: Lengths | None = None,
    noise: Noise = "expected",
    seed: int | Sequence[int] = 0,
    whole_khz: bool = False,
) -> Tensor:
    """Compute HASPI version 2 of each item: the intelligibility for an impaired ear, 0 to 1.

    The score compares the processed signal in the impaired ear with clean speech in a normal ear. A
    delay of ``processed`` does not count. A silent ``processed`` has the score of the ear's noise.
    The score is differentiable in ``processed``; the delays that align it are constant. Bands that
    are inaudible have no gradient. ``HaspiReference`` prepares clean speech once for many scores.

    The result is float64 if one of the signals is, and float32 otherwise. On CUDA, leave
    ``torch.backends.cuda.matmul.allow_tf32`` off, as it is by default. The thresholds of an ear on
    a GPU are not read by the host: if they are out of range, the score is NaN.

    Args:
        processed: Signal at the impaired ear, at least 0.7 s long.
        clean: Clean speech, not amplified. Lengths of both that differ by 0.1 s at most are cut to
            the shorter one, with a warning.
        audiogram: The impaired ear, -10 to 120 dB HL; one ear, or one for each item. Its
            thresholds at 250, 500, 1000, 2000, 4000 and 6000 Hz count, interpolated over log
            frequency where they were not measured.
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0 (pyclarity's ``level1``).
        lengths: Number of samples of each item in a padded batch.
        noise: ``"expected"`` computes the mean over seeds, which is smooth and the same every time;
            ``"seeded"`` draws the noise that pyclarity draws with ``seed`` (scores vary by up to
            0.007); ``"none"`` leaves it out.
        seed: One seed, or one for each item.
        whole_khz: Round the rate to whole kHz, as pyclarity does. From 44.1 to 44 kHz, scores
            change by up to 0.005.

    Shape: (..., time) twice, and (..., 8) dB HL -> (...,).

    Raises:
        ValueError: Signals of other shapes, too short, or not finite; clean speech that is silent
            or below 20 dB SPL; a rate, level, audiogram, length or seed out of range.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> bool(haspi(speech, speech, "N4") < haspi(speech, speech, "NH"))
    True
    """
    processed, clean, lengths = match_pair(processed, clean, sample_rate, lengths)
    reference = HaspiReference(
        clean,
        sample_rate=sample_rate,
        full_scale_spl=full_scale_spl,
        lengths=lengths,
        whole_khz=whole_khz,
        keep=False,
    )
    return reference.score(processed, audiogram, noise=noise, seed=seed)


class HaspiReference(Reference["_Batch"]):
    """Clean speech in a normal ear, prepared for the HASPI of many processed signals.

    It does not depend on an audiogram. In float32 it takes about 4 MB per second of speech.

    Args:
        clean: Clean speech, not amplified. The scores have its dtype and its device. Its gradient
            is not computed.
        settings: ``sample_rate``, ``full_scale_spl``, ``lengths`` and ``whole_khz`` as for
            ``haspi``. ``keep=False`` computes the clean signal's features for each score instead
            of storing them, which takes less memory.

    Raises:
        ValueError: As for ``haspi``.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> reference = HaspiReference(speech)
    >>> bool(reference.score(0.1 * speech, "N3") < reference.score(speech, "N3"))
    True
    """

    score_name = "HASPI"

    def __init__(self, clean: Tensor, **settings: Unpack[Settings]) -> None:
        super().__init__(clean, **settings)

    def _prepare_batches(self, signals: CleanSpeech) -> list[_Batch]:
        return map_on_cores(lambda batch: _Batch(signals, batch), signals.batches, signals.clean)

    def score(
        self,
        processed: Tensor,
        audiogram: AudiogramLike,
        *,
        noise: Noise = "expected",
        seed: int | Sequence[int] = 0,
    ) -> Tensor:
        """Return the HASPI of each processed signal.

        Args:
            processed: Signals of the shape, rate and scale of the clean ones. Lengths that differ
                by 0.1 s at most are cut to the shorter one, with a warning.
            audiogram, noise, seed: The arguments of ``haspi``.

        Shape: (..., time) -> (...,).

        Raises:
            ValueError: As for ``haspi``.
        """
        ears = ear_model.hair_cells(self._signals.thresholds(audiogram))
        features = self._compare(processed, noise, seed, ears)
        return intelligibility(features).reshape(features.shape[:-1])


class _Channels(NamedTuple):
    """Features of the clean speech in some channels of a normal ear.

    Attributes:
        channels: The channels.
        spectrum: Spectrum of the envelopes, which finds the lags of the processed signal.
        delays: Delays that equalise the filters' group delays. Shape: (items, channels).
        channel_sum: Sums of the frames over these channels.
    """

    channels: slice
    spectrum: Tensor
    delays: Tensor
    channel_sum: envelopes.ChannelSum


class _Batch(PreparedBatch[_Channels]):
    """Clean speech of a batch in a normal ear."""

    def __init__(self, signals: CleanSpeech, batch: CleanBatch) -> None:
        normal = ear_model.hair_cells(torch.zeros(8, device=signals.device))
        super().__init__(signals, batch, batch.signals, normal)

    def _prepare(self, channels: slice) -> _Channels:
        extent = self._extent
        cochlea = ear_model.simulate_cochlea(self._clean, self._cells, channels, extent)
        spectrum = ear_model.lag_spectrum(cochlea.power.sqrt(), extent)
        delays = self._longest_delay - ear_model.group_delays(cochlea.bandwidth, channels)
        frames = self._frames(cochlea.power, self._cells.inner[channels], delays)
        return _Channels(channels, spectrum, delays, envelopes.sum_over_channels(frames, channels))

    def _frames(self, power: Tensor, inner: Tensor, delays: Tensor) -> Tensor:
        """Return the smoothed levels of compressed envelopes."""
        levels = ear_model.apply_adaptation(ear_model.sensation(power, inner))
        return envelopes.smooth_frames(levels, delays, self._extent)

    def _sum_channels(
        self, clean: _Channels, sound: Tensor, ear: ear_model.HairCells
    ) -> tuple[envelopes.ChannelSum, envelopes.ChannelSum]:
        """Sum the frames of the clean and of the processed speech over some channels."""
        channels, extent = clean.channels, self._extent
        cochlea = ear_model.simulate_cochlea(sound, ear, channels, extent)
        lags = ear_model.channel_lags(clean.spectrum, cochlea.power.detach().sqrt(), extent)
        power = ear_model.shift(cochlea.power, lags, extent.ends, extent.ends, extent.padded)
        frames = self._frames(power, ear.inner[:, channels], clean.delays)
        return clean.channel_sum, envelopes.sum_over_channels(frames, channels)

    def compare(
        self, processed: Tensor, noise: Noise, seeds: Sequence[int], *ears: ear_model.HairCells
    ) -> Tensor:
        """Compute the ten features of each item."""
        items, extent = self._batch.items, self._extent
        sound, ear = self._align(processed), ears[0].select_items(items)
        clean_sum: envelopes.ChannelSum | None = None
        processed_sum: envelopes.ChannelSum | None = None
        sums = self._map_channels(lambda clean: self._sum_channels(clean, sound, ear), sound)
        for clean_part, processed_part in sums:
            clean_sum = envelopes.add_sums(clean_sum, clean_part)
            processed_sum = envelopes.add_sums(processed_sum, processed_part)
        assert clean_sum is not None and processed_sum is not None
        indices, audible = envelopes.find_audible_frames(clean_sum.loudness, extent)
        x = envelopes.select_frames(clean_sum.cosines, indices)
        y = envelopes.select_frames(processed_sum.cosines, indices)
        if noise == "seeded":
            counts = [2 * CHANNELS * end for end in extent.ends]
            pair = _draw_pairs(seeds[items], counts, audible, x)
            x, y = x + pair[0], y + pair[1]
        covariance = envelopes.modulation_covariance(x, y, audible)
        if noise == "expected":
            return envelopes.expected_correlation(covariance)
        return envelopes.correlation(covariance)


# -- noise -----------------------------------------------------------------------------------------

DEVIATES_PER_DRAW = 2**16
"""Approximate number of deviates that are drawn at once."""


def _draw_pairs(
    seeds: Sequence[int], skipped: Sequence[int], extent: Extent, like: Tensor
) -> Tensor:
    """Draw the noise of the clean and of the processed signals.

    Args:
        seeds: Seed of each item.
        skipped: Deviates that pyclarity draws before, for each item.
        extent: Number of audible frames of each item.
        like: Cosines of the signals. Shape: (items, 5, audible).

    Returns:
        Cosines of the noise. Shape: (2, items, 5, audible).
    """
    noise = torch.zeros((2, *like.shape), dtype=like.dtype)
    for item, (seed, count, frames) in enumerate(zip(seeds, skipped, extent.ends, strict=True)):
        random = legacy_rng_after_normals(seed, count)
        for signal in (0, 1):
            noise[signal, item, :, :frames] = _draw(random, frames, like.dtype)
    return noise.to(like.device, non_blocking=like.device.type != "cpu")


def _draw(random: np.random.RandomState, frames: int, dtype: torch.dtype) -> Tensor:
    """Draw noise on all channels, frame by frame, and return its cosines. Shape: -> (5, frames)."""
    parts = []
    step = DEVIATES_PER_DRAW // CHANNELS
    for start in range(0, frames, step):
        deviates = random.standard_normal((min(step, frames - start), CHANNELS))
        parts.append(torch.from_numpy(deviates).to(dtype))
    return envelopes.NOISE_DB * torch.cat([envelopes.cosines(part.mT) for part in parts], -1)


@lru_cache(maxsize=4)
def _state_after(seed: int, count: int) -> Any:
    """Return the state of numpy's legacy generator after an even number of normal deviates.

    The generator draws points in a square until one lies in the circle, which gives two deviates.
    It is enough to count these points.
    """
    random = np.random.RandomState(seed)
    left = count // 2
    while left:
        coordinates = random.random_sample(2 * min(left, DEVIATES_PER_DRAW))
        coordinates *= 2.0
        coordinates -= 1.0
        coordinates *= coordinates
        square = coordinates[::2] + coordinates[1::2]
        left -= int(np.count_nonzero(square < 1.0) - np.count_nonzero(square == 0.0))
    return random.get_state()


def legacy_rng_after_normals(seed: int, count: int) -> np.random.RandomState:
    """Return numpy's legacy generator after it has drawn normal deviates.

    Args:
        seed: Seed of the generator.
        count: Number of deviates that were drawn, an even number.

    >>> expected = np.random.RandomState(7).standard_normal(5)[4]
    >>> bool(legacy_rng_after_normals(7, 4).standard_normal() == expected)
    True
    """
    random = np.random.RandomState()
    random.set_state(_state_after(seed, count))
    return random


# -- networks --------------------------------------------------------------------------------------


def intelligibility(features: Tensor) -> Tensor:
    """Compute the score from the features, by the mean of ten small networks, scaled to end at 1.

    Shape: (..., 10) -> (...,).

    >>> intelligibility(torch.ones(1, 10)).round(decimals=3)
    tensor([1.])
    """
    hidden, output, normalisation = (
        constant(_network, part, dtype=features.dtype, device=features.device)
        for part in ("hidden", "output", "normalisation")
    )
    hidden_sums = (features[..., None, None, :] * hidden[..., 1:]).sum(-1) + hidden[..., 0]
    output_sums = (torch.sigmoid(hidden_sums) * output[:, 1:]).sum(-1) + output[:, 0]
    return torch.sigmoid(output_sums).mean(-1) / normalisation


def _network(part: str) -> NDArray[np.float64]:
    """Return weights of the networks, biases first.

    Shape: (10, 4, 11) for ``"hidden"``, (10, 5) for ``"output"``, () for ``"normalisation"``.
    """
    stored = json.loads((Path(__file__).parent / "haspi_networks.json").read_text())
    if part == "normalisation":
        return np.array(stored[part])
    return np.array([network[part] for network in stored["networks"]])
