"""MSBG's filters as tensors, computed once per severity, length, type and device and held in a small cache."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch

from hlsim.msbg.ear import ear_filter, lowpass_filter
from hlsim.msbg.ending import ending_response, ending_weights
from hlsim.msbg.filterbank import BANKS, gammatone_response
from hlsim.msbg.fourier import block_points
from hlsim.msbg.recruitment import envelope_lowpass
from hlsim.msbg.smearing import BROADENING, smearing_matrix
from hlsim.msbg.tiers import make_plan


class Filters:
    """Filters of one type on one device. The cache is the process's, not a model's: nothing of it is stored or copied."""

    def __init__(self, dtype: torch.dtype, device: torch.device) -> None:
        self.dtype, self.device = dtype, device

    def get(self, kind: str, *key: Any) -> Any:
        """A filter by name and what it depends on: FFT lengths, severity."""
        return _cached(kind, key, self.dtype, self.device)


@lru_cache(maxsize=48)
def _cached(kind: str, key: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Any:
    with torch.inference_mode(False):
        if kind == "plan":
            severity, points, step = key
            return make_plan(severity, points, step, dtype, device)
        array = _array(kind, key)
        wide = torch.complex128 if np.iscomplexobj(array) else torch.float64
        single = torch.complex64 if wide.is_complex else torch.float32
        narrow = wide if dtype == torch.float64 else single
        return torch.from_numpy(np.ascontiguousarray(array)).to(device=device, dtype=narrow)


def _array(kind: str, key: tuple[Any, ...]) -> np.ndarray[Any, Any]:
    match kind, *key:
        case "smearing", severity, step:
            half = 256 // step
            return smearing_matrix(*BROADENING[severity])[:half, :half]
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
        case "forward", points:
            return np.fft.rfft(ear_filter(), points)
        case ("forward blocks",):
            return np.fft.rfft(ear_filter(), block_points())
        case "backward", points, delay, bins:
            response = np.fft.rfft(ear_filter(backward=True), points) * np.fft.rfft(lowpass_filter(), points)
            advance = np.exp(2j * np.pi * np.arange(points // 2 + 1) * delay / points)
            return (response * advance)[:bins]
    raise AssertionError(kind)
