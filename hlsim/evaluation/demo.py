"""The study of the command ``demo``: an aid that was trained for one ear, beside NAL-R."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from compensators import NALR, MappingConfig
from hlsim.audio import find_audio, read_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import NEURO_RATE, set_level
from hlsim.data import bundled
from hlsim.dsp.resample import resample
from hlsim.evaluation.aid_properties import mean_band_levels, measure_aids, measure_gain_curve
from hlsim.evaluation.comparison import ConditionComparison, compare
from hlsim.evaluation.conditions import (
    NAL_R,
    NAL_R_AT_LEVEL,
    TRAINED,
    UNAIDED,
    AtLevelOf,
    Unaided,
)
from hlsim.evaluation.items import INPUT_LEVELS
from hlsim.evaluation.measures import LEVELS, MEASURES, NORMAL, PERCEPTION, perceive
from hlsim.evaluation.result import Evaluation, ItemSounds
from hlsim.evaluation.sounds import NORMAL_EAR
from hlsim.evaluation.study import Condition, Item
from hlsim.progress import track

if TYPE_CHECKING:
    from pandas import DataFrame

_SPEECH_LEVEL = 65.0
"""Level of the utterances in dB SPL, without an aid and as input of the aids."""

_MAX_SECONDS = 5.0  # of an utterance that is scored, so that HASPI takes half as long

_Signals = Mapping[str, Sequence[Tensor]]
"""Dict from the name of a condition to one signal per item, in pascals, each with shape (time,)."""


def evaluate_trained_aid(
    aid: nn.Module, audiogram: Audiogram, *, ear_name: str, training_steps: int, **running: Any
) -> Evaluation:
    """Compare an aid that was trained for one ear with no aid and NAL-R, on bundled speech.

    The only comparison is the planned one: HASPI of the aid against NAL-R at the aid's level, over
    the means of the voices, because utterances of one voice are not independent.

    Args:
        aid: Trained aid, which is called with a waveform in pascals at 16 kHz, (time,), and an ear.
        audiogram: Audiogram of the ear.
        ear_name: Name of the ear, for the page.
        training_steps: Number of training steps, for the page.
        running: Arguments ``jobs``, ``dask`` and ``progress`` of ``run_study``.

    Returns:
        The evaluation. Its ``details`` have ``gain_curves`` of NAL-R and the aid, see
        ``measure_aids``; ``perceived_levels``, by condition the levels that the ear perceives in
        24 bands in dB SPL, and under ``NORMAL_EAR`` those that a normal ear perceives of the
        speech; and ``speech_levels_hl``, the levels of the input and of the aid's output in these
        bands in dB HL. Its ``sounds`` are those of the last utterance.

    Raises:
        ValueError: The aid fails, or no output could be scored.
        MissingExtraError: A package is not installed.
    """
    nal_r = NALR()
    conditions = [
        Condition(UNAIDED, Unaided(), "unaided"),
        Condition(NAL_R, nal_r, "prescription"),
        Condition(NAL_R_AT_LEVEL, AtLevelOf(nal_r, aid), "same level", TRAINED),
        Condition(TRAINED, aid),
    ]
    items = _read_items(audiogram)
    evaluation = Evaluation.run(
        items,
        conditions,
        [MEASURES["haspi"], LEVELS, PERCEPTION],
        store=None,
        settings={
            "seed": 0,
            "ear": ear_name,
            "training_steps": training_steps,
            "limit_spl": MappingConfig().limit_spl,
        },
        required=["haspi", "level", "loudness_error"],
        **running,
    )
    with torch.no_grad():
        outputs = {c.name: [c.output(item) for item in items] for c in conditions}
    perceived = {NORMAL_EAR: [perceive(item.clean, NORMAL, NEURO_RATE) for item in items]}
    for name, signals in track(outputs.items(), "conditions", len(outputs)):
        perceived[name] = [perceive(signal, audiogram, NEURO_RATE) for signal in signals]
    shortest = min(len(item.clean) for item in items)
    details = {
        "gain_curves": measure_aids(
            {NAL_R: nal_r, TRAINED: aid},
            {ear_name: audiogram},
            measure_gain_curve,
            torch.stack([item.clean[:shortest] for item in items]),
            INPUT_LEVELS,
        ),
        "perceived_levels": {
            name: mean_band_levels(signals) for name, signals in perceived.items()
        },
        "speech_levels_hl": {
            name: mean_band_levels(outputs[name], hearing_level=True) for name in (UNAIDED, TRAINED)
        },
    }
    return replace(
        evaluation,
        comparisons=_compare_voices(evaluation.table),
        details=details,
        sounds=[_last_sounds(items, outputs, perceived)],
    )


def _read_items(audiogram: Audiogram) -> list[Item]:
    """Read the bundled validation utterances as items for an ear: 16 kHz, 65 dB SPL, at most 5 s.

    The seed of an item, for HASPI's noise, is its number. Its facts are ``voice`` and ``severity``.
    """
    items = []
    for number, path in enumerate(find_audio(bundled.SPEECH / "valid")):
        waveform, rate = read_audio(path)
        clip = resample(waveform[0], rate, NEURO_RATE)[: round(_MAX_SECONDS * NEURO_RATE)]
        clean = set_level(clip, _SPEECH_LEVEL)
        facts = {"voice": path.stem.rpartition("-")[0], "severity": audiogram.severity}
        items.append(Item(path.stem, clean, clean, audiogram, seed=number, facts=facts))
    return items


def _compare_voices(table: DataFrame) -> list[ConditionComparison]:
    """Compare the aid with NAL-R at its level by HASPI, over the mean scores of each voice.

    Args:
        table: Table of the study, with the column ``voice``.

    Returns: A list of the planned comparison alone, or an empty list if no voice has both scores or
    no other condition has scores.
    """
    means = table.groupby(["voice", "condition"], sort=False)[["haspi", "level"]].mean()
    rows = means.reset_index().rename(columns={"voice": "item"})
    planned = [("haspi", NAL_R_AT_LEVEL, TRAINED)]
    return [c for c in compare(rows, ["haspi"], planned=planned) if c.planned]


def _last_sounds(items: Sequence[Item], outputs: _Signals, perceived: _Signals) -> ItemSounds:
    """Return the sounds of the last utterance for the page.

    The first group has what a normal ear perceives of clean speech and what the impaired ear
    perceives under each condition but NAL-R at the level of the aid, which is the second group; the
    third one has clean speech and the outputs of the aids. In a group with one gain for all, the
    peaks of NAL-R at that level would make the other sounds too soft to be heard.

    Args:
        items: Items of the study.
        outputs: Outputs of each condition, one per item.
        perceived: Signals that the ear perceives of these outputs, and under ``NORMAL_EAR`` those
            that a normal ear perceives of clean speech.
    """
    item = items[-1]
    aided = {name: signals[-1] for name, signals in outputs.items() if name != UNAIDED}
    last_perceived = {name: signals[-1] for name, signals in perceived.items()}
    loud = {NAL_R_AT_LEVEL: last_perceived.pop(NAL_R_AT_LEVEL)}
    groups = {
        "Perceived by this ear, beside a normal ear": last_perceived,
        "Perceived of NAL-R at the level of the trained aid": loud,
        "Output of the aids": {"original speech": item.clean, **aided},
    }
    return ItemSounds(item.name, item.ear, item.sample_rate, groups)
