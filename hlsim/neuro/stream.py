"""A simulator for a signal that arrives in chunks."""

import math

import torch
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.audiogram.listener import Listener
from hlsim.calibration import NEURO_RATE
from hlsim.checks import check_waveform
from hlsim.neuro.model import NeuroMSBG
from hlsim.torchtools import Audio, as_samples, as_type_of


class SimulatedStream:
    """Simulator for a signal that arrives in chunks.

    Call the object with one chunk after another; it returns as many samples of the perceived
    signal. This output is delayed by the simulator's look-ahead, so that it depends on past input
    only. Its first ``latency`` samples belong to the silence before the first chunk.

    Args:
        simulator: Neuro-MSBG at 16 kHz with a finite receptive field, such as ``neuro-msbg``.
        audiogram: One ear, or a listener with two.

    Attributes:
        latency: Delay of the output in samples: the look-ahead, rounded up to whole blocks.
        block: Number of samples of which the length of every chunk must be a multiple.

    Raises:
        ValueError: The simulator is not a Neuro-MSBG at 16 kHz with a finite receptive field.

    >>> import hlsim
    >>> stream = SimulatedStream(hlsim.load_pretrained("neuro-msbg"), Audiogram.standard("N3"))
    >>> stream(torch.zeros(1536)).shape
    torch.Size([1536])
    """

    def __init__(self, simulator: nn.Module, audiogram: Audiogram | Listener) -> None:
        network = simulator if isinstance(simulator, NeuroMSBG) else None
        field = network.receptive_field if network is not None else None
        if network is None or field is None or network.sample_rate != NEURO_RATE:
            raise ValueError(
                f"expected a Neuro-MSBG at {NEURO_RATE} Hz with a finite receptive field, such "
                "as neuro-msbg"
            )
        self._simulator = network
        self._audiogram = audiogram
        self.block = network.config.step
        self._period, look_ahead = field
        self.latency = math.ceil(look_ahead / self.block) * self.block
        # The frames of a window lie where those of the whole signal do if it begins a whole number
        # of periods before or after the signal.
        self._lead = math.ceil(2 * self.latency / self._period) * self._period
        self._past: Tensor | None = None

    def __call__(self, chunk: Audio) -> Audio:
        """Return the next samples of the perceived signal, ``latency`` samples late.

        Args:
            chunk: Next samples of the input, a tensor or an array. Shape: (time,), or (2, time) for
                a listener.

        Returns:
            Perceived samples of the same shape.

        Raises:
            ValueError: The number of samples is no multiple of ``block``, the chunk is no waveform
                of this shape or has another number of signals than the first chunk, or an ear is
                not valid.
        """
        signals = as_samples(chunk)
        check_waveform(signals, "chunk")
        samples = signals.shape[-1]
        if samples % self.block:
            raise ValueError(
                f"expected a chunk of a multiple of {self.block} samples, got {samples} samples"
            )
        if self._past is None:
            self._past = signals.new_zeros(*signals.shape[:-1], self._lead)
        past: Tensor = self._past
        if past.shape[:-1] != signals.shape[:-1]:
            raise ValueError(
                f"expected a chunk of shape {(*past.shape[:-1], 'time')} as before, got "
                f"{tuple(signals.shape)}; make a new stream for another signal"
            )
        window = torch.cat((past, signals), -1)
        superfluous_periods = (window.shape[-1] - 2 * self.latency) // self._period
        self._past = window[..., superfluous_periods * self._period :]
        with torch.no_grad():
            perceived: Tensor = self._simulator(window, self._audiogram)
        stop = window.shape[-1] - self.latency
        return as_type_of(chunk, perceived[..., stop - samples : stop])
