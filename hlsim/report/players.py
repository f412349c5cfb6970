"""Players for pages and notebooks: sounds to switch between, with spectrograms in dB SPL."""

import io
import math
from collections.abc import Mapping

import soundfile
import torch
from torch import Tensor
from torch.nn import functional

from hlsim.calibration import PASCAL_SPL, level_spl
from hlsim.evaluation.result import Evaluation, ItemSounds
from hlsim.extras import require
from hlsim.progress import track
from hlsim.report.page import (
    SPECTROGRAM_COLOURS,
    SPECTROGRAM_LEVELS,
    Player,
    Section,
    Sound,
)

_PEAK = 0.9  # largest sample of the sounds of a group
_VISIBLE_SPL = 10.0  # level of a bin above which its colour can be told from black
_VISIBLE_SHARE = 0.005  # share of visible bins below which a spectrogram looks black
_HIGHEST_HZ = 8000.0  # at which audiograms and HASPI's filters end

_EXPLANATION = (
    "What the impaired ear perceives, by MSBG. The goal is what a normal ear perceives of the "
    "clean speech. Switch between the sounds while one plays: the position stays the same."
)


def listening_sections(evaluation: Evaluation, about: str = _EXPLANATION) -> list[Section]:
    """Return the section "Listen" of a page, with one player per item that has sounds.

    Args:
        evaluation: Evaluation of the page, whose attribute ``sounds`` is played.
        about: Sentences about the sounds.

    Returns: A list with the section, or an empty list if ``sounds`` is empty.

    >>> from hlsim import Audiogram
    >>> from hlsim.evaluation.result import ItemSounds
    >>> signals = {"a": torch.randn(8000, generator=torch.Generator().manual_seed(0))}
    >>> sounds = ItemSounds("s01", Audiogram.standard("N3"), 16000, {"": signals})
    >>> (section,) = listening_sections(Evaluation([], [], [], None, sounds=[sounds]))
    >>> [sound.label for sound in section.sections[0].player.sounds]
    ['a']
    """
    tracked = track(evaluation.sounds, "players", len(evaluation.sounds))
    sections = [_item_section(sounds) for sounds in tracked]
    return [Section("Listen", [about], sections=sections)] if sections else []


def _item_section(sounds: ItemSounds) -> Section:
    """Return the section with the player of an item, and facts about its ear.

    If all sounds are silent or have failed, there is no player.
    """
    ear = sounds.ear
    thresholds = ", ".join(f"{level:g}" for level in ear.thresholds)
    texts = [
        f"Pure-tone average {ear.pta:.0f} dB HL, WHO grade: {ear.who_grade}; MSBG's group: "
        f"{ear.severity}. Thresholds: {thresholds} dB HL."
    ]
    texts += [f"{name} cannot be played: {reason}." for name, reason in sounds.failures.items()]
    if not any(signal.any() for group in sounds.groups.values() for signal in group.values()):
        return Section(sounds.name, [*texts, "There is no sound to play."])
    return Section(sounds.name, texts, player=make_player(sounds.groups, sounds.sample_rate))


def make_player(groups: Mapping[str, Mapping[str, Tensor]], sample_rate: int) -> Player:
    """Return a player that switches between sounds, with their spectrograms.

    All sounds of a group have one gain, so that their loudness can be compared. Groups have
    different gains, because the output of an aid is much louder than what the ear perceives of it.
    If a group is played over 0.5 dB softer than the first one, its heading says by how many dB.

    Args:
        groups: Signals in pascals, as a dict from the heading of a group, which may be empty, to a
            dict from the label of a button to a signal. Shape of each signal: (time,) or (channels,
            time); lengths and numbers of channels may differ.
        sample_rate: Sample rate in Hz.

    Raises:
        ValueError: All signals of a group are silent.
        MissingExtraError: matplotlib or Pillow is not installed.

    >>> tone = torch.sin(torch.arange(16000) * 0.2)
    >>> player = make_player({"": {"tone": tone, "soft tone": 0.1 * tone}}, 16000)
    >>> [f"{sound.label} {sound.level:.0f} dB SPL" for sound in player.sounds]
    ['tone 91 dB SPL', 'soft tone 71 dB SPL']
    """
    first_peak = _peak(next(iter(groups.values())))
    sounds = {}
    for heading, group in groups.items():
        peak = _peak(group)
        softer = 20.0 * math.log10(peak / first_peak)
        title = heading + (
            f", played {softer:.0f} dB softer than the first row" if softer > 0.5 else ""
        )
        sounds[title] = [
            _make_sound(label, signal, sample_rate, peak) for label, signal in group.items()
        ]
    samples = max(signal.shape[-1] for group in groups.values() for signal in group.values())
    return Player(sounds, samples / sample_rate, _full_scale(first_peak))


def _make_sound(label: str, signal: Tensor, sample_rate: int, peak: float) -> Sound:
    """Encode a signal as a WAV file, and draw its spectrogram.

    Args:
        label: Name on the button.
        signal: Signal in pascals. Shape: (time,) or (channels, time).
        sample_rate: Sample rate in Hz.
        peak: Largest magnitude in pascals of all signals of the group, which becomes 0.9.
    """
    level = float(level_spl(signal.flatten()))
    levels = spectrogram_levels(signal, sample_rate)
    return Sound(
        label,
        level,
        encode_wav(signal * (_PEAK / peak), sample_rate),
        loudness=level - _full_scale(peak),
        spectrogram=_spectrogram_png(levels),
        note=_describe_black(levels),
    )


def encode_wav(waveform: Tensor, sample_rate: int) -> bytes:
    """Encode a signal as the contents of a 16-bit WAV file, for audio players on web pages.

    A FLAC file of libsndfile has half the size, but no seek table: Chromium cannot start to play it
    at some positions, and stops.

    Args:
        waveform: Samples from -1 to 1, (time,) or (channels, time). Larger ones are clipped.
        sample_rate: Sample rate in Hz.

    Returns:
        The contents of the file.

    >>> encode_wav(torch.zeros(160), 16000)[:4]
    b'RIFF'
    """
    data = io.BytesIO()
    samples = waveform.detach().cpu().float().resolve_neg().numpy()
    soundfile.write(data, samples.T, sample_rate, format="WAV", subtype="PCM_16")
    return data.getvalue()


def _describe_black(levels: Tensor) -> str:
    """Return the reason why a spectrogram looks black, or an empty text if it does not.

    Args:
        levels: Levels in dB SPL. Shape: (bins, frames).
    """
    if float(levels.max()) < SPECTROGRAM_LEVELS[0]:
        return "nothing is perceived"
    visible_share = float((levels > _VISIBLE_SPL).float().mean())
    return "almost nothing is perceived" if visible_share < _VISIBLE_SHARE else ""


def _peak(group: Mapping[str, Tensor]) -> float:
    """Return the largest magnitude of a sample, in pascals, in a group of signals by label.

    Raises:
        ValueError: All signals are silent.
    """
    peak = max(float(signal.abs().max()) for signal in group.values())
    if not peak:
        raise ValueError(
            f"all sounds are silent ({', '.join(group)}); pass a signal with samples other than "
            "zero"
        )
    return peak


def _full_scale(peak: float) -> float:
    """Return the level in dB SPL of an RMS of 1.0, if a peak in pascals becomes 0.9."""
    return PASCAL_SPL + 20.0 * math.log10(peak / _PEAK)


def spectrogram_levels(signal: Tensor, sample_rate: int) -> Tensor:
    """Compute the spectrogram of a signal up to 8 kHz, in windows of 20 ms every 10 ms.

    If there are several channels, their powers are averaged. Signals shorter than a window are
    padded with silence. The first window is centred at the first sample.

    Args:
        signal: Signal in pascals. Shape: (time,) or (channels, time).
        sample_rate: Sample rate in Hz.

    Returns: Levels in dB SPL in bins of 50 Hz, from 0 Hz, at least -46. Shape: (bins, frames).

    >>> spectrogram_levels(torch.zeros(16000), 16000).shape
    torch.Size([161, 101])
    """
    points = 2 * (sample_rate // 100)
    window = torch.hann_window(points)
    padding = max(0, points - signal.shape[-1])
    samples = functional.pad(signal.float().cpu(), (0, padding))
    spectrum = torch.stft(samples, points, points // 2, window=window, return_complex=True)
    magnitude = spectrum.abs().reshape(-1, *spectrum.shape[-2:]).square().mean(0).sqrt()
    levels = 20.0 * torch.log10(magnitude * 2.0**0.5 / window.sum() + 1e-7) + PASCAL_SPL
    return levels[: round(_HIGHEST_HZ * points / sample_rate) + 1]


def _spectrogram_png(levels: Tensor) -> bytes:
    """Return the contents of a PNG file with one pixel per bin and frame, bin 0 at the bottom.

    Args:
        levels: Levels in dB SPL, drawn from 0 (black) to 90. Shape: (bins, frames).

    Raises:
        MissingExtraError: Pillow or matplotlib is not installed.
    """
    image = require("PIL.Image", "eval")
    colours = require("matplotlib.colors", "eval").LinearSegmentedColormap
    lowest, highest = SPECTROGRAM_LEVELS
    shares = ((levels - lowest) / (highest - lowest)).clamp(0.0, 1.0)
    pixels = (255.0 * shares).round().to(torch.uint8).flip(0).numpy()
    picture = image.fromarray(pixels)
    palette = colours.from_list("", SPECTROGRAM_COLOURS)(range(256), bytes=True)
    picture.putpalette(palette[:, :3].tobytes())
    data = io.BytesIO()
    picture.save(data, format="PNG", optimize=True)
    return data.getvalue()
