"""Tones are steady, clicks are short, and both depend on the seed alone."""

import pytest
import torch

from hlsim.data.tones_and_clicks import draw_sounds


def draw(items: int, samples: int = 16000, seed: int = 0) -> torch.Tensor:
    return draw_sounds(items, samples, torch.Generator().manual_seed(seed))


def test_tones_are_steady_and_few() -> None:
    tones = draw(40)[::2]
    spectra = (tones[:, 8000:] * torch.hann_window(8000)).T.contiguous()
    powers = torch.fft.rfft(spectra, dim=0).abs().square()
    # The power is in four tones, each of five bins because of the window.
    loudest = powers.topk(5 * 4, dim=0).values.sum(0)
    assert float((loudest / powers.sum(0)).min()) > 0.999
    hertz = powers.argmax(0) * 2.0
    assert float(hertz.min()) >= 98.0 and float(hertz.max()) <= 7502.0
    assert int((hertz % 250.0 == 0.0).sum()) > 5 and len(hertz.unique()) > 10
    begins = (tones.abs() > 1e-6 * tones.abs().amax(-1, keepdim=True)).float().argmax(-1)
    assert 4000 < int(begins.max()) <= 8010 and 5 < int((begins < 10).sum()) < 15


def test_clicks_are_single_samples_that_depend_on_the_seed_alone() -> None:
    counts = (draw(40)[1::2] != 0.0).sum(-1)
    assert int(counts.min()) >= 1 and int(counts.max()) <= 8 and len(counts.unique()) > 2
    assert torch.equal(draw(6), draw(6)) and not torch.equal(draw(6), draw(6, seed=1))


def test_single_items_have_tones_or_clicks() -> None:
    are_clicks = [int((draw(1, 1000, seed) != 0.0).sum()) <= 8 for seed in range(40)]
    assert 10 < sum(are_clicks) < 30


def test_a_sound_has_at_least_one_sample() -> None:
    with pytest.raises(ValueError, match="expected samples to be a whole number from 1, got 0"):
        draw(2, samples=0)
