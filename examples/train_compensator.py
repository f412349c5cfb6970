"""Train a network of your own for one ear.

    python examples/train_compensator.py SPEECH_DIR OUT.pt [EAR] [STEPS]

Any module that maps a waveform to a waveform can be trained. This one multiplies the output of
NAL-R by eight gains per frame, which are interpolated over frequency. Start from a prescription, as
it does: the loss has almost no gradient in a band that the ear does not perceive.
"""

import sys

import torch
from torch import Tensor, nn

from compensators import NALR
from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.data.clips import Clips
from hlsim.dsp.stft import STFT

SAMPLE_RATE = 16000
POWER_FLOOR = 1e-11
"""Power that is added before the logarithm, so that silence has finite features."""


class MyNetwork(nn.Module):
    """NAL-R, followed by eight gains per frame. Before training, the gains are 1."""

    def __init__(self) -> None:
        super().__init__()
        self.prescription = NALR(sample_rate=SAMPLE_RATE)
        self.stft = STFT(400, 400, 100)
        last_layer = nn.Conv1d(32, 8, 1)
        self.layers = nn.Sequential(
            nn.Conv1d(self.stft.frequencies, 32, 5, padding=2), nn.PReLU(), last_layer
        )
        nn.init.zeros_(last_layer.weight)
        nn.init.zeros_(last_layer.bias)

    def forward(self, waveform: Tensor, ear: Audiogram) -> Tensor:
        """Compensate the loss of an ear. Shape: (..., time) in pascals -> the same."""
        samples = waveform.shape[-1]
        prescribed = self.prescription(waveform.reshape(-1, samples), ear)
        spectrum = self.stft.analyse(prescribed)  # (items, frames, frequencies)
        features = (spectrum.abs().square() + POWER_FLOOR).log() / 4.0
        log_gains = self.layers(features.mT).mT  # (items, frames, 8)
        log_gains = nn.functional.interpolate(
            log_gains, self.stft.frequencies, mode="linear", align_corners=True
        )
        output = self.stft.synthesise(spectrum * log_gains.exp(), samples)
        return output.reshape(waveform.shape)


def main(folder: str, out: str, ear_name: str = "N3", steps: str = "200") -> None:
    torch.manual_seed(0)
    ear = Audiogram.standard(ear_name)
    network = MyNetwork()
    loss = HearingLossLoss(ear, sample_rate=SAMPLE_RATE)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    clips = Clips(folder, sample_rate=SAMPLE_RATE, seconds=1.0)
    generator = torch.Generator().manual_seed(0)
    for step in range(int(steps)):
        speech = clips.draw(4, generator)
        levels = 50.0 + 30.0 * torch.rand(4, generator=generator)  # dB SPL
        speech = set_level(speech, levels)
        value = loss(network(speech, ear), speech)
        optimiser.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        if step % 20 == 0 or step + 1 == int(steps):
            print(f"step {step}: loss {float(value.detach()):.3f}", flush=True)
    torch.save(network.state_dict(), out)


if __name__ == "__main__":
    main(*sys.argv[1:])
