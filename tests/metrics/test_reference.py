"""Items are scored on several cores without a change of any score or setting."""

from threading import get_ident

import pytest
import torch
from torch import Tensor

import hlsim
from hlsim.metrics import haspi, hasqi
from hlsim.metrics.reference import map_on_cores

SIGNAL = torch.zeros(1)
pytestmark = pytest.mark.usefixtures("two_threads")


def test_calls_run_in_other_threads_that_compute_alone() -> None:
    settings = map_on_cores(lambda _: (get_ident(), torch.get_num_threads()), range(4), SIGNAL)
    assert all(thread != get_ident() and threads == 1 for thread, threads in settings)
    assert torch.get_num_threads() == 2


def test_differentiable_calls_run_in_this_thread() -> None:
    signal = torch.zeros(1, requires_grad=True)
    assert set(map_on_cores(lambda _: get_ident(), range(4), signal)) == {get_ident()}


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, torch.enable_grad])
def test_calls_have_the_mode_of_this_thread(mode: type) -> None:
    with mode():
        expected = torch.is_inference_mode_enabled()
        modes = map_on_cores(lambda _: torch.is_inference_mode_enabled(), range(2), SIGNAL)
    assert modes == [expected, expected]


def test_the_first_error_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        map_on_cores(lambda divisor: 1 / divisor, [1, 0], SIGNAL)
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("score", [haspi, hasqi])
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_scores_do_not_depend_on_the_cores(score: object, mode: type) -> None:
    clean = hlsim.example_speech()[:48000].unflatten(0, (3, -1))
    processed: Tensor = clean + 0.01 * torch.randn(clean.shape)
    with mode():
        on_two_cores = score(processed, clean, "N3")
        torch.set_num_threads(1)
        assert torch.equal(score(processed, clean, "N3"), on_two_cores)
