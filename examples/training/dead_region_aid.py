"""The filter bank of `filter_bank.py`, trained through another simulator than MSBG, for an ear with a dead region:

    python -m examples.training.dead_region_aid TRAIN_SPEECH VALID_SPEECH [SIMULATOR] [EAR] [STEPS]

SIMULATOR is the folder of a network that learned `dead_region.py`, that file's own module by default, or neuro-msbg. What
is printed is heard by that module, at 65 dB SPL.
"""

import sys

import torch
from torch import Tensor, nn

from examples.training.dead_region import DeadRegion
from examples.training.filter_bank import RATE, trained
from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.training.clips import Clips

BANDS = {"under 1 kHz": (100, 1000), "1 to 2 kHz": (1000, 2000), "above 4 kHz": (4000, 8000)}


def loss_through(simulator: str, ear: Audiogram) -> HearingLossLoss:
    if simulator == "neuro-msbg":
        return HearingLossLoss(ear)
    # a network knows no normal ear but MSBG's; this simulator changes nothing where there is no loss
    return HearingLossLoss(ear, simulator=simulator or DeadRegion(), normal=nn.Identity())


def differences(signal: Tensor, clean: Tensor) -> str:
    """Level of each band in dB against the clean speech's, mean over the items."""
    hz = torch.fft.rfftfreq(clean.shape[-1], 1.0 / RATE)
    powers = [torch.fft.rfft(one).abs().square() for one in (signal, clean)]
    shown = []
    for name, (low, high) in BANDS.items():
        inside = (hz >= low) & (hz < high)
        first, second = (power[:, inside].sum(-1) for power in powers)
        shown.append(f"{float(10.0 * (first / second).log10().mean()):+.1f} dB {name}")
    return ", ".join(shown)


@torch.no_grad()
def main(train: str, valid: str, simulator: str = "", name: str = "S2", steps: str = "350") -> None:
    ear = Audiogram.standard(name)
    clean = set_level(
        Clips(valid, sample_rate=RATE, seconds=2.0).draw(8, torch.Generator().manual_seed(0)), 65.0
    )
    with torch.enable_grad():
        aid = trained(train, loss_through(simulator, ear), int(steps))
    exact, thresholds = DeadRegion(), torch.tensor(ear.thresholds)
    print(f"heard without the aid: {differences(exact(clean, thresholds), clean)}")
    print(f"heard with it: {differences(exact(aid(clean), thresholds), clean)}")
    print(f"its gain: {differences(aid(clean), clean)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
