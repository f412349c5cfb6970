"""Anyone's simulator as the teacher: found by ``package.module:name``, asked at its own rate, checked."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import os
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import set_level
from hlsim.checks import check_rate
from hlsim.dsp.resample import resample
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import reason_of

_LATEST = 2e-3  # s by which noise may be heard late or early


class ForeignTeacher:
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

    def __init__(self, simulator: Callable[[Tensor, Tensor], Tensor], name: str, digest: str) -> None:
        if not callable(simulator):
            raise ValueError(
                f"teacher {name} is {type(simulator).__name__}; allowed: a callable (waveform, audiogram) -> waveform"
            )
        self.simulator, self.name, self.digest = simulator, name, digest
        if isinstance(simulator, nn.Module):
            simulator.eval()
        try:
            self.sample_rate = check_rate(getattr(simulator, "sample_rate", NEURO_RATE))
        except ValueError as error:
            raise ValueError(f"teacher {name}: {error}") from error
        self._refuse_late()

    def __str__(self) -> str:
        return f"{self.name} (sha256 {self.digest[:12]})"

    def __reduce__(self) -> Any:
        return load_teacher, (self.name,)  # another process finds it as this one did

    @torch.no_grad()
    def __call__(self, signals: Tensor, thresholds: Tensor, sample_rate: int) -> Tensor:
        """What each ear hears. Shape: (items, time) in pascals, (items, 8) dB HL -> (items, time).

        Raises ValueError where it fails, or what it returns is no waveform like the one that it was given."""
        given = resample(signals, sample_rate, self.sample_rate)
        if isinstance(self.simulator, nn.Module):
            self.simulator.to(given.device)
        try:
            heard = self.simulator(given, thresholds)
        except Exception as error:  # whatever somebody's code raises is to be one line, and say where
            place = inspect.getinnerframes(error.__traceback__)[-1] if error.__traceback__ else None
            where = f" ({Path(place.filename).name}, line {place.lineno})" if place else ""
            raise ValueError(f"teacher {self.name}: {reason_of(error)}{where}") from error
        if not isinstance(heard, Tensor) or heard.is_complex() or heard.shape != given.shape:
            shape = f"shape {tuple(heard.shape)}" if isinstance(heard, Tensor) else type(heard).__name__
            kind = f"complex {shape}" if isinstance(heard, Tensor) and heard.is_complex() else shape
            raise ValueError(
                f"teacher {self.name} made {kind} of {tuple(given.shape)}; allowed: a real tensor of the same shape"
            )
        if not bool(heard.isfinite().all()):
            raise ValueError(f"teacher {self.name} made NaN or infinity; allowed: finite samples")
        return resample(heard.to(signals), self.sample_rate, sample_rate)[..., : signals.shape[-1]]

    def _refuse_late(self) -> None:
        rate = self.sample_rate
        noise = torch.randn(1, rate // 2, generator=torch.Generator().manual_seed(0))
        noise = set_level(noise, 65.0)
        heard = self(noise, torch.zeros(1, len(FREQUENCIES)), rate)
        spectra = (torch.fft.rfft(functional.pad(signal, (0, rate // 2))) for signal in (heard, noise))
        late = int(torch.fft.irfft(next(spectra) * next(spectra).conj()).abs().argmax())
        late -= rate if late > rate // 2 else 0
        if abs(late) > _LATEST * rate:
            raise ValueError(
                f"teacher {self.name} delays by {1000 * late / rate:.1f} ms; allowed: time-aligned with its input"
            )


@lru_cache(maxsize=8)  # for each process, that what it has opened for a teacher is found again
def load_teacher(name: str) -> ForeignTeacher:
    """The teacher ``package.module:name``, with the working directory on the import path, as ``python -m`` has it.

    A class is called without arguments. Its digest is of the source of module and class, and of a module's weights; not
    of what else it imports or reads.

    Raises:
        ValueError: the module cannot be imported or has no such name, or as ``ForeignTeacher``.
    """
    module_name, _, attribute = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        module = importlib.import_module(module_name)
        found = getattr(module, attribute)
        simulator = found() if isinstance(found, type) else found
    except Exception as error:
        raise ValueError(f"teacher {name}: cannot be had ({reason_of(error)})") from error
    digest = hashlib.sha256()
    kind = simulator if inspect.isroutine(simulator) else type(simulator)
    for path in sorted({*_sources(module), *_sources(kind)}):
        digest.update(Path(path).read_bytes())
    if isinstance(simulator, nn.Module):
        for key, tensor in simulator.state_dict().items():
            digest.update(key.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return ForeignTeacher(simulator, name, digest.hexdigest())


def _sources(thing: Any) -> list[str]:
    try:
        path = inspect.getsourcefile(thing)
    except TypeError:  # built in
        return []
    return [path] if path and Path(path).is_file() else []
