"""An aid may limit the output of each band to the uncomfortable level of the ear."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from compensators import WDRC, HearingAid, load_compensator
from hlsim import Audiogram
from hlsim.audiogram.discomfort import PREDICTION_MARGIN_DB
from hlsim.calibration import level_spl
from tests.compensators.aids import build_wearable, tone

N3 = Audiogram.standard("N3")
SENSITIVE = Audiogram(N3.levels, ucl={500: 80.0, 4000: 80.0})

each_aid = pytest.mark.parametrize("name", ["aid", "wdrc"])


def largest_third_spl(output: Tensor, hertz: float) -> float:
    """Return the level of a steady tone around its frequency."""
    spectrum = torch.fft.rfft(output[..., 8000:]).abs().square()
    frequencies = torch.linspace(0.0, 8000.0, spectrum.shape[-1])
    near = (frequencies > hertz / 1.12) & (frequencies < hertz * 1.12)
    share = spectrum[..., near].sum() / spectrum.sum()
    return float(level_spl(output[..., 8000:]) + 10.0 * share.log10())


@each_aid
@pytest.mark.parametrize(("hertz", "reference"), [(500.0, 4.4), (4000.0, -5.4)])
def test_no_tone_exceeds_the_measured_level(name: str, hertz: float, reference: float) -> None:
    sound = tone(hertz, 85.0)
    limited = build_wearable(name, limit_to_ear=True)(sound, SENSITIVE)
    free = build_wearable(name)(sound, SENSITIVE)
    highest = 80.0 + reference
    assert largest_third_spl(limited, hertz) < highest < largest_third_spl(free, hertz)


@pytest.mark.parametrize("name", ["hearing-aid", "wdrc", "camfit"])
def test_distant_bands_amplify_no_loud_tone_above_the_measured_level(name: str) -> None:
    """Far from a tone of 100 dB SPL, an aid has high gains, which filters of bands must attenuate.

    The limit at these tones is 80.3, 77.7 and 69.1 dB SPL: 75 dB HL.
    """
    levels = Audiogram.standard("N4").levels
    ear = Audiogram(levels, ucl={1000: 75.0, 2000: 75.0, 4000: 75.0})
    aid = load_compensator(name, limit_to_ear=True)
    for hertz, highest in ((449.0, 80.3), (696.0, 77.7), (3240.0, 69.1)):
        output = aid(tone(hertz, 100.0), ear)[8000:-1000]
        assert float(level_spl(output)) < highest


@each_aid
def test_measured_levels_reach_the_aid_by_every_way(name: str, utterance: Tensor) -> None:
    loud = 20.0 * utterance[:8000]
    aid = build_wearable(name, limit_to_ear=True)
    output = aid(loud, SENSITIVE)
    assert torch.equal(build_wearable(name, limit_to_ear=True, audiogram=SENSITIVE)(loud), output)
    predicted = aid(loud, N3)
    torch.testing.assert_close(aid(loud, torch.tensor(N3.thresholds)), predicted)
    assert (predicted - output).abs().max() > 0.01
    both = aid(torch.stack((loud, loud)), [SENSITIVE, N3])
    torch.testing.assert_close(both, torch.stack((output, predicted)))
    mono = aid(torch.stack((loud, loud)).unsqueeze(1), [SENSITIVE, N3])
    torch.testing.assert_close(mono.squeeze(1), both)


@each_aid
def test_a_stream_is_limited_as_the_whole_signal_is(name: str, utterance: Tensor) -> None:
    loud = 20.0 * utterance[:4000]
    aid = build_wearable(name, limit_to_ear=True)
    stream = aid.stream(SENSITIVE)
    chunks = [stream(chunk) for chunk in loud.split(333)]
    output = torch.cat([*chunks, stream.flush()])[aid.latency :]
    torch.testing.assert_close(output, aid(loud, SENSITIVE), rtol=1e-4, atol=1e-5)


@each_aid
def test_a_slam_is_limited_within_a_frame_and_gain_recovers(name: str) -> None:
    """The slam is a decaying noise with a peak of 100 dB SPL."""
    soft, time = tone(2000.0, 40.0), np.arange(4000) / 16000.0
    decay = np.exp(-time / 0.03) * np.random.default_rng(0).normal(size=4000)
    slam = torch.zeros(16000)
    slam[8000:12000] = torch.from_numpy(2.0 * decay / np.abs(decay).max()).float()
    ear = Audiogram([60.0] * 8, ucl={1000: 92.0})
    aid, free = (build_wearable(name, limit_to_ear=limit) for limit in (True, False))
    outputs = [module(soft + slam, ear) for module in (aid, free)]
    energies = [float(output[8000:10000].square().sum()) for output in outputs]
    assert energies[0] < 0.7 * energies[1]
    late = [float(output[15000:].square().sum()) for output in outputs]
    assert late[0] == pytest.approx(late[1], rel=0.1)


@each_aid
def test_gradients_pass_and_gains_for_noise_are_those_without_the_limit(name: str) -> None:
    aid = build_wearable(name, limit_to_ear=True)
    waveform = tone(1000.0, 90.0, 0.1).requires_grad_()
    (gradient,) = torch.autograd.grad(aid(waveform, SENSITIVE).square().sum(), waveform)
    assert bool(gradient.isfinite().all()) and bool(gradient.any())
    assert torch.equal(aid.gains(SENSITIVE), build_wearable(name).gains(N3))


def test_linked_ears_have_limits_of_their_own(utterance: Tensor) -> None:
    loud = 20.0 * utterance[:8000].expand(2, -1)
    aid = WDRC(linked=True, limit_to_ear=True)
    left, right = aid(loud, [SENSITIVE, N3])
    assert float(level_spl(left)) < float(level_spl(right)) - 1.0


@pytest.mark.parametrize("name", ["limit_to_ear", "linked"])
def test_a_switch_is_true_or_false(name: str) -> None:
    wrong: dict[str, Any] = {name: "no"}
    for build in (WDRC, HearingAid, partial(load_compensator, "nalr")):
        with pytest.raises(ValueError, match=f"expected {name} to be True or False, got"):
            build(**wrong)


@each_aid
def test_without_measured_levels_the_limit_is_safer_than_the_prediction(name: str) -> None:
    sound = tone(1000.0, 110.0)
    aid = build_wearable(name, limit_to_ear=True)
    predicted = N3.uncomfortable_levels([1000.0])[0]
    measured = Audiogram(N3.levels, ucl={1000: predicted - PREDICTION_MARGIN_DB})
    torch.testing.assert_close(aid(sound, N3), aid(sound, measured), rtol=1e-3, atol=1e-4)
    as_predicted = Audiogram(N3.levels, ucl={1000: predicted})
    safe, loud = (level_spl(aid(sound, ear)[8000:]) for ear in (N3, as_predicted))
    assert float(loud - safe) == pytest.approx(PREDICTION_MARGIN_DB, abs=1.0)


def test_an_aid_without_bands_rejects_the_limit() -> None:
    assert load_compensator("wdrc", limit_to_ear=True).limit_to_ear
    with pytest.raises(ValueError, match="has no setting limit_to_ear"):
        load_compensator("nalr", limit_to_ear=True)
