"""Augmented training speech has the requested levels, ratios and gains."""

import pytest
import torch
from torch import Tensor

from hlsim.calibration import level_spl
from hlsim.data.augment import HIGHEST_LEVEL, augment_speech, compress, equalise
from hlsim.data.ears import draw_thresholds


def tones(*hz: float, rate: int = 16000, seconds: float = 0.5) -> Tensor:
    time = torch.arange(round(rate * seconds)) / rate
    return torch.stack([torch.sin(2 * torch.pi * f * time) for f in hz])


@pytest.mark.parametrize("rate", [16000, 44100])
def test_equalise_has_the_gains_at_and_between_the_frequencies(rate: int) -> None:
    knots, gains = (200.0, 800.0, 3200.0), torch.tensor([[-12.0, 6.0, 0.0]])
    expected = {100: -12.0, 200: -12.0, 400: -3.0, 800: 6.0, 1600: 3.0, 3200: 0.0, 6000: 0.0}
    tone = tones(*expected, rate=rate)
    out = equalise(tone, gains.expand(len(tone), -1), knots, rate)
    # zero-phase: the tone itself, louder or softer
    louder = 10 ** (torch.tensor([*expected.values()]).unsqueeze(-1) / 20) * tone
    middle = slice(rate // 8, -rate // 8)
    torch.testing.assert_close(out[:, middle], louder[:, middle], atol=0.02, rtol=0)


def test_compress_divides_level_differences_by_the_ratio() -> None:
    loud_and_soft = torch.cat((tones(1000)[0], 0.1 * tones(1000)[0])).unsqueeze(0)
    half = loud_and_soft.shape[-1] // 2
    for ratio in (1.0, 2.0, 4.0):
        out = compress(loud_and_soft, torch.tensor([ratio]), 16000)
        difference = level_spl(out[:, 1000 : half - 1000]) - level_spl(out[:, half + 1000 : -1000])
        # 20 dB; the floor 30 dB under the mean takes a little
        assert float(difference) == pytest.approx(20.0 / ratio, abs=0.5)
    torch.testing.assert_close(compress(loud_and_soft, torch.ones(1), 16000), loud_and_soft)


def drawn(ears: Tensor, seed: int = 0, gain: float = 1.0) -> Tensor:
    """Augment 500 items of noise that stands for speech."""
    generator = torch.Generator().manual_seed(seed)
    speech, noise = torch.randn(2, 500, 400, generator=generator)
    return augment_speech(gain * speech, noise, ears, generator)


def test_levels_are_in_the_stated_range() -> None:
    """Before amplification and equalisation 40 to 95 dB SPL, after them none above the highest."""
    ears = draw_thresholds(500, torch.Generator().manual_seed(0))
    levels = level_spl(drawn(ears))
    assert 40.0 - 15.0 < float(levels.min()) < 45.0
    assert 105.0 < float(levels.max()) <= HIGHEST_LEVEL + 0.01
    assert 64.0 < float(level_spl(drawn(torch.zeros(500, 8))).median()) < 72.0


def test_two_in_five_are_amplified_for_the_ear() -> None:
    aided = level_spl(drawn(torch.full((500, 8), 80.0)))
    gain = aided - level_spl(drawn(torch.zeros(500, 8)))
    amplified = gain > 1.0
    assert 0.33 < float(amplified.float().mean()) < 0.47
    # 0.2 to 0.8 of the loss, unless that would be too loud
    free = amplified & (aided < HIGHEST_LEVEL - 0.1)
    assert float(gain[free].min()) > 0.2 * 80 - 0.1 and float(gain[free].max()) < 0.8 * 80 + 0.1
    assert float(gain[~amplified].abs().max()) < 0.1


def test_items_depend_on_the_generator_and_not_on_the_level_of_recordings() -> None:
    ears = torch.zeros(500, 8)
    assert torch.equal(drawn(ears), drawn(ears)) and not torch.equal(drawn(ears), drawn(ears, 1))
    torch.testing.assert_close(drawn(ears, gain=1e-3), drawn(ears), atol=1e-5, rtol=1e-3)
    assert bool(torch.isfinite(drawn(ears, gain=0.0)).all())
