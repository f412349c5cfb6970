"""Items are scored on several cores without a change of any score or setting."""

from threading import get_ident

import pytest
import torch
from torch import Tensor

import hlsim
from hlsim.metrics import hasqi
from hlsim.torchtools import map_on_cores

pytestmark = pytest.mark.usefixtures("two_threads")


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, torch.enable_grad])
def test_calls_run_alone_in_other_threads_in_the_same_mode(mode: type) -> None:
    def state(_: int) -> tuple[bool, int, bool]:
        is_this_thread = get_ident() == this_thread
        return is_this_thread, torch.get_num_threads(), torch.is_inference_mode_enabled()

    this_thread = get_ident()
    with mode():
        inference = torch.is_inference_mode_enabled()
        states = map_on_cores(state, range(4), torch.zeros(1))
    assert states == [(False, 1, inference)] * 4
    # Hooks of autograd belong to this thread.
    in_one_thread = map_on_cores(state, range(4), torch.zeros(1, requires_grad=True))
    assert in_one_thread == [(True, 2, False)] * 4
    with pytest.raises(ZeroDivisionError):
        map_on_cores(lambda divisor: 1 / divisor, [1, 0], torch.zeros(1))
    assert torch.get_num_threads() == 2


@pytest.mark.slow
def test_scores_do_not_depend_on_the_cores() -> None:
    clean = hlsim.example_speech()[8000:42560].unflatten(0, (3, -1))
    output: Tensor = clean + 0.01 * torch.randn(clean.shape)
    with torch.no_grad():
        on_two_cores = hasqi(output, clean, "N3")
        torch.set_num_threads(1)
        assert torch.equal(hasqi(output, clean, "N3"), on_two_cores)
