"""Fingerprints: modules that compute something else differ, and nothing else makes a difference."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from compensators import NALR, WDRC, load_compensator
from hlsim import MSBG, Audiogram
from hlsim.evaluation.fingerprint import combined_fingerprint, fingerprint
from hlsim.neuro.pretrained import load_pretrained
from hlsim.pretrained import SIMULATOR, shipped_checkpoints


def test_settings_and_ears_tell_modules_apart() -> None:
    ear = Audiogram.standard("N3")
    modules = [
        MSBG(sample_rate=16000),
        MSBG(sample_rate=16000, rescale_active=True),
        MSBG(ear, sample_rate=16000),
        NALR(sample_rate=16000),
        NALR(ear, sample_rate=16000),
        WDRC(),
        WDRC(release=0.2),
        load_compensator("hearing-aid"),
        load_compensator("hearing-aid", linked=True),
    ]
    assert len({fingerprint(module) for module in modules}) == len(modules)
    assert fingerprint(MSBG(sample_rate=16000)) == fingerprint(modules[0])
    assert None not in map(fingerprint, modules)


@pytest.mark.parametrize("name", [*shipped_checkpoints([SIMULATOR])])
def test_a_checkpoint_is_the_same_whenever_it_is_loaded(name: str) -> None:
    once, again = load_pretrained(name), load_pretrained(name)
    again(torch.full((1600,), 0.01), Audiogram.standard("N3"))  # use does not change it
    assert fingerprint(once) == fingerprint(again) is not None


@dataclass
class Options:
    gain: float


class Foreign(nn.Module):
    """A module of somebody else with a setting and one weight."""

    def __init__(self, setting: Any) -> None:
        super().__init__()
        self.setting = setting
        self.weight = nn.Parameter(torch.ones(1))


def test_settings_of_any_describable_kind_count() -> None:
    settings: list[Any] = [
        *([1.0], [2.0], {"a": 1.0}, {"a": 2.0}, None, torch.float32, max, min),
        *(np.ones(2), np.zeros(2), torch.ones(3), Options(0.0), Options(20.0)),
    ]
    fingerprints = [fingerprint(Foreign(setting)) for setting in settings]
    assert None not in fingerprints and len(set(fingerprints)) == len(settings)
    assert fingerprints == [fingerprint(Foreign(setting)) for setting in settings]


def test_where_a_class_is_defined_does_not_count() -> None:
    moved = type("Foreign", (Foreign,), {"__module__": "elsewhere", "__qualname__": "Foreign"})
    assert fingerprint(moved(1.0)) == fingerprint(Foreign(1.0))


def test_what_cannot_be_described_has_none_unless_it_states_one() -> None:
    assert fingerprint(Foreign(lambda: 1.0)) is None
    assert fingerprint(Foreign(partial(max, 1.0))) is None
    assert fingerprint(nn.Identity()) is None, "a foreign module without tensors and config"
    assert fingerprint(lambda waveform: waveform) is None
    stated = Foreign(lambda: 1.0)
    stated.fingerprint = "version 1"  # type: ignore[assignment]
    first = fingerprint(stated)
    stated.fingerprint = "version 2"  # type: ignore[assignment]
    assert first != fingerprint(stated) and first is not None
    assert combined_fingerprint("a", None) is None != combined_fingerprint("a", "b")
