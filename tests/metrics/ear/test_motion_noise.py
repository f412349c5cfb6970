"""Tests of the noise on the motion of the basilar membrane."""

import numpy as np
import pytest
import torch

from hlsim.metrics.ear.motion_noise import draw_motion_noise, state_after_motion_noise


@pytest.mark.parametrize("seed", [0, 7, 4711])
@pytest.mark.parametrize("samples", [1, 403, 404, 12000])
def test_random_numbers_after_the_noise_are_those_of_numpy(seed: int, samples: int) -> None:
    random = np.random.RandomState(seed)
    noise = random.standard_normal((2, 32, samples))
    np.testing.assert_array_equal(draw_motion_noise(seed, samples, torch.float64).numpy(), noise)
    after = np.random.RandomState()
    after.set_state(state_after_motion_noise(seed, samples))
    np.testing.assert_array_equal(after.standard_normal(101), random.standard_normal(101))
