"""The paper's impulse method for the delay of a simulator."""

import torch
from torch import nn

from hlsim.audiogram import Audiogram
from hlsim.audiogram.thresholds import AudiogramLike


def estimate_delay(
    simulator: nn.Module, audiogram: AudiogramLike | None = None, *, level: float = 94.0
) -> int:
    """Delay in samples by a unit impulse: where the output's largest magnitude lies after the impulse.

    The impulse stands in the middle of a second of silence (Section III-A of the paper). What comes back depends on ear
    and level, for the sum of MSBG's channels is dispersive: 1078 with no loss and 1237 to 1271 with one at 44.1 kHz. To
    align signals use ``MSBG.delay``, which does not.

    Args:
        simulator: one with ``sample_rate`` and ``full_scale_spl``; give ``MSBG(..., aligned=False)``, for the aligned
            ones have no delay left.
        audiogram: the ear; by default the simulator's own, or 0 dB HL.
        level: of the impulse's peak, in dB SPL of a steady signal of that RMS.

    Raises:
        ValueError: the simulator has no rate, or more than one ear is given.
    """
    rate, full_scale = (
        getattr(simulator, "sample_rate", None),
        getattr(simulator, "full_scale_spl", None),
    )
    if not isinstance(rate, int) or full_scale is None:
        raise ValueError(
            f"{type(simulator).__name__} has no sample_rate and full_scale_spl; allowed: hlsim's simulators"
        )
    if audiogram is None and getattr(simulator, "thresholds", None) is None:
        audiogram = Audiogram.standard("NH")
    place = rate // 2
    device = next((weights.device for weights in simulator.parameters()), None)
    impulse = torch.zeros(rate, device=device)
    impulse[place] = 10.0 ** ((level - float(full_scale)) / 20.0)
    with torch.no_grad():
        heard = simulator(impulse, audiogram)
    if (ears := heard.shape[:-1].numel()) != 1:
        raise ValueError(f"audiograms of {ears} ears; allowed: one")
    return int(heard.abs().argmax()) - place
