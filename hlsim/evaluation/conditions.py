"""Conditions of studies, each a way to process the input of an item, and their names.

They are: no aid; an equaliser with the mean gain of an aid; an aid at the output level of another
one; an aid for one or several microphones; an aid behind noise reduction; and an aid of your own.
The rival of an aid is the prescription with which it is compared, for all ears the same or by a
rule for the ear. A hearing aid is a function or module ``(waveform, ear) -> waveform``.
"""

import uuid
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
import scipy
import torch
from torch import Tensor, nn

from compensators.directional import DirectionalAid
from compensators.loading import load_compensator
from compensators.nalr import NALR, NALRP
from hlsim.audio import read_audio
from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.audiogram.prescription import PROFOUND_FROM
from hlsim.audiogram.scale import interpolate_over_log
from hlsim.calibration import NEURO_RATE, PASCAL_SPL, gain_to_pascals, level_spl, set_level
from hlsim.checks import check_choice
from hlsim.data.bundled import EXAMPLE_FILE
from hlsim.dsp.fir import filter_without_delay
from hlsim.evaluation.aid_properties import measure_gain_curve
from hlsim.metrics.band_levels import band_centres
from hlsim.plugins import WaveformPlugin
from hlsim.simulators import check_aligned

UNAIDED = "unaided"
"""Name of the condition without an aid."""

NAL_R = "NAL-R"
"""Name of the linear prescription NAL-R."""

Rival = Literal["nalr", "nalrp", "camfit", "for-ear"]
"""Prescription with which a compensator is compared at its level, see ``load_rival``."""

_RIVAL_NAMES = {"nalr": "NAL-R", "nalrp": "NAL-RP", "camfit": "CAMFIT"}
"""Names of prescriptions in tables."""

COMPRESSION = "WDRC"
"""Name of the prescription ``WDRC`` with its default settings."""

BEFORE, AFTER = "before", "after"
"""Names of recorded speech before and after a treatment."""

NAL_R_AT_LEVEL, TRAINED = "NAL-R, same level", "trained aid"
"""Names of two conditions of the demo: NAL-R at the level of the trained aid, and this aid."""

_EQUALISER_TAPS = 513
"""Number of taps of an equaliser, which gives it a resolution of 31 Hz at 16 kHz."""

_LOWEST_GAIN_DB = -100.0
"""Lowest gain of an equaliser in dB."""

_GAINS: dict[tuple[str, Audiogram], list[float]] = {}
"""Gains in dB of the 24 bands of each equaliser for each ear, by equaliser and ear.

In another process, each task of a study gets a new copy of the equaliser, so the gains are kept in
the process.
"""


class Unaided(nn.Module):
    """Condition without a hearing aid: the output is the input.

    >>> Unaided()(torch.ones(2), Audiogram.standard("N3"))
    tensor([1., 1.])
    """

    def forward(self, waveform: Tensor, ear: Any) -> Tensor:
        """Return the waveform as it is."""
        return waveform


class PrescriptionForEar(nn.Module):
    """The prescription for the degree of an ear's loss: NAL-RP if profound at 2 kHz, else NAL-R.

    The rule is that of Byrne, Parkinson and Newall 1990, who corrected NAL-R for ears with a
    threshold above 90 dB HL at 2 kHz. It is known before any output is scored, so that a comparison
    with it needs no correction for a choice.

    >>> PrescriptionForEar()(torch.ones(2), Audiogram.standard("NH")).round()
    tensor([1., 1.])
    """

    def __init__(self) -> None:
        super().__init__()
        self.usual, self.profound = NALR(sample_rate=NEURO_RATE), NALRP(sample_rate=NEURO_RATE)

    def is_measured(self, audiogram: Audiogram) -> bool:
        """Return whether the prescription for an ear is another one than NAL-R.

        ``measure_aids`` calls this method, and leaves out other ears, for which NAL-R is measured.
        """
        return is_profound(audiogram)

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Amplify a waveform at 16 kHz by the prescription for an ear.

        Shape: (time,) in pascals -> (time,).
        """
        aid = self.profound if is_profound(audiogram) else self.usual
        return aid(waveform, audiogram)


def is_profound(audiogram: Audiogram) -> bool:
    """Return whether the loss of an ear at 2 kHz is profound, above 90 dB HL.

    >>> is_profound(Audiogram.standard("N3"))
    False
    """
    return audiogram.thresholds[FREQUENCIES.index(2000.0)] > PROFOUND_FROM


def load_rival(rival: Rival, ears: Iterable[Audiogram]) -> tuple[str, nn.Module]:
    """Return the name in tables and the aid of a rival, with which compensators are compared.

    Args:
        rival: ``"nalr"``, ``"nalrp"``, ``"camfit"``, or ``"for-ear"`` for the prescription that
            ``PrescriptionForEar`` chooses for each ear. If it chooses NAL-R for all of them, NAL-R
            is returned, which is in the tables anyway.
        ears: All ears of the comparison.

    Raises:
        ValueError: There is no such rival.

    >>> load_rival("nalrp", [])[0]
    'NAL-RP'
    """
    check_choice("rival", rival, Rival)
    if rival == "for-ear" and any(is_profound(ear) for ear in ears):
        return "prescription for the ear", PrescriptionForEar()
    name = "nalr" if rival == "for-ear" else rival
    return _RIVAL_NAMES[name], load_compensator(name, sample_rate=NEURO_RATE)


class OnMicrophones(nn.Module):
    """Hearing aid of one ear for the signals of several microphones at one ear or at two.

    An aid with the attribute ``takes_microphones`` gets all signals, as (microphones, time) or
    (microphones, 2, time), and another aid that of the reference, the first microphone of the first
    ear. For two ears, the aid uses the one audiogram for both, and the output of the first ear is
    returned.

    A single signal, (time,), goes to the aid behind a directional front end, or else to all
    microphones of an aid.

    Args:
        aid: The aid.
        shape: Number of microphones, and number of ears.

    >>> OnMicrophones(Unaided(), (2, 1))(torch.eye(2).unsqueeze(1), Audiogram.standard("N3"))
    tensor([1., 0.])
    """

    def __init__(self, aid: nn.Module, shape: tuple[int, int]) -> None:
        super().__init__()
        self.aid, self.shape = aid, shape

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Return the output for the first ear, (microphones, ears, time) or (time,) -> (time,)."""
        is_single = waveform.ndim == 1
        if not takes_microphones(self.aid):
            return self.aid(waveform if is_single else waveform[0, 0], audiogram)
        if is_single and isinstance(self.aid, DirectionalAid):
            return self.aid.aid(waveform, audiogram)
        signals = waveform.expand(*self.shape, -1)
        output = self.aid(signals[:, 0] if self.shape[1] == 1 else signals, audiogram)
        return output[0] if self.shape[1] == 2 else output


def takes_microphones(aid: object) -> bool:
    """Return whether an aid takes several microphones: its attribute ``takes_microphones``, if any.

    >>> takes_microphones(Unaided())
    False
    """
    return bool(getattr(aid, "takes_microphones", False))


class AtLevelOf(nn.Module):
    """Hearing aid whose output is scaled to the RMS level of another aid's output.

    Both aids process the same input. HASPI rises with any gain, so a comparison at equal level
    shows what else an aid does.

    Args:
        aid: Aid whose output is returned.
        other: Aid whose output level is used.

    >>> AtLevelOf(Unaided(), Unaided())(torch.ones(2), Audiogram.standard("N3"))
    tensor([1., 1.])
    """

    def __init__(self, aid: nn.Module, other: nn.Module) -> None:
        super().__init__()
        self.aid, self.other = aid, other

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Return the output of ``aid`` at the RMS level of the output of ``other``.

        Both outputs are cut to the length of the waveform first, because a study scores no later
        sample.

        Shape: as for the aids, such as (..., time) -> (..., time).
        """
        time = waveform.shape[-1]
        level = level_spl(self.other(waveform.clone(), audiogram)[..., :time])
        return set_level(self.aid(waveform, audiogram)[..., :time], level)


class EqualiserLike(nn.Module):
    """Linear filter with the mean gain that a hearing aid has for speech, measured for each ear.

    Studies use it as a rival of the aid: if the aid has a higher score than this filter, the reason
    is not the aid's mean gain.

    Args:
        aid: The aid whose gain is measured.
        utterances: Speech at 16 kHz with which the gain is measured. Shape: (utterances, time).
        levels: Levels of the speech in dB SPL, over which the gain in dB is averaged.

    >>> equaliser = EqualiserLike(Unaided(), torch.randn(1, 16000), (65.0,))
    >>> max(equaliser.gains_db(Audiogram.standard("N3")))
    0.0
    """

    utterances: Tensor

    def __init__(self, aid: nn.Module, utterances: Tensor, levels: Sequence[float]) -> None:
        super().__init__()
        self.aid, self.levels = aid, tuple(levels)
        self.register_buffer("utterances", utterances, persistent=False)
        self._identifier = uuid.uuid4().hex  # the same in every process that receives a copy

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Filter a waveform at 16 kHz with the aid's mean gain for one ear, without delay.

        The gains for an ear are measured at its first call in a process. Later changes of the aid
        have no effect.

        Shape: (..., time) -> (..., time).
        """
        key = self._identifier, audiogram
        if key not in _GAINS:
            _GAINS[key] = self.gains_db(audiogram)
        return _equalise_bands(waveform, _GAINS[key])

    def gains_db(self, audiogram: Audiogram) -> list[float]:
        """Measure the aid's gain for an ear in the 24 bands of ``measure_gain_curve``, in dB.

        The gain of a band is the mean over ``levels``, at least -100 dB, rounded to 0.1 dB.

        Raises:
            ValueError: An output of the aid is not valid, see ``cut_output``.
        """
        curve = measure_gain_curve(self.aid, audiogram, self.utterances, self.levels)
        mean = np.mean(curve["gain_db"], 0).clip(_LOWEST_GAIN_DB, None)
        return [round(gain, 1) for gain in mean.tolist()]


def _equalise_bands(waveform: Tensor, gains_db: Sequence[float]) -> Tensor:
    """Filter a waveform at 16 kHz with linear phase and without delay.

    Gains in dB are interpolated over log frequency, and constant below and above the centres.

    Args:
        waveform: Signals. Shape: (..., time).
        gains_db: Gains in dB at the 24 frequencies of ``band_centres``.

    Returns: Filtered signals. Shape: (..., time).
    """
    hertz = np.linspace(0.0, NEURO_RATE / 2.0, _EQUALISER_TAPS)
    gains = interpolate_over_log(hertz, band_centres(), gains_db)
    taps = scipy.signal.firwin2(_EQUALISER_TAPS, hertz, 10.0 ** (gains / 20.0), fs=NEURO_RATE)
    return filter_without_delay(waveform, torch.from_numpy(taps).to(waveform))


class PluginAid(nn.Module):
    """Hearing aid for both ears that a user has written as a function, loaded by its name.

    Args:
        name: ``package.module:name`` or ``path/to/file.py:name`` of a function ``(waveform,
            listener, sample_rate) -> waveform``.
        sample_rate: Sample rate in Hz with which the function is called.

    Attributes:
        takes_microphones: Whether the function has this attribute, set to True. It then receives
            the signals of several microphones, with shape (microphones, 2, time).
        may_crash: True, because compiled code of the function may end the process.

    Raises:
        ValueError: The function cannot be loaded.

    >>> PluginAid("builtins:max", 16000)
    PluginAid()
    """

    may_crash = True

    def __init__(self, name: str, sample_rate: int) -> None:
        super().__init__()
        self.plugin = WaveformPlugin(name, "aid")
        self.sample_rate = sample_rate
        self.takes_microphones = takes_microphones(self.plugin.function)

    def forward(self, waveform: Tensor, listener: Any) -> Tensor:
        """Call the user's function, without a gradient.

        Args:
            waveform: Signals at the left and the right ear. Shape: (2, time), or (microphones, 2,
                time) if ``takes_microphones``.
            listener: Audiograms of both ears, an ``hlsim.Listener``.

        Returns:
            Outputs for both ears. Shape: (2, time), where ``time`` may differ from the input's.

        Raises:
            ValueError: The function fails, or its output is no floating-point tensor, has another
                shape or is not finite.
        """
        return self.plugin(waveform, listener, self.sample_rate)


class Enhanced(nn.Module):
    """Hearing aid behind an enhancer, which reduces the noise of the aid's input.

    Args:
        enhancer: Function ``(waveform, sample_rate) -> waveform`` for signals in pascals.
        aid: Aid that processes the enhanced signal.
        sample_rate: Sample rate of all signals in Hz.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0 in the inputs and outputs.

    Attributes:
        may_crash: True, because compiled code of the enhancer may end the process.
        takes_microphones: Whether the aid takes the signals of several microphones.

    >>> enhancer = WaveformPlugin("torch:mul", "enhancer")  # waveform * sample_rate
    >>> Enhanced(enhancer, Unaided())(torch.ones(2), Audiogram.standard("N3"))
    tensor([16000., 16000.])
    """

    may_crash = True

    def __init__(
        self,
        enhancer: WaveformPlugin,
        aid: nn.Module,
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
    ) -> None:
        super().__init__()
        self.enhancer, self.aid, self.sample_rate = enhancer, aid, sample_rate
        self.gain = gain_to_pascals(full_scale_spl)
        self.takes_microphones = takes_microphones(aid)

    def forward(self, waveform: Tensor, ear: Any) -> Tensor:
        """Enhance the waveform, and return the aid's output for the enhanced signal.

        Shape: as for the aid, such as (..., time) -> (..., time).

        Raises:
            ValueError: The enhancer fails, or its output is no floating-point tensor of the shape
                of the waveform, or is NaN or infinite.
        """
        enhanced = self.enhancer(waveform * self.gain, self.sample_rate) / self.gain
        return self.aid(enhanced, ear)


def load_enhancers(names: Sequence[str]) -> dict[str, WaveformPlugin]:
    """Load functions ``(waveform, sample_rate) -> waveform`` that reduce noise for hearing aids.

    They process signals in pascals with shape (..., time), at the sample rate of the study. Each is
    tried on two seconds of speech at 16 kHz.

    Args:
        names: ``package.module:name`` or ``path/to/file.py:name`` of each function.

    Returns:
        The enhancers, each under the part of its name after the colon, or under its whole name if
        an earlier enhancer has the same part.

    Raises:
        ValueError: An enhancer cannot be loaded, fails, or its output for speech has another shape,
            or is silent, not finite or not time-aligned.

    >>> load_enhancers([])
    {}
    """
    speech = set_level(read_audio(EXAMPLE_FILE)[0][0, : 2 * NEURO_RATE], 65.0)
    enhancers: dict[str, WaveformPlugin] = {}
    for name in names:
        enhancer = WaveformPlugin(name, "enhancer")
        check_aligned(enhancer, speech, NEURO_RATE, NEURO_RATE)
        label = name.rpartition(":")[2]
        enhancers[name if label in enhancers else label] = enhancer
    return enhancers
