"""Train an aid in a loop of Hugging Face's accelerate.

The network, the optimiser and the loader are prepared. The loss is only moved to the device.
"""

import torch
from accelerate import Accelerator
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level


def main(steps: int = 20) -> nn.Module:
    accelerator = Accelerator()
    aid = nn.Conv1d(1, 1, 65, padding=32)
    speech = set_level(torch.randn(8, 1, 8000), 65.0)  # (items, 1, time), in pascals
    loader = DataLoader(TensorDataset(speech), batch_size=4)
    aid, optimiser, loader = accelerator.prepare(
        aid, torch.optim.Adam(aid.parameters(), lr=1e-3), loader
    )
    # The loss has no parameters and no checkpoint, so there is nothing to prepare.
    loss = HearingLossLoss(Audiogram.standard("N3")).to(accelerator.device)
    for step in range(steps):
        for (clean,) in loader:
            with accelerator.autocast():
                value = loss(aid(clean), clean)
            optimiser.zero_grad()
            accelerator.backward(value)
            optimiser.step()
        accelerator.print(f"step {step}: {value.item():.3f}")
    unwrapped: nn.Module = accelerator.unwrap_model(aid)
    return unwrapped


if __name__ == "__main__":
    main()
