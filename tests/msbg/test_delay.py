"""Delays estimated with an impulse equal pyclarity's, and are close to the structural delay."""

import numpy as np
import pytest
import torch

from hlsim import MSBG, Audiogram
from hlsim.msbg import estimate_delay
from tests.pyclarity import PyclarityOutputs, msbg


@pytest.mark.parametrize("name", ["N1", "N2", "N3", "S1", "S2"])
def test_impulse_method_depends_on_the_ear_and_the_structural_delay_does_not(name: str) -> None:
    ear = Audiogram.standard(name)
    simulator = MSBG(ear, aligned=False, sample_rate=44100)
    # The range is that of pyclarity's delays. The structural delay is 1239 with any smearing.
    assert 1170 <= estimate_delay(simulator, level=120.0) <= 1280
    assert simulator.delay(ear.severity) == 1239


def impulse_delay_of_reference(ear: Audiogram) -> int:
    impulse = np.zeros(44100)
    impulse[22050] = 1.0
    return int(np.abs(msbg(ear, impulse)).argmax()) - 22050


def test_impulse_method_gives_pyclaritys_delay(pyclarity: PyclarityOutputs) -> None:
    for name in ("NH", "N2", "S1"):
        ear = Audiogram.standard(name)
        expected = pyclarity(f"delay of {name}", impulse_delay_of_reference, ear)
        options = {"sample_rate": 44100, "aligned": False, "rescale_active": True}
        simulator = MSBG(ear, full_scale_spl=120.0, **options)
        assert estimate_delay(simulator, level=120.0) == expected


@pytest.mark.parametrize(
    ("simulator", "ears"),
    [(torch.nn.Identity(), None), (MSBG(aligned=False, sample_rate=44100), torch.zeros(2, 8))],
)
def test_bad_input_raises_value_error(simulator: torch.nn.Module, ears: torch.Tensor) -> None:
    with pytest.raises(ValueError):
        estimate_delay(simulator, ears)


def test_one_ear_may_have_any_shape() -> None:
    ear = Audiogram.standard("N2")
    simulator = MSBG(aligned=False, sample_rate=16000)
    delay = estimate_delay(simulator, ear)
    assert estimate_delay(simulator, [ear]) == delay
    assert estimate_delay(simulator, torch.tensor([[ear.thresholds]])) == delay
