"""Four networks that change nothing at the start, or know nothing, through the default loss, judged beside NAL-R:

    python examples/training/networks.py TRAIN_SPEECH VALID_SPEECH {gru-mask,conv-mask,waveform,conv-tasnet} [--ear N3]

It prints a row: HASPI at 65 dB SPL, clean and in noise of the speech's spectrum at 5 dB SNR, each unaided, with NAL-R,
aided, aided at NAL-R's level and with NAL-R at the aided level; then, clean, HASQI, the level given, and the correlation
with the clean speech, each band at its best gain and as it is.
"""

import argparse
import sys
from collections.abc import Callable
from itertools import pairwise

import torch
from conv_tasnet import conv_tasnet
from filter_bank import RATE
from torch import Tensor, nn

from compensators import NALR
from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.stft import STFT
from hlsim.losses.band_levels import band_edges
from hlsim.metrics import haspi, hasqi
from hlsim.training.augment import mix
from hlsim.training.clips import Clips


class Mask(nn.Module):
    """A gain for each of 257 frequencies of 32 ms, from the logarithms of their magnitudes; at the start 1."""

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.stft, self.layers = STFT(512, 512, 128), nn.Sequential(*layers)
        from_zero(layers[-1])

    def forward(self, waveform: Tensor) -> Tensor:
        """Shape: (items, time) -> (items, time)."""
        spectrum = self.stft.analyse(waveform)
        features = (spectrum.abs().square() + 1e-10).log().mT / 4.0
        return self.stft.synthesise(spectrum * self.layers(features).mT.exp(), waveform.shape[-1])


class Recurrent(nn.GRU):
    """Shape: (items, 257, frames) -> (items, 128, frames)."""

    def __init__(self) -> None:
        super().__init__(257, 128, batch_first=True)

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features.mT)[0].mT


class Waveform(nn.Module):
    """Three convolutions of 65 samples and 32 channels, beside the waveform itself."""

    def __init__(self) -> None:
        super().__init__()
        first, second = nn.Conv1d(1, 32, 65, padding=32), nn.Conv1d(32, 32, 65, padding=32)
        last = from_zero(nn.Conv1d(32, 1, 65, padding=32))
        self.layers = nn.Sequential(first, nn.PReLU(), second, nn.PReLU(), last)

    def forward(self, waveform: Tensor) -> Tensor:
        """Shape: (items, time) -> (items, time)."""
        return waveform + self.layers(waveform.unsqueeze(1)).squeeze(1)


def gru_mask() -> Mask:
    return Mask(Recurrent(), nn.Conv1d(128, 257, 1))


def conv_mask() -> Mask:
    first, second = nn.Conv1d(257, 64, 3, padding=1), nn.Conv1d(64, 64, 3, padding=1)
    return Mask(first, nn.PReLU(), second, nn.PReLU(), nn.Conv1d(64, 257, 3, padding=1))


def from_zero(layer: nn.Module) -> nn.Module:
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def mono(network: nn.Module) -> nn.Module:
    """One that takes and gives channels. Shape of what comes of it: (items, time) -> (items, time)."""
    return nn.Sequential(nn.Unflatten(-1, (1, -1)), network, nn.Flatten(1))


# the network, Adam's learning rate, the levels of its training in dB SPL
NETWORKS: dict[str, tuple[Callable[[], nn.Module], float, tuple[float, float]]] = {
    "gru-mask": (gru_mask, 3e-3, (50.0, 80.0)),
    "conv-mask": (conv_mask, 1e-3, (50.0, 80.0)),
    "waveform": (Waveform, 1e-3, (50.0, 80.0)),
    "conv-tasnet": (lambda: mono(conv_tasnet()), 3e-3, (65.0, 65.0)),
}


def trained(options: argparse.Namespace, loss: nn.Module) -> nn.Module:
    """On 4 clips of 1 s a step."""
    torch.manual_seed(options.seed)
    build, rate, (softest, loudest) = NETWORKS[options.network]
    network = build()
    optimiser = torch.optim.Adam(network.parameters(), lr=options.rate or rate)
    generator = torch.Generator().manual_seed(options.seed)
    clips, norms = Clips(options.train, sample_rate=RATE, seconds=1.0), []
    for step in range(1, options.steps + 1):
        speech = clips.draw(4, generator)
        speech = set_level(
            speech, softest + (loudest - softest) * torch.rand(4, generator=generator)
        )
        given = speech
        if options.noisy:
            given = mix(speech, like(speech, generator), 10.0 * torch.rand(4, generator=generator))
        value = loss(network(given), speech)
        optimiser.zero_grad()
        value.backward()
        norms.append(float(nn.utils.clip_grad_norm_(network.parameters(), options.clip)))
        optimiser.step()
        if step % 20 == 0 or step == options.steps:
            last = torch.tensor(norms[-20:])
            text = f"step {step}: {value.item():.3f}, gradient's norm {last.median():.2f}, largest {last.max():.1f}"
            print(text, file=sys.stderr, flush=True)
    return network


def like(speech: Tensor, generator: torch.Generator) -> Tensor:
    """Noise of the spectrum that the items have on average. Shape: (items, time) -> the same."""
    noise = torch.fft.rfft(torch.randn(speech.shape, generator=generator))
    return torch.fft.irfft(
        torch.fft.rfft(speech).abs().square().mean(0).sqrt() * noise, speech.shape[-1]
    )


def correlation(processed: Tensor, clean: Tensor, *, best_gains: bool) -> float:
    """With the clean speech, of all items on average; each of 24 bands at its best gain, negative too, or as it is.

    Shape: (items, time) twice.
    """
    ours, theirs = torch.fft.rfft(processed.double()), torch.fft.rfft(clean.double())
    hz = torch.fft.rfftfreq(clean.shape[-1], 1.0 / RATE).double()
    products = (ours * theirs.conj()).real, ours.abs().square(), theirs.abs().square()
    edges = torch.as_tensor(band_edges())
    bands = [(hz >= low) & (hz < high) for low, high in pairwise(edges)]
    both, own, other = (
        torch.stack([one[:, band].sum(-1) for band in bands], -1) for one in products
    )
    gains = both / own.clamp_min(1e-30) if best_gains else torch.ones_like(own)
    together = (gains * both).sum(-1) / ((gains.square() * own).sum(-1) * other.sum(-1)).sqrt()
    return float(together.mean())


@torch.no_grad()
def judged(network: nn.Module, ear: Audiogram, speech: Tensor, noise: Tensor) -> list[str]:
    """Cells of the row. Shape: (items, time) twice."""
    clean, nalr, cells = set_level(speech, 65.0), NALR(ear), []
    for given in (clean, clean + set_level(noise, 60.0)):
        aided, usual = network(given), nalr(given)
        levels = level_spl(aided), level_spl(usual)
        versions = given, usual, aided, set_level(aided, levels[1]), set_level(usual, levels[0])
        cells += [f"{float(haspi(version, clean, ear).mean()):.3f}" for version in versions]
        if given is clean:
            score, level = float(hasqi(aided, clean, ear).mean()), float(levels[0].mean())
            follows = (correlation(aided, clean, best_gains=best) for best in (True, False))
            last = [f"{score:.3f}", f"{level:.1f}", *(f"{one:.2f}" for one in follows)]
    return cells + last


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("train")
    parser.add_argument("valid")
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("--ear", default="N3")
    parser.add_argument("--criterion", default="coherent-bands")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--rate", type=float, help="Adam's learning rate")
    parser.add_argument(
        "--clip", type=float, default=float("inf"), help="the norm at which the gradient is clipped"
    )
    parser.add_argument(
        "--noisy", action="store_true", help="train in such noise too, at 0 to 10 dB SNR"
    )
    parser.add_argument("--items", type=int, default=12, help="clips of 2 s that are judged")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    ear, generator = Audiogram.standard(options.ear), torch.Generator().manual_seed(0)
    speech = Clips(options.valid, sample_rate=RATE, seconds=2.0).draw(options.items, generator)
    noise = like(speech, generator)
    network = trained(options, HearingLossLoss(ear, criterion=options.criterion)).eval()
    print(f"| {options.network} | {' | '.join(judged(network, ear, speech, noise))} |")


if __name__ == "__main__":
    main()
