"""The limit that keeps a compensator's output safe for the ear."""

from torch import Tensor

_KNEE = 8.0


def soft_limit(waveform: Tensor, peak: float) -> Tensor:
    """Keep every sample within a peak: x / (1 + |x / peak|^8)^(1/8).

    Smooth, and nearly linear below half of the peak, where it takes off 0.004 dB at most.

    Shape: any -> the same, between -peak and peak.
    """
    bounded = waveform.clamp(-1e4 * peak, 1e4 * peak)  # whose eighth power float32 still holds
    return bounded * (1.0 + (bounded / peak).abs() ** _KNEE) ** (-1.0 / _KNEE)
