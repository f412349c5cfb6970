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
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import Lengths, check_choice
from hlsim.metrics.ear import envelope_modulation as envelopes
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.clean_speech import CleanBatch, CleanSpeech, ItemGroup
from hlsim.metrics.ear.model import CHANNELS, Extent
from hlsim.metrics.pair import check_seed, match_pair
from hlsim.torchtools import constant, not_compiled

Noise = Literal["expected", "seeded", "none"]
"""Internal noise of the ear: its mean effect, the noise that pyclarity draws, or none."""


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
        processed: signal at the impaired ear, at least 0.7 s long.
        clean: clean speech, not amplified. Lengths of both that differ by 0.1 s at most are cut to
            the shorter one, with a warning.
        audiogram: the impaired ear, -10 to 120 dB HL; one ear, or one for each item. Its
            thresholds at 250, 500, 1000, 2000, 4000 and 6000 Hz count, interpolated over log
            frequency where they were not measured.
        sample_rate: sample rate in Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0 (pyclarity's ``level1``).
        lengths: number of samples of each item in a padded batch.
        noise: ``"expected"`` computes the mean over seeds, which is smooth and the same every time;
            ``"seeded"`` draws the noise that pyclarity draws with ``seed`` (scores vary by up to
            0.007); ``"none"`` leaves it out.
        seed: one seed, or one for each item.
        whole_khz: round the rate to whole kHz, as pyclarity does. From 44.1 to 44 kHz, scores
            change by up to 0.005.

    Shape: (..., time) twice, and (..., 8) dB HL -> (...,).

    Raises:
        ValueError: signals of other shapes, too short, or not finite; clean speech that is silent
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


class HaspiReference:
    """Clean speech in a normal ear, prepared for the HASPI of many processed signals.

    It does not depend on an audiogram. In float32 it takes about 4 MB per second of speech.

    Args:
        clean, sample_rate, full_scale_spl, lengths, whole_khz: the arguments of ``haspi``. The
            scores have the dtype and the device of ``clean``, whose gradient is not computed.
        keep: store the clean signal's features; otherwise they are computed for each score, which
            takes less memory.

    Raises:
        ValueError: as for ``haspi``.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> reference = HaspiReference(speech)
    >>> bool(reference.score(0.1 * speech, "N3") < reference.score(speech, "N3"))
    True
    """

    @torch.inference_mode(False)  # the features may serve a training later
    def __init__(
        self,
        clean: Tensor,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        lengths: Lengths | None = None,
        whole_khz: bool = False,
        keep: bool = True,
    ) -> None:
        self._signals = CleanSpeech(clean, sample_rate, full_scale_spl, lengths, whole_khz, "HASPI")
        with torch.autocast(clean.device.type, enabled=False):
            self._batches = [_Batch(self._signals, batch, keep) for batch in self._signals.batches]

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
            processed: signals of the shape, rate and scale of the clean ones. Lengths that differ
                by 0.1 s at most are cut to the shorter one, with a warning.
            audiogram, noise, seed: the arguments of ``haspi``.

        Shape: (..., time) -> (...,).

        Raises:
            ValueError: as for ``haspi``.
        """
        check_choice("noise", noise, Noise)
        processed, shorter = self._signals.cut(processed)
        if shorter is not None:
            reference = HaspiReference(**shorter, keep=False)
            return reference.score(processed, audiogram, noise=noise, seed=seed)
        signals = self._signals
        rows = signals.check(processed)
        ears = ear_model.hair_cells(signals.thresholds(audiogram))
        seeds = item_seeds(seed, signals.shape)
        with torch.autocast(processed.device.type, enabled=False):
            features = [batch.compare(rows, ears, noise, seeds) for batch in self._batches]
            return intelligibility(torch.cat(features)).reshape(signals.shape)


# -- items that are processed together -------------------------------------------------------------


class _Channels(NamedTuple):
    """Features of the clean speech in some channels of a normal ear.

    Attributes:
        channels: the channels.
        spectrum: spectrum of the envelopes, which finds the lags of the processed signal.
        delays: delays that equalise the filters' group delays. Shape: (items, channels).
        channel_sum: sums of the frames over these channels.
    """

    channels: slice
    spectrum: Tensor
    delays: Tensor
    channel_sum: envelopes.ChannelSum


class _Batch:
    """Clean signals of a batch in a normal ear.

    Args:
        signals: all clean signals.
        batch: those of the batch.
        keep: compute the features now, and store them.
    """

    def __init__(self, signals: CleanSpeech, batch: CleanBatch, keep: bool) -> None:
        self._signals, self._batch = signals, batch
        self._groups = [_Group(signals, batch, items) for items in signals.groups(batch)]
        if keep:
            for group in self._groups:
                group.store()

    def compare(
        self, processed: Tensor, ears: ear_model.HairCells, noise: Noise, seeds: list[int]
    ) -> Tensor:
        """Compute the features of each item.

        Args:
            processed: all processed signals. Shape: (items, time).
            ears: hair cells of all items. Shape: (items, 32).
            noise: kind of noise.
            seeds: seeds of all items.

        Returns:
            Features. Shape: (items of the batch, 10).
        """
        batch = self._batch
        aligned = self._signals.align(processed, batch)
        ear = ears.select_items(batch.items)
        pairs = [group.sum_channels(aligned, ear) for group in self._groups]
        clean_sum, processed_sum = (envelopes.join_items(sums) for sums in zip(*pairs, strict=True))
        indices, extent = envelopes.find_audible_frames(clean_sum.loudness, batch.audible)
        x = envelopes.select_frames(clean_sum.cosines, indices)
        y = envelopes.select_frames(processed_sum.cosines, indices)
        if noise == "seeded":
            counts = [2 * CHANNELS * end for end in batch.audible.ends]
            pair = _draw_pairs(seeds[batch.items], counts, extent, x)
            x, y = x + pair[0], y + pair[1]
        covariance = envelopes.modulation_covariance(x, y, extent)
        if noise == "expected":
            return envelopes.expected_correlation(covariance)
        return envelopes.correlation(covariance)


class _Group(ItemGroup[_Channels]):
    """Items whose ears are computed together, each with the features of its clean speech."""

    def __init__(self, signals: CleanSpeech, batch: CleanBatch, items: slice) -> None:
        super().__init__(signals, batch, items)
        with torch.no_grad():
            self._ear = ear_model.hair_cells(torch.zeros(8, device=signals.device))
            self._clean = signals.through_middle_ear(batch.signals[items], self._extent)
            self._longest_delay = ear_model.longest_group_delay(
                self._clean, self._ear, self._extent
            )

    @torch.no_grad()
    def _prepare(self, channels: slice) -> _Channels:
        cochlea = ear_model.simulate_cochlea(self._clean, self._ear, channels, self._extent)
        spectrum = ear_model.lag_spectrum(cochlea.power.sqrt(), self._extent)
        delays = self._longest_delay - ear_model.group_delays(cochlea.bandwidth, channels)
        levels = ear_model.apply_adaptation(
            ear_model.sensation(cochlea.power, self._ear.inner[channels])
        )
        frames = envelopes.smooth_frames(levels, delays, self._extent)
        channel_sum = envelopes.sum_over_channels(frames, channels)
        return _Channels(channels, spectrum, delays, channel_sum)

    def sum_channels(
        self, processed: Tensor, ears: ear_model.HairCells
    ) -> tuple[envelopes.ChannelSum, envelopes.ChannelSum]:
        """Sum the frames of the clean and of the processed signals over all channels.

        Shape: (items, padded) and (items, 32) of the batch.
        """
        extent = self._extent
        ear = ears.select_items(self.items)
        sound = self._signals.through_middle_ear(processed[self.items], extent)
        x: envelopes.ChannelSum | None = None
        y: envelopes.ChannelSum | None = None
        for clean in self._channels():
            cells = ear_model.simulate_cochlea(sound, ear, clean.channels, extent)
            lags = ear_model.channel_lags(clean.spectrum, cells.power.detach().sqrt(), extent)
            power = ear_model.shift(cells.power, lags, extent.ends, extent.ends, extent.padded)
            levels = ear_model.apply_adaptation(
                ear_model.sensation(power, ear.inner[:, clean.channels])
            )
            x = envelopes.add_sums(x, clean.channel_sum)
            frames = envelopes.smooth_frames(levels, clean.delays, extent)
            y = envelopes.add_sums(y, envelopes.sum_over_channels(frames, clean.channels))
        assert x is not None and y is not None
        return x, y


# -- noise -----------------------------------------------------------------------------------------

DEVIATES_PER_DRAW = 2**16
"""Approximate number of deviates that are drawn at once."""


def _draw_pairs(seeds: list[int], skipped: list[int], extent: Extent, like: Tensor) -> Tensor:
    """Draw the noise of the clean and of the processed signals.

    Args:
        seeds: seed of each item.
        skipped: deviates that pyclarity draws before, for each item.
        extent: number of audible frames of each item.
        like: cosines of the signals. Shape: (items, 5, audible).

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
        seed: seed of the generator.
        count: number of deviates that were drawn, an even number.

    >>> expected = np.random.RandomState(7).standard_normal(5)[4]
    >>> bool(legacy_rng_after_normals(7, 4).standard_normal() == expected)
    True
    """
    random = np.random.RandomState()
    random.set_state(_state_after(seed, count))
    return random


def item_seeds(seed: int | Sequence[int], shape: torch.Size) -> list[int]:
    """Return one seed for each item.

    Args:
        seed: one seed, or one for each item.
        shape: shape of the batch of items.

    Raises:
        ValueError: the number of seeds is another one, or a seed is out of range.

    >>> item_seeds(3, torch.Size([2]))
    [3, 3]
    """
    items = shape.numel()
    try:
        seeds: list[Any] = list(seed)  # type: ignore[arg-type]
    except TypeError:  # neither a sequence nor a tensor with elements
        seeds = [seed] * items
    if len(seeds) != items:
        raise ValueError(f"expected one seed or {items}, one for each item, got {len(seeds)}")
    return [check_seed(value) for value in seeds]


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
