"""Functions for a notebook: load speech, simulate a loss, apply an aid, and listen."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from compensators import load_compensator
from hlsim.audio import read_audio
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import (
    HIGHEST_SPL,
    LOWEST_SPL,
    NEURO_RATE,
    PASCAL_SPL,
    gain_to_pascals,
    set_level,
)
from hlsim.checks import check_finite, check_number, check_rate, check_waveform
from hlsim.data.bundled import EXAMPLE_FILE
from hlsim.dsp.resample import resample
from hlsim.simulators import load_simulator
from hlsim.torchtools import Audio, Samples, as_samples, as_type_of

if TYPE_CHECKING:
    from hlsim.report.page import Player

EXAMPLE_SPL = 65.0
"""Level of conversational speech in dB SPL."""

_REPORTED_PACKAGES = (
    *("hlsim", "torch", "numpy", "scipy", "soundfile", "safetensors", "lightning", "pandas"),
)
"""Packages whose versions ``info`` lists."""


def load_audio(
    path: str | Path, *, spl: float | None = EXAMPLE_SPL, sample_rate: int | None = None
) -> tuple[Tensor, int]:
    """Load an audio file as a tensor that is calibrated to a presentation level.

    Args:
        path: A file that libsndfile reads, such as WAV, FLAC, Ogg or MP3.
        spl: RMS level over all channels in dB SPL, -20 to 140, to which the recording is scaled,
            with one gain for all channels. With ``None`` nothing is scaled: the file's samples are
            pascals.
        sample_rate: Rate in Hz to which the recording is resampled, 16000 to 48000; by default the
            file's rate.

    Returns:
        Samples in pascals, ``(time,)`` for a mono file and ``(channels, time)`` otherwise, and
        their sample rate in Hz.

    Raises:
        ValueError: The file cannot be read, is empty or silent, contains NaN or infinity, or has a
            sample rate below 16 kHz; or the level or the sample rate is not valid.

    Example:
        >>> import hlsim
        >>> from hlsim.data.bundled import EXAMPLE_FILE
        >>> speech, rate = hlsim.load_audio(EXAMPLE_FILE, spl=65.0)
        >>> speech.ndim, rate
        (1, 16000)
    """
    channels, rate = read_audio(path)
    if sample_rate is not None:
        sample_rate = check_rate(sample_rate)
        channels = resample(channels, rate, sample_rate)
        rate = sample_rate
    if spl is not None:
        check_number("spl", spl, LOWEST_SPL, HIGHEST_SPL)
        channels = set_level(channels.flatten(), spl).reshape(channels.shape)
    if len(channels) == 1:
        channels = channels[0]
    return channels, rate


def example_speech() -> Tensor:
    """Return a bundled utterance of synthetic speech at 16 kHz and 65 dB SPL.

    Returns:
        Samples in pascals, ``(time,)``.

    Example:
        >>> import hlsim
        >>> hlsim.example_speech().shape
        torch.Size([64320])
    """
    speech, _ = load_audio(EXAMPLE_FILE, spl=EXAMPLE_SPL)
    return speech


def simulate(
    audio: Audio,
    audiogram: AudiogramLike,
    sample_rate: int = NEURO_RATE,
    *,
    simulator: str | Path | torch.nn.Module = "msbg",
    full_scale_spl: float = PASCAL_SPL,
) -> Audio:
    """Simulate what an impaired ear perceives of a signal, without gradients.

    Args:
        audio: Tensor or NumPy array of floating-point samples, ``(..., time)``.
        audiogram: An audiogram, the name of a standard one (``"N3"``), eight thresholds in dB HL, a
            mapping of frequencies in Hz to thresholds, a ``Listener`` for ``(..., 2, time)``, or a
            sequence with one ear per item.
        sample_rate: Sample rate in Hz, 16000 to 48000.
        simulator: ``"msbg"``, the exact model; ``"attenuation"``, a linear ear; the name or folder
            of a checkpoint such as ``"neuro-msbg"``; ``package.module:name``, a simulator of your
            own; or a module that was built for this rate and level (see ``load_simulator``).
        full_scale_spl: Level in dB SPL of a signal whose RMS is 1.0, by default 94, so that samples
            are in pascals.

    Returns:
        The perceived signal, of the type and shape of ``audio``. For a sequence of ears and one
        signal, ``(time,)``, one output per ear, ``(ears, time)``.

    Raises:
        ValueError: The audio, the ear, the rate, the level or the simulator is not valid.

    Example:
        >>> import hlsim
        >>> perceived = hlsim.simulate(hlsim.example_speech(), "N4")
        >>> perceived.shape
        torch.Size([64320])
    """
    model = load_simulator(simulator, sample_rate=sample_rate, full_scale_spl=full_scale_spl)
    with torch.no_grad():
        return as_type_of(audio, model(_as_finite_tensor(audio), audiogram))


def compensate(
    audio: Audio,
    audiogram: AudiogramLike,
    sample_rate: int = NEURO_RATE,
    *,
    compensator: str | Path = "hearing-aid",
    full_scale_spl: float = PASCAL_SPL,
) -> Audio:
    """Compute the output of a hearing aid for a signal, without gradients.

    Args:
        audio: Tensor or NumPy array of floating-point samples, ``(..., time)``.
        audiogram: An audiogram, the name of a standard one (``"N3"``), eight thresholds in dB HL, a
            mapping of frequencies in Hz to thresholds, a ``Listener`` for ``(..., 2, time)``, or
            a sequence with one ear per item.
        sample_rate: Sample rate in Hz, 16000 (default) to 48000.
        compensator: ``"nalr"``, ``"nalrp"``, ``"wdrc"`` or ``"camfit"``, or the name or folder
            of a checkpoint, such as ``"hearing-aid"``.
        full_scale_spl: Level in dB SPL of a signal whose RMS is 1.0, by default 94, so that samples
            are in pascals.

    Returns:
        The output of the aid, of the type of ``audio`` and time-aligned with it. Its shape is that
        of ``audio``; for a sequence of ears and one signal, ``(time,)``, there is one output per
        ear, ``(ears, time)``, and an aid with several microphones returns ``(..., 2, time)`` for
        ``(..., microphones, 2, time)``. It is as loud as the ear needs: turn the volume down before
        you play it.

    Raises:
        ValueError: The audio, the ear, the rate, the level or the compensator is not valid.

    Example:
        >>> import hlsim
        >>> output = hlsim.compensate(hlsim.example_speech(), "N3")
        >>> output.shape
        torch.Size([64320])
    """
    aid = load_compensator(compensator, sample_rate=sample_rate, full_scale_spl=full_scale_spl)
    with torch.no_grad():
        return as_type_of(audio, aid(_as_finite_tensor(audio), audiogram))


def listen(
    *,
    sample_rate: int = NEURO_RATE,
    full_scale_spl: float = PASCAL_SPL,
    **signals: Tensor | NDArray[Any],
) -> Player:
    """Show a player in a notebook that switches between signals at the same position.

    All signals have the same gain, so that a sound that the ear perceives as soft is soft here. The
    volume starts at half. The player needs the extra ``eval``.

    Args:
        sample_rate: Sample rate in Hz of all signals, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal whose RMS is 1.0, 0 to 200.
        signals: Signals by the label to show, in which an underscore becomes a space, ``(time,)``,
            or ``(2, time)`` in stereo, left first. Their lengths may differ.

    Returns:
        A player that a notebook displays; its ``save`` method writes a page for a browser.

    Raises:
        ValueError: There is no signal, all signals are silent, one has another shape, no samples,
            whole numbers, or a sample that is NaN, infinite or above 1e9 in magnitude, or the
            sample rate or the level is not valid.
        MissingExtraError: matplotlib or Pillow is not installed.

    Example:
        >>> import hlsim
        >>> speech = hlsim.example_speech()
        >>> hlsim.listen(original=speech, louder=10.0 * speech)
        Player(original 65 dB SPL, louder 85 dB SPL)
    """
    if not signals:
        raise ValueError("no signal to play; pass signals by name, as in listen(original=speech)")
    gain = gain_to_pascals(full_scale_spl)
    pascals = {}
    for label, signal in signals.items():
        tensor = as_samples(signal).detach().cpu()
        if tensor.ndim != 1 and tensor.shape[:-1] != (2,):
            raise ValueError(
                f"expected shape (time,) or (2, time), got {tuple(tensor.shape)} for {label!r}; "
                "pass one item, such as x[0]"
            )
        check_finite(check_waveform(tensor, repr(label)), repr(label))
        pascals[label.replace("_", " ")] = tensor * gain
    from hlsim.report.players import make_player

    return make_player({"": pascals}, check_rate(sample_rate))


def info() -> str:
    """Return versions of hlsim, Python, packages and others for a bug report, one per line.

    Among them are the operating system, CUDA and torch's number of threads.

    Example:
        >>> import hlsim
        >>> hlsim.info().startswith("hlsim")
        True
    """
    lines = []
    for package in _REPORTED_PACKAGES:
        try:
            lines.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            lines.append(f"{package} not installed")
    lines += [f"Python {platform.python_version()}", platform.platform()]
    cuda = torch.version.cuda if torch.cuda.is_available() else None
    lines.append(f"CUDA {cuda or 'not available'}")
    lines.append(f"{torch.get_num_threads()} threads")
    return "\n".join(lines)


def _as_finite_tensor(audio: Samples) -> Tensor:
    """Convert samples to a tensor, and reject NaN and infinity.

    Raises:
        ValueError: The samples are not those of a tensor or of an array of floating-point numbers,
            or one is NaN or infinite.
    """
    samples = as_samples(audio)
    check_finite(samples, "audio")
    return samples
