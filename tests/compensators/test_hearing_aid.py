"""The hearing aid's sliders, loudness, gains and gradients."""

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from compensators import WDRC, HearingAid, load_compensator, save_compensator
from hlsim import MSBG, Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.data.ears import draw_thresholds
from hlsim.evaluation.aid_properties import measure_steady_tones
from tests.compensators.aids import EAR, assert_close, tone, varied_hearing_aid


def test_a_frozen_aid_passes_gradients_on_a_gpu(utterance: Tensor) -> None:
    """cuDNN's LSTM has no backward pass in evaluation mode; a hook imitates its error on a CPU."""
    aid = load_compensator("hearing-aid")
    assert isinstance(aid, HearingAid)

    def refuse_evaluation_mode(lstm: torch.nn.Module, inputs: tuple[Tensor, ...]) -> None:
        if inputs[0].requires_grad and not lstm.training:
            raise RuntimeError("cudnn RNN backward can only be called in training mode")

    aid.recur.register_forward_pre_hook(refuse_evaluation_mode)
    waveform = utterance[:4000].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(aid.eval()(waveform, EAR).square().sum(), waveform)
    assert not aid.training
    assert gradient.isfinite().all()


def test_at_0_and_0_the_input_passes_unchanged(utterance: Tensor) -> None:
    aid = varied_hearing_aid()
    assert torch.equal(aid(utterance, EAR, 0.0, 0.0), utterance)
    stream = aid.stream(EAR, noise_reduction=0.0, amplification=0.0)
    assert torch.equal(stream(utterance)[64:], utterance[:-64])


def test_each_slider_has_its_own_effect_for_each_item(utterance: Tensor) -> None:
    aid: Any = varied_hearing_aid()
    steps = torch.linspace(0.0, 1.0, 5)
    signals = utterance.expand(5, -1)
    amplified = aid(signals, EAR, 0.0, steps)
    assert (level_spl(amplified).diff() > 1.0).all()
    assert (level_spl(aid(signals, EAR, steps, 0.0)).diff() < -0.1).all()
    # Without a loss there is nothing to amplify.
    assert torch.equal(aid(utterance, Audiogram.standard("NH"), 0.0, 1.0), utterance)
    single = torch.stack([aid(utterance, EAR, 0.0, float(step)) for step in steps])
    assert (amplified - single).abs().max() < 1e-4


def test_a_slider_moves_in_a_stream_without_a_click() -> None:
    """Beside a tone, everything farther away than 100 Hz stays 40 dB below it."""
    aid: Any = varied_hearing_aid()
    stream = aid.stream(EAR, noise_reduction=0.0, amplification=0.0)
    before, after = tone(1000.0, 60.0, 2.0).split(16000)
    outputs = [stream(before)]
    stream.set(amplification=1.0)
    outputs += [stream(chunk) for chunk in after.split(160)]
    output = torch.cat(outputs)
    assert level_spl(output[24000:]) > level_spl(output[8000:15000]) + 10.0
    power = torch.fft.rfft(output[14000:22000] * torch.hann_window(8000)).abs().square()
    is_near = (2.0 * torch.arange(4001) - 1000.0).abs() < 100.0
    assert 10.0 * torch.log10(power[~is_near].sum() / power[is_near].sum()) < -40.0


def test_sliders_of_a_stream_are_tensors_or_numbers_by_name() -> None:
    aid: Any = varied_hearing_aid()
    slider, signal = torch.tensor(0.5), torch.randn(2000)
    by_tensor, by_number = aid.stream(EAR, noise_reduction=slider), aid.stream(EAR)
    assert torch.equal(by_tensor(signal), by_number(signal))
    slider.fill_(0.0)
    by_number.set(noise_reduction=0.0)
    assert torch.equal(by_tensor(signal), by_number(signal))
    for stream, name in ((by_number, "volume"), (WDRC().stream(EAR), "noise_reduction")):
        with pytest.raises(ValueError, match=f"unknown sliders of .*: {name}; expected"):
            stream.set(**{name: 0.0})
    assert by_number.sliders == {"noise_reduction": 0.0, "amplification": 1.0}


def test_a_bad_slider_raises_value_error() -> None:
    aid: Any = varied_hearing_aid()
    for slider in (1.5, float("nan"), "loud", torch.tensor([0.0, 2.0]), torch.zeros(3)):
        for call in (
            lambda x, y: aid(x, EAR, 1.0, y),
            lambda x, y: aid.stream(EAR, amplification=y)(x),
        ):
            with pytest.raises(ValueError):
                call(torch.randn(2, 100), slider)


def test_gradients_reach_every_weight(utterance: Tensor) -> None:
    aid = varied_hearing_aid().train().requires_grad_(True)
    signal = utterance[:8000].expand(4, -1).clone().requires_grad_(True)
    aid(signal, draw_thresholds(4)).square().mean().backward()
    for name, tensor in [*aid.named_parameters(), ("signal", signal)]:
        assert tensor.grad is not None, name
        assert tensor.grad.isfinite().all() and tensor.grad.any(), name


def test_noise_reduction_attenuates_noise_and_spares_tones() -> None:
    aid: Any = load_compensator("hearing-aid")
    noise = set_level(torch.randn(32000, generator=torch.Generator().manual_seed(0)), 65.0)
    sounds = [noise, *(tone(hz, 65.0, 2.0) for hz in (500.0, 1000.0, 2000.0, 4000.0))]
    changes = [float(level_spl(aid(sound, "NH", 1.0)[16000:]) - 65.0) for sound in sounds]
    assert -12.0 < changes[0] < -6.0
    assert max(map(abs, changes[1:])) < 1.0


@pytest.mark.parametrize("name", ["N2", "N3", "N4"])
def test_an_impaired_ear_perceives_tones_as_loud_as_a_normal_ear(name: str) -> None:
    aid: Any = load_compensator("hearing-aid")
    errors = measure_steady_tones(aid, Audiogram.standard(name), [65.0])["loudness_error_db"]
    assert max(map(abs, errors[0])) < 3.0


@torch.no_grad()
@pytest.mark.parametrize("name", ["N3", "N4"])
def test_the_ear_perceives_as_many_db_less_as_loudness_says(name: str) -> None:
    sound, ear = tone(1000.0, 65.0, 0.5), Audiogram.standard(name)
    simulator = MSBG(ear, sample_rate=16000)
    quiet = HearingAid(ear, loudness=-10.0).eval()
    perceived = [
        float(level_spl(simulator(aid(sound))[2000:-2000]))
        for aid in (HearingAid(ear).eval(), quiet)
    ]
    assert perceived[1] - perceived[0] == pytest.approx(-10.0, abs=0.5)
    stream = quiet.stream(ear)
    assert_close(torch.cat((stream(sound), stream.flush()))[64:], quiet(sound))
    assert torch.equal(quiet(sound, "NH", 0.0), sound)


def test_loudness_is_loaded_and_out_of_range_or_without_effect_an_error() -> None:
    assert load_compensator("hearing-aid", loudness=-5.0).loudness == -5.0
    for loudness in (1.0, -41.0, float("nan")):
        for build in (HearingAid, partial(load_compensator, "hearing-aid")):
            with pytest.raises(ValueError, match="expected loudness"):
                build(loudness=loudness)
    for name in ("wdrc", "nalr"):
        with pytest.raises(ValueError, match="leave out loudness"):
            load_compensator(name, loudness=-5.0)


@pytest.mark.parametrize("name", ["hearing-aid", "hearing-aid-directional"])
def test_settings_that_are_not_saved_cause_a_warning(tmp_path: Path, name: str) -> None:
    aid = load_compensator(
        name, sample_rate=48000, full_scale_spl=100.0, limit_to_ear=True, loudness=-10.0
    )
    text = "sample_rate=48000, full_scale_spl=100.0, limit_to_ear=True, loudness=-10.0; pass"
    with pytest.warns(UserWarning, match=f"does not store {text}"):
        save_compensator(aid, tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save_compensator(load_compensator(name), tmp_path)
