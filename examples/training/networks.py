"""Train one of four networks through the default loss, and compare it with NAL-R.

    python examples/training/networks.py TRAIN_SPEECH VALID_SPEECH NETWORK [--ear N3]

The networks are ``gru-mask``, ``conv-mask``, ``waveform`` and ``conv-tasnet``. Before training, all
but the last leave their input unchanged. It prints a row of a table: HASPI at 65 dB SPL, for clean
speech and at 5 dB SNR in noise with the spectrum of the speech, each unaided, with NAL-R, with the
network, with the network at the output level of NAL-R, and with NAL-R at the output level of the
network. Then, for clean speech, HASQI, the output level, and the correlation with the clean speech,
with the best gain in each band and without.
"""

import argparse
import sys
from collections.abc import Callable
from itertools import pairwise

import torch
from conv_tasnet import conv_tasnet
from filter_bank import SAMPLE_RATE
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
    """A network that computes gains for 257 frequencies from their levels in frames of 32 ms.

    Args:
        layers: Layers from features of shape (items, 257, frames) to logarithms of gains of the
            same shape. The last one is set to zero, so that all gains are 1 before training.
    """

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.stft = STFT(512, 512, 128)
        self.layers = nn.Sequential(*layers)
        set_to_zero(layers[-1])

    def forward(self, waveform: Tensor) -> Tensor:
        """Apply the gains. Shape: (items, time) -> (items, time)."""
        spectrum = self.stft.analyse(waveform)
        features = (spectrum.abs().square() + 1e-10).log().mT / 4.0
        gains = self.layers(features).mT.exp()
        return self.stft.synthesise(spectrum * gains, waveform.shape[-1])


class GRULayer(nn.GRU):
    """A recurrent layer with channels before time: (items, 257, frames) -> (items, 128, frames)."""

    def __init__(self) -> None:
        super().__init__(257, 128, batch_first=True)

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features.mT)[0].mT


class Waveform(nn.Module):
    """Three convolutions of 65 samples and 32 channels, whose output is added to the waveform."""

    def __init__(self) -> None:
        super().__init__()
        first = nn.Conv1d(1, 32, 65, padding=32)
        second = nn.Conv1d(32, 32, 65, padding=32)
        last = set_to_zero(nn.Conv1d(32, 1, 65, padding=32))
        self.layers = nn.Sequential(first, nn.PReLU(), second, nn.PReLU(), last)

    def forward(self, waveform: Tensor) -> Tensor:
        """Add the output of the convolutions. Shape: (items, time) -> (items, time)."""
        return waveform + self.layers(waveform.unsqueeze(1)).squeeze(1)


def gru_mask() -> Mask:
    """Build a mask of a recurrent and a linear layer."""
    return Mask(GRULayer(), nn.Conv1d(128, 257, 1))


def conv_mask() -> Mask:
    """Build a mask of three convolutions over time."""
    first = nn.Conv1d(257, 64, 3, padding=1)
    second = nn.Conv1d(64, 64, 3, padding=1)
    return Mask(first, nn.PReLU(), second, nn.PReLU(), nn.Conv1d(64, 257, 3, padding=1))


def set_to_zero(layer: nn.Module) -> nn.Module:
    """Set all parameters of a layer to zero, and return the layer."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def without_channels(network: nn.Module) -> nn.Module:
    """Turn a network for (items, 1, time) into one for (items, time)."""
    return nn.Sequential(nn.Unflatten(-1, (1, -1)), network, nn.Flatten(1))


NETWORKS: dict[str, tuple[Callable[[], nn.Module], float, tuple[float, float]]] = {
    "gru-mask": (gru_mask, 3e-3, (50.0, 80.0)),
    "conv-mask": (conv_mask, 1e-3, (50.0, 80.0)),
    "waveform": (Waveform, 1e-3, (50.0, 80.0)),
    "conv-tasnet": (lambda: without_channels(conv_tasnet()), 3e-3, (65.0, 65.0)),
}
"""For each network a function that builds it, a learning rate, and a range of levels in dB SPL."""


def train_network(options: argparse.Namespace, loss: nn.Module) -> nn.Module:
    """Train the chosen network on 4 clips of 1 s per step."""
    torch.manual_seed(options.seed)
    build, rate, (softest, loudest) = NETWORKS[options.network]
    network = build()
    optimiser = torch.optim.Adam(network.parameters(), lr=options.rate or rate)
    generator = torch.Generator().manual_seed(options.seed)
    clips = Clips(options.train, sample_rate=SAMPLE_RATE, seconds=1.0)
    norms = []
    for step in range(1, options.steps + 1):
        speech = clips.draw(4, generator)
        levels = softest + (loudest - softest) * torch.rand(4, generator=generator)
        speech = set_level(speech, levels)
        network_input = speech
        if options.noisy:
            noise = draw_speech_shaped_noise(speech, generator)
            network_input = mix(speech, noise, 10.0 * torch.rand(4, generator=generator))
        value = loss(network(network_input), speech)
        optimiser.zero_grad()
        value.backward()
        norms.append(float(nn.utils.clip_grad_norm_(network.parameters(), options.clip)))
        optimiser.step()
        if step % 20 == 0 or step == options.steps:
            last_norms = torch.tensor(norms[-20:])
            text = (
                f"step {step}: {value.item():.3f}, norm of the gradient {last_norms.median():.2f}, "
                f"largest {last_norms.max():.1f}"
            )
            print(text, file=sys.stderr, flush=True)
    return network


def draw_speech_shaped_noise(speech: Tensor, generator: torch.Generator) -> Tensor:
    """Draw noise with the mean spectrum of the items. Shape: (items, time) -> (items, time)."""
    noise = torch.fft.rfft(torch.randn(speech.shape, generator=generator))
    magnitude = torch.fft.rfft(speech).abs().square().mean(0).sqrt()
    return torch.fft.irfft(magnitude * noise, speech.shape[-1])


def correlation(output: Tensor, clean: Tensor, *, best_gains: bool) -> float:
    """Compute the mean correlation of output and clean speech over the items.

    Args:
        output: Output of an aid with shape (items, time).
        clean: Clean speech with shape (items, time).
        best_gains: Whether each of 24 bands of the output is multiplied by the gain, of either
            sign, that brings it closest to the clean speech.
    """
    output_spectrum = torch.fft.rfft(output.double())
    clean_spectrum = torch.fft.rfft(clean.double())
    hz = torch.fft.rfftfreq(clean.shape[-1], 1.0 / SAMPLE_RATE).double()
    bands = [(hz >= low) & (hz < high) for low, high in pairwise(torch.as_tensor(band_edges()))]

    def sum_bands(values: Tensor) -> Tensor:
        return torch.stack([values[:, band].sum(-1) for band in bands], -1)

    product = sum_bands((output_spectrum * clean_spectrum.conj()).real)
    output_power = sum_bands(output_spectrum.abs().square())
    clean_power = sum_bands(clean_spectrum.abs().square())
    gains = torch.ones_like(product)
    if best_gains:
        gains = product / output_power.clamp_min(1e-30)
    amplified_power = (gains.square() * output_power).sum(-1)
    correlations = (gains * product).sum(-1) / (amplified_power * clean_power.sum(-1)).sqrt()
    return float(correlations.mean())


@torch.no_grad()
def make_cells(network: nn.Module, ear: Audiogram, speech: Tensor, noise: Tensor) -> list[str]:
    """Compute the cells of the table's row.

    Args:
        network: Trained network.
        ear: Ear that wears the aid.
        speech: Clean speech with shape (items, time).
        noise: Noise with shape (items, time).
    """
    nalr = NALR(ear)
    clean = set_level(speech, 65.0)
    noisy = clean + set_level(noise, 60.0)
    cells = []
    for signal in (clean, noisy):
        output = network(signal)
        prescribed = nalr(signal)
        output_level = level_spl(output)
        prescribed_level = level_spl(prescribed)
        versions = (
            signal,
            prescribed,
            output,
            set_level(output, prescribed_level),
            set_level(prescribed, output_level),
        )
        cells += [f"{float(haspi(version, clean, ear).mean()):.3f}" for version in versions]
    output = network(clean)
    return [
        *cells,
        f"{float(hasqi(output, clean, ear).mean()):.3f}",
        f"{float(level_spl(output).mean()):.1f}",
        f"{correlation(output, clean, best_gains=True):.2f}",
        f"{correlation(output, clean, best_gains=False):.2f}",
    ]


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
        "--clip", type=float, default=float("inf"), help="largest norm of the gradient"
    )
    parser.add_argument("--noisy", action="store_true", help="train in noise at 0 to 10 dB SNR")
    parser.add_argument(
        "--items", type=int, default=12, help="number of clips of 2 s that are scored"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    ear, generator = Audiogram.standard(options.ear), torch.Generator().manual_seed(0)
    speech = Clips(options.valid, sample_rate=SAMPLE_RATE, seconds=2.0).draw(
        options.items, generator
    )
    noise = draw_speech_shaped_noise(speech, generator)
    network = train_network(options, HearingLossLoss(ear, criterion=options.criterion)).eval()
    print(f"| {options.network} | {' | '.join(make_cells(network, ear, speech, noise))} |")


if __name__ == "__main__":
    main()
