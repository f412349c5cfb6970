"""HASPI version 2 in PyTorch: the intelligibility of speech in an impaired ear.

The score is that of pyclarity 0.9.0, with a gradient. Please note:

- HASPI rewards gain: 20 dB took one utterance from 0.53 to 0.99. Report the level beside the score.
- White noise in place of the output should score 0. It does to within 0.05 on utterances
  of 3 s and more, but scores up to 0.3 on 1.2 s, 0.5 on 0.7 s and 0.99 on 0.2 s. Signals shorter
  than 0.7 s are rejected.
- Clean speech below 20 dB SPL, or that a normal ear does not hear, is rejected, because every
  output would have the same score. A constant offset does not count as level.
- The ear spans 80 to 8000 Hz. From 24 to 48 kHz, scores of the same sounds differ by less than
  0.001. At 16 kHz, they differ by up to 0.01 for clean speech and 0.05 for noisy speech. Compare
  scores of one rate.
- Signals and channels are aligned by whole samples. One sample in one channel changes a score by up
  to 0.006. Where two delays match equally well, single precision may choose another one than double
  precision.

Source: Kates and Arehart 2021, "The hearing-aid speech perception index (HASPI) version 2", Speech
Communication 131, 35-46, doi 10.1016/j.specom.2020.05.001.
"""

from __future__ import annotations

import json
from functools import reduce
from operator import add
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import Lengths
from hlsim.metrics.ear import alignment, envelope_modulation as envelopes, model as ear_model
from hlsim.metrics.ear.extent import Extent
from hlsim.metrics.ear.model import CHANNELS, HairCells
from hlsim.metrics.ear.motion_noise import state_after_motion_noise
from hlsim.metrics.pair import Noise, match_pair
from hlsim.metrics.reference import PreparedBatch, Reference
from hlsim.torchtools import Audio, Samples, as_type_of, constant, not_compiled


@not_compiled  # tracing takes minutes
def haspi(
    output: Audio,
    clean: Samples,
    audiogram: AudiogramLike,
    *,
    sample_rate: int = 16000,
    full_scale_spl: float = PASCAL_SPL,
    lengths: Lengths | None = None,
    noise: Noise = "expected",
    seed: int = 0,
    whole_khz: bool = False,
) -> Audio:
    """Compute HASPI version 2 of each item: the intelligibility for an impaired ear, 0 to 1.

    The score compares the output of an aid in the impaired ear with clean speech in a normal ear.
    The delay of an output is removed, to whole samples at 24 kHz. A silent output has the score of
    the ear's internal noise (if there is any). ``HaspiReference`` prepares clean speech once for
    many scores.

    The score is differentiable in ``output``. The delays that align the output are constants for
    the gradient, and bands that are inaudible have no gradient.

    The result is float64 if one of the signals is, and float32 otherwise. On CUDA, leave
    ``torch.backends.cuda.matmul.allow_tf32`` off, as it is by default. Thresholds in a tensor on a
    GPU are not validated, because that would synchronise with the GPU: if they are out of range,
    the score is NaN.

    Args:
        output: Output of an aid, at the impaired ear, at least 0.7 s long. Shape: (..., time).
        clean: Clean speech, not amplified. Shape: (..., time). Lengths of both that differ by 0.1 s
            at most are cut to the shorter one, with a warning.
        audiogram: The impaired ear, -10 to 120 dB HL: one for all items or one for each, or a
            ``Listener`` for (..., 2, time). Shape of a tensor: (..., 8). The thresholds at 250,
            500, 1000, 2000, 4000 and 6000 Hz count, interpolated over log frequency where they were
            not measured.
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0, 0 to 200 (pyclarity's ``level1``).
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        noise: Internal noise of the ear. ``"expected"`` computes the score from features that are
            means over all draws of the noise, so that it is smooth and the same every time;
            ``"seeded"`` draws the noise that pyclarity draws with ``seed`` (scores vary by up to
            0.007); ``"none"`` leaves it out.
        seed: Seed of the drawn noise of each item, 0 to 2**32 - 1.
        whole_khz: Round the rate to whole kHz, as pyclarity does. From 44.1 to 44 kHz, scores
            mostly change by less than 0.01.

    Returns:
        Scores, of NumPy if ``output`` is an array. Shape: (...).

    Raises:
        ValueError: Signals of different shapes or on different devices, too short, not
            floating-point, not finite or above 1e9; clean speech that is silent, below 20 dB SPL or
            inaudible to a normal ear; a rate, level, audiogram, length or seed out of range; an
            unknown noise.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> bool(haspi(speech, speech, "N4") < haspi(speech, speech, "NH"))
    True
    """
    matched, clean, lengths = match_pair(output, clean, sample_rate, lengths)
    reference = HaspiReference(
        clean,
        sample_rate=sample_rate,
        full_scale_spl=full_scale_spl,
        lengths=lengths,
        whole_khz=whole_khz,
        keep=False,
    )
    return as_type_of(output, reference.score(matched, audiogram, noise=noise, seed=seed))


class HaspiReference(Reference):
    """Clean speech that is prepared once for the HASPI of many outputs of aids.

    HASPI compares with clean speech in a normal ear, so the impaired ear is an argument of
    ``score``. In float32 the features of clean speech take about 5 MB per second.

    Args:
        clean: Clean speech, not amplified. The scores are on its device, and float64 if it is,
            otherwise float32. Its gradient is not computed. Shape: (..., time).
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0, 0 to 200.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        keep: Store the clean speech's features; otherwise they are computed, and the level is
            validated, for each score, which takes less memory.

    Raises:
        ValueError: Clean speech that lasts less than 0.7 s, has less than 16 ms of sound, is not
            floating-point, not finite, above 1e9, silent or below 20 dB SPL; a rate, level or
            length out of range.

    >>> from hlsim import example_speech
    >>> speech = example_speech()[:16000]
    >>> reference = HaspiReference(speech)
    >>> bool(reference.score(0.1 * speech, "N3") < reference.score(speech, "N3"))
    True
    """

    def __init__(
        self,
        clean: Samples,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        lengths: Lengths | None = None,
        whole_khz: bool = False,
        keep: bool = True,
    ) -> None:
        super().__init__(
            clean,
            "NH",
            sample_rate=sample_rate,
            full_scale_spl=full_scale_spl,
            lengths=lengths,
            whole_khz=whole_khz,
            equalisation=2,
            keep=keep,
        )

    def _features(
        self,
        sound: Tensor,
        cells: HairCells,
        channels: slice,
        longest_delay: Tensor,
        extent: Extent,
    ) -> _Channels:
        cochlea = ear_model.simulate_cochlea(sound, cells, channels, extent)
        delays = longest_delay - ear_model.group_delays(cochlea.bandwidth, channels)
        levels = ear_model.nerve_levels(cochlea.power, cells[..., channels].inner)
        frames = envelopes.smooth_frames(levels, delays, extent)
        return _Channels(
            channels,
            alignment.lag_spectrum(cochlea.power.sqrt(), extent),
            delays,
            envelopes.mean_amplitude(frames),
            envelopes.cepstrum(frames, channels),
        )

    def _compare(
        self, batch: PreparedBatch, output: Tensor, cells: HairCells, noise: Noise, seed: int
    ) -> Tensor:
        """Compute the ten correlations that are the features of HASPI, (items, 10).

        Arguments are those of ``Reference._compare``.

        Raises:
            UnscorableError: Clean speech is inaudible to a normal ear.
        """
        extent = batch.clean.audible
        contributions = [
            (clean.amplitude, clean.cepstrum, _cepstrum(clean, output, cells, extent))
            for clean in batch.features
        ]
        amplitude, *cepstra = (reduce(add, parts) for parts in zip(*contributions, strict=True))
        indices, audible = envelopes.find_audible_frames(amplitude, extent)
        x, y = (cepstrum.take_along_dim(indices[:, None], -1) for cepstrum in cepstra)
        if noise == "expected":
            return envelopes.expected_correlation(x, y, audible)
        if noise == "seeded":
            clean_noise, output_noise = _draw_noise(seed, extent, audible, x)
            x, y = x + clean_noise, y + output_noise
        return envelopes.correlation(x, y, audible)

    def score(
        self,
        output: Audio,
        audiogram: AudiogramLike,
        *,
        noise: Noise = "expected",
        seed: int = 0,
    ) -> Audio:
        """Return the HASPI of each output of an aid.

        Args:
            output: Outputs with the shape, rate and scale of the clean speech. Shape: (..., time).
            audiogram: The impaired ear, or one for each item, as in ``haspi``.
            noise: Internal noise of the ear: ``"expected"``, its mean effect; ``"seeded"``, the
                noise that pyclarity draws; or ``"none"``.
            seed: Seed of the drawn noise of each item, 0 to 2**32 - 1.

        Returns:
            Scores, 0 to 1, of NumPy if ``output`` is an array. Shape: (...).

        Raises:
            ValueError: Outputs of another shape, not floating-point, not finite, above 1e9 or on
                another device; clean speech that a normal ear does not hear or, with
                ``keep=False``, that is silent, too soft or too short; an audiogram or seed out of
                range; an unknown noise.
        """
        ears = ear_model.hair_cells(self._thresholds(audiogram))
        return as_type_of(output, _intelligibility(self._compare_all(output, noise, seed, ears)))


class _Channels(NamedTuple):
    """Features of the clean speech in some channels of a normal ear.

    Attributes:
        channels: Range of these channels among the 32 of the ear.
        spectrum: Result of ``lag_spectrum`` for the envelopes, with which the channels of outputs
            are aligned. Shape: (items, channels, blocks, frequencies).
        delays: Delays in samples that compensate for different group delays. Shape: (items,
            channels).
        amplitude: Contribution of these channels to the mean amplitude of each frame, see
            ``mean_amplitude``. Shape: (items, frames).
        cepstrum: Contribution of these channels to the cepstrum of each frame. Shape: (items, 5,
            frames).
    """

    channels: slice
    spectrum: Tensor
    delays: Tensor
    amplitude: Tensor
    cepstrum: Tensor


def _cepstrum(clean: _Channels, output: Tensor, ear: HairCells, extent: Extent) -> Tensor:
    """Compute the contribution of some channels to the cepstrum of the output's frames.

    Args:
        clean: Features of clean speech in these channels.
        output: Aligned outputs behind the middle ear at 24 kHz. Shape: (items, padded).
        ear: Hair cells of the impaired ears. Shape: (items, 32).
        extent: Number of samples of each item before padding.

    Returns:
        Contributions in dB. Shape: (items, 5, frames).
    """
    channels = clean.channels
    power = ear_model.simulate_cochlea(output, ear, channels, extent).power
    envelope = power.detach().sqrt()
    power = alignment.align_channels(power, envelope, clean.spectrum, extent)
    levels = ear_model.nerve_levels(power, ear.inner[:, channels])
    frames = envelopes.smooth_frames(levels, clean.delays, extent)
    return envelopes.cepstrum(frames, channels)


def _draw_noise(seed: int, extent: Extent, audible: Extent, like: Tensor) -> Tensor:
    """Draw the internal noise of the ear for clean speech and for the output, as pyclarity does.

    Before it, pyclarity draws noise for the motion of the basilar membrane, which only HASQI and
    HAAQI use.

    Args:
        seed: Seed, the same for each item, so that its score does not depend on the batch.
        extent: Number of samples at 24 kHz of each item.
        audible: Number of audible frames of each item.
        like: Cepstrum of the audible frames, which has the shape, the precision and the device of
            the noise. Shape: (items, 5, frames).

    Returns:
        Cepstrum of the noise for clean speech, then for the output. Shape: (2, items, 5, frames).
    """
    noise = torch.zeros((2, *like.shape), dtype=like.dtype)
    random = np.random.RandomState()
    for item, (samples, frames) in enumerate(zip(extent.ends, audible.ends, strict=True)):
        random.set_state(state_after_motion_noise(seed, samples))
        for signal in (0, 1):
            levels = torch.from_numpy(random.standard_normal((frames, CHANNELS))).to(like.dtype)
            noise[signal, item, :, :frames] = envelopes.NOISE_DB * envelopes.cepstrum(levels.mT)
    return noise.to(like.device)


# -- networks --------------------------------------------------------------------------------------


def _intelligibility(features: Tensor) -> Tensor:
    """Compute HASPI as the mean of ten small networks, divided by its largest possible value.

    The best score is therefore 1. The features are ten correlations, see
    ``envelope_modulation.correlation``.

    Shape: (..., 10) -> (...,).
    """
    hidden, output, normalisation = (
        _network(part, like=features) for part in ("hidden", "output", "normalisation")
    )
    hidden_sums = (features[..., None, None, :] * hidden[..., 1:]).sum(-1) + hidden[..., 0]
    output_sums = (torch.sigmoid(hidden_sums) * output[:, 1:]).sum(-1) + output[:, 0]
    return torch.sigmoid(output_sums).mean(-1) / normalisation.squeeze(0)


@constant
def _network(part: str) -> NDArray[np.float64]:
    """Load weights of the ten networks that map features to HASPI. In each row the bias is first.

    Shape: (10, 4, 11) for ``"hidden"``, (10, 5) for ``"output"``, (1,) for ``"normalisation"``.
    """
    networks = json.loads(Path(__file__).with_name("haspi_networks.json").read_text())
    return np.array(networks[part])
