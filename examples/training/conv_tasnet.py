"""torchaudio's ConvTasNet as an aid for one ear: python examples/training/conv_tasnet.py SPEECH_DIR OUT.pt [EAR] [STEPS]

ConvTasNet normalises its input's level away (a global norm in each block), so that it cannot learn compression: it gives
soft and loud speech the same gain. Train it at one level, or mend it: docs/guide/your-own-network.md, which also says
how many steps it needs.
"""

import sys

import torch
from torchaudio.models import ConvTasNet

from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.training.clips import Clips


def conv_tasnet() -> ConvTasNet:
    """Shape of what it takes and gives: (batch, 1, time)."""
    return ConvTasNet(
        num_sources=1,
        enc_num_feats=128,
        msk_num_feats=64,
        msk_num_hidden_feats=128,
        msk_num_layers=6,
    )


def main(folder: str, out: str, ear: str = "N3", steps: str = "500", seconds: float = 1.0) -> None:
    torch.manual_seed(0)
    network = conv_tasnet()
    loss = HearingLossLoss(Audiogram.standard(ear))
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    clips, generator = (
        Clips(folder, sample_rate=16000, seconds=seconds),
        torch.Generator().manual_seed(0),
    )
    for step in range(int(steps)):
        speech = set_level(clips.draw(4, generator), 65.0).unsqueeze(
            1
        )  # (batch, 1, time), in pascals
        value = loss(network(speech), speech)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        if step % 20 == 0 or step + 1 == int(steps):
            print(f"step {step}: {value.item():.3f}", flush=True)
    torch.save(network.state_dict(), out)


if __name__ == "__main__":
    main(*sys.argv[1:])
