"""MSBG's filters as tensors, computed once per severity, length, type and device and held in a small cache."""

from collections import OrderedDict
from collections.abc import Callable
from threading import RLock
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hlsim.dsp.fft import edge
from hlsim.dsp.fir import block_points
from hlsim.msbg.ear import RATE, ear_filter, lowpass_filter
from hlsim.msbg.envelope import envelope_lowpass
from hlsim.msbg.filterbank import BANKS, gammatone_response
from hlsim.msbg.filtfilt_end import ending_response, ending_weights
from hlsim.msbg.multirate import Plan, as_tensor, make_plan, total_response
from hlsim.msbg.recruitment import threshold_weights
from hlsim.msbg.smearing import BROADENING, smeared_bins, smearing_matrix
from hlsim.torchtools import lasting


class Filters:
    """Filters of one type on one device. The cache is the process's, not a model's: nothing of it is stored or copied."""

    def __init__(self, dtype: torch.dtype, device: torch.device) -> None:
        self.dtype, self.device = dtype, device

    def get(self, kind: str, *key: Any) -> Any:
        """A filter by name and what it depends on: FFT lengths, severity."""
        whole = (kind, key, self.dtype, self.device)
        return _KNOWN.get(whole, lambda: _made(*whole))


class _Cache:
    """The filters asked for last, up to ``limit`` bytes of them: those of long signals take 5 MiB a second of signal."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._known: OrderedDict[Any, tuple[Any, int]] = OrderedDict()
        self._lock = RLock()  # modules may run in threads

    def get(self, key: Any, make: Callable[[], Any]) -> Any:
        with self._lock:
            if key in self._known:
                self._known.move_to_end(key)
            else:
                made = make()
                self._known[key] = made, _bytes(made)
                while len(self._known) > 1 and self.held > self.limit:
                    self._known.popitem(last=False)
            return self._known[key][0]

    @property
    def held(self) -> int:
        """Bytes of all."""
        return sum(size for _, size in self._known.values())


_KNOWN = _Cache(2**28)


def _bytes(made: Any) -> int:
    if isinstance(made, Tensor):
        return made.nbytes
    if isinstance(made, Plan):
        return made.lowpass.nbytes + sum(tier.response.nbytes for tier in made.tiers)
    raise AssertionError(type(made))


def _made(kind: str, key: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Any:
    with lasting():
        if kind == "plan":
            severity, points, step, highest = key
            return make_plan(severity, points, step, highest, dtype, device)
        return as_tensor(_array(kind, key), dtype, device)


def _array(kind: str, key: tuple[Any, ...]) -> np.ndarray[Any, Any]:
    match kind, *key:
        case "smearing", severity, step, highest:
            bins = smeared_bins(step, highest)
            return smearing_matrix(*BROADENING[severity])[:bins, :bins]
        case "thresholds", severity:
            return threshold_weights(BANKS[severity])
        case "total", severity, points, step:
            return total_response(severity, points, step)
        case "bank", severity, points:
            return gammatone_response(BANKS[severity], points)
        case "lowpass", severity, points:
            return envelope_lowpass(BANKS[severity], points)
        case "ending weights", severity:
            return ending_weights(BANKS[severity])
        case "ending response", severity, length:
            return ending_response(BANKS[severity], length)
        case "kept", severity, points, length:
            # the advance has nothing to bring in at the end, where the reference puts zeros
            kept = length - np.array(BANKS[severity].advances)[:, None]
            return (np.arange(points) < kept).astype(float)
        case "forward", points, bins, gain, rate:
            return gain * np.fft.rfft(ear_filter(), points)[:bins] * _end(points, bins, rate)
        case ("forward blocks",):
            return np.fft.rfft(ear_filter(), block_points())
        case "backward", points, delay, bins, gain, rate:
            response = np.fft.rfft(ear_filter(backward=True), points) * np.fft.rfft(lowpass_filter(), points)
            advance = np.exp(2j * np.pi * np.arange(bins) * delay / points)
            return gain * response[:bins] * advance * _end(points, bins, rate)
    raise AssertionError(kind)


def _end(points: int, bins: int, rate: int) -> np.ndarray[Any, Any] | float:
    """How the spectrum ends where a signal's rate is not the model's."""
    return edge(bins, RATE / points, min(rate, RATE) / 2) if rate != RATE else 1.0
