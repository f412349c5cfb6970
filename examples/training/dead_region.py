"""A simulator of dead regions, which can be a teacher (``--teacher``) or part of a loss.

``HearingLossLoss(simulator=DeadRegion())`` trains an aid through it. It shows that any simulator
can take the place of MSBG. Each frequency is attenuated by its loss, whatever the level. Above the
first frequency from 2 kHz up whose loss exceeds 70 dB HL, the cochlea is dead, and the ear
perceives nothing.
"""

import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES
from hlsim.dsp.interpolation import interpolate

TAPS = 512
"""Length of the filter in samples, 32 ms."""


class DeadRegion(nn.Module):
    """Attenuation by the threshold loss, with a dead region above 2 kHz.

    Attributes:
        sample_rate: Sample rate of input and output in Hz. ``--teacher`` resamples to it and back.
    """

    sample_rate = 16000

    def forward(self, waveform: Tensor, audiogram: Tensor) -> Tensor:
        """Simulate the loss. Shape: (..., time), (..., 8) in dB HL -> (..., time), time-aligned."""
        hz = tuple(number * self.sample_rate / TAPS for number in range(TAPS // 2 + 1))
        loss_db = interpolate(audiogram, FREQUENCIES, hz)
        is_dead = (loss_db > 70.0) & (torch.tensor(hz, device=loss_db.device) >= 2000.0)
        is_alive = is_dead.cumsum(-1) == 0
        gains = 10.0 ** (-loss_db.clamp_min(0.0) / 20.0) * is_alive
        # The filter is symmetric around its middle, so that it causes no delay.
        impulse_response = torch.fft.irfft(gains.to(waveform)).roll(TAPS // 2, -1)
        impulse_response = impulse_response * torch.hann_window(TAPS).to(waveform)
        time = waveform.shape[-1]
        points = time + TAPS
        spectrum = torch.fft.rfft(waveform, points) * torch.fft.rfft(impulse_response, points)
        return torch.fft.irfft(spectrum, points)[..., TAPS // 2 : TAPS // 2 + time]
