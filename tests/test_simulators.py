"""All names of simulators lead through one door, and a simulator of your own serves everywhere."""

from pathlib import Path

import numpy as np
import pytest
import torch

import hlsim
from hlsim import MSBG, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.simulators import Attenuation, PluginSimulator, load_simulator

PLUGIN = """
class Quieter:
    sample_rate = 44100.0
    def __call__(self, waveform, audiogram):
        return 0.5 * waveform * 10 ** (-audiogram[:, :1] / 20)

def late(waveform, audiogram):
    return waveform.roll(320, -1)

def broken(waveform, audiogram):
    return waveform / 0.0

def in_place(waveform, audiogram):
    audiogram /= 100.0
    return waveform.mul_(0.5)

class Scaled:
    full_scale_spl = 120.0
    def __call__(self, waveform, audiogram):
        return waveform

class Rateless(Scaled):
    full_scale_spl = 94.0
    sample_rate = None

class Adapting:
    calls = 0
    def __call__(self, waveform, audiogram):
        self.calls += 1
        return waveform / self.calls
"""


@pytest.fixture
def plugin(tmp_path: Path) -> str:
    (tmp_path / "plugin.py").write_text(PLUGIN)
    return f"{tmp_path}/plugin.py"


def test_a_plug_in_is_called_at_its_own_rate(plugin: str) -> None:
    simulator = load_simulator(f"{plugin}:Quieter")
    speech = set_level(torch.randn(2, 16000), 65.0)
    # the band that both rates hold
    low = torch.fft.irfft(torch.fft.rfft(speech) * (torch.arange(8001) < 6000), 16000)
    perceived = simulator(low, torch.tensor([[0.0] * 8, [20.0] * 8]))
    expected = low * torch.tensor([[0.5], [0.05]])
    assert float((perceived - expected)[:, 400:-400].norm() / expected.norm()) < 1e-3
    assert str(simulator) == f"{plugin}:Quieter"


def test_a_plug_in_gets_pascals_whatever_the_full_scale(plugin: str) -> None:
    speech = 0.05 * torch.randn(8000)
    in_pascals = PluginSimulator("hlsim:MSBG")(speech, "N3")
    louder_scale = PluginSimulator("hlsim:MSBG", full_scale_spl=114.0)(speech / 10.0, "N3")
    torch.testing.assert_close(louder_scale, in_pascals / 10.0)
    torch.testing.assert_close(in_pascals, MSBG("N3")(speech))


def test_a_plug_in_is_the_ear_of_a_loss_with_its_gradient(plugin: str) -> None:
    loss = HearingLossLoss("N3", simulator="hlsim:MSBG", criterion="bands")
    exact = HearingLossLoss("N3", simulator=MSBG(), criterion="bands")
    clean = hlsim.example_speech()[:16000]
    gradients = []
    for criterion in (loss, exact):
        output = (0.5 * clean).requires_grad_()
        criterion(output, clean).backward()
        gradients.append(output.grad)
    torch.testing.assert_close(*gradients)
    assert bool(gradients[0].any())


def test_a_plug_in_is_the_ear_of_simulate(plugin: str) -> None:
    clean = hlsim.example_speech()[:16000]
    perceived = hlsim.simulate(clean, "N3", simulator=f"{plugin}:Quieter")
    assert perceived.shape == clean.shape and float(perceived.norm()) < 0.5 * float(clean.norm())


@pytest.mark.parametrize(
    ("name", "words"),
    [
        *(("late", "delays by"), ("nobody", "nobody"), ("broken", "NaN or infinite")),
        ("Scaled", "full_scale_spl=94, got 120"),
        ("Rateless", "a sample rate that is a whole number from 1000"),
    ],
)
def test_invalid_plug_ins_are_rejected(plugin: str, name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        load_simulator(f"{plugin}:{name}")


def test_a_plug_in_that_keeps_a_state_causes_a_warning(plugin: str) -> None:
    with pytest.warns(UserWarning, match=r"plugin\.py:Adapting returns another output"):
        load_simulator(f"{plugin}:Adapting")


@pytest.mark.parametrize("rate", [16000, 44100])
@pytest.mark.parametrize("ear", ["N3", "S3", [-10.0, 0.0, 5.0, 100.0, 20.0, 100.0, 60.0, 60.0]])
def test_linear_ear_attenuates_tones_by_the_interpolated_threshold(rate: int, ear: object) -> None:
    simulator = load_simulator("attenuation", sample_rate=rate)
    thresholds = hlsim.Audiogram.standard(ear).levels if isinstance(ear, str) else ear
    hz = np.array([125.0, 250.0, 700.0, 1500.0, 2000.0, 3400.0, 5000.0, 7900.0])
    phase = 2.0 * np.pi * hz[:, None] * np.arange(rate // 2) / rate
    tones = torch.from_numpy(np.sin(phase))
    perceived = simulator(tones, ear)
    # Far from the ends: the output is in phase with the input.
    middle = slice(rate // 8, -rate // 8)
    weight = torch.hann_window(tones[:, middle].shape[-1], dtype=torch.float64)
    products = (perceived[:, middle] * tones[:, middle] * weight).sum(-1)
    gains = products / (tones[:, middle].square() * weight).sum(-1)
    expected = -np.interp(hz, hlsim.audiogram.FREQUENCIES, thresholds)
    tolerance = 0.05 if isinstance(ear, str) else 0.4  # jumps of 95 dB between frequencies
    np.testing.assert_allclose(20.0 * torch.log10(gains), expected, atol=tolerance)


def test_linear_ear_is_linear_and_takes_ears_as_other_simulators_do() -> None:
    speech = hlsim.example_speech()[:16000]
    ear = Attenuation("N3")
    torch.testing.assert_close(ear(10.0 * speech), 10.0 * ear(speech))
    normal = ear(speech, "NH")
    torch.testing.assert_close(normal, speech, atol=1e-6, rtol=0.0)
    both = Attenuation(hlsim.Listener("N2", "N4"))(torch.stack([speech, speech]))
    torch.testing.assert_close(both, Attenuation()(speech, ["N2", "N4"]))
    thresholds = torch.full((8,), 40.0, requires_grad=True)
    ear(speech, thresholds).square().sum().backward()
    assert bool((thresholds.grad < 0.0).all())
    loss = HearingLossLoss("N3", simulator="attenuation")
    assert 0.0 <= float(loss(speech, speech)) < float(loss(0.1 * speech, speech))
    for bad in ("N7", [0.0] * 7):
        with pytest.raises(ValueError):
            ear(speech, bad)


@pytest.mark.parametrize("ear", ["N2", "N3", "N4"])
def test_exact_model_without_smearing_fills_a_spectral_notch_less(ear: str) -> None:
    generator = torch.Generator().manual_seed(0)
    spectrum = torch.fft.rfft(0.05 * torch.randn(16000, generator=generator))
    notch = slice(1500, 2000)
    spectrum[notch] = 0.0
    noise = torch.fft.irfft(spectrum)
    depths = []
    for name in ("msbg", "msbg-unsmeared"):
        powers = torch.fft.rfft(load_simulator(name)(noise, ear)).abs().square()
        beside = torch.cat([powers[1300:1500], powers[2000:2200]])
        depths.append(float(10.0 * (beside.mean() / powers[notch].mean()).log10()))
    smeared, unsmeared = depths
    assert unsmeared > smeared + 3.0


def test_exact_model_without_smearing_is_the_exact_model_where_nothing_is_smeared() -> None:
    speech = hlsim.example_speech()[:16000]
    unsmeared = load_simulator("msbg-unsmeared")
    assert torch.equal(unsmeared(speech, "NH"), MSBG()(speech, "NH"))
    late = MSBG("N4", sample_rate=44100, aligned=False, smearing=False)
    advanced = late(speech)[..., late.delay("severe") :]
    aligned = MSBG("N4", sample_rate=44100, smearing=False)(speech)
    difference = aligned[: len(advanced)] - advanced[: len(aligned)]
    assert float(difference.norm()) < 2e-3 * float(aligned.norm())


def test_a_simulator_that_changes_its_arguments_changes_nothing_of_the_caller(plugin: str) -> None:
    ear, clean = torch.full((8,), 40.0), hlsim.example_speech()[:16000]
    before = clean.clone()

    class InPlace(torch.nn.Module):
        def forward(self, waveform: torch.Tensor, thresholds: torch.Tensor) -> torch.Tensor:
            thresholds /= 100.0
            return waveform.mul_(0.5)

    for simulator in (f"{plugin}:in_place", InPlace()):
        loss = HearingLossLoss(ear, simulator=simulator, criterion="bands")
        assert float(loss(2.0 * clean, clean)) == float(loss(2.0 * clean, clean))
    hlsim.simulate(clean, ear, simulator=f"{plugin}:in_place")
    assert torch.equal(clean, before) and float(ear.mean()) == 40.0


def test_a_module_is_set_to_evaluation_mode() -> None:
    class Dropping(torch.nn.Dropout):
        def forward(self, waveform: torch.Tensor, audiogram: object) -> torch.Tensor:
            return super().forward(waveform)

    clean = torch.linspace(0.01, 0.02, 8000)
    assert torch.equal(hlsim.simulate(clean, "N3", simulator=Dropping(0.5)), clean)
    aid = Dropping(0.5)
    hlsim.reception_threshold("NH", aid, simulator="attenuation", triplets=30)
    assert not aid.training


def test_unknown_names_and_modules_of_another_rate_are_rejected() -> None:
    with pytest.raises(ValueError, match="pyclarty"):
        load_simulator("pyclarty")
    with pytest.raises(ValueError, match="sample_rate=16000, got 44100"):
        load_simulator(MSBG(sample_rate=44100))
