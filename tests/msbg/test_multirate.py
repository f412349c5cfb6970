import numpy as np
import pytest
import torch

from hlsim.dsp.erb import erb
from hlsim.msbg.cochlea import hear
from hlsim.msbg.envelope import envelope, envelope_lowpass
from hlsim.msbg.filterbank import BANKS, gammatone_response
from hlsim.msbg.multirate import assign_rates, multirate_bank
from hlsim.msbg.recruitment import expand

POINTS = 50400
CPU = torch.device("cpu")
RATIOS = {(1.4, 2.6): 5e-4, (1.1, 1.1): 1.5e-3, (1.6, 1.6): 4e-3}
"""Expansion ratios of the lowest and the highest channel, and the relative error that they allow."""


@pytest.mark.parametrize("name", ["mild", "moderate", "severe"])
@pytest.mark.parametrize("step", [1, 2])
def test_every_channel_has_one_rate_that_holds_its_band(name: str, step: int) -> None:
    bank, bands = BANKS[name], assign_rates(BANKS[name], step)
    assert [channel for some, *_ in bands for channel in range(bank.channels)[some]] == list(
        range(bank.channels)
    )
    for some, samples, detector in bands:
        highest = 44100.0 / 24 * samples / (2.0 if detector == "itself" else 1.0)
        hz = np.array(bank.centre_frequencies)[some]
        top = hz + 5.0 * bank.broadening * erb(hz)
        assert np.all(top <= highest) or samples == 24 or step == 2


# white noise is the worst case: it has as much where channels are cut off as in their bands
@pytest.mark.parametrize("name", ["mild", "moderate", "severe"])
@pytest.mark.parametrize(
    ("highest", "ratios", "error"),
    [
        (hz, ratios, error)
        for hz in (22050.0, 10000.0, 9000.0, 8000.0)
        for ratios, error in RATIOS.items()
    ],
)
def test_rate_bands_equal_all_channels_at_44_khz(
    name: str, highest: float, ratios: tuple[float, float], error: float
) -> None:
    bank, step = BANKS[name], 1 if highest > 11025.0 else 2
    bins = round(highest / 44100.0 * POINTS) + 1
    wave = torch.zeros(POINTS, dtype=torch.float64)
    wave[4000:40000] = 0.03 * torch.randn(36000, dtype=torch.float64)
    spectrum = torch.fft.rfft(wave)[None]
    spectrum[:, bins:] = 0.0
    each = torch.linspace(*ratios, bank.channels, dtype=torch.float64)[None]
    multirate = multirate_bank(bank, POINTS, step, highest, torch.float64, CPU)
    # the spectrum of a signal at half the rate is half as large
    heard = (
        hear(spectrum[:, : POINTS // step // 2 + 1] / step, each, multirate, False)[:, :bins] * step
    )
    channels = torch.fft.irfft(
        spectrum.unsqueeze(-2) * torch.from_numpy(gammatone_response(bank, POINTS)), POINTS
    )
    envelopes = envelope(channels, torch.from_numpy(envelope_lowpass(bank, POINTS)))
    truth = torch.fft.rfft(expand(channels, envelopes, each))[:, :bins]
    assert torch.linalg.norm(heard - truth) < error * torch.linalg.norm(truth)
