"""Items of studies that are drawn from a seed: speech in noise, for several ears and levels."""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from compensators.nalr import NALR
from hlsim.audiogram import STANDARD, Audiogram
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import NEURO_RATE, PASCAL_SPL, level_spl, set_level
from hlsim.checks import check_attributes, check_names, check_number
from hlsim.data.augment import compress
from hlsim.data.clips import Clips
from hlsim.data.ears import MILDER, draw_thresholds
from hlsim.data.manifest import warn_of_non_speech
from hlsim.data.mixing import mix
from hlsim.data.recorded_scenes import SceneClips
from hlsim.evaluation.study import Item
from hlsim.progress import track

SIMULATOR_LEVELS = (50.0, 60.0, 65.0, 70.0, 80.0)
"""Levels of the input in dB SPL through which items for simulators cycle."""

INPUT_LEVELS = (50.0, 65.0, 80.0)
"""Levels of the clean speech in dB SPL through which items for hearing aids cycle."""

MAX_SILENT_END = 0.1
"""Largest share of an item that may be silent at its end without a warning.

The level of an item includes its silence, so its speech is then 0.5 dB louder than stated.
"""

_SNRS_DB = (2.5, 7.5, 12.5, 17.5)
"""Signal-to-noise ratios in dB through which noisy items cycle, as in the paper."""

STANDARD_EARS = ("N2", "N3", "N4", "N5", "N6", "S1", "S2", "S3")
"""Bisgaard's standard audiograms, with which hearing aids are compared unless one ear is passed."""


def draw_simulator_items(
    speech: str | Path,
    noise: str | Path | None,
    audiograms: str | Path,
    *,
    items: int,
    seconds: float,
    seed: int,
    levels: Sequence[float] = SIMULATOR_LEVELS,
) -> list[Item]:
    """Draw the items on which simulators are compared: clips of speech, each for one ear.

    Half of the ears are from ``audiograms``, a quarter are mild standard ears (NH, N1, N2, S1) and
    a quarter are random. With noise, every second item is noisy, and the signal-to-noise ratios of
    these items (by RMS level) cycle through 2.5, 7.5, 12.5 and 17.5 dB. With five levels, the 80
    noisy ones of 160 items contain each combination of a ratio, a level and one of the four
    quarters of the ears once.

    Args:
        speech: Folder of recordings of clean speech.
        noise: Folder of recordings of noise, or None.
        audiograms: CSV file of ears with thresholds up to 100 dB HL, or ``"standard"`` for
            Bisgaard's except N7, see ``read_audiograms``.
        items: Number of items, 1 or more.
        seconds: Length of each item in seconds, 0.02 or more.
        seed: Seed of all random draws.
        levels: Levels of the speech with its noise in dB SPL, through which the items cycle.

    Returns: Items at 16 kHz, in pascals. Their facts are ``severity`` (degree of loss),
        ``input_level`` (dB SPL), ``speech`` (clean or noisy), ``noise_snr`` (dB, NaN if clean) and
        ``audiogram`` (thresholds in dB HL at the eight frequencies).

    Raises:
        ValueError: A folder or the file of ears cannot be read, or a number is out of range.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> settings = {"items": 2, "seconds": 1.0, "seed": 0}
    >>> items = draw_simulator_items(EXAMPLE_FILE.parent, None, "standard", **settings)
    >>> [item.name for item in items]
    ['item 0', 'item 1']
    """
    generator = torch.Generator().manual_seed(seed)
    measured = [ear for _, ear in read_audiograms(audiograms, simulated=True)]
    drawn = []
    for number, clean, masker in _draw_clips(speech, noise, items, seconds, generator):
        kind, turn = (number // 2) % 4, number // 8
        level, snr, shift = _level_and_snr(kind, turn, levels)
        if kind < 2:
            ear = measured[int(torch.randint(len(measured), (), generator=generator))]
        elif kind == 2:
            ear = Audiogram.standard(MILDER[(turn + turn // 4 + shift) % len(MILDER)])
        else:
            ear = Audiogram(tuple(draw_thresholds(1, generator).squeeze(0).tolist()))
        signal, snr = _add_noise(clean, masker, snr)
        gain = 10.0 ** ((level - float(level_spl(signal))) / 20.0)
        facts = _facts(ear, level, "noise_snr", snr)
        drawn.append(Item(f"item {number}", clean * gain, signal * gain, ear, facts=facts))
    _warn_of_silence(drawn)
    return drawn


def draw_aid_items(
    speech: str | Path,
    noise: str | Path | None,
    ears: Sequence[tuple[str, Audiogram]],
    *,
    items: int,
    seconds: float,
    seed: int,
    levels: Sequence[float] = INPUT_LEVELS,
) -> list[Item]:
    """Draw the items on which hearing aids are compared: clips of speech, each for one of the ears.

    The items cycle through the ears. With noise, every second item is noisy, and the
    signal-to-noise ratios of these items (by RMS level) cycle through 2.5, 7.5, 12.5 and 17.5 dB.
    The noisy ones of ``8 * len(levels) * len(ears)`` items contain each combination of an ear, a
    level and a ratio once; fewer items contain some of the combinations.

    Args:
        speech: Folder of recordings of clean speech.
        noise: Folder of recordings of noise, or None.
        ears: Names and audiograms of the ears.
        items: Number of items, 1 or more.
        seconds: Length of each item in seconds, 0.02 or more.
        seed: Seed of all random draws.
        levels: Levels of the clean speech in dB SPL, through which the items cycle.

    Returns: Items at 16 kHz, in pascals. Their facts are ``ear`` (its name), ``severity`` (degree
        of loss), ``input_level`` (of the clean speech, in dB SPL), ``speech`` (clean or noisy),
        ``snr`` (dB, NaN if clean) and ``audiogram`` (thresholds in dB HL at the eight frequencies).

    Raises:
        ValueError: A folder cannot be read, or a number is out of range.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> settings = {"items": 1, "seconds": 1.0, "seed": 0}
    >>> (item,) = draw_aid_items(EXAMPLE_FILE.parent, None, read_ears(None), **settings)
    >>> item.facts["ear"], item.facts["input_level"]
    ('N2', 50.0)
    """
    generator = torch.Generator().manual_seed(seed)
    drawn = []
    for number, clip, masker in _draw_clips(speech, noise, items, seconds, generator):
        turn, place = divmod(number if noise is None else number // 2, len(ears))
        ear_name, ear = ears[place]
        level, snr, _ = _level_and_snr(place, turn, levels)
        clean = set_level(clip, level)
        signal, snr = _add_noise(clean, masker, snr)
        facts = {"ear": ear_name, **_facts(ear, level, "snr", snr)}
        item_seed = (seed + number) % 2**32
        drawn.append(Item(f"item {number}", clean, signal, ear, seed=item_seed, facts=facts))
    _warn_of_silence(drawn)
    return drawn


def draw_scene_items(
    scenes: SceneClips,
    ears: Sequence[tuple[str, Audiogram]],
    *,
    items: int,
    seconds: float,
    seed: int,
    levels: Sequence[float] = INPUT_LEVELS,
) -> list[Item]:
    """Draw items out of recorded scenes, each for one of the ears.

    The items cycle through the ears, and the clean speech at the item's ear through the levels. Of
    scenes for two ears, half of the items of an ear are mirrored, so that their ear, the first one,
    is the right ear of the scene.

    Args:
        scenes: Clips of the scenes at 16 kHz.
        ears, items, seconds, seed, levels: See ``draw_aid_items``; ``seconds`` is the length of the
            clips.

    Returns: Items, see ``Item`` for the shape of their signals. Their facts are those of
        ``draw_aid_items``, with ``speech`` always noisy and an unknown SNR (NaN).

    Raises:
        ValueError: A number is out of range, or no scene can be used.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> from hlsim.data.recorded_scenes import SceneFiles
    >>> files = SceneFiles(EXAMPLE_FILE, (EXAMPLE_FILE,), references=(1,))
    >>> scenes = SceneClips([files], sample_rate=16000, seconds=1.0)
    >>> settings = {"items": 1, "seconds": 1.0, "seed": 0}
    >>> (item,) = draw_scene_items(scenes, read_ears(None), **settings)
    >>> item.clean.shape, item.signal.shape
    (torch.Size([16000]), torch.Size([1, 1, 16000]))
    """
    check_number("items", items, 1, whole=True)
    check_number("seconds", seconds, 0.02)
    generator = torch.Generator().manual_seed(seed)
    drawn = []
    for number in track(range(items), "items", items):
        turn, place = divmod(number, len(ears))
        ear_name, ear = ears[place]
        level, _, shift = _level_and_snr(place, turn, levels)
        clean, signal = (signals[0] for signals in scenes.draw_scenes(1, generator))
        if scenes.ears == 2 and (place + turn + shift) % 2 == 1:
            clean, signal = clean.flip(0), signal.flip(1)
        gain = 10.0 ** ((level - float(level_spl(clean[0]))) / 20.0)
        facts = {"ear": ear_name, **_facts(ear, level, "snr", math.nan), "speech": "noisy"}
        item_seed = (seed + number) % 2**32
        signals = gain * clean[0], gain * signal
        drawn.append(Item(f"item {number}", *signals, ear, seed=item_seed, facts=facts))
    _warn_of_silence(drawn)
    _warn_of_unusable("scenes", scenes)
    return drawn


def _warn_of_unusable(noun: str, clips: Clips) -> None:
    """Warn if recordings were drawn that cannot be used, called ``noun``, such as "scenes"."""
    if clips.left_out:
        warnings.warn(
            f"{len(clips.left_out)} of {len(clips)} {noun} were drawn and left out, because they "
            "cannot be used; the items come from the others. Replace or remove these files",
            stacklevel=3,
        )


def _warn_of_silence(items: Sequence[Item]) -> None:
    """Warn of items whose clean speech ends in silence for more than a tenth of their length."""
    ends = [item.clean[-int(MAX_SILENT_END * len(item.clean)) - 1 :] for item in items]
    silent = sum(not end.any() for end in ends)
    if silent:
        warnings.warn(
            f"{silent} of {len(items)} items end in silence for more than a tenth of their length, "
            "for example because recordings are shorter. The silence counts in the level, so the "
            "speech is louder than stated; choose shorter items (seconds, --seconds) or longer "
            "recordings.",
            stacklevel=3,
        )


def read_ears(audiograms: str | Path | None) -> list[tuple[str, Audiogram]]:
    """Return names and audiograms of the ears N2 to N6 and S1 to S3, and of those in a CSV file.

    The name of an ear in the file consists of its columns ``listener`` and ``ear``, and of its
    number in the file, as ``row 3``, if an earlier ear has this name, or if both columns are empty.
    An ear with the name and the thresholds of an earlier one is left out.

    Args:
        audiograms: CSV file of ears, see ``read_audiograms``, or None.

    Raises:
        ValueError: The file cannot be read, or has a threshold above 100 dB HL.

    >>> [name for name, _ in read_ears(None)]
    ['N2', 'N3', 'N4', 'N5', 'N6', 'S1', 'S2', 'S3']
    """
    ears = [(name, Audiogram.standard(name)) for name in STANDARD_EARS]
    rows = read_audiograms(audiograms, simulated=True) if audiograms is not None else []
    for number, (row, ear) in enumerate(rows, start=1):
        name = " ".join(filter(None, (row.get("listener"), row.get("ear"))))
        if (name, ear) in ears:
            continue
        if name in dict(ears):
            name += f", row {number}"
        ears.append((name or f"row {number}", ear))
    return ears


def ear_name(audiogram: Audiogram) -> str:
    """Return the name of an ear if it is a standard one, and its thresholds as text otherwise.

    The text has no frequencies. Uncomfortable levels have no influence.

    >>> ear_name(Audiogram.standard("N4")), ear_name(Audiogram([30, 40], [500, 4000]))
    ('N4', '30, 40 dB HL')
    """
    thresholds = replace(audiogram, ucl=())
    names = [name for name, levels in STANDARD.items() if thresholds == Audiogram(levels)]
    levels = ", ".join(f"{level:g}" for level in audiogram.levels)
    return names[0] if names else f"{levels} dB HL"


def apply_treatments(
    items: Sequence[Item], treatments: Sequence[str], compensator: nn.Module | None = None
) -> list[Item]:
    """Process the inputs of items in several ways, such as by an aid.

    Args:
        items: Items at 16 kHz, in pascals. They are not changed.
        treatments: Names of ways to process the input: ``"as-is"``, ``"louder"`` (by 20 dB),
            ``"nalr"`` (amplified by NAL-R for the ear), ``"compressed"`` (3:1) and
            ``"compensated"`` (by ``compensator``).
        compensator: Aid of the treatment ``"compensated"``, which is called with a waveform and an
            ear. It is set to evaluation mode.

    Returns: One item per item and treatment: all treatments of the first item, then all of the
        second one. Each has the fact ``treatment``, the name of its treatment.

    Raises:
        ValueError: A treatment is unknown, ``"compensated"`` lacks a compensator, or the
            compensator was built for another sample rate or full scale.

    >>> clean = torch.ones(1600)
    >>> item = Item("item 1", clean, clean, Audiogram.standard("N3"))
    >>> [float(item.signal[0]) for item in apply_treatments([item], ["as-is", "louder"])]
    [1.0, 10.0]
    """
    three_to_one = torch.tensor([3.0])
    functions: dict[str, Callable[[Tensor, Any], Tensor]] = {
        "as-is": lambda signal, ear: signal,
        "louder": lambda signal, ear: 10.0 * signal,
        "nalr": NALR(sample_rate=NEURO_RATE),
        "compressed": lambda signal, ear: compress(signal[None], three_to_one, NEURO_RATE)[0],
    }
    if compensator is not None:
        check_attributes(
            compensator, "a compensator", sample_rate=NEURO_RATE, full_scale_spl=PASCAL_SPL
        )
        functions["compensated"] = compensator.eval()
    check_names(treatments, functions, "inputs (compensated needs a compensator)")
    treated = []
    pairs = [*product(items, treatments)]
    for item, treatment in track(pairs, "inputs", len(pairs)):
        with torch.no_grad():
            # A compensator that changes its input in place must not change the item.
            signal = functions[treatment](item.signal.clone(), item.ear)
        facts = {**item.facts, "treatment": treatment}
        treated.append(replace(item, signal=signal, facts=facts))
    return treated


def _draw_clips(
    speech: str | Path,
    noise: str | Path | None,
    items: int,
    seconds: float,
    generator: torch.Generator,
) -> Iterator[tuple[int, Tensor, Tensor | None]]:
    """Yield the number from 0, the clean speech and the noise of each item.

    The noise is None without a folder of noise, and for items with an even number. Speech and noise
    have the shape (time,), 16 kHz, and no calibrated level. After the last item, a warning counts
    the recordings that were drawn and cannot be used.

    Raises:
        ValueError: A number is out of range, or a folder has no usable audio.
    """
    check_number("items", items, 1, whole=True)
    check_number("seconds", seconds, 0.02)
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=seconds)
    warn_of_non_speech(speech, clips.files)
    noises = None
    if noise is not None:
        noises = Clips(noise, sample_rate=NEURO_RATE, seconds=seconds, repeat=True)
    for number in track(range(items), "items", items):
        clean = clips.draw(1, generator)[0]
        is_noisy = noises is not None and number % 2 == 1
        yield number, clean, noises.draw(1, generator)[0] if noises and is_noisy else None
    _warn_of_unusable("recordings of speech", clips)
    if noises is not None:
        _warn_of_unusable("recordings of noise", noises)


def _level_and_snr(ear: int, turn: int, levels: Sequence[float]) -> tuple[float, float, int]:
    """Choose the level and the SNR of an item, so that each ear gets all combinations of both.

    Args:
        ear: Number of the ear, or of the kind of ear.
        turn: Number of earlier items with this ear, where a clean and a noisy item of a pair count
            as one.
        levels: Levels in dB SPL, -20 to 140.

    Returns:
        The level in dB SPL; the SNR in dB; and an offset in the cycle of the SNRs, which is already
        part of the SNR. With an even number of levels, the offset rises by 1 per cycle of the
        levels, because some combinations would otherwise never occur. With an odd number, it is 0.

    Raises:
        ValueError: There is no level, or one is out of range.
    """
    if not levels:
        raise ValueError("expected one or more levels, got none; write levels=[65.0]")
    for level in levels:
        check_number("a level", level, -20.0, 140.0)
    shift = 0 if len(levels) % 2 else turn // len(levels)
    number = ear + turn
    return levels[number % len(levels)], _SNRS_DB[(number + shift) % len(_SNRS_DB)], shift


def _add_noise(clean: Tensor, noise: Tensor | None, snr: float) -> tuple[Tensor, float]:
    """Add noise to speech at an SNR in dB, (time,) each, and return both the sum and the SNR.

    Without noise (None), return the speech and NaN.
    """
    if noise is None:
        return clean, math.nan
    # By RMS level. Trainings mix by active speech level, at which the same number is more noise.
    return mix(clean, noise, snr, sample_rate=None), snr


def _facts(ear: Audiogram, level: float, snr_column: str, snr: float) -> dict[str, Any]:
    """Return the facts of an item, see ``draw_simulator_items``.

    Args:
        ear: Audiogram of the ear.
        level: Level in dB SPL to state as ``input_level``.
        snr_column: Name of the fact with the SNR.
        snr: SNR in dB, or NaN for clean speech.
    """
    return {
        "severity": ear.severity,
        "input_level": level,
        "speech": "clean" if math.isnan(snr) else "noisy",
        snr_column: snr,
        "audiogram": list(ear.thresholds),
    }
