"""A trained directional front end, which cancels noise in the bands of the hearing aid."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from compensators.config import BeamformerConfig, HearingAidConfig
from compensators.directional import (
    POWER_FLOOR,
    DirectionalAid,
    FilterAndSum,
    MicrophoneStream,
    beam_and_blocking_taps,
    look_ahead_samples,
)
from compensators.filter_bank import FRAME, HISTORY, HOP, filter_powers, level_db
from compensators.hearing_aid import HearingAid
from compensators.smoothing import exponential_average, weight_of_past
from compensators.wearable import State
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import NEURO_RATE, PASCAL_SPL, check_full_scale, gain_to_pascals
from hlsim.checkpoint import HubModel
from hlsim.checks import check_settings
from hlsim.dsp.resample import resample
from hlsim.torchtools import built_in_float32, constant

LOOK_AHEAD_SAMPLES = 8
"""Look-ahead of the fixed filters, and again of the adaptive ones: 0.5 ms each, at 16 kHz."""

FILTER_SAMPLES = 128
"""Length of the adaptive filters in samples at 16 kHz."""

EARS = 2
"""Number of ears."""

BLOCKED = 2
"""Number of signals per ear without sound from the front."""

SIGNALS = 1 + BLOCKED
"""Number of signals per ear: the beam to the front, and those without sound from the front."""

INITIAL_LOADING = 1e-2
"""Power that is added to that of each blocked signal before training, relative to this power."""

INITIAL_LEAKAGE = 3e-3
"""Power that is added to that of each blocked signal before training, relative to the beam's power.

The talker leaks into these signals, by -40 dB from the front and more from beside it. Without this
term, speech in quiet would be cancelled.
"""


class AdaptiveBeamformer(FilterAndSum):
    """A trained adaptive beamformer to the front, with 1 ms of look-ahead at 16 kHz.

    The four microphones are a front and a rear one at each side of the head. For each ear, fixed
    filters compute a beam to the front, that of ``BinauralMVDR`` with half of its look-ahead, and
    two signals from which most of the sound from the front is removed. Every 4 ms and in each band
    of the hearing aid, weights are computed with which the two signals, subtracted from the beam,
    leave the least power (generalised sidelobe canceller, Griffiths and Jim 1982). The weights come
    from averages over the recent past. For each ear and band, a small network decides how much a
    frame counts in the averages, and how large a power is added to those of the two signals
    (loading), which makes the weights smaller. Before training, all frames count alike.

    Shape: (..., 2 microphones, 2 ears, time) -> (..., 2 ears, time).

    Args:
        config: Sizes and choices, by default ``BeamformerConfig()``.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. Whole signals at other
            rates than 16000 are resampled, which adds up to 8.5 ms of look-ahead; streams need
            16000. Outputs contain the frequencies below 8 kHz only.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Raises:
        ValueError: The rate or the level is out of range, or ``config`` is not a
            ``BeamformerConfig``.

    >>> AdaptiveBeamformer()(torch.zeros(2, 2, 16000)).shape
    torch.Size([2, 16000])
    """

    @built_in_float32
    def __init__(
        self,
        config: BeamformerConfig | None = None,
        *,
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
    ) -> None:
        config = BeamformerConfig.resolve(config)
        taps = beam_and_blocking_taps(config.loading, config.spacing, LOOK_AHEAD_SAMPLES)
        super().__init__(taps.reshape(-1, *taps.shape[2:]), 2 * LOOK_AHEAD_SAMPLES, sample_rate)
        self.config = config
        self.full_scale_spl = check_full_scale(full_scale_spl)
        decisions = nn.Linear(config.hidden, 2 * EARS * config.bands)
        self.decide = nn.Sequential(
            nn.Linear(2 * SIGNALS * EARS * config.bands, config.hidden),
            nn.SiLU(),
            nn.Linear(config.hidden, config.hidden),
            nn.SiLU(),
            decisions,
        )
        nn.init.zeros_(decisions.weight)
        nn.init.zeros_(decisions.bias)

    def delayed_output(self, waveform: Tensor) -> Tensor:
        if self.sample_rate == NEURO_RATE:
            return super().delayed_output(waveform)
        self.check_microphones(waveform)
        with torch.autocast(waveform.device.type, enabled=False):
            delayed = super().delayed_output(resample(waveform, self.sample_rate, NEURO_RATE))
            output = resample(delayed[..., self.latency :], NEURO_RATE, self.sample_rate)
        # The latency at 16 kHz need not be a whole number of samples at another rate.
        samples = look_ahead_samples(self.sample_rate)
        return functional.pad(output[..., : waveform.shape[-1]], (samples, 0))

    def stream(self, audiogram: AudiogramLike | None = None) -> MicrophoneStream:
        if self.sample_rate != NEURO_RATE:
            raise ValueError(
                f"expected a sample rate of {NEURO_RATE} Hz for a stream, got {self.sample_rate}; "
                "resample the signals, and build the beamformer for this rate"
            )
        return super().stream()

    def initial_state(self, waveform: Tensor) -> State:
        batch, bands = waveform.shape[:-3], self.config.bands
        shapes = {
            "signals": (SIGNALS, EARS, HISTORY),
            "levels": (SIGNALS * EARS * bands,),
            "covariance": (EARS * SIGNALS * SIGNALS * bands,),
            "weights": (2, BLOCKED, EARS, bands),
        }
        zeros = {name: waveform.new_zeros(*batch, *shape) for name, shape in shapes.items()}
        return {**super().initial_state(waveform), **zeros}

    def process(self, waveform: Tensor, state: State) -> tuple[Tensor, State]:
        time = waveform.shape[-1]
        gain = gain_to_pascals(self.full_scale_spl)
        samples = torch.cat((state["past"], waveform * gain), -1)
        filtered = self.filter(samples, self.taps).unflatten(-2, (SIGNALS, EARS))
        signals = torch.cat((state["signals"], filtered), -1)
        position = signals.shape[-1] - HISTORY - time  # in the hop in which the waveform begins
        finished = (position + time) // HOP
        padded = functional.pad(signals, (0, -(position + time) % HOP))
        frames = padded.unfold(-1, FRAME, HOP).movedim(-2, -4)  # (..., hops, signals, ears, FRAME)
        new_weights, memory = self._adapt(frames[..., :finished, :, :, :], state)
        weights = torch.cat((state["weights"], new_weights), -4)
        output = _subtract(frames, weights)[..., position : position + time]
        new_state = {
            "past": samples[..., time:],
            "signals": signals[..., finished * HOP :],
            "weights": weights[..., -2:, :, :, :],
            **memory,
        }
        return output / gain, new_state

    def _adapt(self, frames: Tensor, state: State) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the weights at the end of each frame, and the new averages of the state.

        Args:
            frames: Beams, then the signals with little sound from the front (blocked), in Pa.
            state: Memory of earlier frames, of which ``levels``, ``covariance`` and, if there is no
                frame, ``weights`` are used.

        Returns:
            The weights, and the new ``levels`` and ``covariance`` of the state.

        Shape: (..., hops, signals, ears, FRAME) -> (..., hops, blocked signals, ears, bands).
        """
        bands, past = self.config.bands, weight_of_past(self.config.seconds)
        if frames.shape[-4] == 0:
            empty = state["weights"][..., :0, :, :, :]
            return empty, {name: state[name] for name in ("levels", "covariance")}
        spectra = torch.fft.rfft(frames * _window(like=frames))
        products = spectra.unsqueeze(-4) * spectra.unsqueeze(-3).conj()
        covariances = filter_powers(products.real, bands)
        levels = level_db(filter_powers(spectra.abs().square(), bands)).flatten(-3)
        averages = exponential_average(levels, state["levels"], past)
        features = torch.cat(((averages - 40.0) / 20.0, (levels - averages) / 10.0), -1)
        decisions = self.decide(features.to(next(self.decide.parameters()))).to(frames)
        share, loading = decisions.unflatten(-1, (2, EARS, bands)).tanh().unbind(-3)
        weighted = covariances * (3.0 * share).exp()[..., None, None, :, :]
        covariance = exponential_average(weighted.flatten(-4), state["covariance"], past)
        memory = {"levels": averages[..., -1, :], "covariance": covariance[..., -1, :]}
        matrix = covariance.unflatten(-1, (SIGNALS, SIGNALS, EARS, bands))
        matrix = matrix.movedim((-2, -1), (-4, -3))  # (..., hops, ears, bands, signals, signals)
        powers = matrix.diagonal(dim1=-2, dim2=-1)
        added = INITIAL_LOADING * powers[..., 1:] + INITIAL_LEAKAGE * powers[..., :1]
        added = 10.0 ** (2.0 * loading).unsqueeze(-1) * added + POWER_FLOOR
        noise = matrix[..., 1:, 1:] + torch.diag_embed(added)
        weights = torch.linalg.solve(noise, matrix[..., 1:, :1])
        return weights.squeeze(-1).movedim(-1, -3), memory


class BeamformingAid(DirectionalAid, HubModel):
    """A hearing aid with four microphones: an ``AdaptiveBeamformer``, then a ``HearingAid``.

    The input has the shape (..., microphones, ears, time) of ``compensators.directional``.

    Args:
        audiogram: Ears of the listener, which are used by all calls that pass none.
        config: Sizes and choices of both, by default ``BeamformerConfig()``.
        sample_rate: Sample rate of inputs and outputs in Hz, see ``AdaptiveBeamformer``.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Attributes:
        highest_frequency: Highest frequency of outputs in Hz.

    Raises:
        ValueError: The rate, the level or a setting in ``config.aid`` is out of range, an ear is
            not valid, or ``config`` is not a ``BeamformerConfig``.

    >>> BeamformingAid()(torch.zeros(2, 2, 16000), ["N2", "N4"]).shape
    torch.Size([2, 16000])
    """

    highest_frequency = NEURO_RATE / 2.0
    kind = "beamforming-aid"
    config_class = BeamformerConfig

    @check_settings
    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        config: BeamformerConfig | None = None,
        *,
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
    ) -> None:
        config = BeamformerConfig.resolve(config)
        aid_config = HearingAidConfig.from_dict(config.aid)
        levels: dict[str, Any] = {"sample_rate": sample_rate, "full_scale_spl": full_scale_spl}
        super().__init__(
            AdaptiveBeamformer(config, **levels),
            HearingAid(audiogram, aid_config, **levels),
        )
        self.config = replace(config, aid=aid_config.to_dict())

    def unsaved_settings(self) -> dict[str, Any]:
        settings: dict[str, Any] = self.aid.unsaved_settings()
        return settings


def _subtract(frames: Tensor, weights: Tensor) -> Tensor:
    """Subtract the filtered signals without sound from the front from the beams.

    Over a hop, the filters change linearly from the weights before it to the next ones. The result
    is ``LOOK_AHEAD_SAMPLES`` late.

    Shape: (..., hops, signals, ears, FRAME), (..., hops + 1 or more, blocked signals, ears, bands)
        -> (..., ears, hops * HOP).
    """
    hops = frames.shape[-4]
    filters = torch.complex(*(weights @ part for part in _filters(weights.shape[-1], like=frames)))
    spectra = torch.fft.rfft(frames[..., 1:, :, :])
    before, after = (
        torch.fft.irfft((spectra * filters[..., start : start + hops, :, :, :]).sum(-3))
        for start in (0, 1)
    )
    ramp = torch.arange(1, HOP + 1, dtype=frames.dtype, device=frames.device) / HOP
    cancelled = torch.lerp(before[..., HISTORY:], after[..., HISTORY:], ramp)
    delayed = slice(HISTORY - LOOK_AHEAD_SAMPLES, FRAME - LOOK_AHEAD_SAMPLES)
    beams = frames[..., 0, :, delayed]
    return (beams - cancelled).transpose(-3, -2).flatten(-2)


@constant
def _filters(bands: int) -> NDArray[np.float64]:
    """Return the frequency responses of the bands' filters, which are delayed by 0.5 ms.

    Returns: Real and imaginary parts, (2, bands, FRAME / 2 + 1).
    """
    shares = filter_powers(torch.eye(FRAME // 2 + 1, dtype=torch.float64), bands).T.numpy()
    impulses = np.roll(np.fft.irfft(shares), LOOK_AHEAD_SAMPLES, -1)[:, :FILTER_SAMPLES]
    responses = np.fft.rfft(impulses, FRAME)
    return np.stack((responses.real, responses.imag))


@constant
def _window() -> NDArray[np.float64]:
    """Return a Hann window with which the square of a spectrum is a power in Pa^2, (FRAME,)."""
    window = np.hanning(FRAME + 2)[1:-1]
    return window * np.sqrt(2.0 / (FRAME * np.square(window).sum()))
