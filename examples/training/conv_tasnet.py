"""Train torchaudio's ConvTasNet as an aid for one ear.

    python examples/training/conv_tasnet.py SPEECH_DIR OUT.pt [EAR] [STEPS]

ConvTasNet removes the level of its input, because each block has a global norm. It therefore cannot
learn compression: soft and loud speech get the same gain. Train it at one level, or change its
norms; docs/guide/your-own-network.md says how, and how many steps it requires.
"""

import sys

import torch
from torchaudio.models import ConvTasNet

from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.data.clips import Clips


def conv_tasnet() -> ConvTasNet:
    """Build a small ConvTasNet, whose input and output have the shape (items, 1, time)."""
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
    clips = Clips(folder, sample_rate=16000, seconds=seconds)
    generator = torch.Generator().manual_seed(0)
    for step in range(int(steps)):
        speech = set_level(clips.draw(4, generator), 65.0).unsqueeze(1)  # (items, 1, time)
        value = loss(network(speech), speech)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        if step % 20 == 0 or step + 1 == int(steps):
            print(f"step {step}: {value.item():.3f}", flush=True)
    torch.save(network.state_dict(), out)


if __name__ == "__main__":
    main(*sys.argv[1:])
