"""HASPILoss is 1 minus HASPI and the cost of the level, and its gradient is finite and balanced."""

import pytest
import torch
from torch import Tensor

from compensators import NALR
from hlsim import HASPILoss
from hlsim.calibration import set_level
from hlsim.metrics import haspi, hasqi
from tests.losses.signals import add_noise, excerpt, gain_slope

TIME = 12000


@pytest.fixture
def clean(speech: list[tuple[Tensor, int]]) -> Tensor:
    """0.75 s of two voices at 65 dB SPL. Shape: (2, TIME)."""
    return excerpt(speech, 10000, 10000 + TIME)


def test_value_is_1_minus_the_scores_and_the_cost_of_the_level(clean: Tensor) -> None:
    aided = NALR("N3")(add_noise(clean, 5.0))
    loss = HASPILoss("N3", quality=0.5, reduction="none")
    parts = loss.parts(aided, clean)
    torch.testing.assert_close(parts["haspi"], 1.0 - haspi(aided, clean, "N3"))
    torch.testing.assert_close(parts["hasqi"], 1.0 - hasqi(aided, clean, "N3"))
    level = sum(loss.weights[name] * parts[name] for name in ("levels", "louder", "peaks"))
    value = parts["haspi"] + 0.5 * parts["hasqi"] + level
    assert set(HASPILoss("N3", level=0.0).weights) == {"haspi"}
    torch.testing.assert_close(HASPILoss("N3", quality=0.5)(aided, clean), value.mean())


def test_excess_gain_costs_although_the_score_rises(clean: Tensor) -> None:
    clean = clean[:1]
    aided = NALR("N4")(add_noise(clean, 10.0))
    score, whole = (
        [float(HASPILoss("N4", level=level)(gain * aided, clean)) for gain in (0.1, 2.0, 40.0)]
        for level in (0.0, 1.0)
    )
    assert score[2] < score[0] and score[2] < score[1] + 0.02
    assert whole[1] < whole[0] and whole[1] < whole[2] - 0.5


def test_padded_items_have_the_values_that_they_have_alone(clean: Tensor) -> None:
    loss, output = HASPILoss(reduction="none"), 5.0 * add_noise(clean, 10.0)
    second = loss(output[1, :11500], clean[1, :11500], "N4")
    output[1, 11500:] = 1.0
    values = loss(output, clean, ["N3", "N4"], [TIME, 11500])
    torch.testing.assert_close(values[1], second, rtol=1e-3, atol=1e-4)


def test_bad_weights_and_short_speech_raise_value_error(clean: Tensor) -> None:
    for options in ({"quality": -1.0}, {"level": float("nan")}):
        with pytest.raises(ValueError):
            HASPILoss("N3", **options)
    with pytest.raises(ValueError):
        HASPILoss("N3")(clean[:, :8000], clean[:, :8000])


@pytest.mark.slow
def test_hard_inputs_have_finite_values_and_gradients(clean: Tensor) -> None:
    silence = torch.zeros(TIME)
    square = 30.0 * torch.sign(torch.sin(torch.arange(TIME) * 0.3 + 0.1))
    speech = clean[0]
    reference = torch.stack((silence, speech, silence, speech, speech, square))
    output = torch.stack((silence, silence, speech, 1e-9 * speech, 1e4 * speech, square))
    output.requires_grad_()
    values = HASPILoss("N4", reduction="none")(output, reference)
    (slope,) = torch.autograd.grad(values.sum(), output)
    assert bool(values.isfinite().all()) and bool(slope.isfinite().all())
    assert float(values[0].detach()) == 0.0 and not bool(slope[0].any())


@pytest.mark.slow
def test_ears_and_levels_count_alike(clean: Tensor) -> None:
    """The gradient of HASPI alone differs by a factor of 500 between ears."""
    cases = [*((f"N{i}", 65.0) for i in range(1, 6)), ("N3", 50.0), ("N3", 80.0)]
    slopes = [gain_slope(HASPILoss(), set_level(clean[:1], spl), ear) for ear, spl in cases]
    assert max(slopes) < 10.0 * min(slopes)
