"""Aids whose gains are not those before training, and sounds to process with them."""

from typing import Any

import torch
from torch import Tensor

from compensators import WDRC, HearingAid, MappingCompensator, MappingConfig
from compensators.wearable import Wearable
from hlsim import Audiogram
from hlsim.calibration import set_level

EAR = Audiogram.standard("N3")
SMALL = MappingConfig(channels=8, blocks=1)


def varied_hearing_aid(**options: Any) -> HearingAid:
    """Build an aid whose networks have large weights, so that its gains move."""
    torch.manual_seed(5)
    aid = HearingAid(**options)
    for layer in (aid.leave, aid.correct[-1]):
        torch.nn.init.normal_(layer.weight, std=0.05)
    return aid.eval().requires_grad_(False)


def varied_mapping(config: MappingConfig = SMALL, **options: Any) -> MappingCompensator:
    """Build a network whose correction is about 5 dB."""
    torch.manual_seed(5)
    model = MappingCompensator(config=config, **options)
    for decoder in (model.magnitude_decoder, model.phase_decoder):
        if decoder is not None:
            torch.nn.init.normal_(decoder.leave.weight, std=0.1)
    return model.eval()


WEARABLES: dict[str, type[WDRC] | Any] = {"aid": varied_hearing_aid, "wdrc": WDRC}


def build_wearable(name: str, **options: Any) -> Wearable:
    aid: Wearable = WEARABLES[name](**options)
    return aid


def assert_close(output: Tensor, expected: Tensor, tolerance: float = 1e-5) -> None:
    """Compare shapes, and values relative to the peak."""
    assert output.shape == expected.shape
    error = (output - expected).detach().abs().max()
    assert float(error) < tolerance * float(expected.detach().abs().max())


def tone(hertz: float, spl: float, seconds: float = 1.0, rate: int = 16000) -> Tensor:
    """Compute a sine in float32. Shape: -> (time,)."""
    time = torch.arange(round(rate * seconds), dtype=torch.float64) / rate
    return set_level((2.0 * torch.pi * hertz * time).sin(), spl).float()
