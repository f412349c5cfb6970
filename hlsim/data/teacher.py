"""The teacher: what an impaired ear hears of utterances of any length, time-aligned with what it was given."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audiogram import Audiogram
from hlsim.checks import check_choice, refuse_unknown
from hlsim.data.foreign import ForeignTeacher, load_teacher
from hlsim.metrics.reference import pyclarity_msbg
from hlsim.msbg import MSBG, estimate_delay
from hlsim.msbg.ear import MSBG_RATE

TEACHERS = ("msbg", "pyclarity")
Alignment = Literal["structural", "impulse", "none"]

Reference = Callable[[Tensor, Audiogram, int], Tensor] | ForeignTeacher
"""An aligned simulator of one item, as ``pyclarity_msbg``: signal, ear, rate -> signal; or anyone's of many."""

_FRAME = 64  # samples at 44.1 kHz from one frame of MSBG's smearing to the next
_BODY, _CONTEXT, _TAIL = 1.9, 0.3, 0.2  # s at least: of a block, heard before it, heard after it


class Teacher(nn.Module):
    """The exact MSBG, or another simulator, over whole utterances.

    MSBG forgets within tenths of a second, so that it is asked for blocks of one length: then its filters are made once,
    and memory does not grow with the utterances. Blocks start where frames of its smearing do; against the whole
    utterance at once the error is 1.4e-5 of the signal or less (8.4 s of speech, NH, N1, N3, N5, S3, 50 and 80 dB SPL).

    Args:
        sample_rate: Hz: 16000, 22050, 24000, 32000, 44100, 48000, and others whose grid of blocks is 4 s or less.
        alignment: ``structural``: by MSBG's own delay, to a fraction of a sample; ``impulse``: by the paper's method,
            whole samples, see ``estimate_delay``; ``none``: the delay stays in.
        reference: another simulator instead, asked for whole utterances.

    Raises:
        ValueError: an unknown alignment, MSBG's impulse method for another simulator, or a rate with a coarser grid.
    """

    def __init__(
        self,
        sample_rate: int,
        *,
        alignment: Alignment = "structural",
        reference: Reference | None = None,
    ) -> None:
        super().__init__()
        check_choice("alignment", alignment, Alignment)
        if isinstance(reference, ForeignTeacher) and alignment != "structural":
            raise ValueError(
                f"alignment {alignment!r} of {reference.name}; allowed: structural, for it is aligned"
            )
        self.sample_rate, self.alignment, self.reference = sample_rate, alignment, reference
        self.msbg = MSBG(
            sample_rate=sample_rate, aligned=alignment == "structural" or reference is not None
        )
        self.grid = check_grid(sample_rate)
        self.body = self.grid * math.ceil(_BODY * sample_rate / self.grid)
        self.context = self.grid * math.ceil(_CONTEXT * sample_rate / self.grid)
        self.tail = round(_TAIL * sample_rate)
        self._delays: dict[tuple[float, ...], int] = {}

    @torch.no_grad()
    def forward(self, signals: Tensor, thresholds: Tensor, *, blocks: bool = True) -> Tensor:
        """What each ear hears; without ``blocks`` in one piece, which is quicker where signals are always as long.

        Shape: (items, time) in pascals, (items, 8) dB HL -> (items, time).
        """
        if isinstance(self.reference, ForeignTeacher):
            return self.reference(signals, thresholds, self.sample_rate)
        if self.reference is not None:
            return torch.stack(
                [self._by_reference(*item) for item in zip(signals, thresholds, strict=True)]
            )
        time = signals.shape[-1]
        body, length = self.body, self.context + self.body + self.tail
        if not blocks:
            body, length = time, time + self.tail * (self.alignment == "impulse")
        delays = [self.delay(ear) for ear in thresholds]
        heard = torch.empty_like(signals)
        done = 0
        while done < time:
            start = max(0, done - self.context)
            piece = signals[:, start : start + length]
            block = self.msbg(functional.pad(piece, (0, length - piece.shape[-1])), thresholds)
            end = min(time, start + self.context + body)
            for item, delay in enumerate(delays):
                heard[item, done:end] = block[item, delay + done - start : delay + end - start]
            done = end
        return heard

    def delay(self, thresholds: Tensor) -> int:
        """Samples by which the simulator's output is advanced, beyond what it does itself."""
        if self.alignment != "impulse":
            return 0
        ear = tuple(thresholds.tolist())
        if ear not in self._delays:
            if len(self._delays) >= 1024:
                self._delays.clear()
            unaligned = MSBG(sample_rate=self.sample_rate, aligned=False)
            delay = estimate_delay(unaligned, Audiogram(ear))
            if self.reference is not None:  # it has been advanced by the structural delay
                delay -= round(
                    unaligned.delay(Audiogram(ear).severity) * self.sample_rate / MSBG_RATE
                )
            self._delays[ear] = delay
        return self._delays[ear]

    def _by_reference(self, signal: Tensor, thresholds: Tensor) -> Tensor:
        assert self.reference is not None and not isinstance(self.reference, ForeignTeacher)
        ear = Audiogram(tuple(thresholds.tolist()))
        heard = self.reference(signal.cpu(), ear, self.sample_rate).to(signal)
        delay = self.delay(thresholds)
        return functional.pad(heard, (-delay, delay))


def find_teacher(name: str) -> Reference | None:
    """The reference that a name means: None for ``msbg``, the exact one, ``pyclarity``'s, or ``package.module:name``.

    Raises ValueError where there is none."""
    if ":" not in name:
        refuse_unknown([name], (*TEACHERS, "package.module:name"), "teachers")
        return None if name == "msbg" else pyclarity_msbg
    return load_teacher(name)


def name_of(reference: Reference | None) -> str:
    """What tells targets of one teacher from those of another."""
    return "msbg" if reference is None else str(getattr(reference, "__name__", reference))


def check_grid(sample_rate: int) -> int:
    """Samples from one place where a frame of MSBG's smearing starts to the next that falls on a sample.

    Raises ValueError where these are too many for a teacher."""
    grid = _FRAME * sample_rate // math.gcd(_FRAME * sample_rate, MSBG_RATE)
    if grid > 4 * sample_rate:
        raise ValueError(
            f"sample rate {sample_rate} Hz for a teacher; allowed: 16000, 22050, 24000, 32000, 44100, 48000"
        )
    return grid
