"""The impulse method against the structural delay."""

import pytest
import torch

from hlsim import MSBG, Audiogram
from hlsim.msbg import estimate_delay


def test_impulse_method_with_no_loss_is_the_measured_1078() -> None:
    simulator = MSBG(Audiogram.standard("NH"), aligned=False)
    assert estimate_delay(simulator) == 1078
    assert simulator.delay("none") == 1047


@pytest.mark.parametrize("name", ["N1", "N2", "N3", "S1", "S2"])
def test_impulse_method_depends_on_the_ear_and_the_structural_delay_does_not(name: str) -> None:
    ear = Audiogram.standard(name)
    simulator = MSBG(ear, aligned=False)
    # the method's range as pyclarity gave it; the structural delay is 1239 with any smearing
    assert 1170 <= estimate_delay(simulator, level=120.0) <= 1280
    assert simulator.delay(ear.severity) == 1239


def test_impulse_method_is_pyclaritys() -> None:
    clarity = pytest.importorskip("clarity.evaluator.msbg.msbg")
    for name in ("NH", "N2", "S1"):
        ear = Audiogram.standard(name)
        reference = clarity.Ear()
        reference.set_audiogram(ear.to_clarity())
        impulse = torch.zeros(44100, dtype=torch.float64)
        impulse[22050] = 1.0
        place = int(abs(torch.from_numpy(reference.process(impulse.numpy())[0])).argmax()) - 22050
        simulator = MSBG(ear, aligned=False, full_scale_spl=120.0, rescale_active=True)
        assert estimate_delay(simulator, level=120.0) == place


def test_aligned_output_has_little_left() -> None:
    for name in ("NH", "N2"):
        assert abs(estimate_delay(MSBG(Audiogram.standard(name)))) <= 80


def test_what_is_no_simulator() -> None:
    with pytest.raises(ValueError, match="sample_rate"):
        estimate_delay(torch.nn.Identity())
    with pytest.raises(ValueError, match="allowed: one"):
        estimate_delay(MSBG(aligned=False), torch.zeros(2, 8))


def test_one_ear_in_any_shape() -> None:
    ear, simulator = Audiogram.standard("N2"), MSBG(aligned=False, sample_rate=16000)
    given = ([ear], torch.tensor([[ear.thresholds]]))
    assert {estimate_delay(simulator, one) for one in given} == {estimate_delay(simulator, ear)}
