"""Values are validated where they enter, and messages say what was expected."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from compensators import WDRC, load_compensator
from hlsim import MSBG, Audiogram, HearingLossLoss, load_pretrained
from hlsim.calibration import level_spl, set_level
from hlsim.checks import check_lengths, check_rate, check_waveform
from hlsim.metrics import haspi, hasqi, mbstoi

N3 = Audiogram.standard("N3")


@pytest.mark.parametrize(
    "rate",
    [15999, 48001, 16000.5, -16000, 0, math.nan, math.inf, 10**400, None, "16k", True, [16000]],
)
def test_a_rate_out_of_range_raises_value_error(rate: Any) -> None:
    with pytest.raises(ValueError, match="from 16000 to 48000 Hz"):
        check_rate(rate)


def test_the_message_on_a_rate_names_its_type() -> None:
    with pytest.raises(ValueError, match=r"got '16000' \(str\)"):
        MSBG(sample_rate="16000")  # type: ignore[arg-type]


@pytest.mark.parametrize("rate", [16000, 44100.0, 48000, np.int64(16000), np.float32(16000)])
def test_rates_in_range_come_back_whole(rate: int) -> None:
    assert check_rate(rate) == rate and type(check_rate(rate)) is int


@pytest.mark.parametrize(
    "wave",
    [
        torch.zeros(10, dtype=torch.int16),
        torch.zeros(10, dtype=torch.complex64),
        np.zeros(10),
        None,
        torch.tensor(1.0),
        torch.zeros(2, 0),
        torch.full((2, 10), 1.1e9),
        torch.full((2, 10), -1e18, dtype=torch.float64),
    ],
)
def test_what_is_no_waveform_raises_value_error(wave: Any) -> None:
    with pytest.raises(ValueError, match=r"expected .*perceived"):
        check_waveform(wave, "perceived")


def test_samples_up_to_the_highest_and_nan_pass() -> None:
    for sample in (1e9, -1e9, float("nan"), float("inf")):
        check_waveform(torch.full((10,), sample))
    wave = torch.full((2, 10), 1e18)
    assert torch.equal(torch.compile(check_waveform, backend="eager", fullgraph=True)(wave), wave)


def stream(wave: Tensor) -> Tensor:
    return WDRC().stream(N3)(wave)


ENTRANCES: dict[str, Callable[[Tensor], object]] = {
    "MSBG": MSBG(N3, sample_rate=16000),
    "NeuroMSBG": lambda wave: load_pretrained("neuro-msbg-light")(wave, N3),
    "loss": lambda wave: HearingLossLoss(N3, simulator="msbg")(wave, wave),
    "NALR": lambda wave: load_compensator("nalr")(wave, N3),
    "hearing aid": lambda wave: load_compensator("hearing-aid")(wave, N3),
    "compensator": lambda wave: load_compensator("compensator-general")(wave, N3),
    "stream": stream,
    "haspi": lambda wave: haspi(wave, wave, N3),
    "hasqi": lambda wave: hasqi(wave, wave, N3),
    "mbstoi": lambda wave: mbstoi(wave, wave),
    "level_spl": level_spl,
    "set_level": lambda wave: set_level(wave, 65.0),
}


@pytest.mark.parametrize("entrance", ENTRANCES)
@pytest.mark.parametrize("shape", [(16000, 2), (3, 16000, 1)])
def test_every_entrance_rejects_time_first(entrance: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"time last, got shape \(.*16000.*transpose it: x\.m?T"):
        ENTRANCES[entrance](torch.zeros(shape))


def test_a_batch_of_few_samples_is_no_time_first_array() -> None:
    for shape in ((8, 1), (2, 4), (1,), (40, 9), (40, 2, 8)):
        check_waveform(torch.zeros(shape))


@pytest.mark.parametrize(
    ("lengths", "expected"), [([3, 10], [3, 10]), ([0.25, 1.0], [2, 10]), ((1, 2), [1, 2])]
)
def test_lengths_are_samples_or_shares(lengths: Any, expected: list[int]) -> None:
    assert check_lengths(lengths, torch.Size((2, 10))).tolist() == expected
    mono = check_lengths(torch.tensor(lengths), torch.Size((2, 1, 10)))
    assert mono.tolist() == [[end] for end in expected]


@pytest.mark.parametrize("lengths", [[0, 3], [3, 11], [1.5, 2.0], [3], "34", [True, True], None])
def test_bad_lengths_raise_value_error(lengths: Any) -> None:
    with pytest.raises(ValueError, match=r"expected lengths to be whole numbers from 1 to 10"):
        check_lengths(lengths, torch.Size((2, 10)))
