import numpy as np
import pytest
import torch

from hlsim.msbg.cochlea import hear
from hlsim.msbg.envelope import envelope, envelope_lowpass
from hlsim.msbg.filterbank import BANKS, erb, gammatone_response
from hlsim.msbg.recruitment import expand
from hlsim.msbg.tiers import assign, make_plan

POINTS = 50400
CPU = torch.device("cpu")


@pytest.mark.parametrize("name", ["mild", "moderate", "severe"])
@pytest.mark.parametrize("step", [1, 2])
def test_every_channel_has_one_tier_that_holds_its_band(name: str, step: int) -> None:
    bank, tiers = BANKS[name], assign(BANKS[name], step)
    assert [channel for own, *_ in tiers for channel in range(bank.channels)[own]] == list(
        range(bank.channels)
    )
    for own, rate_step, detector in tiers:
        highest = 44100.0 / rate_step / (2.0 if detector == "itself" else 1.0)
        hz = np.array(bank.centre_frequencies)[own]
        reach = hz + 5.0 * bank.broadening * erb(hz)
        assert np.all(reach <= highest) or rate_step == 1 or step == 2


# white noise is the worst case: it has as much where channels are cut off as in their bands
@pytest.mark.parametrize(
    ("name", "step", "error"), [("mild", 1, 2e-3), ("moderate", 1, 2e-3), ("severe", 1, 5e-4)]
)
def test_tiers_equal_all_channels_at_44_khz(name: str, step: int, error: float) -> None:
    bank = BANKS[name]
    wave = torch.zeros(POINTS, dtype=torch.float64)
    wave[4000:40000] = 0.03 * torch.randn(36000, dtype=torch.float64)
    spectrum = torch.fft.rfft(wave)[None]
    ratios = torch.linspace(1.4, 2.6, bank.channels, dtype=torch.float64)[None]
    heard = torch.fft.irfft(
        hear(spectrum, ratios, make_plan(name, POINTS, step, torch.float64, CPU), False), POINTS
    )
    channels = torch.fft.irfft(
        spectrum.unsqueeze(-2) * torch.from_numpy(gammatone_response(bank, POINTS)), POINTS
    )
    envelopes = envelope(channels, torch.from_numpy(envelope_lowpass(bank, POINTS)))
    truth = expand(channels, envelopes, ratios)
    assert torch.linalg.norm(heard - truth) < error * torch.linalg.norm(truth)
