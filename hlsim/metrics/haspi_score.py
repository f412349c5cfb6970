"""HASPI version 2 in torch: pyclarity 0.9.0's score, differentiable, on a CPU or a GPU, many times as fast.

Kates and Arehart 2021, "The hearing-aid speech perception index (HASPI) version 2", Speech Communication 131, 35-46,
doi 10.1016/j.specom.2020.05.001. What to know of it:

- It rewards gain: 20 dB of it took one utterance from 0.53 to 0.99. Always give the level beside the score.
- White noise in place of the processed speech should score 0. It does, to 0.05, on utterances of 3 s and more, but gets
  up to 0.3 on 1.2 s, 0.45 on 0.7 s and 0.99 on 0.2 s. Shorter signals than 0.7 s are refused.
- With the reference under the threshold of hearing it gives any signal the same score: references under 20 dB SPL are
  refused; a DC offset, which nobody hears, does not count.
- Its ear spans 80 to 8000 Hz: against 48 kHz, 16 kHz moved scores by up to 0.008. Compare within one rate.
- It aligns signals and channels by whole samples: one sample in one channel moves a score by up to 0.006, where two
  delays match equally well, and in single precision such a choice can differ from double precision's.
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
"""Of the hair cells' firing: its mean effect, what pyclarity draws under a seed, or none."""


@not_compiled  # traced, it takes minutes
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
    """Compute HASPI v2 of each item: how much of the speech an impaired ear understands, 0 to 1.

    The score compares the processed signal in the impaired ear with clean speech in a normal ear. A delay of
    ``processed`` does not count. A silent ``processed`` has a score, that of the noise in the ear. The score is
    differentiable in ``processed``, while the delays that align it are constant; a band in which the ear hears nothing
    has no gradient. ``HaspiReference`` prepares clean speech once for many scores.

    The result is float64 if one of the signals is, and float32 otherwise. On CUDA, leave
    ``torch.backends.cuda.matmul.allow_tf32`` off, as it is by default. An ear on a GPU that is out of range has the score
    NaN, because the host does not read its levels.

    Args:
        processed: signal at the impaired ear, at least 0.7 s long.
        clean: clean speech, not amplified. Lengths of both that differ by 0.1 s at most are cut to the shorter one, with
            a warning.
        audiogram: the impaired ear, -10 to 120 dB HL; one ear, or one for each item.
        sample_rate: sample rate in Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0 (pyclarity's ``level1``).
        lengths: number of samples of each item in a padded batch.
        noise: ``"expected"`` computes the mean over seeds, which is smooth and the same every time; ``"seeded"`` draws
            the noise that pyclarity draws with ``seed`` (scores vary by up to 0.007); ``"none"`` leaves it out.
        seed: one seed, or one for each item.
        whole_khz: round the rate to whole kHz, as pyclarity does. 44.1 kHz becomes 44, which moved scores by up to 0.005.

    Shape: (..., time) twice, and (..., 8) dB HL -> (...,).

    Raises:
        ValueError: signals of other shapes, too short, or not finite; clean speech that is silent or below 20 dB SPL; a
            rate, level, audiogram, length or seed out of range.
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
    """Clean speech as a normal ear hears it, prepared to score many processed signals against.

    It depends on no audiogram. It holds about 4 MB a second of speech in float32.

    Args:
        clean, sample_rate, full_scale_spl, lengths, whole_khz: as ``haspi``; the dtype and the device are those of
            ``clean``, whose gradient is not followed.
        keep: what the normal ear makes of it; without, it is computed with each score, in less memory.

    Raises:
        ValueError: as ``haspi``.
    """

    @torch.inference_mode(False)  # it may be scored against where gradients are wanted
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
            self._parts = [_Batch(self._signals, batch, keep) for batch in self._signals.batches]

    def score(
        self,
        processed: Tensor,
        audiogram: AudiogramLike,
        *,
        noise: Noise = "expected",
        seed: int | Sequence[int] = 0,
    ) -> Tensor:
        """``haspi`` of processed signals of the clean ones' shape, rate and scale. Returns (...,)."""
        check_choice("noise", noise, Noise)
        processed, shorter = self._signals.cut(processed)
        if shorter is not None:
            reference = HaspiReference(**shorter, keep=False)
            return reference.score(processed, audiogram, noise=noise, seed=seed)
        signals = self._signals
        given = signals.check(processed)
        ears = ear_model.hair_cells(signals.thresholds(audiogram))
        seeds = item_seeds(seed, signals.shape)
        with torch.autocast(processed.device.type, enabled=False):
            features = [part.compare(given, ears, noise, seeds) for part in self._parts]
            return understood(torch.cat(features)).reshape(signals.shape)


# -- items that are processed together --------------------------------------------------------------------------------


class _Channels(NamedTuple):
    """Some channels of the clean speech in a normal ear.

    Attributes:
        chosen: the channels.
        spectrum: of their envelopes, for the lags of the processed ones.
        delays: that match the filters' group delays. Shape: (items, channels).
        course: of their frames.
    """

    chosen: slice
    spectrum: Tensor
    delays: Tensor
    course: envelopes.Course


class _Batch:
    """Clean signals of a batch, each as a normal ear hears it.

    Args:
        keep: compute now what the ear makes of them, and keep it.
    """

    def __init__(self, signals: CleanSpeech, batch: CleanBatch, keep: bool) -> None:
        self._signals, self._batch = signals, batch
        self._groups = [_Group(signals, batch, items) for items in signals.groups(batch)]
        if keep:
            for group in self._groups:
                group.keep()

    def compare(
        self, processed: Tensor, ears: ear_model.HairCells, noise: Noise, seeds: list[int]
    ) -> Tensor:
        """Compute the features of each item.

        Shape: (items, time) and (items, 32) of the whole input -> (items of the batch, 10).
        """
        batch = self._batch
        given = self._signals.matched(processed, batch)
        ear = ears.items(batch.items)
        pairs = [group.courses(given, ear) for group in self._groups]
        reference, heard = (envelopes.joined(courses) for courses in zip(*pairs, strict=True))
        places, extent = envelopes.audible_frames(reference.loudness, batch.audible)
        x = envelopes.chosen_frames(reference.cosines, places)
        y = envelopes.chosen_frames(heard.cosines, places)
        if noise == "seeded":
            counts = [2 * CHANNELS * end for end in batch.audible.ends]
            drawn = _drawn_pairs(seeds[batch.items], counts, extent, x)
            x, y = x + drawn[0], y + drawn[1]
        found = envelopes.agreement(x, y, extent)
        if noise == "expected":
            return envelopes.expected_correlation(found)
        return envelopes.correlation(found)


class _Group(ItemGroup[_Channels]):
    """Items whose ears are computed together, each with what a normal ear makes of the clean speech."""

    def __init__(self, signals: CleanSpeech, batch: CleanBatch, items: slice) -> None:
        super().__init__(signals, batch, items)
        with torch.no_grad():
            self._ear = ear_model.hair_cells(torch.zeros(8, device=signals.device))
            self._heard = signals.through_middle_ear(batch.signals[items], self._extent)
            self._latest = ear_model.longest_group_delay(self._heard, self._ear, self._extent)

    @torch.no_grad()
    def _hear(self, chosen: slice) -> _Channels:
        heard = ear_model.listen(self._heard, self._ear, chosen, self._extent)
        spectrum = ear_model.lag_spectrum(heard.power.sqrt(), self._extent)
        delays = self._latest - ear_model.group_delays(heard.bandwidth, chosen)
        levels = ear_model.adapted(ear_model.sensation(heard.power, self._ear.inner[chosen]))
        frames = envelopes.frames(levels, delays, self._extent)
        return _Channels(chosen, spectrum, delays, envelopes.course(frames, chosen))

    def courses(
        self, processed: Tensor, ears: ear_model.HairCells
    ) -> tuple[envelopes.Course, envelopes.Course]:
        """Compute the courses of the clean and of the processed signals.

        Shape: (items, padded) and (items, 32) of the batch.
        """
        extent = self._extent
        ear = ears.items(self.items)
        sound = self._signals.through_middle_ear(processed[self.items], extent)
        x: envelopes.Course | None = None
        y: envelopes.Course | None = None
        for part in self._channels():
            cells = ear_model.listen(sound, ear, part.chosen, extent)
            lags = ear_model.channel_lags(part.spectrum, cells.power.detach().sqrt(), extent)
            power = ear_model.shift(cells.power, lags, extent.ends, extent.ends, extent.padded)
            levels = ear_model.adapted(ear_model.sensation(power, ear.inner[:, part.chosen]))
            x = envelopes.added(x, part.course)
            frames = envelopes.frames(levels, part.delays, extent)
            y = envelopes.added(y, envelopes.course(frames, part.chosen))
        assert x is not None and y is not None
        return x, y


# -- noise -------------------------------------------------------------------------------------------------------------

_DRAWN = 2**16
"""Number of deviates, about, that are drawn at once."""


def _drawn_pairs(seeds: list[int], skipped: list[int], extent: Extent, like: Tensor) -> Tensor:
    """Draw the noise of the clean and of the processed signals.

    Args:
        skipped: deviates that pyclarity draws before, by item.
        extent: frames of each item.
        like: cosines of the signals. Shape: (items, 5, kept).

    Returns: (2, items, 5, kept).
    """
    noise = torch.zeros((2, *like.shape), dtype=like.dtype)
    for item, (seed, count, kept) in enumerate(zip(seeds, skipped, extent.ends, strict=True)):
        random = generator_after(seed, count)
        for side in (0, 1):
            noise[side, item, :, :kept] = _drawn(random, kept, like.dtype)
    return noise.to(like.device, non_blocking=like.device.type != "cpu")


def _drawn(random: np.random.RandomState, frames: int, dtype: torch.dtype) -> Tensor:
    """Draw noise on all channels, frame by frame, and return its cosines. Shape: -> (5, frames)."""
    parts = []
    step = _DRAWN // CHANNELS
    for start in range(0, frames, step):
        deviates = random.standard_normal((min(step, frames - start), CHANNELS))
        parts.append(torch.from_numpy(deviates).to(dtype))
    return envelopes.NOISE_DB * torch.cat([envelopes.cosines(part.mT) for part in parts], -1)


@lru_cache(maxsize=4)
def _state_after(seed: int, count: int) -> Any:
    """State of numpy's legacy generator after an even number of normal deviates, none of which is computed.

    It draws pairs of numbers in a square until one lies in the circle, which gives two deviates.
    """
    random = np.random.RandomState(seed)
    left = count // 2
    while left:
        place = random.random_sample(2 * min(left, _DRAWN))
        place *= 2.0
        place -= 1.0
        place *= place
        square = place[::2] + place[1::2]
        left -= int(np.count_nonzero(square < 1.0) - np.count_nonzero(square == 0.0))
    return random.get_state()


def generator_after(seed: int, count: int) -> np.random.RandomState:
    """Numpy's legacy generator under a seed, ``count`` normal deviates on (an even number)."""
    random = np.random.RandomState()
    random.set_state(_state_after(seed, count))
    return random


def item_seeds(seed: int | Sequence[int], shape: torch.Size) -> list[int]:
    """One an item, or ValueError."""
    items = shape.numel()
    try:
        seeds: list[Any] = list(seed)  # type: ignore[arg-type]
    except TypeError:  # no sequence, nor a tensor with elements
        seeds = [seed] * items
    if len(seeds) != items:
        raise ValueError(f"{len(seeds)} seeds for {items} items; allowed: one, or one an item")
    return [check_seed(one) for one in seeds]


# -- networks ----------------------------------------------------------------------------------------------------------


def understood(features: Tensor) -> Tensor:
    """Mean of ten small networks, scaled to end at 1. Shape: (..., 10) -> (...,)."""
    hidden, output, normalisation = (
        constant(_network, part, dtype=features.dtype, device=features.device)
        for part in ("hidden", "output", "normalisation")
    )
    middle = (features[..., None, None, :] * hidden[..., 1:]).sum(-1) + hidden[..., 0]
    last = (torch.sigmoid(middle) * output[:, 1:]).sum(-1) + output[:, 0]
    return torch.sigmoid(last).mean(-1) / normalisation


def _network(part: str) -> NDArray[np.float64]:
    """(10, 4, 11) of the hidden units, (10, 5) of the outputs, biases first, or () of the scale."""
    stored = json.loads((Path(__file__).parent / "haspi_networks.json").read_text())
    if part == "normalisation":
        return np.array(stored[part])
    return np.array([network[part] for network in stored["networks"]])
