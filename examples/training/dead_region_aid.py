"""Train the aid of ``filter_bank.py`` for an ear with a dead region, through another simulator.

    python -m examples.training.dead_region_aid TRAIN_SPEECH VALID_SPEECH [SIMULATOR] [EAR] [STEPS]

SIMULATOR is the folder of a network that was trained with the teacher ``dead_region.py``, or
``neuro-msbg``; by default, it is ``DeadRegion`` itself. The printed levels are those that
``DeadRegion`` simulates at 65 dB SPL.
"""

import sys

import torch
from torch import Tensor, nn

from examples.training.dead_region import DeadRegion
from examples.training.filter_bank import SAMPLE_RATE, train_filter_bank
from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.data.clips import Clips

BANDS = {"under 1 kHz": (100, 1000), "1 to 2 kHz": (1000, 2000), "above 4 kHz": (4000, 8000)}
"""Lowest and highest frequency in Hz of the bands whose levels are printed."""


def make_loss(simulator: str, ear: Audiogram) -> HearingLossLoss:
    """Return the loss through a simulator by name or folder; by default through ``DeadRegion``."""
    if simulator == "neuro-msbg":
        return HearingLossLoss(ear)
    # The default normal ear is that of MSBG. DeadRegion changes nothing where there is no loss.
    return HearingLossLoss(ear, simulator=simulator or DeadRegion(), normal=nn.Identity())


def describe_levels(signal: Tensor, clean: Tensor) -> str:
    """Describe the level of each band relative to clean speech, averaged over the items."""
    hz = torch.fft.rfftfreq(clean.shape[-1], 1.0 / SAMPLE_RATE)
    signal_power = torch.fft.rfft(signal).abs().square()
    clean_power = torch.fft.rfft(clean).abs().square()
    texts = []
    for name, (low, high) in BANDS.items():
        is_inside = (hz >= low) & (hz < high)
        ratio = signal_power[:, is_inside].sum(-1) / clean_power[:, is_inside].sum(-1)
        texts.append(f"{float(10.0 * ratio.log10().mean()):+.1f} dB {name}")
    return ", ".join(texts)


@torch.no_grad()
def main(train: str, valid: str, simulator: str = "", name: str = "S2", steps: str = "350") -> None:
    ear = Audiogram.standard(name)
    clips = Clips(valid, sample_rate=SAMPLE_RATE, seconds=2.0)
    clean = set_level(clips.draw(8, torch.Generator().manual_seed(0)), 65.0)
    with torch.enable_grad():
        aid = train_filter_bank(train, make_loss(simulator, ear), int(steps))
    dead_region = DeadRegion()
    thresholds = torch.tensor(ear.thresholds)
    output = aid(clean)
    print(f"perceived without the aid: {describe_levels(dead_region(clean, thresholds), clean)}")
    print(f"perceived with the aid: {describe_levels(dead_region(output, thresholds), clean)}")
    print(f"gain of the aid: {describe_levels(output, clean)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
