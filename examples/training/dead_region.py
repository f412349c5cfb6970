"""Another simulator than MSBG, in thirty lines, for `--teacher` and for ``HearingLossLoss(simulator=DeadRegion())``.

Each frequency is attenuated by its loss, whatever the level; from the first frequency on, from 2 kHz up, where the loss
exceeds 70 dB HL, the cochlea is dead and nothing is heard.
"""

import torch
from torch import Tensor, nn

from hlsim.audiogram.thresholds import interpolate


class DeadRegion(nn.Module):
    sample_rate = 16000  # of what it takes and gives; `hlsim --teacher` resamples to it and back

    def forward(self, waveform: Tensor, audiogram: Tensor) -> Tensor:
        """Shape: (..., time), (..., 8) dB HL -> (..., time), time-aligned."""
        hz = tuple(k * self.sample_rate / 512 for k in range(257))
        loss = interpolate(audiogram, hz)
        dead = (loss > 70.0) & (torch.tensor(hz, device=loss.device) >= 2000.0)
        gains = 10.0 ** (-loss.clamp_min(0.0) / 20.0) * (dead.cumsum(-1) == 0)
        # a filter of 32 ms around its middle, so that nothing is delayed
        taps = torch.fft.irfft(gains.to(waveform)).roll(256, -1) * torch.hann_window(512).to(
            waveform
        )
        time = waveform.shape[-1]
        size = time + 512
        product = torch.fft.rfft(waveform, size) * torch.fft.rfft(taps, size)
        return torch.fft.irfft(product, size)[..., 256 : 256 + time]
