"""Resampling equals that of torchaudio, and its filter has the documented response."""

import itertools
import math

import numpy as np
import pytest
import scipy.fft
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.resample import KAISER_BETA, ROLLOFF, ZERO_CROSSINGS, resample, sinc_kernel

RATES = [
    *((16000, 44100), (44100, 16000), (48000, 16000)),
    *((16000, 48000), (22050, 44100), (32000, 44100)),
]
CPU = torch.device("cpu")


def frequency_response(kernel: Tensor, source: int, target: int) -> tuple[NDArray, NDArray]:
    """Frequencies relative to the lower Nyquist frequency, and the gain of a kernel in dB."""
    phases = kernel[:, 0].double().numpy()
    reach = (phases.shape[1] - source) // 2
    taps = (np.arange(phases.shape[1]) - reach) * target
    # in samples at the common multiple of both rates
    positions = taps - np.arange(target)[:, None] * source
    filter_taps = np.zeros(scipy.fft.next_fast_len(8 * phases.size))
    filter_taps[positions - positions.min()] = phases / target
    gain = 20 * np.log10(np.abs(np.fft.rfft(filter_taps)) + 1e-15)
    return np.fft.rfftfreq(len(filter_taps)) * 2 * max(source, target), gain


@pytest.mark.parametrize(
    ("dtype", "far_db"),
    [pytest.param(torch.float32, -103.0, marks=pytest.mark.slow), (torch.float64, -145.0)],
    ids=str,
)
def test_pass_band_and_stop_band_are_as_documented(dtype: torch.dtype, far_db: float) -> None:
    for rates in itertools.permutations((16000, 22050, 24000, 32000, 44100, 48000), 2):
        source, target = (rate // math.gcd(*rates) for rate in rates)
        kernel = sinc_kernel(source, target, dtype, CPU)
        frequency, gain_db = frequency_response(kernel, source, target)
        assert np.abs(gain_db[frequency <= 0.9]).max() < 0.023
        assert np.interp(ROLLOFF, frequency, gain_db) == pytest.approx(-6.02, abs=0.02)
        assert gain_db[frequency >= 1.0].max() < -61.6
        assert gain_db[frequency >= 1.01].max() < -90.0
        assert gain_db[frequency >= 1.05].max() < far_db


def test_stop_band_keeps_69_db_where_convolutions_round_to_tf32() -> None:
    for source, target in ((441, 160), (160, 441), (3, 1), (1, 3)):
        kernel = sinc_kernel(source, target, torch.float32, CPU)
        rounded = ((kernel.view(torch.int32) + 0x1000) & ~0x1FFF).view(torch.float32)
        frequency, gain_db = frequency_response(rounded, source, target)
        assert gain_db[frequency >= 1.01].max() < -69.0


@pytest.mark.parametrize(("source", "target"), RATES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_equals_torchaudio(source: int, target: int, dtype: torch.dtype) -> None:
    torchaudio = pytest.importorskip("torchaudio.functional", exc_type=Exception)
    waveform = torch.randn(2, 1500, dtype=dtype)
    options = {"lowpass_filter_width": ZERO_CROSSINGS, "rolloff": ROLLOFF, "beta": KAISER_BETA}
    method = "sinc_interp_kaiser"
    theirs = torchaudio.resample(waveform, source, target, resampling_method=method, **options)
    torch.testing.assert_close(resample(waveform, source, target), theirs, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("source", "target"), RATES)
def test_length_is_rounded_up_and_leading_dimensions_stay(source: int, target: int) -> None:
    for time in (1, 159, 1601):
        waveform = torch.randn(3, 2, time).mT.contiguous().mT  # with gaps in memory
        resampled = resample(waveform, source, target)
        assert resampled.shape == (3, 2, math.ceil(time * target / source))
        torch.testing.assert_close(resampled[1, 1], resample(waveform[1, 1], source, target))


@pytest.mark.slow
def test_resampling_compiles_to_one_graph() -> None:
    waveform = torch.randn(2, 500)
    options = {"backend": "aot_eager", "fullgraph": True}
    compiled = torch.compile(lambda x: resample(x, 44100, 16000), **options)
    torch.testing.assert_close(compiled(waveform), resample(waveform, 44100, 16000))


def test_bad_arguments_are_rejected() -> None:
    with pytest.raises(ValueError, match="expected waveform to be a floating-point tensor"):
        resample(torch.ones(50, dtype=torch.int16), 44100, 16000)
    with pytest.raises(ValueError, match=r"got shape \(50, 2\); transpose it: x.T"):
        resample(torch.ones(50, 2), 44100, 16000)
    with pytest.raises(ValueError, match="cannot resample from 44101 to 16000 Hz"):
        resample(torch.ones(50), 44101, 16000)
