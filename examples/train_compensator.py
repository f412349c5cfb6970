"""Your own network, trained for one ear: python examples/train_compensator.py SPEECH_DIR OUT.pt [EAR] [STEPS]

Any module that takes a waveform will do. This one corrects NAL-R by eight gains a frame, smooth over frequency. Start
from a prescription, as it does: a band that the ear does not hear has almost no gradient.
"""

import sys

import torch
from torch import Tensor, nn

from compensators import NALR
from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.dsp.stft import STFT
from hlsim.training.clips import Clips

RATE = 16000


class MyNetwork(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.prescription, self.stft = NALR(sample_rate=RATE), STFT(400, 400, 100)
        frequencies, gains = self.stft.frequencies, nn.Conv1d(32, 8, 1)
        self.layers = nn.Sequential(nn.Conv1d(frequencies, 32, 5, padding=2), nn.PReLU(), gains)
        nn.init.zeros_(gains.weight)  # the prescription is where it starts
        nn.init.zeros_(gains.bias)

    def forward(self, waveform: Tensor, ear: Audiogram) -> Tensor:
        batch = waveform.reshape(-1, waveform.shape[-1])  # (items, time)
        spectrum = self.stft.analyse(self.prescription(batch, ear))  # (items, frames, frequencies)
        gains = self.layers(
            (spectrum.abs().square() + 1e-11).log().mT / 4.0
        ).mT  # (items, frames, 8)
        gains = nn.functional.interpolate(
            gains, self.stft.frequencies, mode="linear", align_corners=True
        )
        return self.stft.synthesise(spectrum * gains.exp(), waveform.shape[-1]).reshape(
            waveform.shape
        )


def main(folder: str, out: str, ear_name: str = "N3", steps: str = "200") -> None:
    torch.manual_seed(0)
    ear, network = Audiogram.standard(ear_name), MyNetwork()
    loss = HearingLossLoss(ear, sample_rate=RATE)  # frozen; simulator="msbg" is the exact one
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    clips, generator = (
        Clips(folder, sample_rate=RATE, seconds=1.0),
        torch.Generator().manual_seed(0),
    )
    for step in range(int(steps)):
        # in pascals: RMS 1.0 is 94 dB SPL, and levels matter
        speech = set_level(
            clips.draw(4, generator), 50.0 + 30.0 * torch.rand(4, generator=generator)
        )
        value = loss(network(speech, ear), speech)
        optimiser.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)  # few steps have larger ones
        optimiser.step()
        if step % 20 == 0 or step + 1 == int(steps):
            print(f"step {step}: loss {float(value.detach()):.3f}", flush=True)
    torch.save(network.state_dict(), out)


if __name__ == "__main__":
    main(*sys.argv[1:])
