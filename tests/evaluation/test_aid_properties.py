"""Gains, steady tones, quiet noise and look-ahead of aids with known properties."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from compensators import NALR, MappingCompensator
from compensators.config import MappingConfig
from hlsim import MSBG, Audiogram
from hlsim.calibration import level_spl
from hlsim.evaluation.aid_properties import (
    TONES,
    make_tones,
    measure_aids,
    measure_gain_curve,
    measure_steady_tones,
    measure_wearability,
)
from hlsim.evaluation.conditions import (
    EqualiserLike,
    PrescriptionForEar,
    Unaided,
    _equalise_bands,
)
from hlsim.evaluation.measures import NORMAL
from hlsim.metrics.band_levels import band_edges

N3 = Audiogram.standard("N3")
COUNT = len(TONES)


def modulate(waveform: Tensor, ear: Audiogram) -> Tensor:
    """Multiply the waveform by 1 + cos(2 pi 80 t)."""
    turns = 80 * torch.arange(waveform.shape[-1]) % 16000 / 16000
    return waveform * (1.0 + (2.0 * torch.pi * turns).cos())


def mute_steady_sounds(waveform: Tensor, ear: Audiogram) -> Tensor:
    """Reduce a sound by 40 dB if its level is the same in all frames of 32 ms."""
    levels = level_spl(waveform[: len(waveform) // 512 * 512].unflatten(-1, (-1, 512)))
    return 0.01 * waveform if float(levels.std()) < 1.0 else waveform


def anticipate(waveform: Tensor, ear: Audiogram) -> Tensor:
    """Advance the sound by 80 samples; amplify soft sounds by 20 dB and others by 6 dB."""
    gain = 2.0 if float(level_spl(waveform)) > 50.0 else 10.0
    return gain * waveform.roll(-80)


def silence(waveform: Tensor, ear: Audiogram) -> Tensor:
    return 0.0 * waveform


def test_tones_have_their_levels_and_frequencies() -> None:
    sound = make_tones((250, 1000), (50.0, 65.0, 80.0))
    torch.testing.assert_close(level_spl(sound), torch.tensor([50.0, 65.0, 80.0, 50.0, 65.0, 80.0]))
    assert (torch.fft.rfft(sound).abs().argmax(-1) / 2).tolist() == [250.0] * 3 + [1000.0] * 3


def test_the_loudness_error_without_an_aid_is_that_of_the_exact_model() -> None:
    result = measure_steady_tones(Unaided(), N3, (50.0, 65.0))
    time = torch.arange(32000, dtype=torch.float64) / 16000
    for row, level in enumerate((50.0, 65.0)):
        tone = 2**0.5 * 10.0 ** ((level - 94.0) / 20.0) * (2.0 * torch.pi * 1000.0 * time).sin()
        impaired, normal = (level_spl(MSBG(ear)(tone)[8000:24000]) for ear in (N3, NORMAL))
        error = result["loudness_error_db"][row][TONES.index(1000)]
        assert error == pytest.approx(float(impaired - normal), abs=0.01) and error < -20.0


def test_modulation_adds_two_sidebands_of_half_its_depth() -> None:
    result = measure_steady_tones(modulate, NORMAL, (65.0,))
    assert result["sidebands_db"][0] == pytest.approx([10.0 * math.log10(0.5)] * COUNT, abs=0.01)
    loudness = 10.0 * math.log10(1.5)  # A normal ear is linear.
    assert result["loudness_error_db"][0][2] == pytest.approx(loudness, abs=0.1)


@pytest.mark.parametrize(
    ("aid", "error"), [(Unaided(), 0.0), (mute_steady_sounds, -40.0), (silence, None)]
)
def test_muting_of_steady_sounds_is_measured(aid: Callable[..., Tensor], error: Any) -> None:
    result = measure_steady_tones(aid, NORMAL, (50.0, 80.0))
    for level in range(2):
        errors = result["loudness_error_db"][level]
        if error is None:
            assert max(errors) < -40.0 and result["sidebands_db"][level] == [-200.0] * COUNT
        else:
            assert errors == pytest.approx([error] * COUNT, abs=1e-3)


@pytest.mark.parametrize(
    ("aid", "lowest", "highest", "gain"),
    [
        (anticipate, 5.0, 5.0, 20.0),
        (Unaided(), 0.0, 0.0, 0.0),
        # Its filter has 110 samples before the middle, the first of which are small.
        (NALR(), 3.0, 1000.0 * 110 / 16000, None),
        (silence, 0.0, 0.0, None),
    ],
)
def test_look_ahead_gain_for_quiet_noise_and_cost(
    aid: Callable[..., Tensor], lowest: float, highest: float, gain: float | None
) -> None:
    result = measure_wearability(
        aid, N3, torch.randn(48000, generator=torch.Generator().manual_seed(1))
    )
    assert lowest <= result["look_ahead_ms"] <= highest and result["cpu_ms"] > 0.0
    if gain is not None:
        assert result["quiet_gain_db"] == pytest.approx([gain, gain], abs=0.1)


def test_an_equaliser_has_the_mean_gain_of_its_aid() -> None:
    edges = band_edges()
    gains = np.interp(np.linspace(0.0, 1.0, len(edges) - 1), [0.0, 0.4, 1.0], [0.0, 10.0, 40.0])

    class Filter(nn.Module):
        def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
            return _equalise_bands(waveform, gains.tolist())

    noise = torch.randn(1, 48000)
    measured = measure_gain_curve(Filter(), N3, noise, (65.0,))["gain_db"]
    # A band is as loud as its loudest part where the gain rises steeply.
    np.testing.assert_allclose(measured[0], gains, atol=1.0)
    equaliser = EqualiserLike(Filter(), noise, (50.0, 80.0))
    assert equaliser.gains_db(N3) == pytest.approx(measured[0], abs=0.06)
    limited = MappingCompensator(config=MappingConfig(limit_spl=80.0)).eval()
    soft, loud = measure_gain_curve(limited, N3, noise, (50.0, 80.0))["gain_db"]
    assert np.mean(loud) < np.mean(soft) - 6.0


def raise_error(waveform: Tensor, ear: Audiogram) -> Tensor:
    raise RuntimeError("no\nbattery")


@pytest.mark.parametrize(
    ("aid", "message"),
    [
        (lambda waveform, ear: waveform * math.nan, "NaN or infinite"),
        (lambda waveform, ear: waveform[None], "expected a floating-point output of shape"),
        (lambda waveform, ear: (32767 * waveform).short(), "got torch.int16"),
        (lambda waveform, ear: torch.cat((waveform, waveform)), "a difference of 1 s"),
        (raise_error, "RuntimeError: no battery"),
    ],
)
def test_an_aid_that_fails_is_named(aid: Callable[..., Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=f"^mine, ear N3: .*{message}"):
        measure_aids({"mine": aid}, {"N3": N3}, measure_gain_curve, torch.randn(1, 16000), (65.0,))


def test_a_prescription_for_the_ear_is_measured_only_where_it_is_not_nal_r() -> None:
    aids = {"NAL-R": NALR(), "for-ear": PrescriptionForEar()}
    ears = {"N3": N3, "profound": Audiogram([95.0] * 8)}
    rows = measure_aids(aids, ears, lambda aid, ear: {})
    pairs = [(row["ear"], row["aid"]) for row in rows]
    assert pairs == [("N3", "NAL-R"), ("profound", "NAL-R"), ("profound", "for-ear")]
