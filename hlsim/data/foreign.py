"""Anyone's simulator or enhancer: found by ``package.module:name``, asked at its own rate, checked."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import os
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audio import read_audio
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.listener import Listener
from hlsim.calibration import set_level
from hlsim.checks import check_rate
from hlsim.dsp.resample import resample
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import reason_of

_LATEST = 2e-3  # s by which a sound may come late or early
_SPEECH = Path(__file__).parent / "speech" / "valid" / "flite-rms-01.flac"


class _Foreign:
    """Somebody's callable that makes a waveform of a waveform, and what it is called in errors."""

    KIND, FORM = "teacher", "(waveform, audiogram) -> waveform"

    def __init__(self, call: Callable[..., Tensor], name: str, digest: str) -> None:
        if not callable(call):
            raise ValueError(
                f"{self.KIND} {name} is {type(call).__name__}; allowed: a callable {self.FORM}"
            )
        self.call, self.name, self.digest = call, name, digest
        self.who = f"{self.KIND} {name}"
        if isinstance(call, nn.Module):
            call.eval()

    def __str__(self) -> str:
        return f"{self.name} (sha256 {self.digest[:12]})"

    def _ask(self, given: Tensor, *more: Any) -> Tensor:
        """What it makes. Raises ValueError where it fails, or makes no waveform like the one that it was given."""
        if isinstance(self.call, nn.Module):
            self.call.to(given.device)
        try:
            made = self.call(given, *more)
        except (
            Exception
        ) as error:  # whatever somebody's code raises is to be one line, and say where
            place = inspect.getinnerframes(error.__traceback__)[-1] if error.__traceback__ else None
            where = f" ({Path(place.filename).name}, line {place.lineno})" if place else ""
            raise ValueError(f"{self.who}: {reason_of(error)}{where}") from error
        if not isinstance(made, Tensor) or made.is_complex() or made.shape != given.shape:
            shape = (
                f"shape {tuple(made.shape)}" if isinstance(made, Tensor) else type(made).__name__
            )
            kind = f"complex {shape}" if isinstance(made, Tensor) and made.is_complex() else shape
            raise ValueError(
                f"{self.who} made {kind} of {tuple(given.shape)}; allowed: a real tensor of the same shape"
            )
        if not bool(made.isfinite().all()):
            raise ValueError(f"{self.who} made NaN or infinity; allowed: finite samples")
        return made

    def _refuse_late(self, made: Tensor, given: Tensor, rate: int) -> None:
        """Shape: (time,) twice."""
        points = 2 * given.shape[-1]
        first, second = (torch.fft.rfft(signal.float(), points) for signal in (made, given))
        late = int(torch.fft.irfft(first * second.conj(), points).abs().argmax())
        late -= points if late > points // 2 else 0
        if abs(late) > _LATEST * rate:
            raise ValueError(
                f"{self.who} delays by {1000 * late / rate:.1f} ms; allowed: time-aligned with its input"
            )


class ForeignTeacher(_Foreign):
    """A simulator ``(waveform, audiogram) -> waveform`` that is not hlsim's.

    It is called without gradients with (items, time) in pascals and (items, 8) dB HL, -10 to 100, on the device that the
    batch is on, and returns what is heard: as long, finite, and time-aligned, for what is late cannot be learned and its
    SNR says nothing. Its own rate is its attribute ``sample_rate``, 16000 to 48000, or 16000 where it has none.

    Args:
        simulator: a callable; a module goes to eval mode and to the batch's device.
        name: what to call it, ``package.module:name``.
        digest: of what it is made of.

    Raises:
        ValueError: it is not callable, its rate is not allowed, or what it makes of half a second of noise at 65 dB SPL
            and an ear without a loss is no waveform, not as long, not finite, or late or early by more than 2 ms.
    """

    def __init__(
        self, simulator: Callable[[Tensor, Tensor], Tensor], name: str, digest: str
    ) -> None:
        super().__init__(simulator, name, digest)
        try:
            self.sample_rate = rate = check_rate(getattr(simulator, "sample_rate", NEURO_RATE))
        except ValueError as error:
            raise ValueError(f"{self.who}: {error}") from error
        noise = torch.randn(1, rate // 2, generator=torch.Generator().manual_seed(0))
        noise = set_level(noise, 65.0)
        self._refuse_late(self(noise, torch.zeros(1, len(FREQUENCIES)), rate)[0], noise[0], rate)

    def __reduce__(self) -> Any:
        return load_teacher, (self.name,)  # another process finds it as this one did

    @torch.no_grad()
    def __call__(self, signals: Tensor, thresholds: Tensor, sample_rate: int) -> Tensor:
        """What each ear hears. Shape: (items, time) in pascals, (items, 8) dB HL -> (items, time).

        Raises ValueError where it fails, or what it returns is no waveform like the one that it was given."""
        heard = self._ask(resample(signals, sample_rate, self.sample_rate), thresholds)
        return resample(heard.to(signals), self.sample_rate, sample_rate)[..., : signals.shape[-1]]


class ForeignEnhancer(_Foreign):
    """What takes noise off before an aid: ``(waveform, sample_rate) -> waveform``.

    It is called without gradients with (..., time) in pascals, where RMS 1.0 is 94 dB SPL, and the rate in Hz. What it
    returns is as long, finite, and time-aligned: what delays has to look ahead instead, which its latency then tells.

    Raises:
        ValueError: as ``ForeignTeacher``; late or early is told of speech at 65 dB SPL.
    """

    KIND, FORM = "enhancer", "(waveform, sample_rate) -> waveform"

    def __init__(self, enhancer: Callable[[Tensor, int], Tensor], name: str, digest: str) -> None:
        super().__init__(enhancer, name, digest)
        waveform, rate = read_audio(_SPEECH)
        speech = set_level(resample(waveform[0], rate, NEURO_RATE)[: 2 * NEURO_RATE], 65.0)
        self._refuse_late(self(speech, NEURO_RATE), speech, NEURO_RATE)

    def __reduce__(self) -> Any:
        return load_enhancer, (self.name,)

    @torch.no_grad()
    def __call__(self, waveform: Tensor, sample_rate: int) -> Tensor:
        """Shape: (..., time) -> (..., time). Raises ValueError as ``ForeignTeacher``."""
        return self._ask(waveform, sample_rate).to(waveform)


class ForeignAid(_Foreign):
    """Anyone's pair of aids: ``(waveform, listener, sample_rate) -> waveform``, of ``hlsim clarity``.

    It is called without gradients with (2, time) at the scene's rate and scale, left first, and a ``Listener``. What it
    returns is as long and finite; it may come late, for HASPI and HASQI align what they compare.
    """

    KIND, FORM = "aid", "(waveform, listener, sample_rate) -> waveform"

    def __reduce__(self) -> Any:
        return load_aid, (self.name,)

    @torch.no_grad()
    def __call__(self, waveform: Tensor, listener: Listener, sample_rate: int) -> Tensor:
        """Shape: (2, time) -> (2, time). Raises ValueError as ``ForeignTeacher``."""
        return self._ask(waveform, listener, sample_rate).to(waveform)


@lru_cache(maxsize=8)  # for each process, that what it has opened for a teacher is found again
def load_teacher(name: str) -> ForeignTeacher:
    """The teacher ``package.module:name``, with the working directory on the import path, as ``python -m`` has it.

    A class is called without arguments. Its digest is of the source of module and class, and of a module's weights; not
    of what else it imports or reads.

    Raises:
        ValueError: the module cannot be imported or has no such name, or as ``ForeignTeacher``.
    """
    return ForeignTeacher(*_found(name, ForeignTeacher.KIND))


@lru_cache(maxsize=8)
def load_enhancer(name: str) -> ForeignEnhancer:
    """The enhancer ``package.module:name``, found as ``load_teacher`` finds a teacher; ValueError too."""
    return ForeignEnhancer(*_found(name, ForeignEnhancer.KIND))


def load_enhancers(names: Sequence[str]) -> dict[str, ForeignEnhancer]:
    """Several, by what stands after the colon; ValueError where two are called alike."""
    loaded = {name.partition(":")[2]: load_enhancer(name) for name in names}
    if len(loaded) < len(names):
        raise ValueError(f"enhancers {', '.join(names)}; allowed: one a name after the colon")
    return loaded


@lru_cache(maxsize=8)
def load_aid(name: str) -> ForeignAid:
    """The pair of aids ``package.module:name``, found as ``load_teacher`` finds a teacher; ValueError too."""
    return ForeignAid(*_found(name, ForeignAid.KIND))


def _found(name: str, kind: str) -> tuple[Any, str, str]:
    """What a name means, its name, and its digest."""
    module_name, _, attribute = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        module = importlib.import_module(module_name)
        thing = getattr(module, attribute)
        made = thing() if isinstance(thing, type) else thing
    except Exception as error:
        raise ValueError(f"{kind} {name}: cannot be had ({reason_of(error)})") from error
    digest = hashlib.sha256()
    source = made if inspect.isroutine(made) else type(made)
    for path in sorted({*_sources(module), *_sources(source)}):
        digest.update(Path(path).read_bytes())
    if isinstance(made, nn.Module):
        for key, tensor in made.state_dict().items():
            digest.update(key.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return made, name, digest.hexdigest()


def _sources(thing: Any) -> list[str]:
    try:
        path = inspect.getsourcefile(thing)
    except TypeError:  # built in
        return []
    return [path] if path and Path(path).is_file() else []
