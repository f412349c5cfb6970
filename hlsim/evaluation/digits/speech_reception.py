"""The speech reception threshold of an ear, without and with an aid.

The test is that of Smits et al. (2004): triplets of digits in steady noise with the spectrum of the
digits, of which the listener must recognise all three. The noise has a fixed level. The threshold
is the signal-to-noise ratio at which half of the triplets are understood.

The signal-to-noise ratios are constant stimuli (ISO 8253-3) in three rounds: a fifth of the
triplets over the whole range, then twice two fifths around the threshold so far.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from compensators import load_compensator
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.scale import PTA_FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike, as_thresholds
from hlsim.calibration import NEURO_RATE, PASCAL_SPL
from hlsim.checkpoint import DIGIT_LISTENER
from hlsim.checks import (
    check_attributes,
    check_finite,
    check_number,
    check_seed,
    check_shape,
    loud_outputs,
)
from hlsim.evaluation.digits.material import Triplets, draw_triplets, perceive, present
from hlsim.evaluation.digits.people import people_threshold
from hlsim.evaluation.digits.psychometric import (
    HIGHEST_SNR,
    LOWEST_SNR,
    Array,
    Estimate,
    estimate_threshold,
    subtract,
)
from hlsim.evaluation.digits.recogniser import DigitListener, load_listener
from hlsim.simulators import EXACT, load_simulator
from hlsim.torchtools import map_on_cores, one_thread

NOISE_SPL = 65.0
"""Level of the noise in dB SPL by default."""

TRIPLETS = 120
"""Number of triplets per ear and condition by default."""

_PTA = [FREQUENCIES.index(hz) for hz in PTA_FREQUENCIES]
"""Indices of the frequencies of the pure-tone average."""

_ROUND_ENDS = (0.2, 0.6)
"""Shares of the triplets that are presented before the second and before the third round."""

_AROUND_DB = 4.0
"""Largest distance in dB from the latest estimate of the threshold, in the last two rounds."""

_AIDED_AT_ONCE = 8
"""Number of triplets that an aid gets at once, fixed because networks round by the batch size."""

_PERCEIVED_AT_ONCE = 4
"""Number of triplets that a core simulates and recognises at once, whatever the number of cores."""

AidFunction = Callable[..., Tensor]
"""Function of signals in pascals at 16 kHz, (items, time), and one ear, (8,) in dB HL.

It returns the outputs of the aid, (items, time). With ``DigitTest``, the signals may be those of
several microphones, (items, ..., time).
"""


@dataclass(frozen=True)
class ReceptionThreshold:
    """Speech reception thresholds in noise. The lower a threshold, the better.

    The values of an ``Estimate`` are numbers for one ear, and arrays for several ears. A threshold
    above 32 dB is infinite, with its interval; ``benefit`` is then infinite or NaN.

    Attributes:
        unaided: Threshold without an aid, as signal-to-noise ratio in dB.
        aided: Threshold with the aid, or None without an aid.
        benefit: Unaided minus aided threshold in dB, or None without an aid. Its interval counts
            the errors of both thresholds as independent, although both come from the same triplets.
        pta: Pure-tone average in dB HL, the mean threshold at 500, 1000, 2000 and 4000 Hz.
        people: Unaided threshold of people with this mean loss, and the range of 95 % of them, in
            noise of 65 dB SPL, whatever the level of the noise in the test was. The simulated
            listener differs from them (docs/digits.md).

    >>> import hlsim
    >>> result = hlsim.reception_threshold("N2", simulator="attenuation", triplets=30)
    >>> result.aided is None
    True
    """

    unaided: Estimate
    aided: Estimate | None
    benefit: Estimate | None
    pta: Any
    people: Estimate


@dataclass(frozen=True)
class DigitTest:
    """Digits-in-noise test of simulated ears, with the same triplets for all ears and aids.

    Attributes:
        material: Triplets of digits with their noises.
        simulator: Simulator of the hearing loss.
        listener: Network that recognises the digits in what an ear perceives.
        noise_spl: Level of the noise in dB SPL.

    >>> test = DigitTest.draw(30, simulator="attenuation")
    >>> bool(test.measure(torch.zeros(8)).value < test.measure(torch.full((8,), 60.0)).value)
    True
    """

    material: Triplets
    simulator: nn.Module
    listener: DigitListener
    noise_spl: float

    @classmethod
    def draw(
        cls,
        triplets: int = TRIPLETS,
        *,
        simulator: str | Path | nn.Module = EXACT,
        listener: str | Path = DIGIT_LISTENER,
        noise_spl: float = NOISE_SPL,
        seed: int = 0,
    ) -> DigitTest:
        """Draw the triplets of a test, and load its simulator and its listener.

        Args:
            triplets, simulator, listener, noise_spl, seed: See ``reception_threshold``.

        Raises:
            ValueError: There is no such simulator or listener, or a number is out of range.
        """
        check_number("noise_spl", noise_spl, 40.0, 90.0)
        check_number("triplets", triplets, 30, 3000, whole=True)
        check_seed(seed)
        return cls(
            draw_triplets(triplets, torch.Generator().manual_seed(seed)),
            load_simulator(simulator),
            load_listener(listener),
            noise_spl,
        )

    @torch.inference_mode()
    @loud_outputs()
    def measure(
        self, ear: Tensor, aid: AidFunction | None = None, *, aid_in_threads: bool = False
    ) -> Estimate:
        """Measure the speech reception threshold of one ear, in dB.

        Args:
            ear: Hearing thresholds at the eight frequencies in dB HL, (8,).
            aid: Function of signals and the ear, see ``AidFunction``; None for no aid.
            aid_in_threads: Whether several threads may call the aid at once.

        Returns:
            The threshold with its 95 % interval. All three are infinite above 32 dB.

        Raises:
            ValueError: The simulator rejects the ear, or the output of the aid is no floating-point
                tensor, has another shape, or is not finite.
        """
        count = len(self.material.digits)
        snr, right = np.zeros(count), np.zeros(count)
        centre = np.nan  # after the first round, the threshold so far
        ends = [round(share * count) for share in _ROUND_ENDS]
        for part in np.split(np.arange(count), ends):
            if part[0] == 0:
                levels = np.linspace(LOWEST_SNR, HIGHEST_SNR, len(part))
            else:
                levels = centre + np.linspace(-_AROUND_DB, _AROUND_DB, len(part))
            snr[part] = levels.clip(LOWEST_SNR, HIGHEST_SNR)
            right[part] = self._count_right(part, snr[part], ear, aid, aid_in_threads)
            finished = part[-1] + 1
            estimate = estimate_threshold(snr[:finished], right[:finished])
            centre = min(estimate.value, HIGHEST_SNR)
        return estimate

    def _count_right(
        self,
        part: NDArray[np.int64],
        snr: Array,
        ear: Tensor,
        aid: AidFunction | None,
        aid_in_threads: bool,
    ) -> Array:
        """Present some of the triplets, and count the digits of each that are recognised.

        Args:
            part: Indices of the triplets in ``material``, (triplets,).
            snr: Signal-to-noise ratio of each in dB, (triplets,).
            ear, aid, aid_in_threads: See ``measure``.

        Returns: Numbers of right digits, 0 to 3, (triplets,).
        """
        triplets = Triplets(*(values[part] for values in self.material))
        signals = present(triplets, torch.from_numpy(snr).float(), self.noise_spl)

        def recognise(portion: tuple[Tensor, Tensor]) -> Tensor:
            sounds, internal = portion
            return self.listener(perceive(sounds, ear, self.simulator, internal)).argmax(-1)

        # The portions do not depend on the number of cores, so that results do not, either.
        if aid is not None:
            call = partial(_call_aid, aid, ear)
            with one_thread() if not aid_in_threads else nullcontext():
                outputs = map_on_cores(call, signals.split(_AIDED_AT_ONCE), signals)
            signals = torch.cat(outputs)
        parts = (values.split(_PERCEIVED_AT_ONCE) for values in (signals, triplets.internal))
        answers = torch.cat(map_on_cores(recognise, [*zip(*parts, strict=True)], signals))
        return (answers == triplets.digits).sum(-1).double().numpy()


def _call_aid(aid: AidFunction, ear: Tensor, inputs: Tensor) -> Tensor:
    """Compute the outputs of an aid for some triplets, and validate them.

    Shape: (8,) in dB HL and (triplets, time), or (triplets, ..., time) for several microphones
        -> (triplets, time).

    Raises:
        ValueError: The outputs are no floating-point tensor of this shape, or are not finite.
    """
    outputs = check_shape(aid(inputs, ear), "aid", (len(inputs), inputs.shape[-1]))
    check_finite(outputs, "the output of the aid")
    return outputs


def reception_threshold(
    audiogram: AudiogramLike,
    aid: str | Path | AidFunction | None = None,
    *,
    simulator: str | Path | nn.Module = EXACT,
    listener: str | Path = DIGIT_LISTENER,
    noise_spl: float = NOISE_SPL,
    triplets: int = TRIPLETS,
    seed: int = 0,
    show: Callable[[int, int], None] = lambda done, total: None,
    **sliders: Any,
) -> ReceptionThreshold:
    """Measure the speech reception threshold in noise of simulated ears by a digit test.

    A small network recognises triplets of digits in what the simulated ear perceives. Its skill is
    not that of people, so compare thresholds with each other; those of people differ by a constant
    (docs/digits.md). Each ear is tested alone, on the CPU, and each one, without and with the aid,
    gets the same triplets and noises. The same call therefore returns the same bits.

    Args:
        audiogram: One or more ears. The results have their shape: numbers for one ear, (batch,) for
            a list of ears, (2,) for a ``Listener``, whose better ear has the lower threshold.
        aid: Name or folder of an aid, as in ``load_compensator``, or a function of signals in
            pascals at 16 kHz, (items, time), and one ear, (8,) in dB HL; None for no aid. A module
            is set to evaluation mode.
        simulator: Simulator of the hearing loss, as in ``load_simulator``.
        listener: Name of the shipped listener, or the folder of another one
            (examples/train_digit_listener.py).
        noise_spl: Level of the noise in dB SPL, 40 to 90.
        triplets: Number of triplets per ear, without and with the aid, 30 to 3000.
        seed: Seed of digits, voices and noises.
        show: Function that is called with the number of finished tests and the number of all tests,
            to show the progress.
        sliders: Further arguments with which the aid is called, such as ``noise_reduction=0.0``.

    Returns:
        Thresholds in dB with their 95 % intervals. A threshold above 32 dB is infinite.

    Raises:
        ValueError: An ear, an aid, a simulator, a listener or a number is not valid, there are
            sliders without an aid, the aid was built for another rate or level or has several
            microphones, or its output is no floating-point tensor, has another shape or is not
            finite.
        TypeError: The aid does not take one of the sliders.

    >>> import hlsim
    >>> result = hlsim.reception_threshold("N3", "nalr", simulator="attenuation", triplets=30)
    >>> bool(result.unaided.low < result.unaided.value < result.unaided.high)
    True
    """
    if sliders and aid is None:
        names = ", ".join(sliders)
        raise ValueError(f"{names} has no effect without an aid; pass one, such as 'hearing-aid'")
    thresholds = as_thresholds(audiogram)
    ears = thresholds.reshape(-1, len(FREQUENCIES)).to("cpu", torch.float32)
    aids: list[AidFunction | None] = [None]
    if aid is not None:
        function = load_compensator(aid) if isinstance(aid, str | Path) else aid
        check_attributes(function, "an aid", sample_rate=NEURO_RATE, full_scale_spl=PASCAL_SPL)
        if getattr(function, "takes_microphones", False):
            raise ValueError(
                "expected an aid with one microphone, because the test has one signal per ear; "
                "choose another aid"
            )
        if isinstance(function, nn.Module):
            function.eval()
        aids.append(partial(function, **sliders))
    test = DigitTest.draw(
        triplets, simulator=simulator, listener=listener, noise_spl=noise_spl, seed=seed
    )
    total = len(aids) * len(ears)
    estimates: list[Estimate] = []
    shipped = isinstance(aid, str | Path)
    for tested_aid, ear in product(aids, ears):
        show(len(estimates), total)
        estimates.append(test.measure(ear, tested_aid, aid_in_threads=shipped))
    show(total, total)
    shape = thresholds.shape[:-1]
    values = np.array(estimates).T.reshape(len(Estimate._fields), len(aids), *shape)
    results = [Estimate(*values[:, number]) for number in range(len(aids))]
    unaided = results[0]
    aided = None if aid is None else results[1]
    benefit = None if aided is None else subtract(unaided, aided)
    pta = ears.double()[:, _PTA].mean(-1).numpy().reshape(shape)[()]
    return ReceptionThreshold(unaided, aided, benefit, pta, people_threshold(pta))
