"""Laws that hold for every aid."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from compensators import (
    CAMFIT,
    NALR,
    NALRP,
    WDRC,
    HearingAid,
    HearingAidConfig,
    MappingCompensator,
    MappingConfig,
    load_compensator,
    save_compensator,
)
from compensators.beamformer import BeamformingAid
from compensators.config import BeamformerConfig
from compensators.limiter import soft_limit
from hlsim import Audiogram, Listener
from hlsim.calibration import set_level
from tests.compensators.aids import (
    EAR,
    SMALL,
    assert_close,
    varied_hearing_aid,
    varied_mapping,
)

AIDS: dict[str, Callable[..., Any]] = {
    "nalr": NALR,
    "nalrp": NALRP,
    "wdrc": WDRC,
    "camfit": CAMFIT,
    "aid": varied_hearing_aid,
    "mapping": varied_mapping,
}
every_aid = pytest.mark.parametrize("build", AIDS.values(), ids=AIDS)
EARS = torch.tensor([Audiogram.standard(name).thresholds for name in ("NH", "N2", "S3")])


@every_aid
def test_a_batch_equals_its_items_and_broadcasts(
    build: Callable[..., Any], utterance: Tensor
) -> None:
    aid = build()
    batch = torch.stack([utterance[:8000], 3.0 * utterance[4000:12000], 0.1 * utterance[-8000:]])
    outputs = aid(batch, EARS)
    for signal, ear, output in zip(batch, EARS, outputs, strict=True):
        assert_close(aid(signal, ear), output)
    assert_close(aid(batch.unsqueeze(1), EARS.unsqueeze(1)), outputs.unsqueeze(1))
    assert aid(batch[0], EARS).shape == (3, 8000)
    assert aid(batch.unsqueeze(1), EARS[:2]).shape == (3, 2, 8000)


@every_aid
def test_scale_and_precision_are_those_of_the_caller(
    build: Callable[..., Any], utterance: Tensor
) -> None:
    signal = utterance[None, :5000]
    output = build()(signal, EAR)
    # RMS 1.0 at 114 dB SPL is RMS 10 at 94 dB SPL.
    other_scale = build(full_scale_spl=114.0)
    assert_close(10.0 * other_scale(signal / 10.0, EAR), output)
    assert_close(build().double()(signal.double(), EAR).float(), output, 1e-4)
    assert build()(signal.half(), EAR).dtype == torch.float16


@every_aid
@torch.no_grad()
def test_autocast_changes_neither_outputs_nor_gains(
    build: Callable[..., Any], utterance: Tensor
) -> None:
    aid = build()
    output, gains = aid(utterance[:5000], EAR), aid.gains(EAR)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(aid(utterance[:5000], EAR), output)
        assert torch.equal(aid.gains(EAR), gains)


@pytest.mark.parametrize("kind", [NALR, WDRC, HearingAid, MappingCompensator])
def test_an_aid_may_have_an_ear_of_its_own(kind: Callable[..., Any], utterance: Tensor) -> None:
    settings = {"config": SMALL} if kind is MappingCompensator else {}
    torch.manual_seed(5)
    aid = kind("N3", **settings)
    torch.manual_seed(5)
    without_ear = kind(**settings)
    signal, pair = utterance[:4000], Listener("N3", "S2")
    assert torch.equal(aid(signal), without_ear(signal, "N3"))
    assert torch.equal(aid(signal, "S2"), without_ear(signal, "S2"))
    assert torch.equal(aid.gains(), without_ear.gains("N3"))
    assert aid.state_dict().keys() == without_ear.state_dict().keys()
    of_listener = kind(pair, **settings)
    of_listener.load_state_dict(aid.state_dict())
    assert torch.equal(of_listener(signal.expand(2, -1)), without_ear(signal.expand(2, -1), pair))
    with pytest.raises(ValueError, match="for two ears"):
        of_listener(signal)
    for call in (without_ear, lambda _: without_ear.gains()):
        with pytest.raises(ValueError, match="expected an audiogram"):
            call(signal)


@pytest.mark.parametrize("name", ["nalr", "compensator-general"])
def test_an_aid_for_whole_signals_says_that_it_has_no_stream(name: str) -> None:
    with pytest.raises(ValueError, match="whole signals only; load wdrc or hearing-aid"):
        load_compensator(name).stream("N3")


@every_aid
def test_silence_stays_silent_with_finite_gradients(build: Callable[..., Any]) -> None:
    for samples in (1, 37, 4001):
        silence = torch.zeros(2, samples, requires_grad=True)
        output = build()(silence, EAR)
        assert output.shape == silence.shape and not output.any()
        (gradient,) = torch.autograd.grad(output.square().sum() + output.sum(), silence)
        assert gradient.isfinite().all()


@pytest.mark.parametrize("build", [WDRC, varied_hearing_aid, varied_mapping])
@pytest.mark.parametrize("rate", [16000, 44100])
def test_no_sample_exceeds_the_limit(build: Callable[..., Any], rate: int) -> None:
    noise = torch.randn(rate // 4)
    peak = 1.000001 * 10.0 ** (16.0 / 20.0)  # 110 dB SPL
    for level in (65.0, 115.0):
        for ear in ("N2", "N6"):
            output = build(sample_rate=rate)(set_level(noise, level), ear)
            assert float(output.detach().abs().max()) <= peak


def test_the_soft_limit_is_monotonic_and_linear_for_soft_samples() -> None:
    samples = torch.linspace(-6.0, 6.0, 2001, dtype=torch.float64)
    peak = 10.0 ** (6.0 / 20.0)
    limited = soft_limit(samples, 100.0)
    assert limited.diff().min() >= 0.0 and limited.abs().max() <= peak
    soft = samples.abs() < peak / 2.0
    assert (limited[soft] / samples[soft] - 1.0).abs().nan_to_num().max() < 6e-4
    infinite = torch.tensor([1e30, float("inf")])
    assert soft_limit(infinite, 100.0).tolist() == pytest.approx([peak] * 2)


SAVED: dict[str, Any] = {
    "aid": lambda: varied_hearing_aid(config=HearingAidConfig(hidden=32, cap_db=40.0)),
    "mapping": lambda: varied_mapping(MappingConfig(channels=8, blocks=1, reach_db=30.0)),
}


@pytest.mark.parametrize("name", SAVED)
def test_a_saved_aid_is_the_same_when_loaded(name: str, tmp_path: Path, utterance: Tensor) -> None:
    aid = SAVED[name]()
    save_compensator(MappingCompensator(config=SMALL), tmp_path / "mine")
    save_compensator(aid, tmp_path / "mine")  # replaces the other one
    loaded: Any = load_compensator(tmp_path / "mine")
    assert type(loaded) is type(aid) and loaded.config == aid.config and not loaded.training
    assert not any(weight.requires_grad for weight in loaded.parameters())
    assert torch.equal(loaded(utterance, EAR), aid(utterance, EAR))


BAD_SETTINGS: list[tuple[Callable[..., Any], dict[str, Any]]] = [
    (NALR, {"audiogram": torch.full((8,), 121.0)}),
    (NALR, {"sample_rate": 8000}),
    *((WDRC, {name: 200.0}) for name in ("attack", "release", "limit_spl")),
    *((HearingAidConfig, {name: -1.0}) for name in ("bands", "cap_db", "release", "hidden")),
    (HearingAidConfig, {"bands": 20.0}),
    (HearingAidConfig, {"limit_spl": "loud"}),
    *((MappingConfig, {name: 200.0}) for name in ("bands", "reach_db", "limit_spl")),
    *((MappingConfig, settings) for settings in ({"microphones": 17}, {"ears": 2})),
    *((BeamformerConfig, {name: 20.0}) for name in ("bands", "seconds", "loading", "spacing")),
    (MappingConfig, {"start": 0.5}),
    (MappingConfig, {"phase": "minimum"}),
    (MappingConfig.from_dict, {"data": {"layers": 3}}),
    (NALR, {"limit_to_ear": True}),
    (CAMFIT, {"prescription": "nalr"}),
    (CAMFIT, {"knee": 20.0}),
    (HearingAid, {"noise_reduction": 0.5}),
    (MappingCompensator, {"linked": True}),
    (BeamformingAid, {"limit_to_ear": True}),
]


def test_bad_settings_and_calls_raise_value_error() -> None:
    for build, settings in BAD_SETTINGS:
        with pytest.raises(ValueError):
            build(**settings)
    for build in AIDS.values():
        for ear in (None, torch.full((8,), 121.0), torch.zeros(2, 8)):
            with pytest.raises(ValueError):
                build()(torch.randn(3, 100), ear)
