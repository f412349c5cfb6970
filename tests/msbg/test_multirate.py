"""Channels at their own rates give the output of channels at 44.1 kHz."""

import pytest
import torch

from hlsim.msbg.cochlea import simulate_cochlea
from hlsim.msbg.envelope import envelope, envelope_lowpass
from hlsim.msbg.filter_bank import BANKS, gammatone_response
from hlsim.msbg.recruitment import expand

POINTS = 50400
MAX_ERRORS = {(1.4, 2.6): 5e-4, (1.1, 1.1): 1.5e-3, (1.6, 1.6): 4e-3}
"""Largest relative error by the expansion ratios of the lowest and the highest channel."""


# White noise is the worst case, because it is as strong where channels are cut off as in their
# bands.
@pytest.mark.parametrize("name", ["mild", "moderate", "severe"])
@pytest.mark.parametrize("highest", [22050.0, 10000.0, 9000.0, 8000.0])
def test_rate_bands_equal_all_channels_at_44_khz(name: str, highest: float) -> None:
    bank = BANKS[name]
    rate_divisor = 1 if highest > 11025.0 else 2
    bins = round(highest / 44100.0 * POINTS) + 1
    noise = torch.zeros(POINTS, dtype=torch.float64)
    noise[4000:40000] = 0.03 * torch.randn(36000, dtype=torch.float64)
    spectrum = torch.fft.rfft(noise)[None]
    spectrum[:, bins:] = 0.0

    # The spectrum of a signal at half the rate is half as large.
    slow_spectrum = spectrum[:, : POINTS // rate_divisor // 2 + 1] / rate_divisor
    slow_noise = torch.fft.irfft(slow_spectrum, POINTS // rate_divisor)
    options = {"rate_divisor": rate_divisor, "highest": highest, "corrects_kinks": False}
    response = torch.from_numpy(gammatone_response(bank, POINTS))
    channels = torch.fft.irfft(spectrum.unsqueeze(-2) * response, POINTS)
    envelopes = envelope(channels, torch.from_numpy(envelope_lowpass(bank, POINTS)))
    for ratios, max_error in MAX_ERRORS.items():
        channel_ratios = torch.linspace(*ratios, bank.channels, dtype=torch.float64)[None]
        output = simulate_cochlea(slow_noise, channel_ratios, bank, POINTS, **options)
        output = output[:, :bins] * rate_divisor
        expected = torch.fft.rfft(expand(channels, envelopes, channel_ratios))[:, :bins]
        error = torch.linalg.norm(output - expected) / torch.linalg.norm(expected)
        assert error < max_error, ratios
