"""Values are validated where they enter, and messages say what was expected."""

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import hlsim
from compensators import NALR, WDRC
from hlsim import checks
from hlsim.calibration import level_spl, set_level
from hlsim.checks import check_lengths, check_rate, check_waveform
from hlsim.dsp.resample import resample
from hlsim.metrics import HASPI, haspi, hasqi, mbstoi
from tests.helpers import mostly_slow


@pytest.mark.parametrize(
    "rate",
    [15999, 48001, 16000.5, -16000, 0, math.nan, math.inf, None, "16k", True, [16000]],
)
def test_a_rate_out_of_range_raises_value_error(rate: Any) -> None:
    with pytest.raises(ValueError, match="from 16000 to 48000 Hz"):
        check_rate(rate)


def test_the_message_on_a_rate_names_its_type() -> None:
    with pytest.raises(ValueError, match=r"got '16000' \(str\)"):
        hlsim.MSBG(sample_rate="16000")  # type: ignore[arg-type]


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


ENTRANCES: dict[str, Callable[[Tensor], object]] = {
    "MSBG": hlsim.MSBG("N3"),
    "NeuroMSBG": lambda wave: hlsim.load_pretrained("neuro-msbg")(wave, "N3"),
    "loss": lambda wave: hlsim.HearingLossLoss("N3", simulator="neuro-msbg")(wave, wave),
    "NAL-R": NALR("N3"),
    "WDRC": lambda wave: WDRC()(wave, "N3"),
    "mapping": lambda wave: hlsim.load_compensator("compensator-general")(wave, "N3"),
    "stream": lambda wave: WDRC().stream("N3")(wave),
    "haspi": lambda wave: haspi(wave, wave, "N3"),
    "hasqi": lambda wave: hasqi(wave, wave, "N3"),
    "HASPI": lambda wave: HASPI()(wave, wave, "N3"),
    "simulate": lambda wave: hlsim.simulate(wave.numpy(), "N3"),
    "compensate": lambda wave: hlsim.compensate(wave, "N3"),
}


@pytest.mark.parametrize("entrance", mostly_slow(ENTRANCES, set(ENTRANCES) - {"hasqi", "HASPI"}))
def test_every_entrance_rejects_time_first_and_warns_once_of_samples_that_are_no_pascals(
    entrance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "_has_warned_of_level", False)
    call = ENTRANCES[entrance]
    speech = hlsim.example_speech()[8000:19200]  # Scores need 0.7 s.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        call(speech)
        call(set_level(speech, 119.0))
        for shape in ((16000, 2), (3, 16000, 1)):
            message = r"time last, got shape \(.*16000.*transpose it: x\.m?T"
            with pytest.raises(ValueError, match=message):
                call(torch.zeros(shape))
    with pytest.warns(UserWarning, match=r"1\d\d dB SPL.*set_level.*full_scale_spl") as caught:
        for _ in range(2):
            call(speech * 32768.0)  # 16-bit integers that were only converted to float
    assert len(caught) == 1


def test_the_warning_follows_full_scale_spl(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "_has_warned_of_level", False)
    speech = hlsim.example_speech()[8000:24000]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        NALR("N3", full_scale_spl=0.0)(speech * 32768.0)
    with pytest.warns(UserWarning, match="did you forget calibration"):
        NALR("N3", full_scale_spl=180.0)(speech)


def test_loud_outputs_leave_the_warning_to_the_next_waveform(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(checks, "_has_warned_of_level", False)
    loud = torch.full((10,), 1000.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with checks.loud_outputs():
            check_waveform(loud, full_scale_spl=94.0)
    with pytest.warns(UserWarning, match="did you forget calibration"):
        check_waveform(loud, full_scale_spl=94.0)


def test_an_integer_that_is_too_large_for_a_float_is_out_of_range() -> None:
    with pytest.raises(ValueError, match="expected seed"):
        checks.check_seed(10**400)


def test_a_number_of_another_type_is_to_be_converted() -> None:
    expected = r"a whole number from 0 to 4294967295, got .*3.*; convert it: 3"
    with pytest.raises(ValueError, match=expected):
        checks.check_number("seed", np.int64(3), 0, 2**32 - 1, whole=True)


@pytest.mark.parametrize("call", [level_spl, lambda wave: mbstoi(wave, wave)])
def test_measures_reject_time_first(call: Callable[[Tensor], object]) -> None:
    with pytest.raises(ValueError, match=r"transpose it: x\.T"):
        call(torch.zeros(16000, 2))


@pytest.mark.parametrize(
    "call",
    [level_spl, lambda wave: set_level(wave, 65.0), lambda wave: resample(wave, 48000, 16000)],
)
def test_a_tensor_without_dimensions_has_no_time(call: Callable[[Tensor], object]) -> None:
    with pytest.raises(ValueError, match="got a tensor without dimensions"):
        call(torch.tensor(1.0))


def test_a_batch_of_few_samples_is_no_time_first_array() -> None:
    for shape in ((8, 1), (2, 4), (1,), (40, 9), (40, 2, 8)):
        check_waveform(torch.zeros(shape))


def test_lengths_are_whole_numbers_of_samples() -> None:
    assert check_lengths((3, 10), torch.Size((2, 10))).tolist() == [3, 10]
    assert check_lengths(torch.tensor([3, 10]), torch.Size((2, 1, 10))).tolist() == [[3], [10]]
    for dtype in (torch.int16, torch.uint16, torch.uint8, torch.int32):
        ends = check_lengths(torch.tensor([3, 10], dtype=dtype), torch.Size((2, 10)))
        assert ends.tolist() == [3, 10] and ends.dtype == torch.int64


@pytest.mark.parametrize(
    ("lengths", "fix"),
    [
        ([0.5, 1.0], r"multiply relative lengths by the time: \(lengths \* 10\)"),
        (torch.tensor([3.0, 10.0]), r"convert them by \.long\(\)"),
    ],
)
def test_error_about_lengths_names_the_fix(lengths: Any, fix: str) -> None:
    with pytest.raises(ValueError, match=fix):
        check_lengths(lengths, torch.Size((2, 10)))


def test_error_about_an_array_names_the_fix() -> None:
    array = torch.zeros(10).numpy()
    for call in (check_waveform, level_spl):
        with pytest.raises(
            ValueError, match=r"NumPy array of float32; convert it: torch\.from_num"
        ):
            call(array)


@pytest.mark.parametrize(
    "lengths", [[0, 3], [3, 11], [0.5, 1.0], [3], [True, True], ["3", "10"], [[3], [3, 10]], {3}]
)
def test_bad_lengths_raise_value_error(lengths: Any) -> None:
    with pytest.raises(ValueError, match=r"expected lengths to be whole numbers from 1 to 10"):
        check_lengths(lengths, torch.Size((2, 10)))


def test_a_name_that_resembles_a_known_one_has_a_suggestion() -> None:
    with pytest.raises(ValueError, match=r"got 'NAL-R' \(did you mean nalr\?\)"):
        WDRC(prescription="NAL-R")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"criteria: Bands \(did you mean bands\?\), x; expected"):
        checks.check_names(["Bands", "x"], ["bands", "paper"], "criteria")
