"""Compensators judged one utterance at a time: what is measured of each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.signal import firwin2
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.dsp.fir import filter_centred
from hlsim.evaluation.previous.items import Item
from hlsim.losses.band_levels import (
    audibility,
    band_centres,
    band_level_loss,
    band_levels,
    least_audible,
)
from hlsim.metrics.registry import MEASURES
from hlsim.msbg import MSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import Failed, one_thread, reason_of
from hlsim.plugins import WaveformPlugin

OF_NETWORK = "loss_neuro"
"""The figure that depends on the named network; no other does."""

NORMAL = Audiogram.standard("NH")

_TAPS = 513  # of an equaliser: 31 Hz at 16 kHz


class Unaided(nn.Module):
    """What an ear without a hearing aid is given: the signal as it is."""

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        return waveform


class Equaliser(nn.Module):
    """A fixed filter without delay, of linear phase: gains in dB at ``band_centres``, whatever the ear."""

    def __init__(self, gains_db: Sequence[float]) -> None:
        super().__init__()
        self.gains_db = tuple(gains_db)

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        hertz = np.linspace(0.0, NEURO_RATE / 2.0, _TAPS)
        gains_db = np.interp(np.log(hertz.clip(1.0)), np.log(band_centres()), self.gains_db)
        taps = firwin2(_TAPS, hertz, 10.0 ** (gains_db / 20.0), fs=NEURO_RATE)
        return filter_centred(waveform, torch.from_numpy(taps).to(waveform))


class AtLevelOf(nn.Module):
    """An aid's output at the RMS level of what another makes of the same input."""

    def __init__(self, aid: nn.Module, other: nn.Module) -> None:
        super().__init__()
        self.aid, self.other = aid, other

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        return set_level(self.aid(waveform, audiogram), level_spl(self.other(waveform, audiogram)))


class Enhanced(nn.Module):
    """An aid that is given what an enhancer makes of the input."""

    def __init__(self, enhancer: WaveformPlugin, aid: nn.Module) -> None:
        super().__init__()
        self.enhancer, self.aid = enhancer, aid
        self.fingerprint = enhancer.fingerprint  # part of the keys of stored scores
        self.limit_spl = limit_of(aid)

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        aided: Tensor = self.aid(self.enhancer(waveform, NEURO_RATE), audiogram)
        return aided


def limit_of(aid: nn.Module) -> float | None:
    """The peak in dB SPL that an aid promises not to pass."""
    limit: float | None = getattr(getattr(aid, "config", aid), "limit_spl", None)
    return limit


class Keys(NamedTuple):
    """What figures are stored under: all but ``OF_NETWORK``, which depends on more, and that one."""

    most: str
    of_network: str


@dataclass(frozen=True)
class Trial:
    """An item to be judged as each compensator gives it.

    The compensators, by name, and the network are at 16 kHz and 94 dB SPL full scale; ``seed``, the same for all, is of
    the noise that HASPI and HASQI add; ``keys`` are the figures', by compensator.
    """

    item: Item
    compensators: Mapping[str, nn.Module]
    simulator: nn.Module
    seed: int
    keys: Mapping[str, Keys]


@one_thread()
@torch.no_grad()
def judge(trial: Trial, missing: Sequence[str]) -> dict[str, dict[str, Any] | Failed]:
    """The figures whose keys are missing; what goes wrong is the reason.

    - ``haspi``, ``hasqi``: v2, of the output against the clean speech, in noise too.
    - ``level``, ``peak``: of the output, RMS and largest sample in dB SPL (a sample of 1.0 is 94).
    - ``heard``: level in dB SPL after the exact MSBG; ``normal``: what a normal ear hears there of the same input, noise
      and all; ``normal_clean``: of the speech in it.
    - ``band_error``: ``band_error_db`` (24 bands, 32 ms) of what the impaired ear hears and what a normal one hears of
      the clean speech, both by the exact MSBG.
    - ``loss_neuro``, ``loss_msbg``: what ``HearingLossLoss(criterion="bands")`` is under each.
    """
    item = trial.item
    try:
        normal = {"neuro": trial.simulator(item.clean, NORMAL)}
        if any(keys.most in missing for keys in trial.keys.values()):
            normal["msbg"] = _hear(item.clean, NORMAL)
            normal["msbg, of the input"] = _hear(item.signal, NORMAL)
    except Exception as error:  # whatever it is, it is this item's reason, and the others go on
        return dict.fromkeys(missing, Failed(reason_of(error)))
    made: dict[str, dict[str, Any] | Failed] = {}
    for name, keys in trial.keys.items():
        if not (wanted := set(keys) & set(missing)):
            continue
        try:
            aided = trial.compensators[name](item.signal, item.ear)
            records: dict[str, dict[str, Any]] = (
                {keys.most: _figures(trial, aided, normal)} if keys.most in wanted else {}
            )
            of_network = _loss(trial.simulator(aided, item.ear), normal["neuro"])
            records[keys.of_network] = {OF_NETWORK: of_network}
            figures = {
                figure: value for record in records.values() for figure, value in record.items()
            }
            if unknown := [figure for figure, value in figures.items() if not math.isfinite(value)]:
                raise ValueError(f"{', '.join(unknown)}: not finite")
            made |= records
        except Exception as error:
            made |= dict.fromkeys(wanted, Failed(reason_of(error)))
    return made


def _figures(trial: Trial, aided: Tensor, normal: Mapping[str, Tensor]) -> dict[str, float]:
    """All but ``OF_NETWORK``."""
    item = trial.item
    of_pair = (item.clean, aided, item.ear, NEURO_RATE, PASCAL_SPL, trial.seed)
    scores = {name: MEASURES[name].score(*of_pair) for name in ("haspi", "hasqi")}
    heard = _hear(aided, item.ear)
    return {
        **scores,
        "level": float(level_spl(aided)),
        "peak": peak_spl(aided),
        "heard": float(level_spl(heard)),
        "normal": float(level_spl(normal["msbg, of the input"])),
        "normal_clean": float(level_spl(normal["msbg"])),
        "band_error": band_error_db(heard, normal["msbg"]),
        "loss_msbg": _loss(heard, normal["msbg"]),
    }


def _loss(heard: Tensor, normal: Tensor) -> float:
    return float(band_level_loss(heard, normal, NEURO_RATE))


def peak_spl(waveform: Tensor) -> float:
    """The largest sample in dB SPL, where 1.0 is 94. Shape: (time,)."""
    return float(20.0 * waveform.abs().max().clamp_min(1e-10).log10()) + PASCAL_SPL


def band_error_db(heard: Tensor, normal: Tensor) -> float:
    """Median absolute difference of band levels in dB, over the bands and frames that a normal ear finds audible.

    Shape: (time,) twice, in pascals at 16 kHz. ValueError where it finds none audible.
    """
    levels, truth = band_levels(heard, NEURO_RATE), band_levels(normal, NEURO_RATE)
    audible = audibility(truth, least_audible(truth)) > 0.0
    if not bool(audible.any()):
        raise ValueError("nothing of the clean speech is audible to a normal ear")
    return float((levels - truth).abs()[audible].double().quantile(0.5))


def _hear(signal: Tensor, ear: Audiogram) -> Tensor:
    """What the exact MSBG makes of it."""
    heard: Tensor = MSBG(sample_rate=NEURO_RATE)(signal, ear)
    return heard
